"""The processes that `torchrun` starts for one training, and their messages."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

# --- process mesh ---------------------------------------------------------------------------------

# The processes that `torchrun` starts for one training, arranged in a mesh with the axes data and
# band.
#
# Processes along the data axis have different pictures. Processes along the band axis share the
# optics of the same pictures by wavelength. Gradients are added over all processes, so that
# networks, optimisers and state stay equal in all processes. A single process is a mesh of 1 x 1,
# which sends no messages.


class MeshError(ValueError):
    """Error for an argument ``--mesh`` that contradicts the number of processes, the recipe or
    another argument.
    """


@dataclass(frozen=True)
class Mesh:
    """The position of one training process in a mesh of ``data`` x ``band`` processes."""

    data: int = 1
    band: int = 1
    rank: int = 0
    #: the process group (torch.distributed) of the processes with the same pictures
    group: Any = None

    @property
    def size(self) -> int:
        """Return the number of processes in the mesh."""
        return self.data * self.band

    @property
    def row(self) -> int:
        """Return the index of this process along the data axis of the process mesh."""
        return self.rank // self.band

    @property
    def column(self) -> int:
        """Return the index of this process along the band axis of the process mesh."""
        return self.rank % self.band

    @property
    def first(self) -> bool:
        """Return True if this is process 0, the only process that writes files."""
        return self.rank == 0

    def __str__(self) -> str:
        return f"{self.data}x{self.band}"

    # --- messages among all -----------------------------------------------------------------------

    def wait(self) -> None:
        """Wait until all processes of the mesh have called this method."""
        if self.size > 1:
            dist.barrier()

    def agree(self, about: str) -> None:
        """Raise MeshError unless all processes pass the same text, which states folder, stage
        and iteration.
        """
        if self.size == 1:
            return
        texts: list[Any] = [None] * self.size
        dist.all_gather_object(texts, about)
        for rank, other in enumerate(texts):
            if other != texts[0]:
                raise MeshError(
                    f"process 0 is in {texts[0]}, process {rank} is in {other}: use one shared"
                    " folder"
                )

    def numbers(
        self, own: Mapping[str, float], names: Sequence[str], device: str
    ) -> dict[str, float]:
        """Sum the numbers with the given names, such as losses, over all processes, and return
        the sums by name.
        """
        if self.size == 1:
            return dict(own)
        total = torch.tensor(
            [own.get(name, 0.0) for name in names], dtype=torch.float64, device=device
        )
        dist.all_reduce(total)
        return dict(zip(names, total.tolist(), strict=True))

    def share_buffers(self, net: nn.Module) -> None:
        """Copy the buffers of a network, such as the running means of a batch norm, from the
        first process to all.
        """
        if self.size > 1:
            for buffer in net.buffers():
                dist.broadcast(buffer, 0)

    def add_gradients(self, parts: Iterable[nn.Module]) -> None:
        """Replace the gradient of each module parameter by its sum over all processes."""
        if self.size == 1:
            return
        own: list[nn.Parameter] = []
        for module in parts:
            own += module.parameters()
        for kind in dict.fromkeys(p.dtype for p in own):
            _add([p for p in own if p.dtype == kind])


def _add(own: Sequence[nn.Parameter]) -> None:
    """Sum the gradients of parameters over all processes; a gradient that is None in every
    process stays None.
    """
    has_gradient = torch.tensor([float(p.grad is not None) for p in own]).to(own[0])
    grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in own]
    flat = torch.cat([*(g.reshape(-1) for g in grads), has_gradient])
    dist.all_reduce(flat)
    *sums, counts = torch.split(flat, [*(p.numel() for p in own), len(own)])
    for p, total, count in zip(own, sums, counts.tolist(), strict=True):
        p.grad = total.view_as(p).clone() if count else None


ALONE = Mesh()


def processes() -> tuple[int, int]:
    """Return index and number of the processes that `torchrun` started, from the variables RANK
    and WORLD_SIZE.
    """
    return int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))


def shape_of(text: str, world: int) -> tuple[int, int]:
    """Parse a process mesh such as ``4x2`` as (4, 2), or an empty text as (world, 1).

    Raises MeshError for a malformed text, or unless the product is ``world``, the number of
    processes.
    """
    if not text:
        return world, 1
    if not re.fullmatch(r"[1-9]\d*x[1-9]\d*", text):
        raise MeshError(f"--mesh {text}: write DATAxBAND, such as 4x2")
    data, band = map(int, text.split("x"))
    if data * band != world:
        start = f"torchrun --nproc-per-node {data * band} --no-python neusee train ..."
        processes = "there is 1" if world == 1 else f"there are {world}"
        raise MeshError(
            f"--mesh {text} is for {data * band} processes and {processes}: start {start}, or write"
            f" {world}x1"
        )
    return data, band


def device_here(device: str) -> str:
    """Return the name of this process's device, such as ``cuda:1`` for the second process on a
    machine.
    """
    local = os.environ.get("LOCAL_RANK", "0")
    return f"cuda:{local}" if device == "cuda" and processes()[1] > 1 else device


@contextmanager
def joined(text: str, device: str) -> Iterator[Mesh]:
    """Return a context in which this process belongs to the process mesh ``text``, the argument of
    ``--mesh``.

    Raises MeshError if the mesh contradicts the number of processes.
    """
    rank, world = processes()
    data, band = shape_of(text, world)
    if world == 1:
        yield ALONE
        return
    if device.startswith("cuda"):
        torch.cuda.set_device(device)
        dist.init_process_group("nccl", device_id=torch.device(device))
    else:
        dist.init_process_group("gloo")
    groups = [dist.new_group(list(range(row * band, (row + 1) * band))) for row in range(data)]
    mesh = Mesh(data, band, rank, groups[rank // band])
    yield mesh
    # threads of a group that is held would run on while Python shuts down
    object.__setattr__(mesh, "group", None)
    groups.clear()
    # not after an error, because this process would wait for processes that have ended
    dist.destroy_process_group()


# --- collectives ----------------------------------------------------------------------------------

# Messages between training processes with different spectral bands: the exchange of bands and of
# gradients.
#
# Process r of m has the bands r, r + m, ... A message is linear in its tensors, and gradients
# return by the transposed message, so that the derivatives of all processes add up to the
# derivative of the sum. Sums are added in the order of the processes, so that every backend gives
# the same bits.


def own_bands(mesh: Mesh, count: int) -> list[int]:
    """Return the indices of those spectral bands, out of ``count``, that this process computes."""
    return list(range(mesh.column, count, mesh.band))


def gathered(mesh: Mesh, x: Tensor, axis: int, count: int) -> Tensor:
    """Return a tensor with all spectral bands, gathered from the processes that computed them."""
    mine = _filled(x.detach().movedim(axis, 0), -(-count // mesh.band))
    return _woven(_from_each(mesh, mine), axis, count)


def gathered_back(mesh: Mesh, grad: Tensor, axis: int, count: int) -> Tensor:
    """Sum a gradient over all processes, and return the part for the spectral bands of this
    process.
    """
    total = _added(_exchanged(mesh, _unwoven(mesh, grad, axis, count)))
    return total[: len(own_bands(mesh, count))].movedim(0, axis)


class Bands:
    """An exchange in which each process sends its spectral bands of all pictures, and receives
    one complete picture.
    """

    def __init__(self, mesh: Mesh, axis: int, count: int) -> None:
        self.mesh, self.axis, self.count = mesh, axis, count

    def there(self, parts: Sequence[Tensor]) -> Tensor:
        """Send the spectral bands of picture j to process j, and return the picture of this
        process with all bands.
        """
        bands_each = -(-self.count // self.mesh.band)
        sent = [_filled(x.detach().movedim(self.axis, 0), bands_each) for x in parts]
        return _woven(_exchanged(self.mesh, _stacked(self.mesh, sent)), self.axis, self.count)

    def back(self, grad: Tensor) -> list[Tensor]:
        """Exchange the gradients of the pictures; return all gradients at the spectral bands of
        this process.
        """
        own = len(own_bands(self.mesh, self.count))
        received = _exchanged(self.mesh, _unwoven(self.mesh, grad, self.axis, self.count))
        return [x[:own].movedim(0, self.axis) for x in received]


class Sum:
    """An exchange in which each process sends a part of every picture, and receives the sum of
    parts of one picture.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh

    def there(self, parts: Sequence[Tensor]) -> Tensor:
        """Send a part of picture j to process j, and return the sum of all received parts of one
        picture.
        """
        return _added(_exchanged(self.mesh, _stacked(self.mesh, [x.detach() for x in parts])))

    def back(self, grad: Tensor) -> list[Tensor]:
        """Gather the gradients of all pictures; the gradient of a sum is also the gradient of
        each part.
        """
        return list(_from_each(self.mesh, grad.contiguous()))


def _filled(x: Tensor, count: int) -> Tensor:
    """Pad a tensor with zeros to ``count`` spectral bands."""
    return (
        x.contiguous()
        if len(x) == count
        else torch.cat([x, x.new_zeros(count - len(x), *x.shape[1:])])
    )


def _stacked(mesh: Mesh, parts: Sequence[Tensor]) -> Tensor:
    """Stack the tensors of all pictures of a batch, with zeros for each process without a
    picture.
    """
    return torch.stack(
        [*parts, *(torch.zeros_like(parts[0]) for _ in range(mesh.band - len(parts)))]
    )


def _woven(stack: Tensor, axis: int, count: int) -> Tensor:
    """Reorder a tensor (process, bands of the process, ...) so that one axis has all bands in
    spectral order.
    """
    return stack.transpose(0, 1).flatten(0, 1)[:count].movedim(0, axis).contiguous()


def _unwoven(mesh: Mesh, x: Tensor, axis: int, count: int) -> Tensor:
    bands_each = -(-count // mesh.band)
    padded = _filled(x.movedim(axis, 0), bands_each * mesh.band)
    return padded.reshape(bands_each, mesh.band, *padded.shape[1:]).transpose(0, 1).contiguous()


def _added(stack: Tensor) -> Tensor:
    total = stack[0].clone()
    for summand in stack[1:]:
        total += summand
    return total


def _exchanged(mesh: Mesh, stack: Tensor) -> Tensor:
    """Send tensor j of a stack to process j, and return the stack of the received tensors."""
    received = torch.empty_like(stack)
    dist.all_to_all_single(received, stack, group=mesh.group)
    return received


def _from_each(mesh: Mesh, x: Tensor) -> Tensor:
    """Return the stack of the tensors ``x`` of all processes, in the order of the processes."""
    received = x.new_empty(mesh.band, *x.shape)
    dist.all_gather(list(received.unbind()), x, group=mesh.group)
    return received
