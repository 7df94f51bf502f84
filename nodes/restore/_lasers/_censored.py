"""Clipped pixels in a fit: each says that its light was at least full, and nothing more.

The light of a clipped pixel is that of the lasers and lamps and that of the scene, which follows the pixels around it.
The probability that the sum is full is a normal survival function, of the photons and of what the neighbours do not
tell.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.restore._lasers._whitening import LOST, filled, masked_variance

_BRIGHT = 0.01  #: probability that the scene alone clips a pixel, so that no laser must explain it
_WORTH = 1 / 9  #: of a pixel, because pixels within about three share the error of what their neighbours tell


class Censored(NamedTuple):
    """The clipped pixels of a frame, and how well the light of each is known from its neighbours."""

    seen: Tensor  #: (channel, y, x), 1 or 0
    spread: Tensor  #: (pixel,), e-, standard deviation of the charge of each clipped pixel

    def misfits(self, rest: Tensor) -> Tensor:
        """Return numbers (pixel,) whose half square is minus the log likelihood, for the frame less all parts, e-."""
        return _root(self._over(rest))[0]

    def slopes(self, rest: Tensor, columns: Tensor) -> Tensor:
        """Return how each number falls with each value (value, pixel); ``columns`` is what `lit` makes of its light."""
        return _root(self._over(rest))[1] * columns / self.spread

    def lit(self, pictures: Tensor) -> Tensor:
        """Return of pictures (..., channel, y, x) the light of clipped pixels beyond that of their neighbours."""
        return (pictures - filled(pictures, self.seen)) * (1.0 - self.seen)

    def of(self, pictures: Tensor) -> Tensor:
        """Return the clipped pixels of pictures: (..., pixel)."""
        return pictures[..., self.seen == 0]

    def _over(self, rest: Tensor) -> Tensor:
        return self.of(filled(rest, self.seen) - rest) / self.spread


def _root(over: Tensor) -> tuple[Tensor, Tensor]:
    """Return the root of twice the misfit of a pixel by so many deviations over full, and its slope, downwards."""
    short = (1.0 - _BRIGHT) * torch.special.ndtr(-over)
    root = (-2.0 * torch.log1p(-short)).sqrt()
    density = torch.exp(-0.5 * over.square()) / (2.0 * torch.pi) ** 0.5
    slope = (1.0 - _BRIGHT) * density / ((1.0 - short) * root.clamp_min(1e-6))
    return _WORTH**0.5 * root, _WORTH**0.5 * slope


def censored(electrons: Tensor, seen: Tensor, scene: Tensor, read_noise: float) -> Censored | None:
    """Return the clipped pixels of a frame, of which ``scene`` is what the parts do not explain; None without any."""
    if bool(seen.all()):
        return None
    variance = electrons.clamp_min(1.0) + read_noise**2 + LOST * masked_variance(scene, seen)
    return Censored(seen, variance[seen == 0].sqrt())
