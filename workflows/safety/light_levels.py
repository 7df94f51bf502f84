"""Light of the faintest of a number of pixels, over the distance: core and veil of the spot, ranked on the sensor.

A level is the share of the light that passes the lens, in the faintest of the N brightest pixels. It is computed at the
rungs of a ladder of distances, for some defoci and spots around the nominal ones and some shares of scatter, and
interpolated between these in logarithms.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neusee.nodes.flare import surface_of, veil_at
from neusee.nodes.laser import BrightPixels, hidden_light, with_frame
from neusee.workflows.recipe.blocks.safety_block import Safety, Scatter
from neusee.workflows.recipe.distributions.shapes import FloatArray
from neusee.workflows.safety.distance_ladder import interpolated, miss_between
from neusee.workflows.safety.uncertain_values import SettingDraws

ASSUMED = 1.5  #: factor of one standard deviation of a share of scatter that the recipe does not state
_CERTAIN = 0.02  #: largest range of a logarithm that is taken as one value
_ROUNDED = 1e-9  #: rounding of the logarithm of a distance
_STREAM = 9_001  #: of the random numbers of the assumed share
_STEPS = 600  #: levels at which pixels with light from elsewhere are counted, of groups and between them
_FAINTEST = 1e-12  #: of the brightest level, below which no level stands between those of groups
_OWN_RIM = 0.1  #: share of the core in the light of a pixel beyond the window from which the radial law decides it


@dataclass(frozen=True)
class Veil:
    """The light that the lens scatters: its share, with draws, and its law."""

    share: FloatArray  #: (1 + draw or 1,) of the light that passes the lens
    assumed: bool  #: whether the recipe states none
    light: Callable[[FloatArray], FloatArray]  #: of the distance in pixels, in a pixel, for the nominal share


def veil_of(safety: Safety, draws: SettingDraws) -> Veil | None:
    """Return the veil of the lens, or None for a lens that scatters nothing."""
    lens, pitch = safety.settings.lens, safety.settings.sensor.pixel_pitch
    scatter = lens.scatter
    if scatter is None:
        return None
    assumed_surface = {"lens": surface_of(scatter.share, scatter.l, scatter.s)}
    surfaces: Mapping[str, Mapping[str, Any]] = scatter.surfaces or assumed_surface
    camera = {"focal_length": lens.focal_length, "pixel_pitch": pitch, "diameter": lens.diameter}

    known: dict[bytes, FloatArray] = {}

    def light(radius: FloatArray) -> FloatArray:
        key = hashlib.sha1(radius.tobytes()).digest()
        if key not in known:
            known[key] = veil_at(torch.from_numpy(radius), surfaces=surfaces, **camera)[0].numpy()
        return known[key]

    total = float(veil_at(torch.zeros(1, dtype=torch.float64), surfaces=surfaces, **camera)[1])
    share, assumed = _share(safety, draws, scatter, total)
    return Veil(share, assumed, light)


def _share(safety: Safety, draws: SettingDraws, scatter: Scatter, total: float) -> tuple[FloatArray, bool]:
    """Return the share of the light that is scattered, with draws, and whether it is assumed."""
    if scatter.surfaces is not None:
        return np.array([total]), False
    if "lens.scatter.share" in safety.values:
        stated = draws.column("lens.scatter.share", scatter.share)
        return (stated if np.ptp(stated) else stated[:1]), False
    factor = np.power(ASSUMED, draws.normal(_STREAM))
    return np.minimum(scatter.share * np.concatenate([[1.0], factor]), 0.99), True


@dataclass(frozen=True)
class Grid:
    """Points at which levels are computed along one quantity, in its own scale."""

    points: FloatArray

    @classmethod
    def around(cls, values: FloatArray, per_unit: float) -> Grid:
        """Return a grid that holds values: one point if they are alike, else ``per_unit`` points a unit, at least 3."""
        low, high = float(values.min()), float(values.max())
        if high - low < _CERTAIN:
            return cls(values.ravel()[:1].astype(np.float64))
        return cls(np.linspace(low, high, max(3, 1 + int(np.ceil((high - low) * per_unit)))))

    @classmethod
    def through_zero(cls, values: FloatArray, per_unit: float) -> Grid:
        """Return such a grid with a point at 0, so that values of 0 are not interpolated."""
        known = cls.around(np.append(values, 0.0), per_unit).points
        if len(known) == 1:
            return cls(np.zeros(1))
        step = known[1] - known[0]
        ends = math.floor(known[0] / step + _ROUNDED), math.ceil(known[-1] / step - _ROUNDED)
        return cls(np.arange(ends[0], ends[1] + 1) * step)

    def weights(self, values: FloatArray) -> list[FloatArray]:
        """Return the weight of each point in the linear interpolation at values."""
        if len(self.points) == 1:
            return [np.ones((1,) * values.ndim)]
        step = self.points[1] - self.points[0]
        place = np.clip((values - self.points[0]) / step, 0, len(self.points) - 1)
        return [np.clip(1 - np.abs(place - i), 0, 1) for i in range(len(self.points))]


@dataclass(frozen=True)
class Levels:
    """Logarithms of levels at the rungs of a ladder and at points of grids, for several numbers of pixels."""

    rungs: FloatArray  #: (rung,) logarithm of the distance
    grids: tuple[Grid, ...]
    values: FloatArray  #: (rung, point of each grid ..., rank)
    beyond: FloatArray  #: of the same shape: share of the pixels whose light is that of the radial law
    misses: tuple[float, ...] = ()  #: of a logarithm between two rungs, counted upward
    most: FloatArray | None = None  #: (rank,) logarithm of a bound, which counts nearer than the first rung

    def at(self, place: FloatArray, others: Sequence[FloatArray], ranks: slice) -> FloatArray:
        """Return the logarithms of levels (..., rank); ``place`` is the logarithm of the distance."""
        weights = [grid.weights(values) for grid, values in zip(self.grids, others, strict=True)]
        size = np.broadcast_shapes(place.shape, *(part.shape for parts in weights for part in parts))
        clipped = np.broadcast_to(np.clip(place, self.rungs[0], self.rungs[-1]), size)
        total = np.zeros((*size, len(range(*ranks.indices(self.values.shape[-1])))))
        for point in itertools.product(*(range(len(grid.points)) for grid in self.grids)):
            weight = functools.reduce(np.multiply, (part[index] for part, index in zip(weights, point, strict=True)))
            weight = np.broadcast_to(weight, size)
            rows = np.flatnonzero(weight.any(axis=1))  # a draw lies between two points of a grid, and needs no others
            chosen: Any = (slice(None), *point, ranks)
            total[rows] += weight[rows, :, None] * interpolated(self.rungs, self.values[chosen], clipped[rows])
        total += miss_between(self.rungs, self.misses, clipped)[..., None]
        if self.most is None:
            return total
        return np.where(place[..., None] < self.rungs[0] - _ROUNDED, self.most[ranks], total)


@dataclass(frozen=True)
class Counted:
    """Falling levels of light, and how many pixels have at least each of them."""

    light: FloatArray  #: (level,)
    count: FloatArray  #: of the pixels that have at least this light
    alike: FloatArray  #: of those among them that have just this light
    decided: FloatArray  #: of those whose light is that of the radial law


def levels_of(
    groups: BrightPixels, shape: tuple[int, int], ranks: FloatArray, veil: Veil | None, shares: FloatArray, smooth: bool
) -> tuple[FloatArray, FloatArray]:
    """Return the logarithms of the levels (share, rank) of groups of pixels.

    The second array is the share of the counted pixels that lie beyond the window of a PSF, and whose light the radial
    law of `with_frame` decides. ``shares`` are those of the scattered light; without a veil there is one row.
    """
    whole = with_frame(groups, shape)
    radius, pixels = whole.radius.numpy(), whole.pixels.numpy()
    core = (whole.smooth if smooth else whole.light).numpy()
    scattered = veil.light(radius) / veil.share[0] if veil else np.zeros_like(core)
    added = np.arange(len(core)) >= len(groups.radius)
    hidden = hidden_light(groups) if added.any() else 0.0
    levels, beyond = [], []
    for share in shares if veil else (0.0,):
        light = (1 - share) * core + share * scattered
        if hidden:
            counted = _with_hidden(light, pixels, added, (1 - share) * hidden)
        else:
            counted = _as_they_are(light, pixels, added & ((1 - share) * core > _OWN_RIM * light))
        levels.append(_at_ranks(ranks, counted))
        beyond.append(np.interp(ranks, counted.count, counted.decided / counted.count))
    return np.stack(levels), np.stack(beyond)


def _as_they_are(light: FloatArray, pixels: FloatArray, guessed: NDArray[np.bool_]) -> Counted:
    """Return the counts at the levels of groups of pixels; ``guessed`` marks those of the radial law."""
    order = np.argsort(-light)
    return Counted(
        light=light[order],
        count=np.maximum(np.cumsum(pixels[order]), 1e-9),
        alike=pixels[order],
        decided=np.cumsum(np.where(guessed, pixels, 0.0)[order]),
    )


def _with_hidden(light: FloatArray, pixels: FloatArray, added: NDArray[np.bool_], hidden: float) -> Counted:
    """Return the largest counts when light from elsewhere falls on the pixels that are ``added`` to the window."""
    levels = _steps(np.sort(light)[::-1])
    own = np.argsort(-light[~added])
    rising, total = -light[~added][own], np.append(0.0, np.cumsum(pixels[~added][own]))
    inside = total[np.searchsorted(rising, -levels, side="right")]
    brighter = total[np.searchsorted(rising, -levels, side="left")]
    lit = _lit_at_most(light[added], pixels[added], hidden, levels)
    return Counted(levels, np.maximum(inside + lit, 1e-9), inside - brighter, lit)


def _steps(levels: FloatArray) -> FloatArray:
    """Return falling levels: some of the given ones, and others at equal ratios, for gaps between these."""
    picked = levels[np.unique(np.linspace(0, len(levels) - 1, _STEPS).astype(int))]
    top = max(float(levels[0]), 1e-280)
    between = np.geomspace(max(float(levels[-1]), _FAINTEST * top), top, _STEPS)
    rising: FloatArray = np.unique(np.concatenate([picked, between]))
    return rising[::-1]


def _at_ranks(ranks: FloatArray, counted: Counted) -> FloatArray:
    """Return the logarithms of the light at ranks, from the count up to the end of each group; a group is as bright."""
    first = np.minimum(counted.count - counted.alike + 1, counted.count)
    place = np.maximum.accumulate(np.stack([first, counted.count], 1).ravel())
    found: FloatArray = np.interp(np.log(ranks), np.log(place), np.repeat(np.log(counted.light + 1e-300), 2))
    return found


def _lit_at_most(light: FloatArray, pixels: FloatArray, hidden: float, levels: FloatArray) -> FloatArray:
    """Return how many pixels have at least each level, at most, when light from elsewhere is added to their own.

    It is dealt out where least of it is needed: to the brightest pixels first.
    """
    order = np.argsort(-light)
    own, width = light[order], pixels[order]
    number = np.append(0.0, np.cumsum(width))
    needed = np.cumsum(np.maximum(levels[:, None] - own, 0.0) * width, 1)
    return np.array([np.interp(hidden, np.append(0.0, row), number) for row in needed])
