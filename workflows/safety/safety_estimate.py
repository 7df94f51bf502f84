"""Estimate of damage, dazzle and eye exposure by a laser, and the texts on its assumptions and
limits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from neusee.nodes.laser import DamagePart, State, state_of, worst_state
from neusee.workflows.graph.errors import Diagnostic, Location, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.blocks.safety_block import SATURATION, Safety
from neusee.workflows.recipe.distributions.shapes import FloatArray
from neusee.workflows.safety.damage_pattern import (
    DamagePattern,
    DeadPixels,
    Spot,
    damage_patterns,
    damaged_frames,
    refuse_other_lens,
    spots_of,
    with_heated_spots,
)
from neusee.workflows.safety.dazzled_area import Area, area_of
from neusee.workflows.safety.exposure_limits import (
    EyeDazzleFinding,
    EyeFinding,
    Limit,
    emitted,
    eye_dazzle_finding,
    eye_finding,
    limit_parts,
    limit_ratio,
    limits_behind,
    mean_in_frame,
    saturating,
    sees,
    veil_level,
    with_channels,
)
from neusee.workflows.safety.exposures import (
    FAR_FILL,
    FAR_WAVES,
    QUANTILES,
    Emission,
    Exposures,
    Option,
    SettingDraws,
    Spread,
    Zones,
    compute_exposures,
    draw_settings,
    emission_of,
    options_of,
    zones_of,
)
from neusee.workflows.safety.laser_spots import (
    ASSUMED,
    Peaks,
    Ranked,
    Veil,
    peaks_of,
    ranked_of,
    veil_of,
)
from neusee.workflows.safety.what_helps import Remedy, remedies
from neusee.workflows.store.result_store import Store

# --- dazzle curves --------------------------------------------------------------------------------

# Number of pixels that a laser saturates behind each protection: at the distance of the recipe, and
# as a function of irradiance.


_SAMPLES = 300  #: irradiances of a curve
#: ends of a curve: factors on the irradiance at which the stated share of the picture is lost,
#: behind the plain lens (lower end) or behind any protection (upper end)
_FAINT, _STRONG = 1e-6, 1e1


@dataclass(frozen=True)
class Dazzled:
    """The number of pixels that the laser saturates behind one protection."""

    option: str
    masked: bool
    pixels: Spread  #: at the distance of the recipe
    share: float  #: of the picture
    times: float | None  #: ratio to the pixels behind the plain lens; None where either number is 0
    at_lens: FloatArray  #: (irradiance,) mean over the exposure at the lens, W/m2
    curve: FloatArray  #: (irradiance,) share of the picture


def dazzled(
    safety: Safety,
    draws: SettingDraws,
    exposures: Exposures,
    areas: Sequence[Area],
    mean: FloatArray,
) -> tuple[Dazzled, ...]:
    """Return the number of saturated pixels behind each protection; ``mean`` (1 + draw, 1) is the
    mean power in W during one exposure.
    """
    if not areas:
        return ()
    full_irradiance, index = saturating(safety, draws), exposures.at(safety.laser.distance)
    pixel_count = safety.settings.sensor.shape[0] * safety.settings.sensor.shape[1]
    pixel_area = safety.settings.sensor.pixel_pitch**2
    irradiance_here = float(mean[0, 0] * exposures.lens[0, index])
    # emitted power in W that would saturate a single pixel if it received all light behind the lens
    filling_powers = [
        full_irradiance[:, None]
        * pixel_area
        / exposures.through[area.option.name][:, index : index + 1]
        for area in areas
    ]
    faintest_shares = [
        float(area.level(exposures, draws, veiled=False)[0, index]) for area in areas
    ]
    # irradiance at the lens at which exactly the share of pixels that may be lost is saturated
    limits_at_lens = [
        filling_power[0, 0] / faintest_share * exposures.lens[0, index]
        for filling_power, faintest_share in zip(filling_powers, faintest_shares, strict=True)
    ]
    irradiances = np.geomspace(
        _FAINT * limits_at_lens[0],
        max(_STRONG * max(limits_at_lens), 2 * irradiance_here),
        _SAMPLES,
    )
    rows: list[Dazzled] = []
    for area, filling_power in zip(areas, filling_powers, strict=True):
        count = np.minimum(
            area.saturated(exposures, draws, index, filling_power / mean)[:, 0], pixel_count
        )
        pixels = Spread.of(float(count[0]), count[1:])
        plain_pixels = rows[0].pixels if rows else pixels
        times = (
            pixels.value / plain_pixels.value
            if pixels.value > 0 and plain_pixels.value > 0
            else None
        )
        # share of the transmitted light that saturates a pixel, falling with the irradiance
        light_shares = filling_power[:1] * exposures.lens[0, index] / irradiances[None]
        curve = np.minimum(
            area.saturated(exposures, draws, index, light_shares)[0] / pixel_count, 1.0
        )
        lost_share = pixels.value / pixel_count
        rows.append(
            Dazzled(
                area.option.name, area.option.masked, pixels, lost_share, times, irradiances, curve
            )
        )
    return tuple(rows)


# --- damage verdict -------------------------------------------------------------------------------

# The damage verdict behind each protection: one state, one sentence, and a row for each part of the
# light (such as one pulse, or the mean over time).


#: a row with at least this share of the largest ratio may be named in place of the row with that
#: ratio, if it comes first in the table
_ALIKE = 0.98
_CONTINUOUS = ("pulse", "mean", "accumulation")


@dataclass(frozen=True)
class DamageRow:
    """The judgement of one part of the light: its ratio to the damage threshold, or why no
    threshold is known for it.
    """

    part: str  #: pulse, mean, accumulation or incubation
    kind: str  #: of damage
    state: State
    reason: str  #: why the part is not judged; empty if it is judged
    finding: Finding | None  #: for the limit of this part; None: not judged

    @property
    def ratio(self) -> float:
        """Return the ratio of exposure to threshold; 0 for a part without a threshold."""
        return 0.0 if self.finding is None else self.finding.ratio


@dataclass(frozen=True)
class DamageVerdict:
    """Whether a laser damages the sensor behind one protection, at the distance of the recipe."""

    option: str
    state: State
    rows: tuple[DamageRow, ...]

    @property
    def nearest(self) -> DamageRow | None:
        """Return the row that the verdict quotes: about the largest ratio among the rows in the
        state of the verdict; None if no row has a limit.

        A verdict that is not judged names the largest ratio of what is judged. Incubation is an
        assumption: it is named only where no other part has the state of the verdict.
        """
        candidates = self._candidates()
        largest = max((row.ratio for row in candidates), default=0.0)
        return next((row for row in candidates if row.ratio >= _ALIKE * largest), None)

    def _candidates(self) -> list[DamageRow]:
        """Return the rows from which the verdict quotes one."""
        rows = [row for row in self.with_limit if row.state == self.state]
        if self.state == "not judged":
            rows = [row for row in self.with_limit if row not in self.unjudged] or rows
        # incubation is an assumption: another part of the same state goes first
        return rows if self.state == "below" else _measured(rows) or rows

    @property
    def with_limit(self) -> tuple[DamageRow, ...]:
        """Return the rows that have a limit."""
        return tuple(row for row in self.rows if row.finding is not None)

    @property
    def unjudged(self) -> tuple[DamageRow, ...]:
        """Return the rows that are not judged."""
        return tuple(row for row in self.rows if row.state == "not judged")


def _measured(rows: Sequence[DamageRow]) -> list[DamageRow]:
    """Return all rows but those of incubation, whose threshold is an assumption."""
    return [row for row in rows if row.part != "incubation"]


def damage_verdicts(
    safety: Safety,
    options: Sequence[Option],
    exposures: Exposures,
    draws: SettingDraws,
    findings: Sequence[Finding],
) -> Iterator[DamageVerdict]:
    """Yield the damage verdict behind each option; nothing if the recipe has no damage settings."""
    for option in options:
        light_parts = limit_parts(safety, option, exposures, draws)
        damage_findings = [
            finding
            for finding in findings
            if finding.option == option.name and finding.limit.effect == "damage"
        ]
        rows = tuple(
            _rows(light_parts, damage_findings, continuous=not exposures.beams[0].is_pulsed)
        )
        if rows:
            yield DamageVerdict(option.name, worst_state(row.state for row in rows), rows)


def _rows(
    parts: Sequence[DamagePart], findings: Sequence[Finding], continuous: bool
) -> Iterator[DamageRow]:
    """Yield the row of each part of the light; ``findings`` has one entry for each part with a
    threshold, in the same order.
    """
    findings_in_order = iter(findings)
    for damage_part in parts:
        finding = next(findings_in_order) if damage_part.threshold is not None else None
        state: State = "not judged" if finding is None else state_of_finding(finding)
        reason = damage_part.reason if state == "not judged" else ""
        # continuous light has one part, which counts as pulse, mean and accumulation
        for name in _CONTINUOUS if continuous else (damage_part.part,):
            yield DamageRow(name, damage_part.kind, state, reason, finding)


def state_of_finding(finding: Finding) -> State:
    """Return whether the exposure at the distance of the recipe is above, within or below the
    uncertainty interval of a damage limit.
    """
    assert finding.ratios is not None
    return state_of(finding.ratios.low, finding.ratios.high, finding.limit.open_below)


# --- counted parts --------------------------------------------------------------------------------

# Sentences on which effects an estimate includes along the optical axis: scatter, focus, air and
# the beam itself.


_ARMS = {"plain": "plain lens", "mask": "mask"}
_REMEDY = "increase optics.samples and add a step laser.wavefront to compute nearer distances"


def scatter_text(veil: Veil | None) -> str:
    """Return a sentence on the share of the light that the lens scatters, whether it is assumed,
    and what it affects.
    """
    if veil is None:
        return (
            "The lens scatters no light (safety.lens.scatter: null). A real lens scatters light,"
            " and is dazzled at larger and at smaller distances than those given here."
        )
    share = f"Lens scatter {100 * float(veil.share[0]):.2g} %"
    source = "as given in the recipe"
    if veil.assumed:
        source = (
            f"assumed, within a factor of {ASSUMED:g} (one standard deviation): set"
            " safety.lens.scatter to the scatter of your lens"
        )
    return (
        f"{share}, {source}. The scattered light is a veil beside the spot, behind a mask as well"
        " as behind the plain lens, and counts as dazzle. It does not raise the peak, so it adds"
        " no damage."
    )


def focus_text(safety: Safety) -> str:
    """Return a sentence on the distance at which the lens is focused, and on the effect of another
    focus.
    """
    focus = safety.settings.lens.focus
    if focus == "laser":
        return "The lens is focused on the laser at every distance, which gives the highest peak."
    name = "infinity" if focus == "infinity" else f"{focus:g} m"
    return (
        f"The lens is focused at {name} (safety.lens.focus), so a laser at another distance is"
        " out of focus. A camera that focuses on the laser has a higher peak: set"
        " safety.lens.focus: laser."
    )


def counted(safety: Safety) -> Iterator[str]:
    """Yield one sentence for each property of beam and air: either included, with its value, or not
    included.
    """
    beam, m_squared = safety.settings.beam, safety.laser.beam().m_squared
    if beam.hot_spots > 1 or "beam.hot_spots" in safety.values:
        yield (
            f"Hot spots of the beam: included, factor {beam.hot_spots:g} on the irradiance of an"
            " even Gaussian beam."
        )
    else:
        yield "Hot spots of the beam: not included (safety.beam.hot_spots is 1)."
    if beam.cn2 is None:
        yield "Turbulence of the air (scintillation): not included (safety.beam.cn2 is not set)."
    else:
        yield (
            f"Turbulence of the air: included, Cn2 {beam.cn2:g} m^(-2/3); the exposure is"
            f" exceeded for {100 * (1 - beam.worst):.2g} % of the time, by Rytov's variance of a"
            " plane wave, an upper bound."
        )
    if m_squared > 1 + 1e-6:
        yield (
            f"M2 of {m_squared:.3g}: included in the width of the beam. The light is focused as a"
            " single Gaussian mode, an upper bound of the peak: a beam of many modes has a wider"
            " spot."
        )
    else:
        yield (
            "M2 is 1: a beam of many modes has a wider spot and a lower peak; its hot spots are"
            " named above."
        )


def ladder_text(ranked: tuple[Ranked, ...], peaks: Peaks | None) -> str:
    """Return a text on the number of distances at which the spot is computed, and on the
    interpolation error between them.
    """
    text = (
        "The spot of the clear lens is computed at every distance. Where the beam fills the lens"
        f" to (D / 2w)^2 = {FAR_FILL:g} with {FAR_WAVES:g} waves of curvature, and beyond, the"
        " spot is that of a distant laser."
    )
    spots = [(spot.arm, len(spot.distances), spot.error) for spot in ranked]
    if peaks and len(peaks.along) > 1:
        spots.append(("peak behind the mask", len(peaks.along), peaks.error))
    parts = [
        f"{arm}: {count} distances, interpolated within {max(100 * error, 0.1):.2g} %, rounded"
        " upward"
        for arm, count, error in spots
        if math.isfinite(error)
    ]
    text += f" Point-spread functions, {'; '.join(parts)}." if parts else ""
    return text


def near_text(asked: float, ranked: tuple[Ranked, ...], peaks: Peaks | None) -> Iterator[str]:
    """Yield one sentence for each point-spread function that is not computed at the nearest
    distance of the settings, ``asked`` (m).

    Another one says at which distances light outside the window of the spot behind the mask counts
    as its peak.
    """
    if peaks and peaks.along[0][0] > asked:
        yield (
            f"At less than {peaks.along[0][0]:.3g} m the beam in front of the mask is not"
            f" computed ({_REMEDY}): there the peak counts as the peak of the clear lens in"
            " focus, which no mask exceeds."
        )
    if peaks and peaks.outside:
        missing = max(share for _, share in peaks.outside)
        where_text = (
            f"{len(peaks.outside)} of {len(peaks.along)} distances, the farthest"
            f" {peaks.outside[-1][0]:.3g} m"
        )
        yield (
            f"At {where_text}, the window of the spot behind the mask lacks light (up to"
            f" {100 * missing:.2g} %) that may be brighter outside the window: this light counts"
            " as one spot, as sharp as the spot of the clear lens. Choose a larger window."
        )
    for spot in ranked:
        if math.isfinite(spot.error) and spot.distances[0] > asked:
            yield (
                f"At less than {spot.distances[0]:.3g} m the pixels behind the {_ARMS[spot.arm]}"
                f" are not computed ({_REMEDY}): all light counts in the pixels that may be lost,"
                " which is an upper bound."
            )


# --- unsaid parts ---------------------------------------------------------------------------------

# Sentences on what an estimate leaves out, each with its reason.


_BEYOND = 0.2  #: largest share of the lost pixels outside a window that is not reported


def unsaid_of_damage(safety: Safety, verdicts: Sequence[DamageVerdict]) -> Iterator[str]:
    """Yield one sentence for each reason why a part of the light is not judged, or one sentence if
    the recipe has no damage settings.
    """
    if safety.settings.damage is None:
        yield "No statement about damage: the recipe does not request it (safety.damage)."
        return
    reasons: dict[str, dict[str, None]] = {}
    for verdict in verdicts:
        for row in verdict.unjudged:
            reasons.setdefault(row.reason, {})[row.part] = None
    for reason, parts in reasons.items():
        yield (
            f"Damage is not judged for the {' and the '.join(parts)}: {reason}. Name a table of"
            " your own: safety.damage.file."
        )


def unsaid_of_dazzle(safety: Safety, areas: Mapping[str, Area | str]) -> Iterator[str]:
    """Yield sentences on what the estimate leaves out of dazzle; ``areas`` maps each protection to
    its dazzled area or to the reason why it is unknown.
    """
    dazzle, sensor = safety.settings.dazzle, safety.settings.sensor
    if dazzle is None:
        lacking = [name.replace("_", " ") for name in SATURATION if getattr(sensor, name) is None]
        reason = "the recipe does not request it (safety.dazzle)"
        if lacking:
            reason = (
                f"the recipe does not set {', '.join(lacking)} of the sensor at this wavelength"
            )
        yield f"No statement about dazzle: {reason}."
        return
    if not sees(safety.channels):
        yield (
            "No statement about dazzle: by the table of its responses, no channel of the camera"
            f" detects {safety.laser.wavelength * 1e9:.4g} nm. A sensor without its filters may"
            " detect it."
        )
        return
    yield from _unsaid_areas(areas)
    level = veil_level(dazzle)
    if level <= 0:
        yield "The feature of safety.dazzle is lost even without a laser, so no veil is computed."
    elif level >= sensor.fills:
        yield (
            f"The feature of safety.dazzle is visible through {level:.3g} e- of veiling light per"
            " pixel, more than the full well: a pixel is lost when it saturates, so no veil is"
            " computed."
        )


def _unsaid_areas(areas: Mapping[str, Area | str]) -> Iterator[str]:
    """Yield one sentence for each reason why a dazzled area is unknown, with the protections it
    applies to.
    """
    reasons: dict[str, list[str]] = {}
    for name, area in areas.items():
        if isinstance(area, str):
            reasons.setdefault(area, []).append(name)
    for reason, names in reasons.items():
        yield (
            f"No statement about dazzle behind {' and '.join(f'the {name}' for name in names)}:"
            f" {reason}."
        )


def beyond_window(shares: Mapping[str, float]) -> Iterator[str]:
    """Yield one sentence if many of the lost pixels lie outside the window of a PSF; ``shares``
    maps each protection to the share of such pixels.
    """
    shares_to_name = {name: share for name, share in shares.items() if share > _BEYOND}
    if shares_to_name:
        parts = ", ".join(
            f"{100 * share:.2g} % behind the {name}" for name, share in shares_to_name.items()
        )
        yield (
            "The window of the point-spread function does not contain the dazzled area at every"
            f" distance: up to {parts} of its pixels have the light of a radial law (the third"
            " power of the distance), and light that this law does not explain counts where it"
            " dazzles most. Choose a larger window."
        )


# --- safety estimate ------------------------------------------------------------------------------

# Estimate of damage, dazzle and eye exposure by a laser: limits, exposures and intervals of
# distance.


CERTIFICATE = "An estimate, not a certificate: neusee decides nothing about eyes or sensors."


@dataclass(frozen=True)
class Finding:
    """The comparison of the exposure with one limit behind one option: limit at the lens, exposure,
    and zones of distance.
    """

    option: str
    limit: Limit
    at_sensor: Spread  #: the limit at the peak on the sensor
    at_lens: Spread  #: the limit at the lens at the distance of the recipe: MPE_S or MDE_S
    #: at the peak on the sensor at the distance of the recipe, in the quantity of the limit
    exposure: Spread
    ratio: float  #: nominal exposure over the nominal limit
    #: probability of damage to a randomly drawn device; None where the spread of devices is unknown
    probability: Spread | None
    zones: Zones
    curve: FloatArray  #: (3, distance) of the limit at the lens: nominal, 5 % and 95 %
    ratios: Spread | None = None  #: ``ratio`` with its interval


@dataclass(frozen=True)
class Estimate:
    """The complete result of `neusee safety` for one recipe."""

    recipe: Recipe
    safety: Safety
    emission: Emission
    options: tuple[Option, ...]
    draws: SettingDraws
    exposures: Exposures
    findings: tuple[Finding, ...]
    eye: EyeFinding | None
    eye_dazzle: EyeDazzleFinding
    unsaid: tuple[str, ...]  #: what the estimate leaves out, with the reason
    patterns: tuple[DamagePattern, ...] = ()
    dazzled: tuple[Dazzled, ...] = ()  #: behind each protection for which the dazzled area is known
    dead: tuple[DeadPixels, ...] = ()  #: examples of damage in a raw frame
    ranked: tuple[Ranked, ...] = ()
    #: behind each protection; empty if the recipe has no damage settings
    damage: tuple[DamageVerdict, ...] = ()
    #: filter, notch filter, stop or exposure time that meets each limit behind the plain lens
    helps: tuple[Remedy, ...] = ()
    peaks: Peaks | None = None
    veil: Veil | None = None

    @property
    def at(self) -> int:
        """Return the index of the distance of the recipe in the array of distances."""
        return self.exposures.at(self.safety.laser.distance)

    @property
    def mean_at_lens(self) -> float:
        """Return the nominal irradiance at the lens in W/m2 at the distance of the recipe, averaged
        over one exposure.
        """
        mean = mean_in_frame(self.exposures, self.safety.settings.sensor.exposure or 1.0)
        return float(mean[0, 0] * self.exposures.lens[0, self.at])


def estimate(recipe: Recipe, store: Store | None = None) -> Estimate:
    """Return the estimate of a recipe with a block ``safety``; results of its steps come from the
    store if present.

    Raises `RecipeError` for a recipe without the block, for a distribution with values that are not
    allowed and for a step that does not exist, all before anything is computed, and `RunError` if a
    step of the mask fails.
    """
    return complete(recipe, prepare(recipe, store))


@dataclass(frozen=True)
class Prepared:
    """All inputs of an estimate: settings, draws, and the results of the recipe's steps for lens
    and mask.
    """

    safety: Safety
    draws: SettingDraws
    options: tuple[Option, ...]
    spots: tuple[Spot, ...]
    ranked: tuple[Ranked, ...]
    peaks: Peaks | None


def prepare(recipe: Recipe, store: Store | None) -> Prepared:
    """Return all inputs of an estimate; raises the errors that `estimate` lists."""
    safety = settings_of(recipe)
    refuse_other_lens(recipe, safety, store)
    safety = with_channels(recipe, safety, store)
    draws = draw_settings(recipe, safety)
    spots = spots_of(recipe, safety, store)
    ranked = ranked_of(recipe, safety, store)
    peaks = peaks_of(recipe, safety, store)
    options = (
        options_of(safety, peaks.here, peaks.along, peaks.misses)
        if peaks
        else options_of(safety, None)
    )
    return Prepared(safety, draws, with_heated_spots(options, spots), spots, ranked, peaks)


def complete(recipe: Recipe, prepared: Prepared) -> Estimate:
    """Return the estimate from its inputs."""
    safety, draws, options = prepared.safety, prepared.draws, prepared.options
    exposures = compute_exposures(safety, draws, options)
    area_behind = {option.name: area_of(safety, option, prepared.ranked) for option in options}
    areas = (
        tuple(area for area in area_behind.values() if isinstance(area, Area))
        if _dazzles(safety)
        else ()
    )
    findings = tuple(_findings(safety, draws, options, exposures, areas))
    verdicts = tuple(damage_verdicts(safety, options, exposures, draws, findings))
    eye = eye_finding(safety, exposures)
    eye_reasons = (eye,) if isinstance(eye, str) else ()
    beyond = {area.option.name: area.beyond(exposures, draws) for area in areas}
    unsaid = (
        *unsaid_of_damage(safety, verdicts),
        *unsaid_of_dazzle(safety, area_behind),
        *beyond_window(beyond),
        *near_text(safety.settings.distances[0], prepared.ranked, prepared.peaks),
        *eye_reasons,
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
    """Return True if the recipe has dazzle settings and at least one channel of the sensor sees the
    laser.
    """
    return safety.settings.dazzle is not None and sees(safety.channels)


def settings_of(recipe: Recipe) -> Safety:
    """Return the settings in the block ``safety`` of a recipe; raise `RecipeError` if there is no
    such block.
    """
    if recipe.safety is None:
        text = (
            "the recipe does not say what to estimate: add the block safety, as in the recipe"
            " safety_pointer"
        )
        raise RecipeError([Diagnostic(Location(recipe.name), "safety", text)])
    return recipe.safety


def _findings(
    safety: Safety,
    draws: SettingDraws,
    options: tuple[Option, ...],
    exposures: Exposures,
    areas: tuple[Area, ...],
) -> Iterator[Finding]:
    """Yield the comparison with each limit behind each option."""
    area_behind = {area.option: area for area in areas}
    for option in options:
        for limit in limits_behind(safety, draws, option, area_behind.get(option), exposures):
            yield _finding(safety, option, limit, exposures)


def _finding(safety: Safety, option: Option, limit: Limit, exposures: Exposures) -> Finding:
    """Return the comparison with one limit behind one option, at all distances and at the distance
    of the recipe.

    Rows of arrays are the nominal values and then the draws.
    """
    per_power, index = exposures.sensor[option.name], exposures.at(safety.laser.distance)
    emitted_light = emitted(safety, limit, exposures)
    limit_values = limit.values * limit.devices * np.ones((len(emitted_light), per_power.shape[1]))
    ratio, at_lens = (
        limit_ratio(safety, option.name, limit, exposures),
        limit_values * exposures.lens / per_power,
    )
    # exposure at the peak on the sensor: emitted power or energy times exposure per unit of it
    exposure_here = emitted_light[:, 0] * per_power[:, index]
    return Finding(
        option.name,
        limit,
        _spread(limit_values[:, index]),  # limit on the sensor
        _spread(at_lens[:, index]),  # limit at the lens
        _spread(exposure_here),  # exposure
        float(ratio[0, index]),
        _probability(limit, ratio[1:, index] * limit.devices[1:, 0]),
        zones_of(
            exposures.distances,
            ratio[0],
            ratio[1:],
            safety.laser.distance,
            safety.settings.distances,
        ),
        np.stack([at_lens[0], *np.quantile(at_lens[1:], QUANTILES, axis=0)]),
        _spread(ratio[:, index]),
    )


def _spread(values: FloatArray) -> Spread:
    """Return the nominal value (first element) with the interval of the draws (all others)."""
    return Spread.of(float(values[0]), values[1:])


def _probability(limit: Limit, ratio: FloatArray) -> Spread | None:
    """Return the share of devices that are damaged, with its interval over all uncertain inputs but
    the device.

    ``ratio`` (draw,) is that of the exposure to the limit of the median device.
    """
    if limit.effect != "damage" or limit.factor is None:
        return None
    from scipy.special import ndtr

    # the thresholds of devices are lognormal around that of the median device
    shares = ndtr(np.log(ratio) / np.log(limit.factor))
    return Spread.of(float(shares.mean()), shares)
