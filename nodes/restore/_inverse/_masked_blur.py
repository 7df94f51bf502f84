"""A blurred picture of which only some pixels are seen, the prior of what is behind it, and their algebra in spectra.

A spectrum is half that of a torus: (channel, fy, fx) with fx >= 0, as `torch.fft.rfft2` gives it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

Size = tuple[int, int]
Map = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Blurred:
    """A picture = (blur of x) + noise; x has mean 0, and its channels correlate."""

    picture: Tensor  #: (channel, y, x)
    weight: Tensor  #: (channel, y, x), 1 / variance of the noise; 0 where nothing is known
    transfer: Tensor  #: (channel, fy, fx), half a spectrum of the torus, with the picture in its first corner
    power: Tensor  #: (fy, fx) of x; its mean over the whole spectrum is the variance of x
    torus: Size
    grey: float  #: correlation of any two channels of x, below 1
    glare: tuple[Tensor, ...] = ()  #: (channel, y, x) patterns of unknown strength that lie over the picture
    pull: Tensor | None = None  #: (channel, fy, fx), what else raises the log likelihood: its slope

    def blur(self, spectrum: Tensor) -> Tensor:
        """From half the spectrum of x to the pixels of the picture."""
        y, x = self.picture.shape[-2:]
        pairs = zip(self.transfer, spectrum.expand_as(self.transfer), strict=True)  # at once takes twice as long
        return torch.stack([torch.fft.irfft2(t * s, s=self.torus)[:y, :x] for t, s in pairs])

    def gathered(self, pixels: Tensor) -> Tensor:
        """The adjoint of `blur`."""
        spectrum: Tensor = self.transfer.conj() * torch.fft.rfft2(pixels, s=self.torus)
        return spectrum

    def slope(self, x: Tensor) -> Tensor:
        """How the log likelihood rises with x; 0 at the most likely."""
        own, shared = inverse_colour(len(x), self.grey)
        prior = mixed(x, own, -shared) / self.power.clamp_min(1e-30)
        rise = self.gathered(weighing(self)(self.picture - self.blur(x))) - prior
        return rise if self.pull is None else rise + self.pull


def weighing(seen: Blurred) -> Map:
    """Residuals times their weight, blind to any amount of each glare."""
    if not seen.glare:
        return lambda residual: seen.weight * residual
    flat = torch.stack(seen.glare).flatten(1)
    weighted = seen.weight.flatten() * flat
    inverse = torch.linalg.pinv((weighted.double() @ flat.double().T), hermitian=True).to(flat)

    def weigh(residual: Tensor) -> Tensor:
        rest = seen.weight * residual
        for strength, pattern in zip(inverse @ (weighted @ residual.flatten()), weighted, strict=True):
            rest.addcmul_(strength, pattern.view_as(rest), value=-1.0)
        return rest

    return weigh


def mixed(spectrum: Tensor, own: float, shared: float) -> Tensor:
    """Each channel, and the sum of all."""
    return own * spectrum + shared * spectrum.sum(0)


def inverse_colour(channels: int, grey: float) -> tuple[float, float]:
    """The inverse of  (1 - grey) I + grey  over the channels, as  own I - shared."""
    return 1.0 / (1.0 - grey), grey / ((1.0 - grey) * (1.0 - grey + channels * grey))


def variance(power: Tensor, size: Size) -> Tensor:
    """Mean over a whole spectrum of which the last dimension holds one half."""
    return (power.sum(-2) * times(size, power)).sum(-1) / (size[0] * size[1])


def times(size: Size, like: Tensor) -> Tensor:
    """How often each column of half a spectrum stands in the whole."""
    count = torch.full((size[1] // 2 + 1,), 2.0, dtype=like.real.dtype, device=like.device)
    count[0] = 1.0
    if size[1] % 2 == 0:
        count[-1] = 1.0
    return count


def narrowed(spectrum: Tensor, size: Size) -> Tensor:
    """Half a spectrum of a grid twice as fine, cut to this size; nothing at the highest frequency if that is even."""
    up, down, right = (size[0] + 1) // 2, (size[0] - 1) // 2, (size[1] + 1) // 2
    cut = spectrum.new_zeros(*spectrum.shape[:-2], size[0], size[1] // 2 + 1)
    cut[..., :up, :right] = spectrum[..., :up, :right]
    cut[..., size[0] - down :, :right] = spectrum[..., spectrum.shape[-2] - down :, :right]
    return cut


def widened(spectrum: Tensor, size: Size, wide: Size) -> Tensor:
    """Half a spectrum on a grid twice as fine."""
    up, down, right = (size[0] + 1) // 2, (size[0] - 1) // 2, (size[1] + 1) // 2
    whole = spectrum.new_zeros(*spectrum.shape[:-2], wide[0], wide[1] // 2 + 1)
    whole[..., :up, :right] = 4.0 * spectrum[..., :up, :right]
    whole[..., wide[0] - down :, :right] = 4.0 * spectrum[..., size[0] - down :, :right]
    return whole
