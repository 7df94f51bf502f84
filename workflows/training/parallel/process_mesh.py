"""Where a process stands among those that learn together: a mesh of (data, band), as `torchrun` starts them.

Every process runs the same program. Along the data axis they look at different pictures; along the band axis they
share the optics of the same pictures by wavelength. What all of them compute alike (networks, optimisers, the state)
is not shared but kept alike: gradients are added up over all, and each takes the same step. One process alone is a
mesh of 1 x 1, which says nothing to anybody.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import nn


class MeshError(ValueError):
    """A mesh that does not fit the processes, the recipe or what the processes were given."""


@dataclass(frozen=True)
class Mesh:
    """One process of ``data`` x ``band``; those next to each other share the bands of the same pictures."""

    data: int = 1
    band: int = 1
    rank: int = 0
    group: Any = None  #: of torch.distributed: the processes with the same pictures

    @property
    def size(self) -> int:
        """How many processes there are."""
        return self.data * self.band

    @property
    def row(self) -> int:
        """Which of the groups that look at different pictures."""
        return self.rank // self.band

    @property
    def column(self) -> int:
        """Which of those that share the bands of the same pictures."""
        return self.rank % self.band

    @property
    def first(self) -> bool:
        """Whether this is the one process that writes."""
        return self.rank == 0

    def __str__(self) -> str:
        return f"{self.data}x{self.band}"

    # --- what all say to all --------------------------------------------------------------------------------------

    def wait(self) -> None:
        """Until all have come so far."""
        if self.size > 1:
            dist.barrier()

    def agree(self, about: str) -> None:
        """Raise MeshError unless all say the same."""
        if self.size == 1:
            return
        said: list[Any] = [None] * self.size
        dist.all_gather_object(said, about)
        for rank, other in enumerate(said):
            if other != said[0]:
                raise MeshError(f"process 0 is at {said[0]}, process {rank} at {other}: let all see the same folder")

    def numbers(self, found: Mapping[str, float], names: Sequence[str], device: str) -> dict[str, float]:
        """The sum of each of ``names`` over all; of one process, what it found."""
        if self.size == 1:
            return dict(found)
        total = torch.tensor([found.get(name, 0.0) for name in names], dtype=torch.float64, device=device)
        dist.all_reduce(total)
        return dict(zip(names, total.tolist(), strict=True))

    def add_gradients(self, parts: Iterable[nn.Module]) -> None:
        """Give all processes the sum of their gradients, in one message for each precision; none stays none."""
        if self.size == 1:
            return
        own = [p for part in parts for p in part.parameters()]
        for kind in dict.fromkeys(p.dtype for p in own):
            _add([p for p in own if p.dtype == kind])


def _add(own: Sequence[nn.Parameter]) -> None:
    """Behind the gradients stands how many processes had one: a parameter that none moves is not moved by zeros."""
    there = torch.tensor([float(p.grad is not None) for p in own]).to(own[0])
    grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in own]
    flat = torch.cat([*(g.reshape(-1) for g in grads), there])
    dist.all_reduce(flat)
    *sums, counts = torch.split(flat, [*(p.numel() for p in own), len(own)])
    for p, total, count in zip(own, sums, counts.tolist(), strict=True):
        p.grad = total.view_as(p).clone() if count else None


ALONE = Mesh()


def processes() -> tuple[int, int]:
    """This process's number and how many there are, as `torchrun` or whoever else starts them says."""
    return int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))


def shape_of(text: str, world: int) -> tuple[int, int]:
    """``4x2`` as numbers; nothing: all processes along the data axis. Raises MeshError where that is not ``world``."""
    if not text:
        return world, 1
    if not re.fullmatch(r"[1-9]\d*x[1-9]\d*", text):
        raise MeshError(f"--mesh {text}: write DATAxBAND, such as 4x2")
    data, band = map(int, text.split("x"))
    if data * band != world:
        start = f"torchrun --nproc-per-node {data * band} --no-python neusee train ..."
        there = "there is 1" if world == 1 else f"there are {world}"
        raise MeshError(f"--mesh {text} is for {data * band} processes and {there}: start {start}, or write {world}x1")
    return data, band


def device_here(device: str) -> str:
    """Of the devices of one machine, each process takes its own."""
    local = os.environ.get("LOCAL_RANK", "0")
    return f"cuda:{local}" if device == "cuda" and processes()[1] > 1 else device


@contextmanager
def joined(text: str, device: str) -> Iterator[Mesh]:
    """The mesh that ``--mesh`` names, for as long as the command runs; raises MeshError where there is none such."""
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
    yield Mesh(data, band, rank, groups[rank // band])
    dist.destroy_process_group()  # after an error all end, and nobody waits for the others
