"""Protective measures: the grey filter, notch filter, stop or exposure time that brings the laser
down to each limit.

Damage, saturation and contrast are treated separately, behind the plain lens at the distance of the
recipe. The value of a measure is found with the same functions that compute the verdict, and is
checked with them again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from neusee.nodes.laser import (
    diffraction_cutoff,
    feature_snr,
    field_angle,
    notch_band,
    optical_density,
    white_share,
)
from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.recipe.distributions.shapes import FloatArray
from neusee.workflows.safety.dazzled_area import Area, area_of
from neusee.workflows.safety.exposure_limits import limit_ratio, limits_behind, veil_level
from neusee.workflows.safety.exposures import Option, SettingDraws, Spread, compute_exposures
from neusee.workflows.safety.laser_spots import Ranked

Problem = Literal["damage", "saturation", "contrast"]
Means = Literal["grey filter", "notch filter", "stop", "exposure"]
#: exposure over limit (1 + draw,) by the name of the limit; row 0 is nominal
Ratios = Mapping[str, FloatArray]

#: transmittances that are tried, from none to the strongest
_FILTERS = tuple(10.0**-x for x in (0, 1, 2, 4, 8, 12))
_SLOWEST_F_NUMBER = 64.0  #: f-number of the smallest stop
#: half a photographic stop, as a ratio of diameters; neighbouring trial diameters differ by at most
#: twice this step
_HALF_STOP = 2.0**-0.25
_SHORTER = tuple(10.0**-x for x in (0, 0.5, 1, 2, 3, 4, 5, 6))  #: exposures over that of the recipe
_LONGER = tuple(10.0 ** (x / 4) for x in range(13))
_SAFE_SHARE = 0.95  #: share of the draws in which a safe value must be sufficient
_SEARCH_STEPS = 60  #: most steps of the search for a nominal value
_AGREED_LOG = 1e-7  #: largest logarithm of a nominal ratio at the end of the search
_REFINING_ROUNDS = 3  #: rounds of correcting a safe value by computing its ratio again
_UNCHANGED_RATIO = 1e-6  #: relative difference of ratios that count as equal
_FLOOR, _CEILING = 1e-300, 1e300

MET = "not needed"
OPEN = "not judged: exposures below this limit are not known"
UNSAFE = "no value holds in 95 % of the draws"


@dataclass(frozen=True)
class PictureCost:
    """The effect of a measure on the picture while no laser shines."""

    scene: float  #: share of the scene's light that a pixel collects in one exposure
    cutoff_before: float  #: cycles a pixel, finest detail that diffraction leaves
    cutoff_after: float
    #: e- of a white that filled the well without the measure; None: the well is not known
    white: float | None = None
    #: e- behind the stated feature; None here and below: no feature is stated
    background: float | None = None
    snr_before: float | None = None  #: signal-to-noise ratio of the stated feature
    snr_after: float | None = None


@dataclass(frozen=True)
class Remedy:
    """The effect of one protective measure on one limit behind the plain lens."""

    problem: Problem
    limit: str
    means: Means
    value: Spread | None  #: optical density, diameter in m or exposure in s; None: it does not help
    safe: float | None = None  #: value that is sufficient in 95 % of the draws; None
    reason: str = ""  #: why it is not needed, does not help or is not judged
    #: nominal ratio of exposure to limit with the value, computed again
    put_back: float | None = None
    #: share of the draws below the limit with the safe value, computed again
    covered: float | None = None
    #: m, wavelengths at normal incidence that a notch filter has to cover
    band: tuple[float, float] | None = None
    #: cost of the safe value, or of the nominal one where no value is safe
    cost: PictureCost | None = None


def remedies(safety: Safety, draws: SettingDraws, ranked: Sequence[Ranked]) -> tuple[Remedy, ...]:
    """Return the effect of each protective measure on each limit behind the plain lens, at the
    distance of the recipe.
    """
    question = _Question(safety, draws, ranked)
    plain_ratios = question.ratios(_Trial(Option("plain lens")))
    means = list(_ways(question)) if plain_ratios else []
    answers: list[Remedy] = []
    for limit in plain_ratios:
        for remedy in _remedies(limit, means):  # which may find that the limit is open
            answers.append(_open(remedy) if limit in question.open else remedy)
    return tuple(answers)


def _open(remedy: Remedy) -> Remedy:
    """Return a remedy marked as not judged: nothing is known of exposures below its limit, so no
    value is safe.
    """
    return replace(remedy, value=None, safe=None, cost=None, reason=OPEN)


def problem_of(limit: str) -> Problem:
    """Return the problem that a limit belongs to, by its name."""
    first_word = limit.partition(":")[0]
    if first_word == "saturated":
        return "saturation"
    return "contrast" if first_word == "veiled" else "damage"


# --- the question: how often is each limit exceeded behind another protection? --------------------


@dataclass(frozen=True)
class _Trial:
    """A protection to evaluate, with the exposure time relative to that of the recipe."""

    option: Option
    exposure: float = 1.0


@dataclass(frozen=True)
class _Question:
    """The ratios of exposure to limit behind any trial protection, at the distance of the
    recipe.
    """

    safety: Safety
    draws: SettingDraws
    ranked: Sequence[Ranked]
    #: names of limits below which nothing is known, filled by `ratios`
    open: set[str] = field(default_factory=set)
    #: `Exposures.tables`, shared by all trials: with draws, and without
    tables: Mapping[bool, dict[Any, Any]] = field(default_factory=lambda: {True: {}, False: {}})

    def ratios(self, trial: _Trial, drawn: bool = True) -> Ratios:
        """Return the ratio (1 + draw,) for each limit that is judged; (1,) without draws."""
        safety, draws = _exposed(self.safety, self.draws, trial.exposure)
        if not drawn:
            draws = replace(
                draws, count=0, values={name: values[:0] for name, values in draws.values.items()}
            )
        exposures = compute_exposures(
            safety, draws, (trial.option,), np.array([safety.laser.distance])
        )
        # filter and exposure leave the spot as it is
        exposures = replace(exposures, tables=self.tables[drawn])
        area = area_of(safety, trial.option, self.ranked) if safety.settings.dazzle else None
        dazzled_area = area if isinstance(area, Area) else None
        limits = list(limits_behind(safety, draws, trial.option, dazzled_area, exposures))
        self.open.update(limit.name for limit in limits if getattr(limit, "open_below", False))
        return {
            limit.name: limit_ratio(safety, trial.option.name, limit, exposures)[:, 0]
            for limit in limits
        }

    def of(self, limit: str, asked: Ratios, trial: _Trial) -> FloatArray | None:
        """Return the ratio for one limit from ``asked``; None where the limit is not judged.

        A veil is infinite where the scene alone fills the well and where the feature is lost
        without a laser. Without a limit of its own it is that of saturation, which hides the
        feature first.
        """
        if problem_of(limit) != "contrast":
            return asked.get(limit)
        saturation_ratio = asked.get(limit.replace("veiled", "saturated"))
        safety, _ = _exposed(self.safety, self.draws, trial.exposure)
        dazzle, well = safety.settings.dazzle, safety.settings.sensor.full_well
        if saturation_ratio is None or dazzle is None or well is None:
            return None
        scene_share = trial.option.scene_share(safety.settings.lens.diameter)
        if veil_level(dazzle, scene_share) <= 0 or dazzle.background * scene_share >= well:
            return np.full_like(saturation_ratio, math.inf)
        return asked.get(limit, saturation_ratio)


def _exposed(safety: Safety, draws: SettingDraws, factor: float) -> tuple[Safety, SettingDraws]:
    """Return settings and draws with the exposure time, and the electrons of the scene, multiplied
    by ``factor``.
    """
    settings = safety.settings
    if factor == 1.0 or settings.sensor.exposure is None:
        return safety, draws
    sensor = settings.sensor.model_copy(update={"exposure": settings.sensor.exposure * factor})
    dazzle = settings.dazzle
    if dazzle is not None:
        dazzle = dazzle.model_copy(update={"background": dazzle.background * factor})
    values = {
        name: drawn_values * factor if name == "sensor.exposure" else drawn_values
        for name, drawn_values in draws.values.items()
    }
    changed = settings.model_copy(update={"sensor": sensor, "dazzle": dazzle})
    return replace(safety, settings=changed), replace(draws, values=values)


# --- the means ------------------------------------------------------------------------------------


@dataclass
class _Way:
    """One protective measure with its trial factors, from 1 (no change) to the strongest, and the
    ratios at each factor.
    """

    question: _Question
    means: Means
    factors: tuple[float, ...]  #: transmittance, or diameter or exposure over that of the recipe
    trial: Callable[[float], _Trial]
    unit: float | None = None  #: m or s of the factor 1; None: the value is an optical density
    band: tuple[float, float] | None = None
    answers: dict[float, Ratios] = field(default_factory=dict)

    def ratio(self, limit: str, factor: float) -> FloatArray | None:
        """Return the ratio (1 + draw,) for a limit at a factor; None where it is not judged."""
        trial = self.trial(factor)
        if factor not in self.answers:
            self.answers[factor] = self.question.ratios(trial)
        return self.question.of(limit, self.answers[factor], trial)

    def nominal(self, limit: str, factor: float) -> float:
        """Return the nominal ratio for a limit at a factor."""
        trial = self.trial(factor)
        ratio = self.question.of(limit, self.question.ratios(trial, drawn=False), trial)
        return math.inf if ratio is None else float(ratio[0])

    def value(self, factor: float) -> float:
        """Return the optical density, the diameter in m or the exposure time in s that a factor
        stands for.
        """
        return optical_density(1 / factor) if self.unit is None else factor * self.unit

    def cost(self, factor: float) -> PictureCost:
        """Return the effect of a factor on the picture."""
        settings, trial = self.question.safety.settings, self.trial(factor)
        lens, sensor, dazzle = settings.lens, settings.sensor, settings.dazzle
        scene = trial.option.scene_share(lens.diameter) * trial.exposure
        diameters = (lens.diameter, min(lens.diameter, trial.option.diameter or lens.diameter))
        cutoffs = [
            diffraction_cutoff(lens.focal_length, diameter, sensor.pixel_pitch)
            for diameter in diameters
        ]
        white = None if sensor.full_well is None else sensor.full_well * min(1.0, scene)
        if dazzle is None:
            return PictureCost(scene, cutoffs[0], cutoffs[1], white)
        feature = {
            "contrast": dazzle.contrast,
            "feature": dazzle.feature,
            "read_noise": dazzle.read_noise,
        }
        # without a filter or stop, and with it, while no laser shines: 0.0 is its light
        feature_snrs = [
            feature_snr(dazzle.background * share, 0.0, **feature) for share in (1.0, scene)
        ]
        return PictureCost(
            scene,
            cutoffs[0],
            cutoffs[1],
            white,
            dazzle.background * scene,
            feature_snrs[0],
            feature_snrs[1],
        )


def _ways(question: _Question) -> Iterator[_Way]:
    """Yield the protective measures to try; the exposure time is tried both shorter and longer."""
    diameter, exposure = (
        question.safety.settings.lens.diameter,
        question.safety.settings.sensor.exposure,
    )
    band = _notch(question)
    # share of white light that the notch lets through
    scene_left = 1 - white_share(*band)
    yield _Way(
        question, "grey filter", _FILTERS, lambda x: _Trial(Option("grey filter", passing=x))
    )
    notch = _Way(
        question,
        "notch filter",
        _FILTERS,
        lambda x: _Trial(Option("notch filter", passing=x, scene=scene_left)),
    )
    yield replace(notch, band=band)
    stops = _stops(question.safety.settings.lens.focal_length / diameter)
    yield _Way(
        question, "stop", stops, lambda x: _Trial(Option("stop", diameter=diameter * x)), diameter
    )
    if exposure is not None:
        for factors in (_SHORTER, _LONGER):
            yield _Way(
                question, "exposure", factors, lambda x: _Trial(Option("plain lens"), x), exposure
            )


def _stops(f_number: float) -> tuple[float, ...]:
    """Return diameters relative to the lens, from 1 down to f/64, or to one half for a lens slower
    than f/32.
    """
    smallest = min(0.5, f_number / _SLOWEST_F_NUMBER)
    # diameters in equal ratios, of two half stops at most
    step_count = max(4, math.ceil(math.log(smallest) / math.log(_HALF_STOP) / 2))
    return tuple(smallest ** (x / step_count) for x in range(step_count + 1))


def _notch(question: _Question) -> tuple[float, float]:
    """Return the band at normal incidence of a notch filter that blocks the laser, with all its
    draws, over the whole field.
    """
    settings = question.safety.settings
    wavelengths = question.draws.column("laser.wavelength", question.safety.laser.wavelength)
    angle = field_angle(
        settings.sensor.shape, settings.sensor.pixel_pitch, settings.lens.focal_length
    )
    return notch_band(
        float(wavelengths.min()), float(wavelengths.max()), angle, settings.protection.notch_index
    )


# --- the answer -----------------------------------------------------------------------------------


def _remedies(limit: str, ways: Sequence[_Way]) -> Iterator[Remedy]:
    """Yield the effect of each measure on one limit; of a shorter and a longer exposure only the
    one that helps.
    """
    yield from (_remedy(limit, way) for way in ways if way.means != "exposure")
    exposure_ways = [way for way in ways if way.means == "exposure"]
    if problem_of(limit) != "contrast":
        exposure_ways = exposure_ways[:1]  # a longer exposure can only help contrast
    answers = [_remedy(limit, way) for way in exposure_ways]
    # the first that helps, else the first
    yield from [answer for answer in answers if answer.value is not None][:1] or answers[:1]


def _remedy(limit: str, way: _Way) -> Remedy:
    """Return the effect of one protective measure on one limit."""
    problem, present_value = problem_of(limit), way.value(1.0)
    present_ratio = way.ratio(limit, 1.0)
    if present_ratio is not None and _is_met(present_ratio):
        return Remedy(
            problem,
            limit,
            way.means,
            Spread(present_value, present_value, present_value),
            present_value,
            MET,  # reason
            float(present_ratio[0]),  # put back
            1.0,  # share of the draws below the limit
        )
    ratios = [way.ratio(limit, factor) for factor in way.factors]
    judged_ratios = [row for row in ratios if row is not None]
    if len(judged_ratios) < len(ratios):
        return Remedy(
            problem,
            limit,
            way.means,
            None,
            reason="not judged: the dazzled area behind this protection is not known",
        )
    # (factor, 1 + draw)
    ratio_table = np.stack(judged_ratios)
    # (1 + draw,), NaN where no factor is enough
    factors = crossing(np.array(way.factors), ratio_table, problem)
    if np.isnan(factors[0]):
        return Remedy(
            problem, limit, way.means, None, reason=_why_not(problem, way.means, ratio_table)
        )
    return _solved(limit, way, factors)


def _solved(limit: str, way: _Way, factors: FloatArray) -> Remedy:
    """Return the remedy from the factors (1 + draw,) at which the laser reaches a limit, checked by
    computing the ratio again.
    """
    nominal = _refined(limit, way, float(factors[0]))
    safe, covered = _safe(limit, way, factors[1:]) if len(factors) > 1 else (nominal, None)
    drawn_values = np.array([way.value(factor) for factor in factors[1:] if factor > 0])
    return Remedy(
        problem=problem_of(limit),
        limit=limit,
        means=way.means,
        value=Spread.of(way.value(nominal), drawn_values),
        safe=None if safe is None else way.value(safe),
        reason="" if safe is not None else UNSAFE,
        put_back=way.nominal(limit, nominal),
        covered=covered,
        band=way.band,
        cost=way.cost(nominal if safe is None else safe),
    )


def _is_met(ratio: FloatArray) -> bool:
    """Return True if the exposure is below a limit at the nominal values and in 95 % of the
    draws.
    """
    return (
        bool(ratio[0] <= 1 and (ratio[1:] <= 1).mean() >= _SAFE_SHARE)
        if len(ratio) > 1
        else bool(ratio[0] <= 1)
    )


def crossing(factors: FloatArray, ratio: FloatArray, problem: Problem) -> FloatArray:
    """Return the factor (1 + draw,) at which the ratio (factor, 1 + draw) falls below 1; NaN if it
    never does.

    The factors run from the present one to the strongest. For damage and saturation every stronger
    factor has to stay below 1 too. For contrast the first factor counts, since a stronger one dims
    the scene until nothing is seen. Between two factors the logarithm of the ratio is linear in
    that of the factor.
    """
    within = ratio <= 1
    if problem != "contrast":
        # within here and at every stronger factor
        within = np.flip(np.logical_and.accumulate(np.flip(within, 0), 0), 0)
    first_within = within.argmax(0)
    one_before = np.maximum(first_within - 1, 0)
    column = np.arange(ratio.shape[1])
    log_ratio = np.log(np.clip(ratio, _FLOOR, _CEILING))
    height_before, height_within = log_ratio[one_before, column], log_ratio[first_within, column]
    # position of the zero of the logarithm between both factors; the present factor stays
    share = np.where(
        first_within == 0,
        1.0,
        height_before / np.where(first_within == 0, 1.0, height_before - height_within),
    )
    log_factor = np.log(factors[one_before]) + share * (
        np.log(factors[first_within]) - np.log(factors[one_before])
    )
    return np.where(within.any(0), np.exp(log_factor), np.nan)


def _refined(limit: str, way: _Way, factor: float) -> float:
    """Return the nominal factor at which the recomputed ratio is 1, starting from an interpolated
    factor.

    False position in the logarithms of factor and ratio; if one end of the bracket stays twice, its
    height is halved (Illinois algorithm).
    """
    if factor in (way.factors[0], way.factors[-1]):
        return factor
    # the first factor that is as strong, which ends the bracket
    index = next(
        i
        for i, tried in enumerate(way.factors)
        if (tried < factor) == (way.factors[-1] < 1) or tried == factor
    )
    bracket = [math.log(way.factors[index - 1]), math.log(way.factors[index])]
    heights = [_height(limit, way, end) for end in bracket]
    log_factor, last_side = math.log(factor), 0
    for _ in range(_SEARCH_STEPS):
        height = _height(limit, way, log_factor)
        if abs(height) < _AGREED_LOG:
            break
        # end 0 has a ratio above 1
        side = 0 if height > 0 else 1
        if side == last_side:
            heights[1 - side] /= 2
        bracket[side], heights[side], last_side = log_factor, height, side
        log_factor = (bracket[0] * heights[1] - bracket[1] * heights[0]) / (heights[1] - heights[0])
    return math.exp(log_factor)


def _height(limit: str, way: _Way, place: float) -> float:
    """Return the logarithm of the nominal ratio; ``place`` is the logarithm of the factor."""
    return math.log(min(max(way.nominal(limit, math.exp(place)), _FLOOR), _CEILING))


def _safe(limit: str, way: _Way, factors: FloatArray) -> tuple[float | None, float | None]:
    """Return the factor that keeps 95 % of the draws below the limit, and the share of the draws
    below the limit with it.
    """
    # stronger is smaller, or for a longer exposure larger
    direction = -1 if way.factors[-1] < 1 else 1
    # the weakest first; draws without a factor last
    ordered_factors = np.sort(
        direction * np.where(np.isnan(factors), direction * math.inf, factors)
    )
    safe = direction * float(
        ordered_factors[
            min(len(ordered_factors) - 1, math.ceil(_SAFE_SHARE * len(ordered_factors)))
        ]
    )
    for _ in range(_REFINING_ROUNDS):
        if not math.isfinite(safe) or safe <= 0:
            return None, None
        ratio = way.ratio(limit, safe)
        covered_share = 0.0 if ratio is None else float((ratio[1:] <= 1).mean())
        if covered_share >= _SAFE_SHARE or ratio is None:
            return safe, covered_share
        ratio_at_quantile = float(np.quantile(ratio[1:], _SAFE_SHARE, method="higher"))
        # the ratio is proportional to a transmittance, and to up to the square of a diameter or an
        # exposure
        safe *= ratio_at_quantile ** (-1.0 if way.unit is None else 0.5 * direction)
    return None, None


def _why_not(problem: Problem, means: Means, table: FloatArray) -> str:
    """Return why a protective measure does not help against a limit."""
    # nominal ratio at the strongest factor over that at the present one
    changes_ratio = bool(np.abs(table[-1, 0] / table[0, 0] - 1) > _UNCHANGED_RATIO)
    if problem == "damage" and means == "exposure" and not changes_ratio:
        return "a shorter exposure does not change damage"
    if means == "exposure" and not changes_ratio:
        return "the exposure changes scene and laser alike"
    if problem == "contrast" and means == "grey filter":
        return "a grey filter weakens the scene as much as the laser"
    if problem == "contrast" and means == "stop":
        return "a stop weakens the scene too: no stop down to f/64 helps"
    return {
        "stop": "no stop down to f/64 helps",
        "exposure": "no exposure down to a millionth helps",
    }.get(means, "no density up to 12 helps")
