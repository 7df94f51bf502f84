"""A cube as few planes: principal components of its spectra, found and proved some pixels at a time."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

_PIECE = 4096  #: pixels looked at together: 31 bands of them in float64 are 1 MB and stay in the cache
_FLOOR = 8  #: roundings of the planes, below which no bound can be had
_SAMPLE = 4096  #: pixels by which the number of planes is guessed


class Source(NamedTuple):
    """A cube that need not be in memory."""

    part: Callable[[slice | Tensor], Tensor]  #: some pixels, (band, pixel) float64, in memory of their own
    bands: int
    pixels: int
    dtype: torch.dtype  #: of the planes

    def pieces(self) -> list[slice]:
        """All pixels, some at a time."""
        return [slice(i, min(i + _PIECE, self.pixels)) for i in range(0, self.pixels, _PIECE)]


class Found(NamedTuple):
    """What `Mixture` holds, pixels in one row."""

    planes: Tensor  #: (k, pixel)
    basis: Tensor  #: (band, k) float64
    rest: Tensor  #: (k + 1, band) float64
    spread: Tensor  #: (k + 1, band) float64


def few_planes(source: Source, within: float) -> Found:
    """The fewest principal components that come within a share of the largest element; raises ValueError for NaN.

    A few pixels say how many may do; then all are looked at, and of those that miss the worst join the few.
    """
    most, gram = _looked_at(source)
    scale = float(most.max())
    scaled = scale > 0 and not 1e-280 < float(gram.amax()) < 1e280
    if scaled:
        gram = _looked_at(source, scale)[1]
    axes = torch.linalg.eigh(gram).eigenvectors.flip(1)
    target = max(within, _FLOOR * torch.finfo(source.dtype).eps) * scale
    some = torch.linspace(0, source.pixels - 1, min(source.pixels, _SAMPLE), dtype=torch.float64).long()
    sample, k = source.part(some), 1
    while True:
        k = max(k, _least(sample, axes, target))
        planes, last, worst = _projected(source, axes[:, :k])
        if k == source.bands or float(last.max()) <= target:
            rest = _rest(most, planes, axes[:, :k], last)
            spread = _spread(gram / source.pixels, axes, k, torch.finfo(source.dtype).eps)
            return Found(planes, axes[:, :k], rest, spread * scale if scaled else spread)
        sample, k = torch.cat([sample, source.part(worst)], 1), k + 1


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


def _least(sample: Tensor, axes: Tensor, target: float) -> int:
    """How many planes the sample needs."""
    left = sample.clone()
    for k in range(axes.shape[1]):
        if float(left.abs().max()) <= target:
            return k
        left -= axes[:, k, None] * (axes[:, k] @ sample)
    return axes.shape[1]


def _projected(source: Source, axes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Planes in their own precision, the largest that they leave of each band, and the pixels where they do."""
    planes = torch.empty(axes.shape[1], source.pixels, dtype=source.dtype, device=axes.device)
    last, worst = axes.new_zeros(source.bands), torch.zeros(source.bands, dtype=torch.long, device=axes.device)
    for piece in source.pieces():
        x = source.part(piece)
        planes[:, piece] = axes.T @ x
        left = x.sub_(axes @ planes[:, piece].double()).abs_()
        top = left.amax(1)
        if bool((top > last).any()):
            worst = torch.where(top > last, piece.start + left.argmax(1), worst)
            last = torch.maximum(last, top)
    return planes, last, torch.unique(worst)


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
