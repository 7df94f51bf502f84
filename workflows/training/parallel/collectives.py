"""Messages between the processes of a band axis: they exchange bands for pictures, and gradients return.

Process r of m holds the bands r, r + m, ... A message is linear in its tensors, and gradients return by its transpose,
so that the derivatives of all processes add up to the derivative of the sum. Sums are taken in the order of the
processes, which is the same on every backend.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.distributed as dist
from torch import Tensor

from neusee.workflows.training.parallel.process_mesh import Mesh


def own_bands(mesh: Mesh, count: int) -> list[int]:
    """Return the bands of this process among ``count``."""
    return list(range(mesh.column, count, mesh.band))


def gathered(mesh: Mesh, x: Tensor, axis: int, count: int) -> Tensor:
    """Gather all bands of a tensor of which each process has its own bands."""
    mine = _filled(x.detach().movedim(axis, 0), -(-count // mesh.band))
    return _woven(_from_each(mesh, mine), axis, count)


def gathered_back(mesh: Mesh, grad: Tensor, axis: int, count: int) -> Tensor:
    """Add the gradients of all processes, and return the sum at the bands of this process."""
    found = _exchanged(mesh, _unwoven(mesh, grad, axis, count))
    return _added(found)[: len(own_bands(mesh, count))].movedim(0, axis)


class Bands:
    """An exchange: a process gives its bands of every picture, and gets all bands of its own picture."""

    def __init__(self, mesh: Mesh, axis: int, count: int) -> None:
        self.mesh, self.axis, self.count = mesh, axis, count

    def there(self, parts: Sequence[Tensor]) -> Tensor:
        """Send all bands of picture j to process j; a process without a picture gets zeros."""
        most = -(-self.count // self.mesh.band)
        sent = [_filled(x.detach().movedim(self.axis, 0), most) for x in parts]
        return _woven(_exchanged(self.mesh, _stacked(self.mesh, sent)), self.axis, self.count)

    def back(self, grad: Tensor) -> list[Tensor]:
        """Return the gradient of each picture at the bands of this process."""
        found = _exchanged(self.mesh, _unwoven(self.mesh, grad, self.axis, self.count))
        mine = len(own_bands(self.mesh, self.count))
        return [x[:mine].movedim(0, self.axis) for x in found]


class Sum:
    """A sum: a process gives its share of every picture, and gets the sum of all shares of its own picture."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh

    def there(self, parts: Sequence[Tensor]) -> Tensor:
        """Send the sum of picture j to process j."""
        return _added(_exchanged(self.mesh, _stacked(self.mesh, [x.detach() for x in parts])))

    def back(self, grad: Tensor) -> list[Tensor]:
        """Return the gradient of each picture's sum, which is the gradient of every share."""
        return list(_from_each(self.mesh, grad.contiguous()))


def _filled(x: Tensor, most: int) -> Tensor:
    """Append zeros for the bands that another process has in addition."""
    return x.contiguous() if len(x) == most else torch.cat([x, x.new_zeros(most - len(x), *x.shape[1:])])


def _stacked(mesh: Mesh, parts: Sequence[Tensor]) -> Tensor:
    """Stack one tensor for each process, with zeros for processes without a picture."""
    return torch.stack([*parts, *(torch.zeros_like(parts[0]) for _ in range(mesh.band - len(parts)))])


def _woven(each: Tensor, axis: int, count: int) -> Tensor:
    """Bring (process, its bands, ...) into the order of the bands."""
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
    """Return what every process sends to this process, in exchange for what it sends to them."""
    found = torch.empty_like(each)
    dist.all_to_all_single(found, each, group=mesh.group)
    return found


def _from_each(mesh: Mesh, x: Tensor) -> Tensor:
    """Return the tensors of all processes, which have one shape, stacked in the order of the processes."""
    found = x.new_empty(mesh.band, *x.shape)
    dist.all_gather(list(found.unbind()), x, group=mesh.group)
    return found
