"""The most likely values of all lasers and lamps of a frame at once, and their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from neusee.nodes.restore._lasers._components import NANOMETRE, Lamp, Laser
from neusee.nodes.restore._lasers._whitening import LOST, Filter, Weights, filled, masked_variance

# --- censored -------------------------------------------------------------------------------------

# Clipped pixels in a fit: each says that its light was at least full, and nothing more.
#
# The light of a clipped pixel is that of the lasers and lamps and that of the scene, which follows
# the pixels around it. The probability that the sum is full is a normal survival function, of the
# photons and of what the neighbours do not tell.


_BRIGHT = 0.01  #: probability that the scene alone clips a pixel, so that no laser must explain it
#: of a pixel, because pixels within about three share the error of what their neighbours tell
_WORTH = 1 / 9


class Censored(NamedTuple):
    """The clipped pixels of a frame, and how well the light of each is known from its
    neighbours.
    """

    seen: Tensor  #: (channel, y, x), 1 or 0
    spread: Tensor  #: (pixel,), e-, standard deviation of the charge of each clipped pixel

    def misfits(self, residual: Tensor) -> Tensor:
        """Return numbers (pixel,) whose half square is minus the log likelihood, for the frame
        less all parts, e-.
        """
        return _root(self._over(residual))[0]

    def slopes(self, residual: Tensor, columns: Tensor) -> Tensor:
        """Return how each number falls with each value (value, pixel); ``columns`` is what `lit`
        makes of its light.
        """
        return _root(self._over(residual))[1] * columns / self.spread

    def lit(self, pictures: Tensor) -> Tensor:
        """Return of pictures (..., channel, y, x) the light of clipped pixels beyond that of
        their neighbours.
        """
        return (pictures - filled(pictures, self.seen)) * (1.0 - self.seen)

    def of(self, pictures: Tensor) -> Tensor:
        """Return the clipped pixels of pictures: (..., pixel)."""
        return pictures[..., self.seen == 0]

    def _over(self, residual: Tensor) -> Tensor:
        return self.of(filled(residual, self.seen) - residual) / self.spread


def _root(over: Tensor) -> tuple[Tensor, Tensor]:
    """Return the root of twice the misfit of a pixel by so many deviations over full, and its
    slope, downwards.
    """
    short = (1.0 - _BRIGHT) * torch.special.ndtr(-over)
    root = (-2.0 * torch.log1p(-short)).sqrt()
    density = torch.exp(-0.5 * over.square()) / (2.0 * torch.pi) ** 0.5
    slope = (1.0 - _BRIGHT) * density / ((1.0 - short) * root.clamp_min(1e-6))
    return _WORTH**0.5 * root, _WORTH**0.5 * slope


def censored(
    electrons: Tensor, unclipped: Tensor, scene: Tensor, read_noise: float
) -> Censored | None:
    """Return the clipped pixels of a frame, of which ``scene`` is what the parts do not explain;
    None without any.
    """
    if bool(unclipped.all()):
        return None
    variance = electrons.clamp_min(1.0) + read_noise**2 + LOST * masked_variance(scene, unclipped)
    return Censored(unclipped, variance[unclipped == 0].sqrt())


# --- joint fit ------------------------------------------------------------------------------------

# The most likely values of all lasers and lamps of a frame at once, by steps of Gauss and Newton.


Parts = tuple[Laser | Lamp, ...]
#: factors of the diagonal, tried in this order until a step lowers the misfit
_DAMPED = (0.0, 1e-3, 1e-1, 10.0)
_PIECE = 1 << 16  #: numbers at a time whose float64 copies fit in the cache
_ENOUGH = 0.02  #: log likelihood, a smaller gain of which ends the steps


class Data(NamedTuple):
    """What is fitted: a frame, and what its pixels count."""

    electrons: Tensor  #: (channel, y, x)
    use: Filter
    weights: Weights
    clipped: Censored | None = None  #: None leaves the clipped pixels out


class Fit(NamedTuple):
    """Lasers and lamps, and how well they explain a frame."""

    parts: Parts
    misfit: float  #: half the sum of squares of the white residual and of the errors of responses
    normal: Tensor  #: (value, value), matrix of second derivatives of the misfit
    #: (value, number), slopes of the white residual, and of the misfits of clipped pixels after it
    columns: Tensor
    rest: Tensor  #: (number,), the white residual, and the misfits of clipped pixels after it


def fitted(data: Data, parts: Sequence[Laser | Lamp], steps: int) -> Fit:
    """Return the parts after at most ``steps`` steps, each of which lowers the misfit, with the
    slopes at the end.
    """
    parts_fitted, left, white_residual, misfit = _walked(data, tuple(parts), steps)
    columns = _columns(data, parts_fitted, left)
    return Fit(parts_fitted, misfit, _normal(parts_fitted, columns), columns, white_residual)


def misfit_of(data: Data, parts: Sequence[Laser | Lamp], steps: int) -> tuple[Parts, float]:
    """Return the parts after at most ``steps`` steps, and their misfit."""
    now, _, _, misfit = _walked(data, tuple(parts), steps)
    return now, misfit


def _walked(data: Data, now: Parts, steps: int) -> tuple[Parts, Tensor, Tensor, float]:
    """Return parts after steps, the frame less their light, the white residual and the misfit."""
    left, white_residual, misfit = _misfit(data, now)
    for _ in range(steps):
        better = _step(data, now, left, white_residual, misfit)
        if better is None:
            break
        gained = misfit - better[3]
        now, left, white_residual, misfit = better
        if gained < _ENOUGH:
            break
    return now, left, white_residual, misfit


def _step(
    data: Data, now: Parts, left: Tensor, white_residual: Tensor, misfit: float
) -> tuple[Parts, Tensor, Tensor, float] | None:
    """Return the parts after one step, and what `_misfit` says of them; None if no step lowers
    the misfit.
    """
    columns = _columns(data, now, left)
    normal = _normal(now, columns)
    pulled = torch.cat([component.values * component.precision for component in now])
    slope = columns @ white_residual - pulled
    sizes = [len(component.values) for component in now]
    for damping in _DAMPED:
        step = solved(normal + damping * normal.diagonal().diag(), slope).to(slope)
        moved = tuple(
            component.moved(own)
            for component, own in zip(now, torch.split(step, sizes), strict=True)
        )
        after, white, new = _misfit(data, moved)
        if new < misfit:
            return moved, after, white, new
    return None


def _columns(data: Data, parts: Parts, left: Tensor) -> Tensor:
    """Return the slopes of what `_misfit` squares: (value, number)."""
    white = torch.cat(
        [data.weights(component.columns(data.use.__call__)).flatten(1) for component in parts]
    )
    if data.clipped is None:
        return white
    lit = torch.cat([data.clipped.of(component.columns(data.clipped.lit)) for component in parts])
    return torch.cat([white, data.clipped.slopes(left, lit)], 1)


def _normal(parts: Parts, columns: Tensor) -> Tensor:
    return (
        products(columns) + torch.cat([component.precision for component in parts]).double().diag()
    )


def products(columns: Tensor) -> Tensor:
    """Return the products (value, value) of columns (value, number), summed in float64, a piece at
    a time.

    Of a million numbers float32 loses 1e-4 of a product, and what tells strength from responses is
    smaller than that.
    """
    total = torch.zeros(len(columns), len(columns), dtype=torch.float64, device=columns.device)
    for first in range(0, columns.shape[1], _PIECE):
        piece = columns[:, first : first + _PIECE].double()
        total += piece @ piece.T
    return total


def solved(normal: Tensor, right: Tensor) -> Tensor:
    """Solve a normal system, whose values have any scale, in spite of values that nothing tells."""
    scale = normal.diagonal().clamp_min(1e-30).rsqrt()
    even = scale[:, None] * normal * scale
    even = even + 1e-12 * torch.eye(len(even)).to(even)
    row_scale = scale if right.ndim == 1 else scale[:, None]
    answer: Tensor = row_scale * torch.linalg.solve(even, row_scale * right.to(even))
    return answer


def _misfit(data: Data, parts: Parts) -> tuple[Tensor, Tensor, float]:
    """Return the frame less the light of the parts, the numbers that are squared, and the
    misfit.
    """
    left = data.electrons
    for component in parts:
        left = left - component.electrons()
    numbers = data.weights(data.use(left)).flatten()
    if data.clipped is not None:
        numbers = torch.cat([numbers, data.clipped.misfits(left)])
    prior = sum(
        float((component.precision * component.values.square()).sum()) for component in parts
    )
    return left, numbers, 0.5 * (float(numbers.double().square().sum()) + prior)


# --- intervals ------------------------------------------------------------------------------------

# How well a frame tells the values of each laser: from the curvature of the fit and the scatter of
# its residual.


NORMAL = 1.6448536269514722  #: standard deviations on each side of a 90 % interval
_BLOCK = 8  #: pixels a side of blocks whose residuals count as independent of one another
#: pixels, pixels and nm, standard deviations of what dirt and defocus change
_MODEL = (0.0036, 0.0036, 0.08)
#: the same over the root of the number of pixels seen, whose scattered light is random
_GRAINS = (0.23, 0.23, 5.9)
#: standard deviation of the wavelength from the unknown shape of a line, over the width of the line
_SHAPE = 0.03
_AMOUNT = 0.0015  #: the same of the electrons of each channel, relative


class Spread(NamedTuple):
    """How well a frame tells the values of one laser."""

    covariance: Tensor  #: (value, value), of y, x (pixels), nm, and the electrons of each channel
    #: (channel,) e-, standard deviation of these electrons behind a lens that is as its recipe says
    ideal: Tensor


def spreads(fit: Fit, unclipped: Tensor) -> list[Spread]:
    """Return for each laser how well its values are told.

    ``unclipped`` (channel, y, x) is 0 for clipped pixels, which the fit has after all others, if at
    all. The inverse of the second derivatives is enlarged where the slopes of blocks of the frame
    scatter more than the model says.
    """
    count = len(fit.normal)
    inverse = solved(fit.normal, torch.eye(count).to(fit.normal))
    scores_by_number = (fit.columns * fit.rest).double()
    pictures = scores_by_number[:, : unclipped.numel()].view(count, *unclipped.shape)
    if scores_by_number.shape[1] > unclipped.numel():
        pictures[:, unclipped == 0] = scores_by_number[
            :, unclipped.numel() :
        ]  # a clipped pixel has no residual
    scores = pictures.sum(1)
    y, x = (-n % _BLOCK for n in unclipped.shape[-2:])
    blocks = (
        pad(scores, (0, x, 0, y))
        .unfold(1, _BLOCK, _BLOCK)
        .unfold(2, _BLOCK, _BLOCK)
        .sum((-2, -1))
        .flatten(1)
    )
    prior = fit.normal - products(fit.columns)
    scattered = inverse @ (blocks @ blocks.T + prior) @ inverse
    growth = (scattered.diagonal() / inverse.diagonal().clamp_min(1e-300)).clamp_min(1.0).sqrt()
    covariance = growth[:, None] * inverse * growth
    laser_spreads, first = [], 0
    for component in fit.parts:
        own = slice(first, first + len(component.values))
        first += len(component.values)
        if isinstance(component, Laser):
            pixels = int(unclipped.amin(0).sum())
            grown, ideal = (
                _of_channels(component, matrix[own, own], pixels)
                for matrix in (covariance, inverse)
            )
            laser_spreads.append(Spread(grown, ideal.diagonal()[3:].sqrt()))
    return laser_spreads


def _of_channels(laser: Laser, own: Tensor, pixels: int) -> Tensor:
    """Return the covariance of place, wavelength and electrons of each channel, with what the model
    neglects.

    ``pixels`` counts those that no channel clips.
    """
    slopes = laser.channel_slopes().to(own)
    to = torch.zeros(3 + len(slopes), len(own)).to(own)
    to[:3, :3] = torch.eye(3).to(own)
    to[3:] = slopes
    neglected = torch.zeros(len(to)).to(own)
    grains = torch.tensor(_GRAINS).to(own).square() / max(pixels, 1)
    neglected[:3] = torch.tensor(_MODEL).to(own).square() + grains
    neglected[2] += (_SHAPE * laser.fwhm.to(own) / NANOMETRE).square()
    neglected[3:] = (_AMOUNT * laser.channels()).square().to(own)
    return to @ own @ to.T + neglected.diag()
