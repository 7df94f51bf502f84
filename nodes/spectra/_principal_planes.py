"""A cube as few planes: principal components of its spectra, found and proved some pixels at a time."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

_PIECE = 4096  #: pixels looked at together: 31 bands of them in float64 are 1 MB and stay in the cache
_FLOOR = 8  #: roundings of the planes, below which no bound can be had
_ROOT = 2e-7  #: what products in float64 can tell of a root mean square


class Source(NamedTuple):
    """A cube that need not be in memory."""

    part: Callable[[slice], Tensor]  #: some pixels, (band, pixel) float64, in memory of their own
    bands: int
    pixels: int
    dtype: torch.dtype  #: of the planes

    def pieces(self) -> list[slice]:
        """All pixels, some at a time."""
        return [slice(i, min(i + _PIECE, self.pixels)) for i in range(0, self.pixels, _PIECE)]


class Found(NamedTuple):
    """What `LowRankCube` holds, pixels in one row."""

    planes: Tensor  #: (k, pixel)
    basis: Tensor  #: (band, k) float64
    residual_max: Tensor  #: (k + 1, band) float64
    residual_rms: Tensor  #: (k + 1, band) float64
    residual_map: Tensor  #: (pixel,)


def few_planes(source: Source, within: float) -> Found:
    """The fewest principal components whose root mean square error is within a share of the largest element.

    Raises ValueError for NaN. What they leave of every pixel is measured too.
    """
    most, gram = _looked_at(source)
    scale = float(most.max())
    scaled = scale > 0 and not 1e-280 < float(gram.amax()) < 1e280
    if scaled:
        gram = _looked_at(source, scale)[1]
    axes = torch.linalg.eigh(gram).eigenvectors.flip(1)
    target = max(within, _FLOOR * torch.finfo(source.dtype).eps, _ROOT) * scale
    eps = torch.finfo(source.dtype).eps
    spread = _spread(gram / source.pixels, axes, source.bands, eps) * (scale if scaled else 1.0)
    count = max(1, next((k for k, left in enumerate(spread) if float(left.max()) <= target), source.bands))
    planes, last, off = _projected(source, axes[:, :count])
    rest = _rest(most, planes, axes[:, :count], last)
    spread = torch.cat([spread[:count], torch.minimum(spread[count], rest[count])[None]])  # of what was measured
    return Found(planes, axes[:, :count], rest, spread, off)


def _looked_at(source: Source, scale: float = 1.0) -> tuple[Tensor, Tensor]:
    """The largest |element| of each band, and the products of the bands, of the cube over ``scale``."""
    if not source.pixels or not source.bands:
        raise ValueError("the cube has no pixels: give a scene")
    tops, gram = [], None
    for piece in source.pieces():
        x = source.part(piece).div_(scale) if scale != 1.0 else source.part(piece)
        gram = x @ x.T if gram is None else gram.addmm_(x, x.T)
        tops.append(x.abs_().amax(1))
    most = torch.stack(tops).amax(0) * scale
    if gram is None or not bool(torch.isfinite(most).all()):
        raise ValueError("the cube holds NaN or infinite light: mend the scene, or keep the image of all bands")
    return most, gram


def _projected(source: Source, axes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Planes in their own precision, the largest that they leave of each band, and of each pixel."""
    planes = torch.empty(axes.shape[1], source.pixels, dtype=source.dtype, device=axes.device)
    last, off = axes.new_zeros(source.bands), planes.new_empty(source.pixels)
    for piece in source.pieces():
        x = source.part(piece)
        planes[:, piece] = axes.T @ x
        left = x.sub_(axes @ planes[:, piece].double()).abs_()
        last = torch.maximum(last, left.amax(1))
        off[piece] = left.amax(0)
    return planes, last, off.mul_(1 + 2 * torch.finfo(source.dtype).eps)


def _spread(power: Tensor, axes: Tensor, count: int, eps: float) -> Tensor:
    """Root mean square of what the first r planes leave: that of the other axes, and the rounding of the planes.

    ``power``: mean products of the bands. Rounding of the products themselves counts as if it were left too.
    """
    each = axes.square() * ((power @ axes) * axes).sum(0).clamp_min(0)
    after = torch.cat([each.flip(1).cumsum(1).flip(1), torch.zeros_like(each[:, :1])], 1)[:, : count + 1].T
    total = power.diagonal()
    double = 64 * torch.finfo(torch.float64).eps * total.sum()
    planes = torch.arange(count + 1, dtype=total.dtype, device=total.device)[:, None]
    return (after + double).sqrt() + eps * (planes * total).sqrt()


def _rest(most: Tensor, planes: Tensor, basis: Tensor, last: Tensor) -> Tensor:
    """What the first r planes leave: measured for none and for all, and between them no more than the others' sum."""
    each = basis.abs() * torch.maximum(planes.amax(1), -planes.amin(1)).double()
    last = last + 4 * torch.finfo(torch.float64).eps * (most + each.sum(1))  # what measuring it may have lost
    after = each.flip(1).cumsum(1).flip(1).T
    return torch.cat([most[None], last + after[1:], last[None]])
