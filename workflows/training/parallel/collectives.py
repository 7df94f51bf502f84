"""Bands and pictures change places: what the processes of a band axis send each other, and how gradients go back.

Process r of m holds bands r, r + m, ... A message is linear in what is sent, and the gradient goes back by its
transpose, so that the sum of what all processes differentiate is the derivative of the sum. Sums are taken in the
order of the processes, the same on every backend.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.distributed as dist
from torch import Tensor

from neusee.workflows.training.parallel.process_mesh import Mesh


def own_bands(mesh: Mesh, count: int) -> list[int]:
    """Which of ``count`` bands are this process's."""
    return list(range(mesh.column, count, mesh.band))


def gathered(mesh: Mesh, x: Tensor, axis: int, count: int) -> Tensor:
    """All bands, of which each process has its own."""
    mine = _filled(x.detach().movedim(axis, 0), -(-count // mesh.band))
    return _woven(_from_each(mesh, mine), axis, count)


def gathered_back(mesh: Mesh, grad: Tensor, axis: int, count: int) -> Tensor:
    """Of the gradients of all bands that each process has, the sum at its own bands."""
    found = _exchanged(mesh, _unwoven(mesh, grad, axis, count))
    return _added(found)[: len(own_bands(mesh, count))].movedim(0, axis)


class Bands:
    """Each process has its bands of every picture; each gets all bands of its own."""

    def __init__(self, mesh: Mesh, axis: int, count: int) -> None:
        self.mesh, self.axis, self.count = mesh, axis, count

    def there(self, parts: Sequence[Tensor]) -> Tensor:
        """Of picture j, process j of the axis gets all bands; what a process without a picture gets is nothing."""
        most = -(-self.count // self.mesh.band)
        sent = [_filled(x.detach().movedim(self.axis, 0), most) for x in parts]
        return _woven(_exchanged(self.mesh, _stacked(self.mesh, sent)), self.axis, self.count)

    def back(self, grad: Tensor) -> list[Tensor]:
        """Of each picture, the gradient at the own bands."""
        found = _exchanged(self.mesh, _unwoven(self.mesh, grad, self.axis, self.count))
        mine = len(own_bands(self.mesh, self.count))
        return [x[:mine].movedim(0, self.axis) for x in found]


class Sum:
    """Each process has its bands' share of every picture; each gets the sum of all shares of its own."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh

    def there(self, parts: Sequence[Tensor]) -> Tensor:
        """Of picture j, process j of the axis gets the sum."""
        return _added(_exchanged(self.mesh, _stacked(self.mesh, [x.detach() for x in parts])))

    def back(self, grad: Tensor) -> list[Tensor]:
        """Of each picture, the gradient of the sum is that of every share."""
        return list(_from_each(self.mesh, grad.contiguous()))


def _filled(x: Tensor, most: int) -> Tensor:
    """With zeros for the bands that another process has more."""
    return x.contiguous() if len(x) == most else torch.cat([x, x.new_zeros(most - len(x), *x.shape[1:])])


def _stacked(mesh: Mesh, parts: Sequence[Tensor]) -> Tensor:
    """One for each process; nothing for those that have no picture."""
    return torch.stack([*parts, *(torch.zeros_like(parts[0]) for _ in range(mesh.band - len(parts)))])


def _woven(each: Tensor, axis: int, count: int) -> Tensor:
    """(process, its bands, ...) in the order of the bands."""
    return each.transpose(0, 1).flatten(0, 1)[:count].movedim(0, axis).contiguous()


def _unwoven(mesh: Mesh, x: Tensor, axis: int, count: int) -> Tensor:
    most = -(-count // mesh.band)
    whole = _filled(x.movedim(axis, 0), most * mesh.band)
    return whole.reshape(most, mesh.band, *whole.shape[1:]).transpose(0, 1).contiguous()


def _added(each: Tensor) -> Tensor:
    total = each[0].clone()
    for one in each[1:]:
        total += one
    return total


def _exchanged(mesh: Mesh, each: Tensor) -> Tensor:
    """What every process sends to this one, for what this one sends to every."""
    found = torch.empty_like(each)
    dist.all_to_all_single(found, each, group=mesh.group)
    return found


def _from_each(mesh: Mesh, x: Tensor) -> Tensor:
    """What every process has of the same shape, one after another."""
    found = x.new_empty(mesh.band, *x.shape)
    dist.all_gather(list(found.unbind()), x, group=mesh.group)
    return found
