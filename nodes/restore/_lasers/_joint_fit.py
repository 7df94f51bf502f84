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
    """Return numbers whose half square is `_WORTH` times the misfit of clipped pixels, and how they
    fall with ``over``.

    ``over`` is by how many standard deviations the light of a pixel exceeds what fills it. The
    misfit is -log(1 - p), where p is the probability that the pixel is not full, and the scene
    alone does not fill it.
    """
    below_full = (1.0 - _BRIGHT) * torch.special.ndtr(-over)
    root = (-2.0 * torch.log1p(-below_full)).sqrt()
    density = torch.exp(-0.5 * over.square()) / (2.0 * torch.pi) ** 0.5
    # derivative of sqrt(-2 log(1 - p)) with respect to the deviations
    slope = (1.0 - _BRIGHT) * density / ((1.0 - below_full) * root.clamp_min(1e-6))
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
    parts_fitted, remainder, white_residual, misfit = _walked(data, tuple(parts), steps)
    columns = _columns(data, parts_fitted, remainder)
    return Fit(parts_fitted, misfit, _normal(parts_fitted, columns), columns, white_residual)


def misfit_of(data: Data, parts: Sequence[Laser | Lamp], steps: int) -> tuple[Parts, float]:
    """Return the parts after at most ``steps`` steps, and their misfit."""
    fitted_parts, _, _, misfit = _walked(data, tuple(parts), steps)
    return fitted_parts, misfit


def _walked(data: Data, now: Parts, steps: int) -> tuple[Parts, Tensor, Tensor, float]:
    """Return the parts after at most ``steps`` steps, the frame less their light, the white
    residual and the misfit.
    """
    remainder, white_residual, misfit = _misfit(data, now)
    for _ in range(steps):
        next_fit = _step(data, now, remainder, white_residual, misfit)
        if next_fit is None:
            break
        # next_fit is (parts, remainder, residual, misfit)
        gain = misfit - next_fit[3]
        now, remainder, white_residual, misfit = next_fit
        if gain < _ENOUGH:
            break
    return now, remainder, white_residual, misfit


def _step(
    data: Data, now: Parts, left: Tensor, white_residual: Tensor, misfit: float
) -> tuple[Parts, Tensor, Tensor, float] | None:
    """Return the parts after one step, and what `_misfit` says of them; None if no step lowers
    the misfit.
    """
    columns = _columns(data, now, left)
    normal = _normal(now, columns)
    prior_pull = torch.cat([component.values * component.precision for component in now])
    slope = columns @ white_residual - prior_pull
    sizes = [len(component.values) for component in now]
    for damping in _DAMPED:
        step = solved(normal + damping * normal.diagonal().diag(), slope).to(slope)
        moved = tuple(
            component.moved(own_step)
            for component, own_step in zip(now, torch.split(step, sizes), strict=True)
        )
        remainder, residual_after, misfit_after = _misfit(data, moved)
        if misfit_after < misfit:
            return moved, remainder, residual_after, misfit_after
    return None


def _columns(data: Data, parts: Parts, left: Tensor) -> Tensor:
    """Return the slopes of what `_misfit` squares: (value, number)."""
    white = torch.cat(
        [data.weights(component.columns(data.use.__call__)).flatten(1) for component in parts]
    )
    if data.clipped is None:
        return white
    clipped_light = torch.cat(
        [data.clipped.of(component.columns(data.clipped.lit)) for component in parts]
    )
    return torch.cat([white, data.clipped.slopes(left, clipped_light)], 1)


def _normal(parts: Parts, columns: Tensor) -> Tensor:
    """Return the matrix (value, value) of second derivatives: products of slopes, and the prior's
    precision.
    """
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
    scaled_matrix = scale[:, None] * normal * scale
    scaled_matrix = scaled_matrix + 1e-12 * torch.eye(len(scaled_matrix)).to(scaled_matrix)
    row_scale = scale if right.ndim == 1 else scale[:, None]
    solution: Tensor = row_scale * torch.linalg.solve(
        scaled_matrix, row_scale * right.to(scaled_matrix)
    )
    return solution


def _misfit(data: Data, parts: Parts) -> tuple[Tensor, Tensor, float]:
    """Return the frame less the light of the parts, the numbers that are squared, and the
    misfit.
    """
    remainder = data.electrons
    for component in parts:
        remainder = remainder - component.electrons()
    numbers = data.weights(data.use(remainder)).flatten()
    if data.clipped is not None:
        numbers = torch.cat([numbers, data.clipped.misfits(remainder)])
    prior = sum(
        float((component.precision * component.values.square()).sum()) for component in parts
    )
    return remainder, numbers, 0.5 * (float(numbers.double().square().sum()) + prior)


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
    value_count = len(fit.normal)
    inverse = solved(fit.normal, torch.eye(value_count).to(fit.normal))
    # each number's part of the slope of the misfit with respect to each value
    scores_by_number = (fit.columns * fit.rest).double()
    pictures = scores_by_number[:, : unclipped.numel()].view(value_count, *unclipped.shape)
    if scores_by_number.shape[1] > unclipped.numel():
        pictures[:, unclipped == 0] = scores_by_number[
            :, unclipped.numel() :
        ]  # a clipped pixel has no residual
    scores = pictures.sum(1)
    # up to whole blocks
    rows_missing, columns_missing = (-n % _BLOCK for n in unclipped.shape[-2:])
    blocks = (
        pad(scores, (0, columns_missing, 0, rows_missing))
        .unfold(1, _BLOCK, _BLOCK)
        .unfold(2, _BLOCK, _BLOCK)
        .sum((-2, -1))
        .flatten(1)
    )
    prior = fit.normal - products(fit.columns)
    # Huber's sandwich: the scatter of the blocks' scores in place of their expectation
    sandwich = inverse @ (blocks @ blocks.T + prior) @ inverse
    deviation_growth = (
        (sandwich.diagonal() / inverse.diagonal().clamp_min(1e-300)).clamp_min(1.0).sqrt()
    )
    covariance = deviation_growth[:, None] * inverse * deviation_growth
    laser_spreads, first_value = [], 0
    for component in fit.parts:
        own_values = slice(first_value, first_value + len(component.values))
        first_value += len(component.values)
        if isinstance(component, Laser):
            pixels = int(unclipped.amin(0).sum())
            covariance_of_laser, ideal_covariance = (
                _of_channels(component, matrix[own_values, own_values], pixels)
                for matrix in (covariance, inverse)
            )
            # after y, x and nm come the electrons of the channels
            laser_spreads.append(
                Spread(covariance_of_laser, ideal_covariance.diagonal()[3:].sqrt())
            )
    return laser_spreads


def _of_channels(laser: Laser, own: Tensor, pixels: int) -> Tensor:
    """Return the covariance of place, wavelength and electrons of each channel, with what the model
    neglects.

    ``pixels`` counts those that no channel clips.
    """
    slopes = laser.channel_slopes().to(own)
    # from y, x, nm, ... of `Laser.values` to y, x, nm and the electrons of each channel
    jacobian = torch.zeros(3 + len(slopes), len(own)).to(own)
    jacobian[:3, :3] = torch.eye(3).to(own)
    jacobian[3:] = slopes
    neglected = torch.zeros(len(jacobian)).to(own)
    grain_variance = torch.tensor(_GRAINS).to(own).square() / max(pixels, 1)
    neglected[:3] = torch.tensor(_MODEL).to(own).square() + grain_variance
    neglected[2] += (_SHAPE * laser.fwhm.to(own) / NANOMETRE).square()
    neglected[3:] = (_AMOUNT * laser.channels()).square().to(own)
    return jacobian @ own @ jacobian.T + neglected.diag()
