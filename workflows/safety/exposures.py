"""Exposure at lens and sensor as a function of distance, and the distances at which it exceeds a
limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from neusee.nodes import ParameterError
from neusee.nodes.laser import (
    Beam,
    air_transmittance,
    axis_density,
    beam_radius,
    defocus_at,
    density_in_spot,
    heated_diameter,
    heated_in_spot,
    scintillation,
    sensor_density,
    share_through,
    stopped_share,
    widest_heated_diameter,
)
from neusee.workflows.graph.errors import Diagnostic, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.blocks.safety_block import BEAM, Lens, Safety
from neusee.workflows.recipe.distributions.nominal_values import Uncertain
from neusee.workflows.recipe.distributions.shapes import FloatArray
from neusee.workflows.recipe.uncertain_inputs import (
    NEGLIGIBLE,
    only_values,
    within_allowed,
)

# --- uncertain values -----------------------------------------------------------------------------

# Random draws of the settings that a recipe gives as distributions or by a posterior.


_ROWS = 3  #: stream of random numbers that selects rows of a table of samples


@dataclass(frozen=True)
class SettingDraws:
    """Draws of the uncertain settings of an estimate."""

    count: int
    values: Mapping[str, FloatArray]  #: (draw,) in SI by setting, such as ``laser.power``
    laws: Mapping[str, str]  #: distribution as written, by setting
    seed: int

    def column(self, name: str, nominal: float) -> FloatArray:
        """Return the nominal value of a setting and its draws (1 + draw,)."""
        draws = self.values.get(name, np.full(self.count, nominal))
        return np.concatenate([[nominal], draws])

    def normal(self, stream: int) -> FloatArray:
        """Return a standard normal number for each draw; different values of ``stream`` give
        independent numbers.
        """
        return np.random.default_rng([self.seed, 2, stream]).standard_normal(self.count)


def draw_settings(recipe: Recipe, safety: Safety) -> SettingDraws:
    """Return random draws of each setting that the recipe gives as a distribution or by a
    posterior.

    A negligible part of a distribution outside the values that the recipe allows is cut off, and
    its text says so. Raises `RecipeError` for a distribution with more outside.
    """
    uncertain, count = recipe.uncertain, safety.settings.draws
    if uncertain is None:
        return SettingDraws(count, {}, {}, recipe.seed)
    paths = {
        setting: value.name
        for setting, value in safety.values.items()
        if value.name in uncertain.names
    }
    allowed, notes = within_allowed(only_values(uncertain, paths.values()), NEGLIGIBLE)
    draws_by_path = _draws(allowed, count, recipe.seed)
    texts = {path: uncertain.said(path) for path in draws_by_path}
    texts |= {path: f"{texts[path]} ({note})" for path, note in notes.items()}
    # in the order in which they were drawn
    order = sorted(paths, key=lambda setting: list(draws_by_path).index(paths[setting]))
    values = {setting: draws_by_path[paths[setting]] for setting in order}
    return SettingDraws(
        count, values, {setting: texts[paths[setting]] for setting in order}, recipe.seed
    )


def _draws(uncertain: Uncertain, count: int, seed: int) -> dict[str, FloatArray]:
    """Return ``count`` draws of each uncertain value; values from a table of samples are drawn as
    whole rows, which keeps their correlation.
    """
    standard_normal = np.random.default_rng([seed, 1]).standard_normal(
        (count, len(uncertain.names))
    )
    draws_by_name = {
        name: law.at(standard_normal[:, i]) for i, (name, law) in enumerate(uncertain.laws.items())
    }
    joint = uncertain.joint
    if joint is None:
        return draws_by_name
    if joint.draws is None:
        # the last columns of random numbers are for the joint values
        rows = joint.at(standard_normal[:, len(draws_by_name) :])
    else:
        rows = joint.draws[
            np.random.default_rng([seed, _ROWS]).integers(0, len(joint.draws), count)
        ]
    return draws_by_name | dict(zip(joint.names, rows.T, strict=True))


# --- distance ladder ------------------------------------------------------------------------------

# Distances at which the spot of a laser is recomputed: closely spaced where its shape changes, and
# none where it stays the same.


#: largest fill (D / (2 w))^2 and defocus (waves) at which a spot counts as that of a distant laser
FAR_FILL, FAR_WAVES = 0.02, 0.03
#: largest defocus (waves) for a lens that is out of focus far away, where each wave has a
#: first-order effect
UNFOCUSED_WAVES = 0.002
#: defocus (waves) up to which the distances follow the change of the spot's centre between bright
#: and dark
FOLLOWED_WAVES = 2.0
_DEFOCUS = 550e-9  #: m; the wavelength in which waves of defocus are counted


def far_distance(beam: Beam, diameter: float, waves: float = FAR_WAVES) -> float:
    """Return the distance in m from which the beam overfills a lens and its wavefront is plane.

    The fill (D / (2 w))^2 is then at most 0.02, which lowers the spot by 2 %, and the curvature at
    most 0.03 waves, which lowers the spot of a lens in focus by 0.3 %; the power into the lens is
    exact at every distance.
    """
    least_radius = diameter / (2 * math.sqrt(FAR_FILL))
    # w(R)^2 = waist^2 + (divergence R / 2)^2
    overfilled_from = 2 * math.sqrt(max(least_radius**2 - beam.waist**2, 0.0)) / beam.divergence
    # path at the rim D^2 / (8 R), in waves
    plane_from = diameter**2 / (8 * beam.wavelength * waves)
    return max(overfilled_from, plane_from)


def focus_of(lens: Lens) -> float:
    """Return the distance in m at which a lens is focused; infinity for a lens that follows the
    laser.
    """
    return math.inf if isinstance(lens.focus, str) else lens.focus


def ladder(
    beam: Beam, lens: Lens, diameter: float, ends: tuple[float, float], step: float, waves: float
) -> FloatArray:
    """Return rising distances from the nearest to the furthest of ``ends``, or to that of a distant
    laser.

    Between two of them the distance grows by the factor 1 + ``step`` at most, and the defocus
    changes by ``waves`` or, from `FOLLOWED_WAVES`, by the share ``step`` of itself at most.
    """
    nearest, furthest = ends
    follows = lens.focus == "laser"
    focused = follows or (lens.focus == "infinity" and not lens.defocus)
    farthest = min(
        furthest, far_distance(beam, diameter, FAR_WAVES if focused else UNFOCUSED_WAVES)
    )

    def defocus(distance: float) -> float:
        defocused = defocus_at(beam, distance, diameter, focus_of(lens), lens.defocus * _DEFOCUS)
        return 0.0 if follows else float(defocused)

    # from the farthest rung to the nearest
    rungs = [farthest]
    while rungs[-1] > nearest:
        rung, factor = rungs[-1], 1 + step
        allowed = (
            waves if abs(defocus(rung)) < FOLLOWED_WAVES else max(waves, step * abs(defocus(rung)))
        )
        # smaller steps until the defocus changes little enough
        while abs(defocus(rung / factor) - defocus(rung)) > allowed and factor > 1.002:
            # no step below 0.2 % of the distance
            factor = math.sqrt(factor)
        rungs.append(max(rung / factor, nearest))
    return np.array(rungs[::-1])


def miss_between(rungs: FloatArray, misses: Sequence[float], place: FloatArray) -> FloatArray:
    """Return an upper bound of the interpolation error at ``place``: 0 at each rung, and largest in
    the middle of a gap.

    ``misses`` has one number for each gap between two rungs; without any nothing is missed.
    """
    if not len(misses):
        return np.zeros_like(place)
    gap = np.clip(np.searchsorted(rungs, place, side="right") - 1, 0, len(rungs) - 2)
    share_of_gap = np.clip((place - rungs[gap]) / (rungs[gap + 1] - rungs[gap]), 0, 1)
    # a parabola that is 1 in the middle of the gap
    missed: FloatArray = np.asarray(misses, np.float64)[gap] * 4 * share_of_gap * (1 - share_of_gap)
    return missed


def interpolated(rungs: FloatArray, values: FloatArray, place: FloatArray) -> FloatArray:
    """Return values (rung, ...) interpolated at ``place`` (any, ...), without overshoot; a single
    rung gives a constant.
    """
    from scipy.interpolate import PchipInterpolator

    if len(rungs) == 1:
        return np.broadcast_to(values[0], (*np.shape(place), *values.shape[1:]))
    # cubic, and monotone where the values are
    between: FloatArray = PchipInterpolator(rungs, values)(place)
    return between


def as_wide(beam: Beam, radius: FloatArray) -> FloatArray:
    """Return the distance in m at which the 1/e2 radius of a beam is ``radius``; 1 mm if the beam
    is wider at every distance.
    """
    # at least the square of divergence times 1 mm / 2
    reached = np.maximum(radius**2 - beam.waist**2, (5e-4 * beam.divergence) ** 2)
    distance: FloatArray = 2 * np.sqrt(reached) / beam.divergence
    return distance


def fill_at(beam: Beam, diameter: float, distance: float) -> float:
    """Return the fill (D / (2 w))^2 of a lens of diameter D by a beam of radius w at a distance."""
    return diameter**2 / (4 * beam_radius(beam, distance) ** 2)


# --- distance zones -------------------------------------------------------------------------------

# Intervals of distance in which an exposure exceeds a limit, for the nominal values and for random
# draws.


QUANTILES = (0.05, 0.95)  #: ends of the interval that contains 90 % of the draws
_ROUNDED = 1e-9  #: relative rounding of the logarithm of a distance


@dataclass(frozen=True)
class Spread:
    """A number with the interval that contains 90 % of its draws; all three are equal without
    uncertainty.
    """

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, value: float, draws: FloatArray) -> Spread:
        """Return a number with the interval of its draws; draws that are NaN are ignored."""
        finite = draws[~np.isnan(draws)]
        if not finite.size:
            return cls(value, value, value)
        low, high = np.quantile(finite, QUANTILES)
        return cls(value, float(low), float(high))


@dataclass(frozen=True)
class Zone:
    """An interval of distance in m, whose ends have intervals of their own."""

    near: Spread
    far: Spread
    begins_before: bool  #: whether the zone reaches below the shortest distance of the settings
    ends_beyond: bool  #: whether the zone reaches beyond the longest distance of the settings


@dataclass(frozen=True)
class Zones:
    """The intervals of distance in which a limit is exceeded, and how certain they are."""

    zones: tuple[Zone, ...]  #: at the nominal values
    none: float  #: share of the draws without any zone
    #: share of the draws with as many zones as the nominal values; only these give the ends between
    #: zones
    alike: float
    #: largest distance of any zone, over the draws with a zone; None if no draw has one
    reach: Spread | None
    #: share of the draws in which the limit is exceeded at the distance of the recipe
    inside: float


def crossings(distances: FloatArray, ratio: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the near and far ends (draw, zone) of the intervals in which ``ratio`` (draw,
    distance) is at least 1.

    Ends between two distances are interpolated in the logarithms. Rows with fewer zones than others
    end with NaN. A zone that begins before the first distance, or ends beyond the last, has this
    distance as its end.
    """
    with np.errstate(divide="ignore"):
        log_ratio = np.log(np.maximum(ratio, 1e-300))
    log_distance, inside = np.log(distances), log_ratio >= 0
    outside = np.zeros((len(inside), 1), bool)
    begins_here = inside & ~np.concatenate([outside, inside[:, :-1]], 1)
    ends_here = inside & ~np.concatenate([inside[:, 1:], outside], 1)
    return _placed(log_distance, log_ratio, begins_here, -1), _placed(
        log_distance, log_ratio, ends_here, 1
    )


def _placed(
    place: FloatArray, height: FloatArray, marks: NDArray[np.bool_], step: int
) -> FloatArray:
    """Return the distance (draw, zone) of the zero crossing next to each marked sample; ``step``
    (-1 or 1) selects the side.
    """
    row, column = np.nonzero(marks)
    neighbour = np.clip(column + step, 0, len(place) - 1)
    inner_height, outer_height = height[row, column], height[row, neighbour]
    # linear between the two samples; 0 at an end of the distances
    fraction = np.where(
        neighbour == column,
        0.0,
        inner_height / np.where(neighbour == column, 1.0, inner_height - outer_height),
    )
    distances = np.exp(place[column] + fraction * (place[neighbour] - place[column]))
    per_row = marks.sum(1)
    table = np.full((len(marks), int(per_row.max(initial=0))), np.nan)
    # the n-th mark of a row goes to column n: its index less that of the row's first mark
    table[row, np.arange(len(row)) - np.repeat(np.cumsum(per_row) - per_row, per_row)] = distances
    return table


def zones_of(
    distances: FloatArray,
    nominal: FloatArray,
    drawn: FloatArray,
    distance: float,
    asked: tuple[float, float] | None = None,
) -> Zones:
    """Return the zones of a limit from the ratio of exposure to limit, ``nominal`` (distance,) and
    ``drawn`` (draw, distance).

    Zones lie between the two distances ``asked``, whether or not the ``distance`` of the recipe
    does. The outer ends, such as the farthest distance, have the interval of all draws that have a
    zone; ends between two zones have that of the draws with as many zones as the nominal values.
    """
    exceeded_here = _at(distances, drawn, distance) >= 1
    if asked is not None:
        is_asked = (distances >= asked[0] * (1 - _ROUNDED)) & (
            distances <= asked[1] * (1 + _ROUNDED)
        )
        distances, nominal, drawn = distances[is_asked], nominal[is_asked], drawn[:, is_asked]
    # of the nominal values: (zone,)
    near_ends, far_ends = (ends[0] for ends in crossings(distances, nominal[None]))
    # (draw, zone), NaN after the last zone of a draw
    starts, stops = crossings(distances, drawn)
    zone_counts = (~np.isnan(starts)).sum(1)
    has_as_many_zones = zone_counts == len(near_ends)
    farthest_ends = np.nanmax(stops[zone_counts > 0], 1) if (zone_counts > 0).any() else np.zeros(0)
    # outer ends: from every draw with a zone
    first_ends, last_zone = starts[zone_counts > 0, :1].ravel(), len(near_ends) - 1
    zones = tuple(
        Zone(
            Spread.of(
                float(near_ends[zone]),
                _column(starts[has_as_many_zones], zone) if zone else first_ends,
            ),
            Spread.of(
                float(far_ends[zone]),
                _column(stops[has_as_many_zones], zone) if zone < last_zone else farthest_ends,
            ),
            bool(near_ends[zone] <= distances[0] * (1 + _ROUNDED)),
            bool(far_ends[zone] >= distances[-1] * (1 - _ROUNDED)),
        )
        for zone in range(len(near_ends))
    )
    reach = (
        Spread.of(
            float(far_ends.max()) if len(far_ends) else float(np.median(farthest_ends)),
            farthest_ends,
        )
        if farthest_ends.size
        else None
    )
    return Zones(
        zones,
        float((zone_counts == 0).mean()),
        float(has_as_many_zones.mean()),
        reach,
        float(exceeded_here.mean()),
    )


def _column(ends: FloatArray, zone: int) -> FloatArray:
    """Return the ends (draw,) of one zone; empty without draws."""
    return ends[:, zone] if len(ends) else np.zeros(0)


def _at(distances: FloatArray, ratio: FloatArray, distance: float) -> FloatArray:
    """Return the ratio (draw,) at ``distance``, which must be an element of ``distances``."""
    column: FloatArray = ratio[:, int(np.argmin(np.abs(distances - distance)))]
    return column


def sampled(first: float, last: float, also: Sequence[float] = (), count: int = 600) -> FloatArray:
    """Return rising distances from ``first`` to ``last`` in a geometric series, and the distances
    ``also``.
    """
    return np.unique(
        np.concatenate([np.geomspace(first, last, count), np.asarray(also, np.float64)])
    )


# --- exposures ------------------------------------------------------------------------------------

# Exposure at the lens and on the sensor as a function of distance, for nominal values and for
# draws.


Emission = Literal["continuous", "single pulse", "pulse train"]
#: the peak is the largest within this relative change of the defocus: half a step of distance
WITHIN = 0.01


@dataclass(frozen=True)
class Option:
    """One way to protect the sensor, as changes of the light between lens and sensor."""

    name: str
    diameter: float | None = None  #: m, of a smaller stop; None: that of the lens
    passing: float = 1.0  #: transmittance of a filter
    peak: float = 1.0  #: peak of the PSF over that of the clear lens, at the distance of the recipe
    masked: bool = False  #: whether the mask is in front of the lens
    #: diameter of the heated spot over that of the clear lens; None: not known
    heated: float | None = None
    #: transmittance of a filter for the scene's light; None: the same as for the laser
    scene: float | None = None

    def scene_share(self, diameter: float) -> float:
        """Return the share of the scene's light that reaches the sensor, for a lens of
        ``diameter`` m.
        """
        filtered = self.passing if self.scene is None else self.scene
        return filtered * stopped_share(diameter, self.diameter or diameter)

    #: distance in m, and the peak there over that of the lens in focus
    peaks: tuple[tuple[float, float], ...] = ()
    #: interpolation error of the logarithm of the peak between two of these distances, an upper
    #: bound
    misses: tuple[float, ...] = ()


@dataclass(frozen=True)
class Exposures:
    """Exposure per unit of emitted power or pulse energy (1/m2) as a function of distance.

    Every array is (1 + draw or 1, distance), and row 0 has the nominal values.
    """

    #: (distance,) m, at equal ratios; the distance of the recipe is one of them
    distances: FloatArray
    lens: FloatArray  #: on the axis at the lens
    sensor: Mapping[str, FloatArray]  #: by option, at the peak on the sensor
    spot: Mapping[str, FloatArray]  #: m, by option, diameter of the spot that heats the sensor
    beams: tuple[Beam, ...]  #: of the nominal values and of each draw
    through: Mapping[str, FloatArray]  #: by option, share of the power that reaches the sensor
    fill: Mapping[str, FloatArray]  #: by option, (D / (2 w))^2
    waves: Mapping[str, FloatArray]  #: by option, defocus at the rim of the lens
    #: cache of the tables of `Area`
    tables: dict[Any, Any] = field(default_factory=dict, compare=False, repr=False)

    def at(self, distance: float) -> int:
        """Return the index of the array element nearest to ``distance``."""
        return int(np.argmin(np.abs(self.distances - distance)))

    def emitted(self, quantity: Literal["irradiance", "fluence"]) -> FloatArray:
        """Return the mean power in W or the pulse energy in J (1 + draw, 1): nominal, then of each
        draw.
        """
        quantity_name = "power" if quantity == "irradiance" else "pulse_energy"
        return np.array([getattr(beam, quantity_name) for beam in self.beams], np.float64)[:, None]


def emission_of(beam: Beam) -> Emission:
    """Return whether a laser is continuous, emits a single pulse, or a pulse train."""
    if not beam.is_pulsed:
        return "continuous"
    return "single pulse" if beam.repetition_rate is None else "pulse train"


def compute_exposures(
    safety: Safety,
    draws: SettingDraws,
    options: tuple[Option, ...],
    distances: FloatArray | None = None,
) -> Exposures:
    """Return the exposures at the lens and behind each option; raise `RecipeError` if a draw gives
    an impossible beam.

    Without ``distances`` they are those of the settings and of the recipe.
    """
    sampled_distances = (
        asked_distances(safety) if distances is None else np.asarray(distances, np.float64)
    )
    beams = tuple(_beams(safety, draws))
    beam, distance_row = _stacked(beams), torch.from_numpy(sampled_distances)
    air_factor: Any = torch.from_numpy(
        _air(safety, draws, sampled_distances) * _uneven(safety, draws, sampled_distances)
    )
    lens_transmittance = _exposure_column(
        draws, "lens.transmittance", safety.settings.lens.transmittance
    )
    focal_length = _exposure_column(draws, "lens.focal_length", safety.settings.lens.focal_length)
    diameter = _exposure_column(draws, "lens.diameter", safety.settings.lens.diameter)
    by_quantity: dict[str, dict[str, FloatArray]] = {
        name: {} for name in ("sensor", "spot", "through", "fill", "waves")
    }
    for option in options:
        aperture: Any = (
            diameter
            if option.diameter is None
            else torch.minimum(diameter, torch.tensor(option.diameter))
        )
        waves = _waves(safety.settings.lens, beam, distance_row, aperture)
        transmittance = lens_transmittance * option.passing * air_factor
        # last argument 1.0: no losses in the lens
        focused_density: Any = sensor_density(beam, distance_row, aperture, focal_length, 1.0)
        density = (
            focused_density * _at_width(option, beams[0], beam_radius(beam, distance_row))
            if option.masked
            else (density_in_spot(beam, distance_row, aperture, focal_length, waves, WITHIN))
        )
        by_quantity["sensor"][option.name] = (density * transmittance).numpy()
        heated_spot: Any = (
            heated_diameter(beam, distance_row, aperture, focal_length)
            * _widened(option, density / focused_density)
            if option.masked
            else heated_in_spot(beam, distance_row, aperture, focal_length, waves, density)
        )
        by_quantity["spot"][option.name] = heated_spot.numpy()
        by_quantity["through"][option.name] = (
            share_through(beam, distance_row, aperture) * transmittance
        ).numpy()
        by_quantity["fill"][option.name] = (
            aperture**2 / (4 * beam_radius(beam, distance_row) ** 2)
        ).numpy()
        by_quantity["waves"][option.name] = waves.numpy()
    # not in the loop: the same for all options
    lens_density = axis_density(beam, distance_row, air_factor).numpy()
    return Exposures(
        sampled_distances,
        lens_density,
        by_quantity["sensor"],
        by_quantity["spot"],
        beams,
        by_quantity["through"],
        by_quantity["fill"],
        by_quantity["waves"],
    )


def _widened(option: Option, peak: Any) -> Any:
    """Return an upper bound of the heated spot's diameter relative to the clear lens in focus;
    ``peak`` is the ratio of the peaks.

    The width behind a mask at the distance of the recipe is `Option.heated`, so that the rest
    counts here alone.
    """
    ratio_to_focus = (peak / option.peak).clamp_max(1.0)
    width_ratio = widest_heated_diameter(torch.ones_like(ratio_to_focus), ratio_to_focus)
    # 1e-9 is rounding: no light is lost from the peak
    return width_ratio.where(ratio_to_focus < 1 - 1e-9, 1.0)


def asked_distances(safety: Safety) -> FloatArray:
    """Return the distances of the settings in a geometric series, with the distance of the recipe
    among them.
    """
    nearest, furthest = safety.settings.distances
    return sampled(nearest, furthest, (safety.laser.distance,))


def _waves(lens: Lens, beam: Beam, where: Any, aperture: Any) -> Any:
    """Return the defocus in waves at the rim of the aperture (1 + draw or 1, distance)."""
    if lens.focus == "laser":
        return torch.zeros(1, 1, dtype=torch.float64)
    focus = math.inf if isinstance(lens.focus, str) else lens.focus
    # the path at the rim grows with the square of the diameter
    path_factor = (aperture / lens.diameter) ** 2 if lens.defocus else 1.0
    return defocus_at(beam, where, aperture, focus, lens.defocus * _DEFOCUS * path_factor)


def _at_width(option: Option, nominal: Beam, radius: Any) -> Any:
    """Return the peak behind a mask relative to the clear lens in focus; ``radius`` is the 1/e2
    radius of the beam at the lens.

    A beam that is drawn has the peak of the nominal beam at the distance where the nominal beam is
    as wide. Nearer than the first peak the ratio is 1, which no mask exceeds.
    """
    if not option.peaks:
        return option.peak
    log_distances, ratio = np.log(np.array(option.peaks)).T
    # where the nominal beam is as wide
    log_distance = np.log(as_wide(nominal, np.asarray(radius, np.float64)))
    clipped_distance = np.clip(log_distance, log_distances[0], log_distances[-1])
    interpolated_ratio = np.exp(
        interpolated(log_distances, ratio, clipped_distance)
        + miss_between(log_distances, option.misses, clipped_distance)
    )
    return torch.from_numpy(
        np.where(
            log_distance < log_distances[0] - _ROUNDED, 1.0, np.minimum(interpolated_ratio, 1.0)
        )
    )


def _uneven(safety: Safety, draws: SettingDraws, distances: FloatArray) -> FloatArray:
    """Return the factor (1 + draw or 1, distance) by which hot spots and turbulence raise the
    irradiance.
    """
    beam = safety.settings.beam
    factor = draws.column("beam.hot_spots", beam.hot_spots)[:, None]
    if not np.ptp(factor):
        factor = factor[:1]
    if beam.cn2 is None:
        return factor
    structure_constants = torch.from_numpy(draws.column("beam.cn2", beam.cn2)[:, None])
    scintillation_factor: Any = scintillation(
        safety.laser.wavelength, torch.from_numpy(distances), structure_constants, beam.worst
    )
    return np.asarray(factor * scintillation_factor.numpy(), np.float64)


def _beams(safety: Safety, draws: SettingDraws) -> list[Beam]:
    """Return the nominal beam, followed by the beam of each draw."""
    draws_by_name = {
        name: draws.values[f"laser.{name}"] for name in BEAM if f"laser.{name}" in draws.values
    }
    beams = [safety.laser.beam()]
    try:
        for draw in range(draws.count):
            beams.append(
                safety.laser.beam(
                    {name: float(values[draw]) for name, values in draws_by_name.items()}
                )
                if draws_by_name
                else beams[0]
            )
    except ParameterError as error:
        value = safety.values.get(f"laser.{error.parameter}", next(iter(safety.values.values())))
        raise RecipeError(
            [Diagnostic(value.mark, value.name, f"the value is drawn, but {error}")]
        ) from None
    return beams


def _stacked(beams: tuple[Beam, ...]) -> Beam:
    """Return one beam whose quantities are columns (1 + draw, 1), so that formulas compute all
    draws at once.

    A column of equal values has one row.
    """
    fields = ("wavelength", "waist", "divergence")
    columns = {name: _short(np.array([getattr(beam, name) for beam in beams])) for name in fields}
    return beams[0]._replace(**columns)


def _short(values: FloatArray) -> Any:
    """Return values as a column (1 + draw, 1), or as one row if all are equal."""
    # `ptp` is 0 where all values are equal
    return torch.from_numpy((values if np.ptp(values) else values[:1])[:, None])


def _exposure_column(draws: SettingDraws, name: str, nominal: float) -> Any:
    """Return the nominal value and the draws of a setting as a column (1 + draw, 1), or as one
    row if all are equal.
    """
    return _short(draws.column(name, nominal))


def _air(safety: Safety, draws: SettingDraws, distances: FloatArray) -> FloatArray:
    """Return the transmittance of the air (1 + draw, distance), the power of the transmittance of
    one metre of homogeneous air.
    """
    laser = safety.laser
    if laser.air_transmittance is not None:
        transmittance = draws.column("laser.air_transmittance", laser.air_transmittance)[:, None]
        return np.asarray(np.power(transmittance, distances / laser.distance), np.float64)
    if laser.visibility is None:
        return np.ones((1, 1))
    visibilities = draws.column("laser.visibility", laser.visibility).tolist()
    per_metre = {
        visibility: air_transmittance(1.0, visibility, laser.wavelength, laser.haze)
        for visibility in set(visibilities)
    }
    return np.asarray(
        np.power(
            np.array([per_metre[visibility] for visibility in visibilities])[:, None], distances
        ),
        np.float64,
    )


def options_of(
    safety: Safety,
    mask: float | None,
    peaks: tuple[tuple[float, float], ...] = (),
    misses: tuple[float, ...] = (),
) -> tuple[Option, ...]:
    """Return the plain lens and the protections that the settings name.

    ``mask`` is the peak behind the mask at the distance of the recipe, ``peaks`` are those over the
    distance, and ``misses`` how much the logarithm of a peak between two distances may be higher
    than interpolated.
    """
    protection = safety.settings.protection
    options = [Option("plain lens")]
    if mask is not None:
        options.append(Option("mask", peak=mask, masked=True, peaks=peaks, misses=misses))
    if protection.filter is not None:
        options.append(Option(f"grey filter {protection.filter:g}", passing=protection.filter))
    if protection.stop is not None:
        options.append(Option(f"stop {protection.stop * 1e3:g} mm", diameter=protection.stop))
    if mask is not None and protection.filter is not None:
        options.append(replace(options[1], name="mask and grey filter", passing=protection.filter))
    return tuple(options)
