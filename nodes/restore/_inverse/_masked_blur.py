"""The model of a blurred picture of which only some pixels are seen, and the prior of the picture before the blur.

All spectra are half spectra of a torus: (channel, fy, fx) with fx >= 0, as `torch.fft.rfft2` returns them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

Size = tuple[int, int]
Map = Callable[[Tensor], Tensor]

_ALIKE = 1e-13  #: added to products of patterns of norm 1, so that equal patterns have a Cholesky factor
_PIECE = 2**18  #: pixels of all patterns that are converted to float64 at a time


@dataclass(frozen=True)
class Blurred:
    """The model  picture = (blur of x) + noise,  where x has mean 0 and correlated channels."""

    picture: Tensor  #: (channel, y, x)
    weight: Tensor  #: (channel, y, x), 1 / variance of the noise; 0 where a pixel is not seen
    transfer: Tensor  #: (channel, fy, fx), half a spectrum of the torus, with the picture in its first corner
    power: Tensor  #: (fy, fx), power spectrum of x; the mean over the whole spectrum is the variance of x
    torus: Size
    grey: float  #: correlation of any two channels of x, below 1
    glare: tuple[Tensor, ...] = ()  #: (channel, y, x) patterns of unknown strength that are added to the picture
    pull: Tensor | None = None  #: (channel, fy, fx), a further term of the log posterior's gradient
    bounded: int = 0  #: how many patterns, the last ones, have strengths of mean 0 and variance 1, not any strength
    held: Tensor | None = None  #: (channel, y, x), precision of a further prior of x in the frame, of mean 0

    def blur(self, spectrum: Tensor) -> Tensor:
        """Return the blurred picture, given half the spectrum of x."""
        y, x = self.picture.shape[-2:]
        return blurred(self.transfer, spectrum, self.torus, (y, x))

    def first(self, spectrum: Tensor) -> Tensor:
        """Return the pixels of x in the frame of the picture, given half the spectrum of x."""
        y, x = self.picture.shape[-2:]
        parts = [torch.fft.irfft2(s, s=self.torus)[:y, :x] for s in spectrum]  # one batch takes twice as long
        return torch.stack(parts)

    def gathered(self, pixels: Tensor) -> Tensor:
        """Return half the spectrum that results from the adjoint of `blur`, applied to a picture."""
        return gathered(self.transfer, pixels, self.torus)

    def slope(self, x: Tensor) -> Tensor:
        """Return the gradient of the log posterior at the picture of spectrum x; the most likely picture has 0."""
        own, shared = inverse_colour(len(x), self.grey)
        prior = mixed(x, own, -shared) / self.power.clamp_min(1e-30)
        rise = self.gathered(weighing(self)(self.picture - self.blur(x))) - prior
        if self.held is not None:
            rise = rise - torch.fft.rfft2(self.held * self.first(x), s=self.torus)
        return rise if self.pull is None else rise + self.pull


def blurred(transfer: Tensor, spectrum: Tensor, torus: Size, size: Size) -> Tensor:
    """Return the first corner (..., channel, *size) of blurred pictures, given half their spectra (..., fy, fx)."""
    whole = spectrum.expand(*spectrum.shape[:-3], *transfer.shape)
    pairs = zip(transfer, whole.unbind(-3), strict=True)  # one batch of all channels takes twice as long
    return torch.stack([torch.fft.irfft2(t * s, s=torus)[..., : size[0], : size[1]] for t, s in pairs], -3)


def gathered(transfer: Tensor, pixels: Tensor, torus: Size) -> Tensor:
    """Return half the spectra that result from the adjoint of `blurred`, applied to pictures (..., channel, y, x)."""
    spectrum: Tensor = transfer.conj() * torch.fft.rfft2(pixels, s=torus)
    return spectrum


def weighing(seen: Blurred) -> Map:
    """Return a function that multiplies residuals by the pixel weights and removes the fitted glare patterns."""
    if not seen.glare:
        return lambda residual: seen.weight * residual
    flat = torch.stack(seen.glare).flatten(1)
    weighted = seen.weight.flatten() * flat
    products = with_bounds(weighted.double() @ flat.double().T, seen.bounded)
    if seen.bounded:  # similar patterns: differences of large sums would lose digits in float32
        weighted, inverse = _apart(weighted, products), None
    else:
        inverse = torch.linalg.pinv(products, hermitian=True).to(flat)

    def weigh(residual: Tensor) -> Tensor:
        rest, found = seen.weight * residual, weighted @ residual.flatten()
        for strength, pattern in zip(found if inverse is None else inverse @ found, weighted, strict=True):
            rest.addcmul_(strength, pattern.view_as(rest), value=-1.0)
        return rest

    return weigh


def with_bounds(products: Tensor, bounded: int) -> Tensor:
    """Return the products of all pairs of glare patterns, plus the precisions of their strengths: 1 if bounded."""
    if not bounded:
        return products
    certain = torch.zeros(len(products), dtype=products.dtype, device=products.device)
    certain[-bounded:] = 1.0
    return products + certain.diag()


def _apart(weighted: Tensor, products: Tensor) -> Tensor:
    """Return combinations of patterns whose outer products add up to those of the patterns through inverse products.

    The combinations are the rows of L^-1 for the Cholesky factor L of the products, computed in float64 piece by piece.
    """
    scale = products.diagonal().detach().clamp_min(1e-300).rsqrt()
    even = scale[:, None] * products * scale
    even = even + _ALIKE * torch.eye(len(even), dtype=even.dtype, device=even.device)
    lower = torch.linalg.cholesky(even)
    pieces = (scale[:, None] * part.double() for part in torch.split(weighted, _PIECE, 1))
    return torch.cat([torch.linalg.solve_triangular(lower, part, upper=False).to(weighted) for part in pieces], 1)


def mixed(spectrum: Tensor, own: float, shared: float) -> Tensor:
    """Return `own` times the spectrum of each channel plus `shared` times the sum of the spectra of all channels."""
    return own * spectrum + shared * spectrum.sum(0)


def inverse_colour(channels: int, grey: float) -> tuple[float, float]:
    """Return (own, shared) such that  own I - shared  is the inverse of  (1 - grey) I + grey  over the channels."""
    return 1.0 / (1.0 - grey), grey / ((1.0 - grey) * (1.0 - grey + channels * grey))


def variance(power: Tensor, size: Size) -> Tensor:
    """Return the variance of pictures with a given power spectrum, which is the mean over all frequencies."""
    return (power.sum(-2) * times(size, power)).sum(-1) / (size[0] * size[1])


def times(size: Size, like: Tensor) -> Tensor:
    """Return the number of times that each column of half a spectrum occurs in the whole spectrum."""
    count = torch.full((size[1] // 2 + 1,), 2.0, dtype=like.real.dtype, device=like.device)
    count[0] = 1.0
    if size[1] % 2 == 0:
        count[-1] = 1.0
    return count


def narrowed(spectrum: Tensor, size: Size) -> Tensor:
    """Return half a spectrum cropped to the frequencies of a coarser grid `size`; the Nyquist frequencies are 0."""
    up, down, right = (size[0] + 1) // 2, (size[0] - 1) // 2, (size[1] + 1) // 2
    cut = spectrum.new_zeros(*spectrum.shape[:-2], size[0], size[1] // 2 + 1)
    cut[..., :up, :right] = spectrum[..., :up, :right]
    cut[..., size[0] - down :, :right] = spectrum[..., spectrum.shape[-2] - down :, :right]
    return cut


def widened(spectrum: Tensor, size: Size, wide: Size) -> Tensor:
    """Return half a spectrum of a grid `size`, extended by zeros to a grid `wide` that is twice as fine."""
    up, down, right = (size[0] + 1) // 2, (size[0] - 1) // 2, (size[1] + 1) // 2
    whole = spectrum.new_zeros(*spectrum.shape[:-2], wide[0], wide[1] // 2 + 1)
    whole[..., :up, :right] = 4.0 * spectrum[..., :up, :right]
    whole[..., wide[0] - down :, :right] = 4.0 * spectrum[..., size[0] - down :, :right]
    return whole
