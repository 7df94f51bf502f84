"""Messages between the processes of a band axis, which exchange bands for pictures and return gradients.

Process r of m holds the bands r, r + m, ... A message is linear in its tensors, and gradients return by the transposed
message, so that the derivatives of all processes add up to the derivative of the sum. Sums are taken in the order of
the processes, which is the same on every backend.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.distributed as dist
from torch import Tensor

from neusee.workflows.training.parallel.process_mesh import Mesh


def own_bands(mesh: Mesh, count: int) -> list[int]:
    """Return the indices of the bands of this process among ``count`` bands."""
    return list(range(mesh.column, count, mesh.band))


def gathered(mesh: Mesh, x: Tensor, axis: int, count: int) -> Tensor:
    """Gather all bands of a tensor from the processes, each of which has its own bands."""
    mine = _filled(x.detach().movedim(axis, 0), -(-count // mesh.band))
    return _woven(_from_each(mesh, mine), axis, count)


def gathered_back(mesh: Mesh, grad: Tensor, axis: int, count: int) -> Tensor:
    """Add the gradients of all processes, and return the sum at the bands of this process."""
    total = _added(_exchanged(mesh, _unwoven(mesh, grad, axis, count)))
    return total[: len(own_bands(mesh, count))].movedim(0, axis)


class Bands:
    """An exchange in which a process sends its bands of every picture and receives all bands of its own picture."""

    def __init__(self, mesh: Mesh, axis: int, count: int) -> None:
        self.mesh, self.axis, self.count = mesh, axis, count

    def there(self, parts: Sequence[Tensor]) -> Tensor:
        """Send all bands of picture j to process j, and zeros to a process without a picture."""
        most = -(-self.count // self.mesh.band)
        sent = [_filled(x.detach().movedim(self.axis, 0), most) for x in parts]
        return _woven(_exchanged(self.mesh, _stacked(self.mesh, sent)), self.axis, self.count)

    def back(self, grad: Tensor) -> list[Tensor]:
        """Return the gradient of each picture at the bands of this process."""
        own = len(own_bands(self.mesh, self.count))
        each = _exchanged(self.mesh, _unwoven(self.mesh, grad, self.axis, self.count))
        return [x[:own].movedim(0, self.axis) for x in each]


class Sum:
    """A sum in which a process sends its part of every picture and receives the sum of all parts of its own picture."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh

    def there(self, parts: Sequence[Tensor]) -> Tensor:
        """Send the sum of the parts of picture j to process j."""
        return _added(_exchanged(self.mesh, _stacked(self.mesh, [x.detach() for x in parts])))

    def back(self, grad: Tensor) -> list[Tensor]:
        """Return the gradient of the sum of each picture, which is the gradient of every part."""
        return list(_from_each(self.mesh, grad.contiguous()))


def _filled(x: Tensor, most: int) -> Tensor:
    """Append zeros to a tensor until it has ``most`` bands."""
    return x.contiguous() if len(x) == most else torch.cat([x, x.new_zeros(most - len(x), *x.shape[1:])])


def _stacked(mesh: Mesh, parts: Sequence[Tensor]) -> Tensor:
    """Stack one tensor for each process, with zeros for a process without a picture."""
    return torch.stack([*parts, *(torch.zeros_like(parts[0]) for _ in range(mesh.band - len(parts)))])


def _woven(each: Tensor, axis: int, count: int) -> Tensor:
    """Return a tensor (process, bands of the process, ...) in the order of the bands."""
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
    """Send tensor j to process j, and return the tensors that all processes send to this process."""
    received = torch.empty_like(each)
    dist.all_to_all_single(received, each, group=mesh.group)
    return received


def _from_each(mesh: Mesh, x: Tensor) -> Tensor:
    """Return the tensors of all processes, which have equal shapes, stacked in the order of the processes."""
    received = x.new_empty(mesh.band, *x.shape)
    dist.all_gather(list(received.unbind()), x, group=mesh.group)
    return received
