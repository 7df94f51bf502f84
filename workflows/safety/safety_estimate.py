"""Estimate of damage, dazzle and eye exposure by a laser: limits, exposures and intervals of distance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from neusee.nodes import ParameterError
from neusee.nodes.laser import eye_limit, frame_power, nominal_ocular_hazard_distance
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.diagnostics import Diagnostic, Location, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.recipe.distributions.scalar import FloatArray
from neusee.workflows.safety.damage_pattern import DamagePattern, Spot, damage_patterns, spots_of, step_of
from neusee.workflows.safety.dazzle_curves import Dazzled, dazzled
from neusee.workflows.safety.dazzled_area import Area, Ranked, area_of, ranked_of
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
from neusee.workflows.safety.sensor_limits import Limit, damage_limits, dazzle_limits
from neusee.workflows.safety.uncertain_values import SettingDraws, draw_settings
from neusee.workflows.safety.unsaid_parts import unsaid_of_damage, unsaid_of_dazzle
from neusee.workflows.store.result_store import Store

CERTIFICATE = "An estimate, no certificate: neusee decides nothing about eyes or sensors."
EYE_SOURCE = "IEC 60825-1:2014, small source, as written out in neusee (nodes.laser.eye_mpe)"


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


@dataclass(frozen=True)
class EyeFinding:
    """The exposure limit of the eye, and the distance beyond which the laser does not exceed it."""

    duration: float  #: s
    limit: float  #: W/m2, or J/m2 of each pulse
    quantity: str
    exposure: Spread  #: at the distance of the recipe, on the axis
    distance: Spread  #: nominal ocular hazard distance, m
    source: str = EYE_SOURCE


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
    unsaid: tuple[str, ...]  #: what the estimate does not say, with the reason
    patterns: tuple[DamagePattern, ...] = ()
    dazzled: tuple[Dazzled, ...] = ()  #: behind each protection for which the dazzled area is known
    dead: tuple[DeadPixels, ...] = ()  #: examples of damage in a raw frame
    ranked: tuple[Ranked, ...] = ()

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


def prepare(recipe: Recipe, store: Store | None) -> Prepared:
    """Return what decides an estimate, with the errors that `estimate` lists."""
    safety = _with_stop(recipe, settings_of(recipe), store)
    draws = draw_settings(recipe, safety)
    spots = spots_of(recipe, safety, store)
    ranked = ranked_of(recipe, safety, store)
    return Prepared(safety, draws, options_of(safety, _mask_peak(recipe, safety, store)), spots, ranked)


def complete(recipe: Recipe, prepared: Prepared) -> Estimate:
    """Return the estimate from everything that decides it."""
    safety, draws, options = prepared.safety, prepared.draws, prepared.options
    exposures = compute_exposures(safety, draws, options)
    known = {option.name: area_of(safety, option, prepared.ranked) for option in options}
    areas = tuple(area for area in known.values() if isinstance(area, Area)) if safety.settings.dazzle else ()
    findings = tuple(_findings(safety, draws, options, exposures, areas))
    eye, faults = _eye(safety, exposures)
    unsaid = (*unsaid_of_damage(safety, findings), *unsaid_of_dazzle(safety, known, findings), *faults)
    patterns = tuple(damage_patterns(prepared.spots, findings))
    mean = mean_in_frame(exposures, safety.settings.sensor.exposure or 1.0)
    filled = dazzled(safety, draws, exposures, areas, mean)
    dead = tuple(damaged_frames(safety, prepared.spots, findings, exposures))
    emission = emission_of(safety.laser.beam())
    return Estimate(
        recipe, safety, emission, options, draws, exposures, findings, eye, unsaid, patterns, filled, dead,
        prepared.ranked,
    )  # fmt: skip


def settings_of(recipe: Recipe) -> Safety:
    """Return the settings of a recipe's block ``safety``; raise `RecipeError` for a recipe without them."""
    if recipe.safety is None:
        text = "the recipe does not say what to estimate: add the block safety, as in the recipe safety_pointer"
        raise RecipeError([Diagnostic(Location(recipe.name), "safety", text)])
    return recipe.safety


def _with_stop(recipe: Recipe, safety: Safety, store: Store | None) -> Safety:
    """Return the settings with the diameter of the step of the stop, whose grid may be narrower than the lens."""
    lens = safety.settings.lens
    if lens.stop is None:
        return safety
    step = step_of(recipe, safety, "lens.stop", lens.stop, "")
    diameter = min(lens.diameter, float(run(recipe, store, [step])[step].diameter))
    narrowed = lens.model_copy(update={"diameter": diameter})
    return replace(safety, settings=safety.settings.model_copy(update={"lens": narrowed}))


def _mask_peak(recipe: Recipe, safety: Safety, store: Store | None) -> float | None:
    """Return the peak behind the mask over that behind the plain lens, or None without a mask.

    The largest laser suppression ratio of the mask counts. Where the same step has a copy for the plain lens, its ratio
    divides: a beam that does not fill the lens lowers both.
    """
    named = safety.settings.protection.mask
    if named is None:
        return None
    step = step_of(recipe, safety, "protection.mask", named, "mask")
    plain = step.replace("[mask,", "[plain,")
    if plain == step or plain not in recipe.steps:
        return float(run(recipe, store, [step])[step].max())
    found = run(recipe, store, [step, plain])
    return float(found[step].max() / found[plain].max())


def _findings(
    safety: Safety,
    draws: SettingDraws,
    options: tuple[Option, ...],
    exposures: Exposures,
    areas: tuple[Area, ...],
) -> Iterator[Finding]:
    """Yield what each limit says behind each option."""
    for option in options:
        for limit in damage_limits(safety, option, exposures, draws):
            yield _finding(safety, option, limit, exposures)
        for area in areas:
            if area.option == option:
                for limit in dazzle_limits(safety, area, draws):
                    yield _finding(safety, option, limit, exposures)


def _finding(safety: Safety, option: Option, limit: Limit, exposures: Exposures) -> Finding:
    per_power, at = exposures.sensor[option.name], exposures.at(safety.laser.distance)
    emitted = _emitted(safety, limit, exposures)
    limits = limit.values * limit.devices * np.ones_like(per_power)
    ratio, at_lens = emitted * per_power / limits, limits * exposures.lens / per_power
    here = emitted[:, 0] * per_power[:, at]
    return Finding(
        option.name,
        limit,
        _spread(limits[:, at]),
        _spread(at_lens[:, at]),
        _spread(here),
        float(ratio[0, at]),
        _probability(limit, ratio[1:, at] * limit.devices[1:, 0]),
        zones_of(exposures.distances, ratio[0], ratio[1:], safety.laser.distance),
        np.stack([at_lens[0], *np.quantile(at_lens[1:], QUANTILES, axis=0)]),
    )


def _spread(values: FloatArray) -> Spread:
    """Return the nominal value, which comes first, with the interval of the draws after it."""
    return Spread.of(float(values[0]), values[1:])


def _emitted(safety: Safety, limit: Limit, exposures: Exposures) -> FloatArray:
    """Return power or pulse energy (1 + draw, 1); for dazzle the mean power of the light that reaches one frame."""
    if limit.effect == "damage":
        return exposures.emitted(limit.quantity)
    return mean_in_frame(exposures, safety.settings.sensor.exposure or 1.0)


def mean_in_frame(exposures: Exposures, exposure: float) -> FloatArray:
    """Return the mean power in W during an exposure in which at least one pulse of a pulsed laser falls."""
    rows = [frame_power(beam, exposure) for beam in exposures.beams]
    return np.array(rows, np.float64)[:, None]


def _probability(limit: Limit, ratio: FloatArray) -> Spread | None:
    """Return the share of devices that are damaged, with the interval from everything but the device.

    ``ratio`` (draw,) is that of the exposure to the limit of the median device.
    """
    if limit.effect != "damage" or limit.factor is None:
        return None
    from scipy.special import ndtr

    shares = ndtr(np.log(ratio) / np.log(limit.factor))
    return Spread.of(float(shares.mean()), shares)


def _eye(safety: Safety, exposures: Exposures) -> tuple[EyeFinding | None, tuple[str, ...]]:
    """Return the finding of the eye, or the reason why there is none."""
    beam, at = exposures.beams[0], exposures.at(safety.laser.distance)
    duration = safety.settings.eye.exposure or (0.25 if beam.wavelength <= 700e-9 else 10.0)
    try:
        limit = eye_limit(beam, duration)
        reach = np.array([nominal_ocular_hazard_distance(each, duration) for each in exposures.beams])
    except ParameterError as error:
        return None, (f"Nothing is said of the eye: {error}.",)
    quantity = "fluence" if beam.is_pulsed else "irradiance"
    here = exposures.emitted("fluence" if beam.is_pulsed else "irradiance")[:, 0] * exposures.lens[:, at]
    return EyeFinding(
        duration, limit, quantity, Spread.of(float(here[0]), here[1:]), Spread.of(float(reach[0]), reach[1:])
    ), ()
