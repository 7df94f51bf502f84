"""The spot of a laser behind lens and mask as a function of distance: core, veil and peak."""

from __future__ import annotations

import functools
import hashlib
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neusee.nodes.flare import surface_of, veil_at
from neusee.nodes.laser import (
    BrightPixels,
    beam_radius,
    curvature_radius,
    hidden_light,
    summit_gain,
    unseen_light,
    with_frame,
)
from neusee.nodes.values import Psf
from neusee.workflows.engine.execution import RunSeries
from neusee.workflows.engine.runner import Result, run
from neusee.workflows.graph.errors import Diagnostic, RecipeError, RunError
from neusee.workflows.graph.recipe_graph import Recipe, Step, needed
from neusee.workflows.recipe.blocks.safety_block import Safety, Scatter
from neusee.workflows.recipe.distributions.shapes import FloatArray
from neusee.workflows.safety.damage_pattern import step_of
from neusee.workflows.safety.exposures import (
    SettingDraws,
    far_distance,
    fill_at,
    interpolated,
    miss_between,
)
from neusee.workflows.store.remote_store import open_store
from neusee.workflows.store.result_store import Store

# --- light levels ---------------------------------------------------------------------------------

# Light of the faintest of a number of pixels, over the distance: core and veil of the spot, ranked
# on the sensor.
#
# A level is the share of the light that passes the lens, in the faintest of the N brightest pixels.
# It is computed at the rungs of a ladder of distances, for some defoci and spots around the nominal
# ones and some shares of scatter, and interpolated between these in logarithms.


#: geometric standard deviation of the scattered share where the recipe does not state the share
ASSUMED = 1.5
_CERTAIN = 0.02  #: range of a logarithm below which all values count as one
_ROUNDED = 1e-9  #: rounding of the logarithm of a distance
_STREAM = 9_001  #: stream of random numbers for the assumed share
#: number of levels at which pixels that receive hidden light are counted: of groups, and between
#: them
_STEPS = 600
#: fraction of the brightest level below which no level is added between those of groups
_FAINTEST = 1e-12
#: a pixel beyond the window counts as decided by the radial law if the core is more than this share
#: of its light
_OWN_RIM = 0.1


@dataclass(frozen=True)
class Veil:
    """The light scattered by the lens: its share of the total, with draws, and its radial
    profile.
    """

    share: FloatArray  #: (1 + draw or 1,) of the light that passes the lens
    assumed: bool  #: whether the recipe states none
    #: light in a pixel as a function of its distance from the spot in pixels, for the nominal share
    light: Callable[[FloatArray], FloatArray]


def veil_of(safety: Safety, draws: SettingDraws) -> Veil | None:
    """Return the veil of the lens, or None for a lens that scatters nothing."""
    lens, pitch = safety.settings.lens, safety.settings.sensor.pixel_pitch
    scatter = lens.scatter
    if scatter is None:
        return None
    assumed_surface = {"lens": surface_of(scatter.share, scatter.l, scatter.s)}
    surfaces: Mapping[str, Mapping[str, Any]] = scatter.surfaces or assumed_surface
    camera = {"focal_length": lens.focal_length, "pixel_pitch": pitch, "diameter": lens.diameter}

    computed: dict[bytes, FloatArray] = {}

    def light(radius: FloatArray) -> FloatArray:
        key = hashlib.sha1(radius.tobytes()).digest()
        if key not in computed:
            # `veil_at` returns the light in pixels, and the scattered share
            computed[key] = veil_at(torch.from_numpy(radius), surfaces=surfaces, **camera)[
                0
            ].numpy()
        return computed[key]

    total_share = float(
        veil_at(torch.zeros(1, dtype=torch.float64), surfaces=surfaces, **camera)[1]
    )
    share, assumed = _share(safety, draws, scatter, total_share)
    return Veil(share, assumed, light)


def _share(
    safety: Safety, draws: SettingDraws, scatter: Scatter, total: float
) -> tuple[FloatArray, bool]:
    """Return the scattered share of the light (1 + draw or 1,), and True if the share is assumed.

    ``total`` is the share that measured surfaces scatter, which is exact.
    """
    if scatter.surfaces is not None:
        return np.array([total]), False
    if "lens.scatter.share" in safety.values:
        shares = draws.column("lens.scatter.share", scatter.share)
        # one value is enough where all draws are alike
        return (shares if np.ptp(shares) else shares[:1]), False
    factors = np.power(ASSUMED, draws.normal(_STREAM))
    # a lens cannot scatter all of its light
    return np.minimum(scatter.share * np.concatenate([[1.0], factors]), 0.99), True


@dataclass(frozen=True)
class Grid:
    """Points along one quantity at which levels are computed, in the scale of that quantity."""

    points: FloatArray

    @classmethod
    def around(cls, values: FloatArray, per_unit: float) -> Grid:
        """Return a grid over the range of ``values``: one point if they are alike, else
        ``per_unit`` points for each unit, and 3 or more.
        """
        smallest, largest = float(values.min()), float(values.max())
        if largest - smallest < _CERTAIN:
            return cls(values.ravel()[:1].astype(np.float64))
        return cls(
            np.linspace(
                smallest, largest, max(3, 1 + int(np.ceil((largest - smallest) * per_unit)))
            )
        )

    @classmethod
    def through_zero(cls, values: FloatArray, per_unit: float) -> Grid:
        """Return a grid as `around` does, with a point at 0, so that values of 0 need no
        interpolation.
        """
        points = cls.around(np.append(values, 0.0), per_unit).points
        if len(points) == 1:
            return cls(np.zeros(1))
        step = points[1] - points[0]
        # in whole steps from 0, so that 0 is a point
        end_indices = (
            math.floor(points[0] / step + _ROUNDED),
            math.ceil(points[-1] / step - _ROUNDED),
        )
        return cls(np.arange(end_indices[0], end_indices[1] + 1) * step)

    def weights(self, values: FloatArray) -> list[FloatArray]:
        """Return the weight of each grid point in the linear interpolation at ``values``."""
        if len(self.points) == 1:
            return [np.ones((1,) * values.ndim)]
        step = self.points[1] - self.points[0]
        position = np.clip((values - self.points[0]) / step, 0, len(self.points) - 1)
        # a hat of the width of a step around each point
        return [np.clip(1 - np.abs(position - i), 0, 1) for i in range(len(self.points))]


@dataclass(frozen=True)
class Levels:
    """Logarithms of levels at rungs of distance and points of grids, for several ranks (numbers of
    pixels).
    """

    rungs: FloatArray  #: (rung,) logarithm of the distance
    grids: tuple[Grid, ...]
    values: FloatArray  #: (rung, point of each grid ..., rank)
    #: share of the pixels, in the same shape, whose light follows the radial law
    beyond: FloatArray
    #: interpolation error of a logarithm between two rungs, an upper bound
    misses: tuple[float, ...] = ()
    #: (rank,) logarithm of an upper bound, used nearer than the first rung
    most: FloatArray | None = None

    def at(self, place: FloatArray, others: Sequence[FloatArray], ranks: slice) -> FloatArray:
        """Return the logarithms of levels (..., rank) at ``place``, the logarithm of the distance,
        and at ``others``, the values along the grids.
        """
        weights = [grid.weights(values) for grid, values in zip(self.grids, others, strict=True)]
        full_shape = np.broadcast_shapes(
            place.shape, *(weight.shape for weight in itertools.chain(*weights))
        )
        log_distance = np.broadcast_to(np.clip(place, self.rungs[0], self.rungs[-1]), full_shape)
        # (draw, distance, rank), where a slice of ranks may be shorter than all
        total = np.zeros((*full_shape, len(range(*ranks.indices(self.values.shape[-1])))))
        for grid_point in itertools.product(*(range(len(grid.points)) for grid in self.grids)):
            weight = functools.reduce(
                np.multiply,
                (
                    grid_weights[index]
                    for grid_weights, index in zip(weights, grid_point, strict=True)
                ),
            )
            weight = np.broadcast_to(weight, full_shape)
            # a draw lies between two points of a grid; all other weights are 0
            rows = np.flatnonzero(weight.any(axis=1))
            value_index: Any = (slice(None), *grid_point, ranks)
            total[rows] += weight[rows, :, None] * interpolated(
                self.rungs, self.values[value_index], log_distance[rows]
            )
        # add the interpolation error, so that the level is an upper bound
        total += miss_between(self.rungs, self.misses, log_distance)[..., None]
        if self.most is None:
            return total
        # nearer than the first rung nothing is computed: use the upper bound
        return np.where(place[..., None] < self.rungs[0] - _ROUNDED, self.most[ranks], total)


@dataclass(frozen=True)
class Counted:
    """Falling levels of light, and the number of pixels that reach each level."""

    light: FloatArray  #: (level,)
    count: FloatArray  #: number of pixels with at least this light
    alike: FloatArray  #: number of pixels with exactly this light
    decided: FloatArray  #: number of counted pixels whose light follows the radial law


def levels_of(
    groups: BrightPixels,
    shape: tuple[int, int],
    ranks: FloatArray,
    veil: Veil | None,
    shares: FloatArray,
    smooth: bool,
) -> tuple[FloatArray, FloatArray]:
    """Return the logarithms of the levels (share, rank) of groups of equally bright pixels.

    The second array is the share of the counted pixels that lie beyond the window of a PSF, and
    whose light the radial law of `with_frame` decides. ``shares`` are those of the scattered light;
    without a veil there is one row.
    """
    framed = with_frame(groups, shape)
    radius, pixels = framed.radius.numpy(), framed.pixels.numpy()
    core_light = (framed.smooth if smooth else framed.light).numpy()
    # the law of the veil is that of the nominal share: here for all light scattered
    scattered_light = veil.light(radius) / veil.share[0] if veil else np.zeros_like(core_light)
    # `with_frame` appends the pixels beyond the window to those of the groups
    beyond_window = np.arange(len(core_light)) >= len(groups.radius)
    hidden = hidden_light(groups) if beyond_window.any() else 0.0
    levels, beyond_shares = [], []
    for share in shares if veil else (0.0,):
        light = (1 - share) * core_light + share * scattered_light
        if hidden:
            counted = _with_hidden(light, pixels, beyond_window, (1 - share) * hidden)
        else:
            counted = _as_they_are(
                light, pixels, beyond_window & ((1 - share) * core_light > _OWN_RIM * light)
            )
        levels.append(_at_ranks(ranks, counted))
        beyond_shares.append(np.interp(ranks, counted.count, counted.decided / counted.count))
    return np.stack(levels), np.stack(beyond_shares)


def _as_they_are(light: FloatArray, pixels: FloatArray, guessed: NDArray[np.bool_]) -> Counted:
    """Return the counts of pixels at the levels of their groups, without hidden light.

    ``light`` is that in a pixel of each group and ``pixels`` the number of its pixels; ``guessed``
    marks the groups whose light is that of the radial law.
    """
    order = np.argsort(-light)
    return Counted(
        light=light[order],
        # 1e-9 keeps the logarithm of a count finite
        count=np.maximum(np.cumsum(pixels[order]), 1e-9),
        alike=pixels[order],
        decided=np.cumsum(np.where(guessed, pixels, 0.0)[order]),
    )


def _with_hidden(
    light: FloatArray, pixels: FloatArray, added: NDArray[np.bool_], hidden: float
) -> Counted:
    """Return an upper bound of the number of pixels at each level when hidden light falls on the
    pixels beyond the window.

    ``added`` marks the groups beyond the window, and ``hidden`` is the share of the light that
    neither the window nor the radial law accounts for.
    """
    levels = _steps(np.sort(light)[::-1])
    inside_order = np.argsort(-light[~added])
    # negative, because `searchsorted` needs rising numbers
    negative_light, pixels_so_far = (
        -light[~added][inside_order],
        np.append(0.0, np.cumsum(pixels[~added][inside_order])),
    )
    at_least = pixels_so_far[np.searchsorted(negative_light, -levels, side="right")]
    above = pixels_so_far[np.searchsorted(negative_light, -levels, side="left")]
    lit_beyond = _lit_at_most(light[added], pixels[added], hidden, levels)
    return Counted(levels, np.maximum(at_least + lit_beyond, 1e-9), at_least - above, lit_beyond)


def _steps(levels: FloatArray) -> FloatArray:
    """Return about twice `_STEPS` falling levels: a selection of ``levels`` (falling), and a
    geometric series that closes the gaps between them.
    """
    picked = levels[np.unique(np.linspace(0, len(levels) - 1, _STEPS).astype(int))]
    # positive, so that ratios exist
    brightest = max(float(levels[0]), 1e-280)
    between = np.geomspace(max(float(levels[-1]), _FAINTEST * brightest), brightest, _STEPS)
    rising: FloatArray = np.unique(np.concatenate([picked, between]))
    return rising[::-1]


def _at_ranks(ranks: FloatArray, counted: Counted) -> FloatArray:
    """Return the logarithm of the light of the pixel at each rank; the brightest pixel has rank 1.

    All pixels of a group are equally bright; between groups the logarithms are interpolated.
    """
    # ranks of the first and of the last pixel of each group
    first_ranks = np.minimum(counted.count - counted.alike + 1, counted.count)
    rank_ends = np.maximum.accumulate(np.stack([first_ranks, counted.count], 1).ravel())
    logarithms: FloatArray = np.interp(
        np.log(ranks), np.log(rank_ends), np.repeat(np.log(counted.light + 1e-300), 2)
    )
    return logarithms


def _lit_at_most(
    light: FloatArray, pixels: FloatArray, hidden: float, levels: FloatArray
) -> FloatArray:
    """Return an upper bound of the number of pixels that reach each level once ``hidden`` light is
    added to their own light.

    It is dealt out where least of it is needed: to the brightest pixels first.
    """
    order = np.argsort(-light)
    own_light, group_sizes = light[order], pixels[order]
    pixels_so_far = np.append(0.0, np.cumsum(group_sizes))
    # (level, group): light that raises this group and all brighter ones to the level
    light_needed = np.cumsum(np.maximum(levels[:, None] - own_light, 0.0) * group_sizes, 1)
    return np.array(
        [
            np.interp(hidden, np.append(0.0, needed_up_to_group), pixels_so_far)
            for needed_up_to_group in light_needed
        ]
    )


# --- spots along ----------------------------------------------------------------------------------

# The spot of a laser behind lens and mask at several distances, from the steps of the recipe.
#
# The steps of a spot are run again with another distance in the step of the wavefront: taper and
# curvature of the beam at that distance, through lens and mask. Results are kept in the store, by
# their distance.


_RANKS = "laser.bright_pixels"
_FACTOR = 6.0  #: ratio of two neighbouring distances of the initial ladder
_CLOSE = 0.02  #: interpolation error of a peak or a level below which no spot is added
_MOST_PEAKS = 25  #: most peaks behind a mask
_CLOSE_PEAKS = 0.005  #: interpolation error of a peak below which none is added
_WIDENINGS = 2  #: most doublings of the window of a spot that lacks light
_MOST_SPOTS = 17  #: most spots behind lens or mask
_FINEST = 1.3  #: least ratio of two neighbouring distances
_DEFOCUS = 550e-9  #: m; the wavelength in which waves of defocus are counted
#: largest phase step of the wavefront between two samples of the pupil, in turns; the mask adds its
#: own
_TURN = 0.25
_DIM = 3.0  #: 1/e2 radii of the irradiance beyond which the beam in the pupil counts as dark


@dataclass(frozen=True)
class Ranked:
    """The pixels behind lens or mask at several distances; light is in shares of the light through
    the lens.
    """

    arm: str  #: ``plain`` or ``mask``
    distances: tuple[float, ...]  #: m, rising
    groups: tuple[BrightPixels, ...]  #: at each distance
    error: float  #: largest error of a level by interpolation between the distances
    #: interpolation error of the logarithm of a level in each gap between two distances, an upper
    #: bound
    misses: tuple[float, ...] = ()


@dataclass(frozen=True)
class Peaks:
    """The peak behind the mask at several distances, relative to the clear lens in focus with the
    same beam.
    """

    here: float  #: at the distance of the recipe, over the peak of the clear lens without taper
    along: tuple[tuple[float, float], ...]  #: distance in m, and ratio
    error: float  #: largest error of the ratio by interpolation
    #: interpolation error of the logarithm of the ratio in each gap between two distances, an upper
    #: bound
    misses: tuple[float, ...] = ()
    #: distance in m, and share of the light outside the window that is taken as one peak
    outside: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class _Runs:
    """A series of runs of the recipe's steps at several distances, which reads the code of the
    steps only once.
    """

    recipe: Recipe
    safety: Safety
    store: Store
    series: RunSeries

    @classmethod
    def begun(cls, recipe: Recipe, safety: Safety, store: Store | None) -> _Runs:
        """Return a series without a run."""
        opened = store or open_store()
        return cls(recipe, safety, opened, RunSeries.begun(opened))

    def of(self, recipe: Recipe, outputs: Sequence[str]) -> Result:
        """Return the result of steps of ``recipe``, which may differ from the recipe of the series
        only in parameters.
        """
        return run(recipe, self.store, outputs, series=self.series)


def ranked_of(recipe: Recipe, safety: Safety, store: Store | None) -> tuple[Ranked, ...]:
    """Return the ranked pixels of the steps named in the settings; raise `RecipeError` for a step
    of another kind.
    """
    protection = safety.settings.protection
    named_steps = {
        arm: step
        for arm, step in protection.pixels
        if step is not None and (arm, protection.mask) != ("mask", None)
    }
    if safety.settings.dazzle is None or not named_steps:
        return ()
    steps = {arm: _step(recipe, safety, arm, step) for arm, step in named_steps.items()}
    runs = _Runs.begun(recipe, safety, store)
    return tuple(_ranked(runs, arm, step) for arm, step in steps.items())


def peaks_of(recipe: Recipe, safety: Safety, store: Store | None) -> Peaks | None:
    """Return the peak behind the mask as a function of distance, or None without a mask."""
    if safety.settings.protection.mask is None:
        return None
    step, runs = _mask_step(recipe, safety), _Runs.begun(recipe, safety, store)
    plain_step = step.replace("[mask,", "[plain,")
    # without a step of the plain lens, the step states the ratio itself
    reference = plain_step if plain_step != step and plain_step in recipe.steps else None
    peak_here = _peak(runs, recipe, step, safety.laser.distance)
    clear_peak = _peak(runs, recipe, reference, safety.laser.distance).inside if reference else 1.0
    if _wavefront_of(recipe, step) is None:  # the spot of a plane wave, which a distant laser has
        far_end = far_distance(safety.laser.beam(), safety.settings.lens.diameter)
        counted_here = (
            ((safety.laser.distance, peak_here.unseen),)
            if peak_here.most > peak_here.inside
            else ()
        )
        return Peaks(
            peak_here.most / clear_peak,
            ((far_end, peak_here.most / clear_peak),),
            0.0,
            outside=counted_here,
        )
    outside: dict[float, float] = {}

    def log_ratio(distance: float) -> FloatArray:
        peak = _peak(runs, at_distance(recipe, safety, step, distance), step, distance)
        if peak.most > peak.inside:
            outside[distance] = peak.unseen
        # as an array, which `_refined` interpolates
        return np.array([math.log(peak.most / peak.focused)])

    refined = _refined(_first(safety, recipe, step), log_ratio, _MOST_PEAKS, _CLOSE_PEAKS)
    peak_ratios = (math.exp(float(value[0])) for value in refined.values)
    peaks_at_distances = tuple(zip(refined.distances, peak_ratios, strict=True))
    counted_outside = tuple(sorted(outside.items()))
    return Peaks(
        peak_here.most / clear_peak,
        peaks_at_distances,
        max(refined.misses, default=0.0),
        refined.misses,
        counted_outside,
    )


@dataclass(frozen=True)
class _Peak:
    """The peak of a spot relative to the clear lens without taper, and a bound for the light
    outside its window.
    """

    inside: float  #: in the window
    unseen: float  #: share of the beam's light that may form one spot outside the window
    focused: float  #: peak of the clear lens in focus with the same beam

    @property
    def most(self) -> float:
        """Return the highest possible peak: the unseen light may form a spot as sharp as that of
        the clear lens.
        """
        return max(self.inside, self.unseen * self.focused)


def _peak(runs: _Runs, recipe: Recipe, step: str, distance: float) -> _Peak:
    """Return the largest value of a step; for `metrics.lsr` the maximum of the spot interpolated
    between its samples.

    A window that lacks light which may hold a higher peak is doubled, as far as the samples of the
    pupil carry it. Values are over the peak of the clear lens without taper.
    """
    has_taper = _wavefront_of(recipe, step) is not None
    beam, diameter = runs.safety.laser.beam(), runs.safety.settings.lens.diameter
    fill = fill_at(beam, diameter, distance) if has_taper else 0.0
    psf_step = _psf_of(recipe, step)
    if psf_step is None:
        return _Peak(float(runs.of(recipe, [step])[step].max()), 0.0, _focused(fill))
    peak = _peak_of(runs.of(recipe, [psf_step])[psf_step], fill)
    window_step = next(
        (source.name for source in _upstream(recipe, psf_step) if source.node.path == "optics.psf"),
        None,
    )
    for _ in range(_WIDENINGS):
        if window_step is None or peak.most <= peak.inside:
            break
        # double the window, and look whether the light in it rules out a higher peak
        shape = tuple(2 * size for size in recipe.steps[window_step].params["shape"])
        recipe = _with_param(recipe, window_step, "shape", shape)
        try:
            peak = _peak_of(runs.of(recipe, [psf_step])[psf_step], fill)
        except RunError:  # the pupil sampling does not support a window of this size
            break
    return peak


def _peak_of(psf: Psf, fill: float) -> _Peak:
    """Return the peak of a PSF relative to the clear lens without taper, the highest of its bands;
    ``fill`` is (D / (2 w))^2 of the beam.
    """
    passing = _passing(fill)
    bands = list(zip(psf.intensity, psf.clear_peak.tolist(), strict=True))
    # `summit_gain`: the peak between samples over the largest sample
    inside = max(float(band.max() * summit_gain(band)) / clear_peak for band, clear_peak in bands)
    return _Peak(
        inside, max(float(unseen_light(band, passing)) for band, _ in bands), _focused(fill)
    )


def _mask_step(recipe: Recipe, safety: Safety) -> str:
    """Return the name of the step of the peak behind the mask."""
    named_step = safety.settings.protection.mask
    assert named_step is not None
    return step_of(recipe, safety, "protection.mask", named_step, "mask")


def _psf_of(recipe: Recipe, step: str) -> str | None:
    """Return the name of the PSF that a step of `metrics.lsr` reads; None for a step of another
    node.
    """
    return (
        str(recipe.steps[step].wires["psf"])
        if recipe.steps[step].node.path == "metrics.lsr"
        else None
    )


def _passing(fill: float) -> float:
    """Return the power of a Gaussian beam through the lens, relative to a uniform beam with the
    irradiance on its axis.
    """
    # mean of exp(-2 r^2 / w^2) over the disc of the lens
    return 1.0 if fill < 1e-9 else -math.expm1(-2 * fill) / (2 * fill)


def _focused(fill: float) -> float:
    """Return the peak of a focused Gaussian beam, relative to a uniform beam with the irradiance on
    its axis.
    """
    # squared mean of the amplitude exp(-r^2 / w^2) over the disc of the lens
    return 1.0 if fill < 1e-9 else (-math.expm1(-fill) / fill) ** 2


def _ranked(runs: _Runs, arm: str, step: str) -> Ranked:
    """Return the ranked pixels behind lens or mask at as many distances as their interpolation
    needs.
    """
    recipe, safety = runs.recipe, runs.safety
    beam, lens = safety.laser.beam(), safety.settings.lens
    nominal_veil = _nominal_veil(safety)
    pixels_at: dict[float, BrightPixels] = {}
    shared_psf = _psf_beside(recipe, safety, arm, step)

    def level(distance: float) -> FloatArray:
        pixels = BrightPixels(
            *runs.of(at_distance(recipe, safety, step, distance), [step, *shared_psf])[step]
        )
        # convert light relative to a uniform beam to light relative to what passes the lens
        passing_share = _passing(fill_at(beam, lens.diameter, distance))
        pixels_at[distance] = pixels._replace(
            light=pixels.light / passing_share,
            smooth=pixels.smooth / passing_share,
            # the rim has a distance, which stays, and two shares of light
            rim=pixels.rim * pixels.rim.new_tensor([1.0, 1 / passing_share, 1 / passing_share]),
        )
        return _log_level(pixels_at[distance], safety, nominal_veil)

    if _wavefront_of(recipe, step) is None:
        # a plane wave: one spot for all distances
        level(safety.laser.distance)
        return Ranked(arm, (safety.laser.distance,), (pixels_at[safety.laser.distance],), math.inf)
    refined = _refined(_first(safety, recipe, step), level, _MOST_SPOTS)
    error = max(refined.misses, default=0.0)
    return Ranked(
        arm,
        refined.distances,
        tuple(pixels_at[distance] for distance in refined.distances),
        error,
        refined.misses,
    )


def _psf_beside(recipe: Recipe, safety: Safety, arm: str, step: str) -> list[str]:
    """Return the PSF of the peak behind the mask if it shares the pupil of ``step``, so that one
    run computes both.
    """
    if arm != "mask" or safety.settings.protection.mask is None:
        return []
    peak_psf = _psf_of(recipe, _mask_step(recipe, safety))
    one_pupil = (
        peak_psf is not None
        and _wavefront_of(recipe, peak_psf) == _wavefront_of(recipe, step) is not None
    )
    return [peak_psf] if peak_psf is not None and one_pupil else []


def _nominal_veil(safety: Safety) -> Veil | None:
    """Return the veil of the lens without draws."""
    return veil_of(safety, SettingDraws(0, {}, {}, 0))


def _log_level(groups: BrightPixels, safety: Safety, veil: Veil | None) -> FloatArray:
    """Return the logarithm of the level at the number of pixels that may be lost, with the nominal
    veil.

    The level is the share of the light in the faintest of these pixels; the array is (rank,), one.
    """
    dazzle, shape = safety.settings.dazzle, safety.settings.sensor.shape
    asked_pixels = (dazzle.share if dazzle else 1.0) * shape[0] * shape[1]
    shares = veil.share[:1] if veil else np.zeros(1)
    # not smoothed over a feature
    levels, _ = levels_of(groups, shape, np.array([max(asked_pixels, 1.0)]), veil, shares, False)
    nominal: FloatArray = levels[0]
    return nominal


def _first(safety: Safety, recipe: Recipe, step: str) -> list[float]:
    """Return the initial distances of spots, from the nearest distance that the pupil's sampling
    allows to a far one.
    """
    beam, lens = safety.laser.beam(), safety.settings.lens
    far_end = far_distance(beam, lens.diameter)
    near_end = min(max(safety.settings.distances[0], _carried(safety, recipe, step)), far_end)
    if far_end / near_end < _FINEST:
        return [near_end, far_end] if near_end < far_end else [far_end]
    # distances by factors of `_FACTOR` at most, three at least
    count = max(3, 1 + math.ceil(math.log(far_end / near_end) / math.log(_FACTOR)))
    return [float(distance) for distance in np.geomspace(near_end, far_end, count)]


def _carried(safety: Safety, recipe: Recipe, step: str) -> float:
    """Return the shortest distance in m at which the pupil samples resolve the curvature of the
    beam.
    """
    pupil = _pupils(recipe, step)[0]
    stop = recipe.steps[str(pupil.wires["stop"])].params
    pitch = safety.settings.lens.diameter / float(stop["samples"])
    beam, rim = safety.laser.beam(), safety.settings.lens.diameter / 2
    for distance in np.geomspace(*safety.settings.distances, 400):
        lit_radius = min(rim, _DIM * beam_radius(beam, distance))
        # a sphere of radius R has the slope r / R: the path between two samples, in waves
        if lit_radius * pitch / curvature_radius(beam, distance) <= _TURN * beam.wavelength:
            return float(distance)
    return safety.settings.distances[1]


@dataclass(frozen=True)
class _Refined:
    """Values at rising distances, and the interpolation error in each gap."""

    distances: tuple[float, ...]  #: m
    values: tuple[FloatArray, ...]  #: logarithms
    misses: tuple[float, ...]  #: of the logarithm, by gap


def _refined(
    distances: Sequence[float],
    value: Callable[[float], FloatArray],
    limit: int,
    close: float = _CLOSE,
) -> _Refined:
    """Return values (logarithms) at distances, and at the middles of the gaps with the largest
    interpolation error.

    A middle shows how much its gap missed. Each half is then counted with as much, until its own
    middle is known: the peak behind a mask has kinks, where another lobe becomes the brightest.
    Gaps that miss no more than ``close`` stay.
    """
    values = {distance: value(distance) for distance in distances}
    misses = dict.fromkeys(itertools.pairwise(distances), math.inf)
    while len(values) < limit:
        open_gaps = [gap for gap in misses if gap[1] / gap[0] > _FINEST and misses[gap] > close]
        if not open_gaps:
            break
        near, far = max(open_gaps, key=lambda gap: misses[gap] * math.log(gap[1] / gap[0]))
        middle = math.sqrt(near * far)
        rising_distances = sorted(values)
        interpolated_value = interpolated(
            np.log(rising_distances),
            np.stack([values[known] for known in rising_distances]),
            np.log(middle),
        )
        values[middle] = value(middle)
        miss = float(np.abs(values[middle] - interpolated_value).max())
        del misses[near, far]
        misses |= {(near, middle): miss, (middle, far): miss}
    rising_distances = sorted(values)
    gaps = tuple(misses[gap] for gap in itertools.pairwise(rising_distances))
    return _Refined(
        tuple(rising_distances), tuple(values[distance] for distance in rising_distances), gaps
    )


def at_distance(recipe: Recipe, safety: Safety, step: str, distance: float) -> Recipe:
    """Return the recipe with another laser distance in the wavefront upstream of a step.

    A lens that is focused on a distance, or on the laser, has the defocus of its pupil changed with
    it.
    """
    wavefront = _wavefront_of(recipe, step)
    assert wavefront is not None
    varied = _with_param(recipe, wavefront, "distance", distance)
    lens = safety.settings.lens
    if lens.focus == "infinity":
        return varied
    curvature = _bend(safety, distance) if lens.focus == "laser" else 1 / float(lens.focus)
    for pupil in _pupils(recipe, step):
        # a curvature 1/R is the path D^2 / (8 R) at the rim, in waves of 550 nm
        defocus = pupil.params["defocus"] - curvature * lens.diameter**2 / 8 / _DEFOCUS
        varied = _with_param(varied, pupil.name, "defocus", defocus)
    return varied


def _with_param(recipe: Recipe, step: str, name: str, value: Any) -> Recipe:
    """Return the recipe with another value of one parameter of a step."""
    changed = recipe.steps[step]
    changed = replace(changed, params={**changed.params, name: value})
    return replace(recipe, steps={**recipe.steps, step: changed})


def _pupils(recipe: Recipe, step: str) -> list[Step]:
    """Return the steps of the pupil on which a step depends."""
    return [above for above in _upstream(recipe, step) if above.node.path == "optics.pupil"]


def _bend(safety: Safety, distance: float) -> float:
    """Return the curvature in 1/m of the laser's wavefront at a distance."""
    return float(1 / curvature_radius(safety.laser.beam(), distance))


def _wavefront_of(recipe: Recipe, step: str) -> str | None:
    """Return the name of the wavefront's step upstream of ``step``; None without one."""
    names = (
        source.name for source in _upstream(recipe, step) if source.node.path == "laser.wavefront"
    )
    return next(names, None)


def _upstream(recipe: Recipe, step: str) -> Iterator[Step]:
    """Yield the steps on which a step depends."""
    yield from (recipe.steps[name] for name in needed(recipe, [step]))


def _step(recipe: Recipe, safety: Safety, arm: str, named: str) -> str:
    """Return the name of a step of ranked pixels; raise `RecipeError` for another node or another
    sensor.
    """
    setting, sensor = f"protection.pixels.{arm}", safety.settings.sensor
    step = step_of(recipe, safety, setting, named, arm)
    ranking_step, params = recipe.steps[step], recipe.steps[step].params
    value, problem = safety.values[setting], ""
    if ranking_step.node.path != _RANKS:
        problem = f"the step {step} has the node {ranking_step.node.path}: name a step of {_RANKS}"
    elif (
        not math.isclose(params["pixel_pitch"], sensor.pixel_pitch)
        or tuple(params["shape"]) != sensor.shape
    ):
        problem = (
            f"the step {step} has another sensor: set its sensor to safety.sensor.pixel_pitch and"
            " safety.sensor.shape"
        )
    elif any(source.node.path == "flare.stray_light" for source in _upstream(recipe, step)):
        problem = (
            f"the step {step} includes stray light, which the estimate adds itself: rank the PSF"
            " before flare.stray_light"
        )
    if problem:
        raise RecipeError([Diagnostic(value.mark, value.name, problem)])
    return step
