"""Estimate of damage, dazzle and eye exposure by a laser: limits, exposures and intervals of distance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from neusee.workflows.graph.diagnostics import Diagnostic, Location, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.recipe.distributions.shapes import FloatArray
from neusee.workflows.safety.counted_parts import near_text
from neusee.workflows.safety.damage_pattern import (
    DamagePattern,
    Spot,
    damage_patterns,
    spots_of,
    with_heated_spots,
)
from neusee.workflows.safety.damage_verdict import DamageVerdict, damage_verdicts
from neusee.workflows.safety.dazzle_curves import Dazzled, dazzled
from neusee.workflows.safety.dazzled_area import Area, area_of
from neusee.workflows.safety.dead_pixels import DeadPixels, damaged_frames
from neusee.workflows.safety.distance_zones import QUANTILES, Spread, Zones, zones_of
from neusee.workflows.safety.exposures import (
    Emission,
    Exposures,
    Option,
    compute_exposures,
    emission_of,
    options_of,
)
from neusee.workflows.safety.eye_findings import EyeDazzleFinding, EyeFinding, eye_dazzle_finding, eye_finding
from neusee.workflows.safety.first_channel import sees, with_channels
from neusee.workflows.safety.lens_of_recipe import refuse_other_lens
from neusee.workflows.safety.light_levels import Veil, veil_of
from neusee.workflows.safety.limit_ratios import emitted, limit_ratio, limits_behind, mean_in_frame
from neusee.workflows.safety.sensor_limits import Limit
from neusee.workflows.safety.spots_along import Peaks, Ranked, peaks_of, ranked_of
from neusee.workflows.safety.uncertain_values import SettingDraws, draw_settings
from neusee.workflows.safety.unsaid_parts import beyond_window, unsaid_of_damage, unsaid_of_dazzle
from neusee.workflows.safety.what_helps import Remedy, remedies
from neusee.workflows.store.result_store import Store

CERTIFICATE = "An estimate, no certificate: neusee decides nothing about eyes or sensors."


@dataclass(frozen=True)
class Finding:
    """What one limit says behind one option: the limit at the lens, the exposure, and the zones of distance."""

    option: str
    limit: Limit
    at_sensor: Spread  #: the limit at the peak on the sensor
    at_lens: Spread  #: the limit at the lens at the distance of the recipe: MPE_S or MDE_S
    exposure: Spread  #: at the peak on the sensor at the distance of the recipe, in the quantity of the limit
    ratio: float  #: nominal exposure over the nominal limit
    probability: Spread | None  #: of damage to a device drawn from all; None where the spread of devices is unknown
    zones: Zones
    curve: FloatArray  #: (3, distance) of the limit at the lens: nominal, 5 % and 95 %
    ratios: Spread | None = None  #: ``ratio`` with its interval


@dataclass(frozen=True)
class Estimate:
    """Everything that `neusee safety` says of a recipe."""

    recipe: Recipe
    safety: Safety
    emission: Emission
    options: tuple[Option, ...]
    draws: SettingDraws
    exposures: Exposures
    findings: tuple[Finding, ...]
    eye: EyeFinding | None
    eye_dazzle: EyeDazzleFinding
    unsaid: tuple[str, ...]  #: what the estimate does not say, with the reason
    patterns: tuple[DamagePattern, ...] = ()
    dazzled: tuple[Dazzled, ...] = ()  #: behind each protection for which the dazzled area is known
    dead: tuple[DeadPixels, ...] = ()  #: examples of damage in a raw frame
    ranked: tuple[Ranked, ...] = ()
    damage: tuple[DamageVerdict, ...] = ()  #: behind each protection; empty if damage is not asked for
    helps: tuple[Remedy, ...] = ()  #: filter, notch, stop or exposure for each limit behind the plain lens
    peaks: Peaks | None = None
    veil: Veil | None = None

    @property
    def at(self) -> int:
        """Return the index of the distance of the recipe among all distances."""
        return self.exposures.at(self.safety.laser.distance)

    @property
    def mean_at_lens(self) -> float:
        """Return the nominal irradiance at the lens at the distance of the recipe, the mean over one exposure, W/m2."""
        mean = mean_in_frame(self.exposures, self.safety.settings.sensor.exposure or 1.0)
        return float(mean[0, 0] * self.exposures.lens[0, self.at])


def estimate(recipe: Recipe, store: Store | None = None) -> Estimate:
    """Return the estimate of a recipe with a block ``safety``; the peak behind the mask comes from the store if it can.

    Raises `RecipeError` for a recipe without the block, for a distribution with values that are not allowed and for a
    step that does not exist, all before anything is computed, and `RunError` if a step of the mask fails.
    """
    return complete(recipe, prepare(recipe, store))


@dataclass(frozen=True)
class Prepared:
    """Everything that decides an estimate: settings, draws, and what the steps of the recipe say of lens and mask."""

    safety: Safety
    draws: SettingDraws
    options: tuple[Option, ...]
    spots: tuple[Spot, ...]
    ranked: tuple[Ranked, ...]
    peaks: Peaks | None


def prepare(recipe: Recipe, store: Store | None) -> Prepared:
    """Return what decides an estimate, with the errors that `estimate` lists."""
    safety = settings_of(recipe)
    refuse_other_lens(recipe, safety, store)
    safety = with_channels(recipe, safety, store)
    draws = draw_settings(recipe, safety)
    spots = spots_of(recipe, safety, store)
    ranked = ranked_of(recipe, safety, store)
    peaks = peaks_of(recipe, safety, store)
    options = options_of(safety, peaks.here, peaks.along, peaks.misses) if peaks else options_of(safety, None)
    return Prepared(safety, draws, with_heated_spots(options, spots), spots, ranked, peaks)


def complete(recipe: Recipe, prepared: Prepared) -> Estimate:
    """Return the estimate from everything that decides it."""
    safety, draws, options = prepared.safety, prepared.draws, prepared.options
    exposures = compute_exposures(safety, draws, options)
    known = {option.name: area_of(safety, option, prepared.ranked) for option in options}
    areas = tuple(area for area in known.values() if isinstance(area, Area)) if _dazzles(safety) else ()
    findings = tuple(_findings(safety, draws, options, exposures, areas))
    verdicts = tuple(damage_verdicts(safety, options, exposures, draws, findings))
    eye = eye_finding(safety, exposures)
    faults = (eye,) if isinstance(eye, str) else ()
    beyond = {area.option.name: area.beyond(exposures, draws) for area in areas}
    unsaid = (
        *unsaid_of_damage(safety, verdicts),
        *unsaid_of_dazzle(safety, known),
        *beyond_window(beyond),
        *near_text(safety.settings.distances[0], prepared.ranked, prepared.peaks),
        *faults,
    )
    mean = mean_in_frame(exposures, safety.settings.sensor.exposure or 1.0)
    return Estimate(
        recipe=recipe,
        safety=safety,
        emission=emission_of(safety.laser.beam()),
        options=options,
        draws=draws,
        exposures=exposures,
        findings=findings,
        eye=None if isinstance(eye, str) else eye,
        unsaid=unsaid,
        patterns=tuple(damage_patterns(prepared.spots, findings)),
        dazzled=dazzled(safety, draws, exposures, areas, mean),
        dead=tuple(damaged_frames(safety, prepared.spots, findings, exposures)),
        ranked=prepared.ranked,
        peaks=prepared.peaks,
        veil=veil_of(safety, draws),
        damage=verdicts,
        eye_dazzle=eye_dazzle_finding(safety, exposures),
        helps=remedies(safety, draws, prepared.ranked),
    )


def _dazzles(safety: Safety) -> bool:
    """Return True if dazzle is asked for and some channel of the sensor sees the laser."""
    return safety.settings.dazzle is not None and sees(safety.channels)


def settings_of(recipe: Recipe) -> Safety:
    """Return the settings of a recipe's block ``safety``; raise `RecipeError` for a recipe without them."""
    if recipe.safety is None:
        text = "the recipe does not say what to estimate: add the block safety, as in the recipe safety_pointer"
        raise RecipeError([Diagnostic(Location(recipe.name), "safety", text)])
    return recipe.safety


def _findings(
    safety: Safety,
    draws: SettingDraws,
    options: tuple[Option, ...],
    exposures: Exposures,
    areas: tuple[Area, ...],
) -> Iterator[Finding]:
    """Yield what each limit says behind each option."""
    known = {area.option: area for area in areas}
    for option in options:
        for limit in limits_behind(safety, draws, option, known.get(option), exposures):
            yield _finding(safety, option, limit, exposures)


def _finding(safety: Safety, option: Option, limit: Limit, exposures: Exposures) -> Finding:
    per_power, at = exposures.sensor[option.name], exposures.at(safety.laser.distance)
    light = emitted(safety, limit, exposures)
    limits = limit.values * limit.devices * np.ones((len(light), per_power.shape[1]))
    ratio, at_lens = limit_ratio(safety, option.name, limit, exposures), limits * exposures.lens / per_power
    here = light[:, 0] * per_power[:, at]
    return Finding(
        option.name,
        limit,
        _spread(limits[:, at]),
        _spread(at_lens[:, at]),
        _spread(here),
        float(ratio[0, at]),
        _probability(limit, ratio[1:, at] * limit.devices[1:, 0]),
        zones_of(exposures.distances, ratio[0], ratio[1:], safety.laser.distance, safety.settings.distances),
        np.stack([at_lens[0], *np.quantile(at_lens[1:], QUANTILES, axis=0)]),
        _spread(ratio[:, at]),
    )


def _spread(values: FloatArray) -> Spread:
    """Return the nominal value, which comes first, with the interval of the draws after it."""
    return Spread.of(float(values[0]), values[1:])


def _probability(limit: Limit, ratio: FloatArray) -> Spread | None:
    """Return the share of devices that are damaged, with the interval from everything but the device.

    ``ratio`` (draw,) is that of the exposure to the limit of the median device.
    """
    if limit.effect != "damage" or limit.factor is None:
        return None
    from scipy.special import ndtr

    shares = ndtr(np.log(ratio) / np.log(limit.factor))
    return Spread.of(float(shares.mean()), shares)
