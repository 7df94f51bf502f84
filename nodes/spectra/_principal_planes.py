"""Principal components of a spectral cube, computed and verified in blocks of pixels."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.values import LowRankCube

_PIECE = 4096  #: pixels of a block: 31 bands in float64 take 1 MB and stay in the cache
_FLOOR = 8  #: round-off units of the planes; no smaller error can be guaranteed
_ROOT = 2e-7  #: relative resolution of a root mean square that is computed from products in float64


class Source(NamedTuple):
    """A spectral cube that is read in blocks of pixels, so that the whole cube is never in memory."""

    part: Callable[[slice], Tensor]  #: a block of pixels, (band, pixel) float64, as a copy that may be changed
    bands: int
    pixels: int
    dtype: torch.dtype  #: of the planes

    def pieces(self) -> list[slice]:
        return [slice(i, min(i + _PIECE, self.pixels)) for i in range(0, self.pixels, _PIECE)]


def few_planes(source: Source, within: float) -> LowRankCube:
    """Approximate a spectral cube by the fewest principal components that keep the rms error within a bound.

    The bound ``within`` is relative to the largest element. The planes and the map of errors are flat, with all pixels
    in one row. Raises ValueError for NaN.
    """
    most, gram = _largest_and_products(source)
    scale = float(most.max())
    scaled = scale > 0 and not 1e-280 < float(gram.amax()) < 1e280
    if scaled:
        gram = _largest_and_products(source, scale)[1]
    axes = torch.linalg.eigh(gram).eigenvectors.flip(1)
    eps = torch.finfo(source.dtype).eps
    target = max(within, _FLOOR * eps, _ROOT) * scale
    spread = _spread(gram / source.pixels, axes, source.bands, eps) * (scale if scaled else 1.0)
    count = max(1, next((k for k, left in enumerate(spread) if float(left.max()) <= target), source.bands))
    planes, last, off = _projected(source, axes[:, :count])
    rest = bound_by_planes(most, planes, axes[:, :count], last)
    spread = torch.cat([spread[:count], torch.minimum(spread[count], rest[count])[None]])  # no more than was measured
    return LowRankCube(planes, axes[:, :count], rest, spread, off)


def _largest_and_products(source: Source, scale: float = 1.0) -> tuple[Tensor, Tensor]:
    """Return the largest absolute element of each band of a cube, and the Gram matrix of the bands.

    The Gram matrix is that of the cube divided by ``scale``.
    """
    if not source.pixels or not source.bands:
        raise ValueError("the cube has no pixels: give a scene with pixels")
    tops, gram = [], None
    for piece in source.pieces():
        x = source.part(piece).div_(scale) if scale != 1.0 else source.part(piece)
        gram = x @ x.T if gram is None else gram.addmm_(x, x.T)
        tops.append(x.abs_().amax(1))
    most = torch.stack(tops).amax(0) * scale
    if gram is None or not bool(torch.isfinite(most).all()):
        raise ValueError("the cube holds NaN or infinite values: replace these values, or do not compress the cube")
    return most, gram


def _projected(source: Source, axes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Project a spectral cube on the axes of principal components, and return the largest error by band and by pixel.

    The first returned value holds the basis images, in the precision of the source.
    """
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
    """Return the rms error of each band if a spectral cube is approximated by its first k principal components.

    The rows of the result are for k = 0, 1, 2 and so on. The error is that of the omitted components plus the round-off
    of the basis images. ``power`` holds the mean products of the bands. The round-off of these products counts as part
    of the error.
    """
    each = axes.square() * ((power @ axes) * axes).sum(0).clamp_min(0)
    after = torch.cat([each.flip(1).cumsum(1).flip(1), torch.zeros_like(each[:, :1])], 1)[:, : count + 1].T
    total = power.diagonal()
    double = 64 * torch.finfo(torch.float64).eps * total.sum()
    planes = torch.arange(count + 1, dtype=total.dtype, device=total.device)[:, None]
    return (after + double).sqrt() + eps * (planes * total).sqrt()


def bound_by_planes(most: Tensor, planes: Tensor, basis: Tensor, last: Tensor) -> Tensor:
    """Return a bound of the largest error of each band if a cube is approximated by its first k principal components.

    The rows of the result are for k = 0, 1, 2 and so on. The errors with no component and with all components are
    measured. In between, the bound adds the omitted components to the error with all components.
    """
    each = basis.abs() * torch.maximum(planes.amax(1), -planes.amin(1)).double()
    last = last + 4 * torch.finfo(torch.float64).eps * (most + each.sum(1))  # round-off of the measurement
    after = each.flip(1).cumsum(1).flip(1).T
    return torch.cat([most[None], last + after[1:], last[None]])
