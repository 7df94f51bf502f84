"""Low-rank form of a spectral cube that is a matrix times a picture, with negative light clipped to 0.

Without the clipping, such a cube has as many principal components as the picture has channels, and these follow from
the products of the channels: the cube itself need not be analysed. The clipped light is measured on every pixel.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.spectra._principal_planes import bound_by_planes
from neusee.nodes.values import LowRankCube

_PIECE = 1 << 14  #: pixels of a block: 31 bands in float32 take 2 MB and stay in the cache
_SAMPLE = 1 << 14  #: pixels that tell beforehand whether the clipped light is within the error
_LEAST = 1e-5  #: least error that is tried: float32 alone leaves a few 1e-7


class _Axes(NamedTuple):
    """Orthonormal spectra of the unclipped cube, the strongest first, and what makes the planes from the picture."""

    basis: Tensor  #: (band, k) float64
    weights: Tensor  #: (k, channel) float64
    power: Tensor  #: (k,) mean square of each plane


def linear_planes(picture: Tensor, matrix: Tensor, within: float) -> LowRankCube | None:
    """Return the cube ``matrix @ picture``, clipped at 0, as its fewest components with an rms error of ``within``.

    Shapes: picture (channel, pixel) float32, matrix (band, channel) float64. The error is relative to the largest
    element. Return None where more components are needed than the picture has channels, or ``within`` is below 1e-5.
    """
    if picture.dtype != torch.float32 or within < _LEAST or not bool(torch.isfinite(picture.sum(1)).all()):
        return None
    axes = _axes(picture, matrix)
    some = matrix @ picture[:, :: max(1, picture.shape[1] // _SAMPLE)].double()
    target = within * float(some.amax())
    count = next((k for k in range(1, len(axes.power) + 1) if float(_omitted(axes, k).max()) <= target), 0)
    if not count or float(some.clamp_max(0).square().mean(1).max()) >= target**2:
        return None
    found = _measured(picture, matrix, axes, count)
    return found if float(found.residual_rms[-1].max()) <= within * float(found.residual_max[0].max()) else None


def _axes(picture: Tensor, matrix: Tensor) -> _Axes:
    gram = matrix.new_zeros(len(picture), len(picture))
    for at in range(0, picture.shape[1], _PIECE):
        x = picture[:, at : at + _PIECE].double()
        gram.addmm_(x, x.T)
    values, vectors = torch.linalg.eigh(gram / picture.shape[1])
    root = vectors * values.clamp_min(0).sqrt()  # root @ root.T is the mean product of the channels
    basis, strength, _ = torch.linalg.svd(matrix @ root, full_matrices=False)
    return _Axes(basis, basis.T @ matrix, strength.square())


def _omitted(axes: _Axes, count: int) -> Tensor:
    """Return the rms of each band of the unclipped cube that is not in its first ``count`` components."""
    return (axes.basis[:, count:].square() @ axes.power[count:]).sqrt()


def _measured(picture: Tensor, matrix: Tensor, axes: _Axes, count: int) -> LowRankCube:
    """Return the first components of a cube, and the errors that omitted components and clipping leave."""
    basis, weights = axes.basis[:, :count], axes.weights[:count]
    light, kept = matrix.to(picture), None if count == len(axes.power) else (basis @ weights).to(picture)
    planes, off = picture.new_empty(count, picture.shape[1]), picture.new_empty(picture.shape[1])
    tops, lasts, squares = [], [], matrix.new_zeros(len(matrix))
    for at in range(0, picture.shape[1], _PIECE):
        part = slice(at, at + _PIECE)
        x = picture[:, part]
        planes[:, part] = weights @ x.double()
        bands = light @ x
        tops.append(bands.amax(1))
        if kept is None:  # what is clipped is all that is lost
            lost = bands.amin(0).neg_().clamp_min_(0)
            off[part], at_loss = lost, lost.nonzero()[:, 0]
            left = bands[:, at_loss].clamp_max_(0)
        else:
            left = bands.clamp_min_(0).sub_(kept @ x)
            off[part] = left.abs().amax(0)
        if left.shape[1]:
            lasts.append(left.abs().amax(1))
            squares += left.square().sum(1)
    rms = (squares / picture.shape[1]).sqrt()
    return _bounded(planes, basis, axes, off, (torch.stack(tops), lasts, rms))


def _bounded(
    planes: Tensor, basis: Tensor, axes: _Axes, off: Tensor, found: tuple[Tensor, list[Tensor], Tensor]
) -> LowRankCube:
    """Return the low-rank cube with the bounds of its errors, to which the rounding of float32 is added."""
    tops, lasts, rms = found
    most = tops.amax(0).double().clamp_min(0)
    sizes = torch.maximum(planes.amax(1), -planes.amin(1)).double()
    rounding = 4 * torch.finfo(planes.dtype).eps * float((basis.abs() @ sizes).max())
    last = (torch.stack(lasts).amax(0).double() if lasts else torch.zeros_like(most)) + rounding
    before = [_omitted(axes, k) + rms for k in range(planes.shape[0])]
    spread = torch.stack([*before, rms]) + rounding
    return LowRankCube(planes, basis, bound_by_planes(most, planes, basis, last), spread, off.add_(rounding))
