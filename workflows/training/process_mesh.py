"""The processes that `torchrun` starts for one training, and their communication."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import nn

# The processes that `torchrun` starts for one training.
#
# Every process has its own pictures. Gradients are summed over all processes, so that networks,
# optimisers and state stay equal. A single process does not communicate.


class MeshError(ValueError):
    """Error for several processes that contradict the recipe or each other."""


@dataclass(frozen=True)
class Mesh:
    """The rank of one training process among the ``size`` processes of its training."""

    size: int = 1
    rank: int = 0

    @property
    def first(self) -> bool:
        """Return True for process 0, the only process that writes files."""
        return self.rank == 0

    def __str__(self) -> str:
        return f"{self.size}x1"

    def wait(self) -> None:
        """Wait until all processes of the mesh have called this method."""
        if self.size > 1:
            dist.barrier()

    def agree(self, about: str) -> None:
        """Raise MeshError unless all processes pass the same text, with folder, stage and
        iteration.
        """
        if self.size == 1:
            return
        texts: list[Any] = [None] * self.size
        dist.all_gather_object(texts, about)
        for rank, text in enumerate(texts):
            if text != texts[0]:
                raise MeshError(
                    f"process 0 is in {texts[0]}, process {rank} is in {text}: use one shared"
                    " folder"
                )

    def numbers(
        self, own: Mapping[str, float], names: Sequence[str], device: str
    ) -> dict[str, float]:
        """Return the sums over all processes of the numbers with the given ``names``, such as
        losses.
        """
        if self.size == 1:
            return dict(own)
        total = torch.tensor(
            [own.get(name, 0.0) for name in names], dtype=torch.float64, device=device
        )
        dist.all_reduce(total)
        return dict(zip(names, total.tolist(), strict=True))

    def share_buffers(self, net: nn.Module) -> None:
        """Copy the buffers of a network, such as running means of batch norm, from process 0 to all
        others.
        """
        if self.size > 1:
            for buffer in net.buffers():
                dist.broadcast(buffer, 0)

    def add_gradients(self, parts: Iterable[nn.Module]) -> None:
        """Replace the gradient of each parameter by its sum over all processes."""
        if self.size == 1:
            return
        parameters: list[nn.Parameter] = []
        for module in parts:
            parameters += module.parameters()
        for kind in dict.fromkeys(p.dtype for p in parameters):
            _add([p for p in parameters if p.dtype == kind])


def _add(own: Sequence[nn.Parameter]) -> None:
    """Sum the gradients of parameters over all processes; a gradient that is None everywhere stays
    None.
    """
    has_gradient = torch.tensor([float(p.grad is not None) for p in own]).to(own[0])
    grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in own]
    # one vector: all gradients, then a flag for each parameter
    all_numbers = torch.cat([*(g.reshape(-1) for g in grads), has_gradient])
    dist.all_reduce(all_numbers)
    *sums, counts = torch.split(all_numbers, [*(p.numel() for p in own), len(own)])
    for p, total, count in zip(own, sums, counts.tolist(), strict=True):
        p.grad = total.view_as(p).clone() if count else None


ALONE = Mesh()


def processes() -> tuple[int, int]:
    """Return rank and number of the processes started by `torchrun`, from the variables RANK and
    WORLD_SIZE.
    """
    return int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))


def device_here(device: str) -> str:
    """Return the device of this process, such as ``cuda:1`` for the second process on a machine."""
    local = os.environ.get("LOCAL_RANK", "0")
    return f"cuda:{local}" if device == "cuda" and processes()[1] > 1 else device


@contextmanager
def joined(device: str) -> Iterator[Mesh]:
    """Context in which this process belongs to the process group of `torchrun`; yields
    its `Mesh`.
    """
    rank, process_count = processes()
    if process_count == 1:
        yield ALONE
        return
    if device.startswith("cuda"):
        torch.cuda.set_device(device)
        dist.init_process_group("nccl", device_id=torch.device(device))
    else:
        dist.init_process_group("gloo")
    yield Mesh(process_count, rank)
    # not after an error, because it would wait for processes that have already ended
    dist.destroy_process_group()
