"""Messages between training processes with different spectral bands: the exchange of bands and of gradients.

Process r of m has the bands r, r + m, ... A message is linear in its tensors, and gradients return by the transposed
message, so that the derivatives of all processes add up to the derivative of the sum. Sums are added in the order of
the processes, so that every backend gives the same bits.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.distributed as dist
from torch import Tensor

from neusee.workflows.training.parallel.process_mesh import Mesh


def own_bands(mesh: Mesh, count: int) -> list[int]:
    """Return the indices of those spectral bands, out of ``count``, that this process computes."""
    return list(range(mesh.column, count, mesh.band))


def gathered(mesh: Mesh, x: Tensor, axis: int, count: int) -> Tensor:
    """Return a tensor with all spectral bands, gathered from the processes that computed them."""
    mine = _filled(x.detach().movedim(axis, 0), -(-count // mesh.band))
    return _woven(_from_each(mesh, mine), axis, count)


def gathered_back(mesh: Mesh, grad: Tensor, axis: int, count: int) -> Tensor:
    """Sum a gradient over all processes, and return the part for the spectral bands of this process."""
    total = _added(_exchanged(mesh, _unwoven(mesh, grad, axis, count)))
    return total[: len(own_bands(mesh, count))].movedim(0, axis)


class Bands:
    """An exchange in which each process sends its spectral bands of all pictures, and receives one complete picture."""

    def __init__(self, mesh: Mesh, axis: int, count: int) -> None:
        self.mesh, self.axis, self.count = mesh, axis, count

    def there(self, parts: Sequence[Tensor]) -> Tensor:
        """Send the spectral bands of picture j to process j, and return the picture of this process with all bands."""
        most = -(-self.count // self.mesh.band)
        sent = [_filled(x.detach().movedim(self.axis, 0), most) for x in parts]
        return _woven(_exchanged(self.mesh, _stacked(self.mesh, sent)), self.axis, self.count)

    def back(self, grad: Tensor) -> list[Tensor]:
        """Exchange the gradients of the pictures; return all gradients at the spectral bands of this process."""
        own = len(own_bands(self.mesh, self.count))
        each = _exchanged(self.mesh, _unwoven(self.mesh, grad, self.axis, self.count))
        return [x[:own].movedim(0, self.axis) for x in each]


class Sum:
    """An exchange in which each process sends a part of every picture, and receives the sum of parts of one picture."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh

    def there(self, parts: Sequence[Tensor]) -> Tensor:
        """Send a part of picture j to process j, and return the sum of all received parts of one picture."""
        return _added(_exchanged(self.mesh, _stacked(self.mesh, [x.detach() for x in parts])))

    def back(self, grad: Tensor) -> list[Tensor]:
        """Gather the gradients of all pictures; the gradient of a sum is also the gradient of each part."""
        return list(_from_each(self.mesh, grad.contiguous()))


def _filled(x: Tensor, most: int) -> Tensor:
    """Pad a tensor with zeros to ``most`` spectral bands."""
    return x.contiguous() if len(x) == most else torch.cat([x, x.new_zeros(most - len(x), *x.shape[1:])])


def _stacked(mesh: Mesh, parts: Sequence[Tensor]) -> Tensor:
    """Stack the tensors of all pictures of a batch, with zeros for each process without a picture."""
    return torch.stack([*parts, *(torch.zeros_like(parts[0]) for _ in range(mesh.band - len(parts)))])


def _woven(each: Tensor, axis: int, count: int) -> Tensor:
    """Reorder a tensor (process, bands of the process, ...) so that one axis has all bands in spectral order."""
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
    """Send tensor j of a stack to process j, and return the stack of the received tensors."""
    received = torch.empty_like(each)
    dist.all_to_all_single(received, each, group=mesh.group)
    return received


def _from_each(mesh: Mesh, x: Tensor) -> Tensor:
    """Return the stack of the tensors ``x`` of all processes, in the order of the processes."""
    received = x.new_empty(mesh.band, *x.shape)
    dist.all_gather(list(received.unbind()), x, group=mesh.group)
    return received
