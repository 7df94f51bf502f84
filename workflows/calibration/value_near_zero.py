"""The distribution of a positive parameter that is hardly told from 0, and of all others, given the widths of noise.

The levels depend on the parameter itself, for example on a dark current, and a sampler moves in its logarithm. Given
the widths the parameter is nearly normal, with a prior of its logarithm: the logarithm has a long lower tail, in which
the levels see a 0 and the prior alone decides. This density is computed on a grid of the logarithm for each set of
widths. All others are nearly normal given the widths and the parameter, with a mean that is linear in the parameter.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from neusee.workflows.calibration.given_widths import GivenWidths, draw_student, student_density
from neusee.workflows.calibration.posterior_mixture import Random, uniform

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from neusee.workflows.calibration.camera_density import Law
    from neusee.workflows.calibration.log_posterior import FloatArray

_CELLS, _REACH = 240, 8.0  #: cells of the grid, and its reach about the middle of the prior, in its deviations
_SAFE, _POWER = 0.15, 0.4  #: share and power of the part with wider tails
_FARTHEST = 300.0  #: largest change of the logarithm, so that the square of the parameter stays a number
_BARE = 1e-300  #: a density of which a logarithm can be taken


class NearZero:
    """The distribution of the parameter ``number`` and of all others, given the widths of the noise of a camera."""

    def __init__(self, others: GivenWidths, number: int, spread: float) -> None:
        self.at, self._theta = others.at, others.theta
        self._others, own = others, np.arange(len(others.theta)) == number
        self._own, self._rest = own[~others.at], ~own & ~others.at
        self._number, self._unit = number, float(others.unit[self._own][0])
        self._units, self._scale = others.unit[~self._own], float(np.log(np.abs(others.unit)).sum())
        self._middle = float(others.middle[self._own][0])
        narrow = abs(spread / self._unit)
        low, high = np.arcsinh((np.array([-_REACH, _REACH]) - self._middle) / narrow)
        self._points = narrow * np.sinh(np.linspace(low, high, _CELLS + 1))  #: from the mode, in units of the prior
        self._sizes = np.diff(self._points)
        self._counts = 0.5 * (np.append(self._sizes, 0.0) + np.append(0.0, self._sizes))  #: of the trapezoidal rule
        self._value = self._value_at(self._points)
        self._prior = -0.5 * (self._points + self._middle) ** 2

    def law(self, widths: FloatArray) -> Law:
        """Return the distribution for each set of ``widths`` (draw, width).

        The density (draw, point) of the logarithm; the mean (draw, other) of all others at the mode of the parameter,
        its change (draw, other) with the parameter, and the root (draw, other, other) of their precision. All are in
        units of the prior.
        """
        slope, precision = self._others.information(widths)
        own, rest = self._own, ~self._own
        # the prior of the parameter is that of its logarithm and joins on the grid
        slope_own, own_own = slope[:, own][:, 0] + self._middle, precision[:, own][:, :, own][:, 0, 0] - 1
        across, root = precision[:, rest][:, :, own], np.linalg.cholesky(precision[:, rest][:, :, rest])
        both = np.concatenate([slope[:, rest][..., None], across], -1)
        whole = np.linalg.solve(root, both)
        steps, pull = np.moveaxis(np.linalg.solve(np.swapaxes(root, 1, 2), whole), -1, 0)
        curve = (own_own - (whole[..., 1] ** 2).sum(1)).clip(0)
        tilt = slope_own - (whole[..., 0] * whole[..., 1]).sum(1)
        log = tilt[:, None] * self._value - 0.5 * curve[:, None] * self._value**2 + self._prior
        log -= log.max(1, keepdims=True)
        density = (1 - _SAFE) * self._normalised(np.exp(log)) + _SAFE * self._normalised(np.exp(_POWER * log))
        return density, steps, -pull, root.astype(np.float64)

    def draw(self, widths: FloatArray, law: Law, rng: Random) -> FloatArray:
        """Return samples (draw, free) with the given ``widths`` and their ``law``."""
        density, steps, pull, root = law
        place = self._place(density, uniform(len(widths), rng))
        samples = np.empty((len(widths), len(self.at)))
        samples[:, self.at] = widths
        samples[:, self._number] = self._theta[self._number] + place * self._unit
        away = steps + self._value_at(place)[:, None] * pull + draw_student(root, rng)
        samples[:, self._rest] = self._theta[self._rest] + away * self._units
        return samples

    def log_density(self, samples: FloatArray, law: Law) -> FloatArray:
        """Return the log density of all parameters but the widths at ``samples``, up to a constant."""
        density, steps, pull, root = law
        place = (samples[:, self._number] - self._theta[self._number]) / self._unit
        cell, share = self._cell(place)
        draw = np.arange(len(place))
        height = (1 - share) * density[draw, cell] + share * density[draw, cell + 1]
        own = np.log(np.where((share >= 0) & (share <= 1), height, 0.0).clip(_BARE)) + math.lgamma(0.5)  # as `Mixture`
        away = (
            (samples[:, self._rest] - self._theta[self._rest]) / self._units
            - steps
            - self._value_at(place)[:, None] * pull
        )
        log: FloatArray = own + student_density(away, root) - self._scale
        return log

    def _value_at(self, place: FloatArray) -> FloatArray:
        """Return the change of the parameter from the mode to each place, in units that are those of a small change."""
        value: FloatArray = np.expm1((place * self._unit).clip(max=_FARTHEST)) / self._unit
        return value

    def _normalised(self, density: FloatArray) -> FloatArray:
        normalised: FloatArray = density / (density @ self._counts)[:, None]
        return normalised

    def _cell(self, place: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
        """Return the cell of each place, and the share of the cell that lies below the place."""
        cell = np.searchsorted(self._points, place).clip(1, _CELLS) - 1
        return cell, (place - self._points[cell]) / self._sizes[cell]

    def _place(self, density: FloatArray, chance: FloatArray) -> FloatArray:
        """Return the place below which lies the probability ``chance`` of each draw."""
        size = self._sizes
        below = np.cumsum(0.5 * (density[:, 1:] + density[:, :-1]) * size, 1)
        cell = (below < (chance * below[:, -1])[:, None]).sum(1).clip(max=_CELLS - 1)
        draw = np.arange(len(chance))
        left = chance * below[:, -1] - np.where(cell > 0, below[draw, cell - 1], 0.0)
        first, last = density[draw, cell], density[draw, cell + 1]
        # the root of first * t + (last - first) * t^2 / 2 = left / size, in the form that loses no digits
        area = left / size[cell]
        share = 2 * area / (first + np.sqrt((first**2 + 2 * (last - first) * area).clip(0))).clip(_BARE)
        place: FloatArray = self._points[cell] + share.clip(0, 1) * size[cell]
        return place
