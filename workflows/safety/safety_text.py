"""Table cells and sentences of an estimate, and the whole estimate as text for a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from neusee.workflows.recipe.blocks.safety_block import EyeDazzle
from neusee.workflows.report.terminal_text import columns, wrapped
from neusee.workflows.safety import safety_estimate
from neusee.workflows.safety.exposure_limits import EyeDazzleFinding, EyeDazzleRow, EyeFinding
from neusee.workflows.safety.exposures import Spread, Zone, Zones
from neusee.workflows.safety.safety_estimate import (
    CERTIFICATE,
    DamageRow,
    DamageVerdict,
    Dazzled,
    Estimate,
    Finding,
    state_of_finding,
)
from neusee.workflows.safety.what_helps import MET, PictureCost, Remedy

# --- safety words ---------------------------------------------------------------------------------

# Table cells and sentences of an estimate, shared by its page and the terminal.


_PREFIXES = {-15: "f", -12: "p", -9: "n", -6: "u", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}
_PER_CM2 = 1e-4  #: of a quantity per m2
_LEAST_RELATIVE_WIDTH = 0.01  #: intervals narrower than this relative width are not written
_LEAST_SHARE = 1e-4  #: smallest share that is written as a number
UNITS = {"irradiance": "W", "fluence": "J"}

LIMIT_COLUMNS = (
    "protection",
    "limit",
    "on the sensor",
    "of it now",
    "limit at the lens",
    "probability",
)
DAZZLE_COLUMNS = ("protection", "saturated pixels", "of the picture", "times the plain lens")
ZONE_COLUMNS = (
    "protection",
    "limit",
    "exceeded from … to …",
    "probability of nowhere",
    "probability here",
)


def scaled(value: float, unit: str) -> str:
    """Return a positive number with three digits and an SI prefix, such as ``20.4 MW``."""
    if not (math.isfinite(value) and value > 0):
        return f"{value:g} {unit}"
    # the largest multiple of 3 below the logarithm; 1e-12 is its rounding
    exponent = min(max(3 * math.floor(math.log10(value) / 3 + 1e-12), -15), 12)
    text = f"{value / 10.0**exponent:.3g}"
    # rounding to three digits has reached the next prefix
    if float(text) >= 1000 and exponent < 12:
        exponent, text = exponent + 3, f"{value / 10.0 ** (exponent + 3):.3g}"
    return (
        f"{float(text):g} {_PREFIXES[exponent]}{unit}"
        if 0.1 <= float(text) < 1e4
        else f"{value:.3g} {unit}"
    )


def with_ends(spread: Spread, unit: str, factor: float = 1.0) -> str:
    """Return a number with the interval of its draws in brackets, or the number alone without
    uncertainty.
    """
    nominal_text = scaled(factor * spread.value, unit)
    if math.isclose(spread.low, spread.high, rel_tol=_LEAST_RELATIVE_WIDTH):
        return nominal_text
    number, _, prefixed = nominal_text.partition(" ")
    prefix_value = factor * spread.value / float(number)
    low, high = (f"{factor * bound / prefix_value:.3g}" for bound in (spread.low, spread.high))
    return f"{number} ({plain(low)} to {plain(high)}) {prefixed}"


def plain(number: str) -> str:
    """Return a number text such as 1.02e+03 without its exponent (1020), if that is short."""
    return f"{float(number):.0f}" if "e+" in number and abs(float(number)) < 1e5 else number


def metres(distance: float) -> str:
    """Return a distance with three digits, in m or km."""
    return f"{distance / 1e3:.3g} km" if distance >= 999.5 else f"{distance:.3g} m"


def end(spread: Spread) -> str:
    """Return a distance as text, with the interval of its draws."""
    if math.isclose(spread.low, spread.high, rel_tol=_LEAST_RELATIVE_WIDTH):
        return metres(spread.value)
    return f"{metres(spread.value)} ({metres(spread.low)} to {metres(spread.high)})"


def zone_text(zone: Zone) -> str:
    """Return the ends of a zone, with their intervals."""
    near = f"below {metres(zone.near.value)}" if zone.begins_before else end(zone.near)
    far = f"beyond {metres(zone.far.value)}" if zone.ends_beyond else end(zone.far)
    return f"{near} to {far}"


def zones_text(zones: Zones) -> str:
    """Return the zones of a limit as text; without a nominal zone, how far the zones of the draws
    reach.
    """
    if zones.zones:
        return "; ".join(map(zone_text, zones.zones))
    if zones.reach is None:
        return "nowhere"
    return f"nowhere at the nominal values; in some draws up to {end(zones.reach)}"


def share(value: float) -> str:
    """Return a probability as a percentage with two digits, never closer to 0 or 100 % than
    0.01 %.
    """
    if value in (0.0, 1.0):
        return f"{100 * value:.0f} %"
    if value < _LEAST_SHARE:
        return "< 0.01 %"
    if value > 1 - _LEAST_SHARE:
        return "> 99.99 %"
    return f"{100 * value:.2g} %" if value < 0.995 else f"{100 * value:.2f} %"


def probability(finding: Finding) -> str:
    """Return the probability of damage as text with its interval; a dash where none is stated."""
    spread = finding.probability
    if spread is None:
        return "–" if finding.limit.effect == "dazzle" else "not known: no spread was published"
    middle_text, low_text, high_text = map(share, (spread.value, spread.low, spread.high))
    return (
        middle_text
        if low_text == high_text == middle_text
        else f"{middle_text} ({low_text} to {high_text})"
    )


def limit_cells(finding: Finding) -> list[str]:
    """Return the table row of a limit: protection, name, limit on the sensor, ratio, limit at the
    lens, probability.
    """
    unit = UNITS[finding.limit.quantity]
    ratio_text = (
        f"{plain(f'{finding.ratio:.2g}')} times" if finding.ratio >= 1 else f"{finding.ratio:.2g}"
    )
    limit_text = with_ends(finding.at_sensor, f"{unit}/cm²", _PER_CM2)
    return [
        finding.option,
        finding.limit.name,
        limit_text,
        ratio_text,
        with_ends(finding.at_lens, f"{unit}/m²"),
        probability(finding),
    ]


def zone_cells(finding: Finding) -> list[str]:
    """Return the row of a limit in the table of distance zones."""
    zones = finding.zones
    return [
        finding.option,
        finding.limit.name,
        zones_text(zones),
        share(zones.none),
        share(zones.inside),
    ]


def eye_text(eye: EyeFinding) -> str:
    """Return two sentences on the exposure limit of the eye."""
    unit = f"{UNITS[eye.quantity]}/m²"
    per_pulse = " of each pulse" if eye.quantity == "fluence" else ""
    verb = "exceeds" if eye.exposure.value > eye.limit else "does not exceed"
    return (
        f"The eye may receive {scaled(eye.limit, unit)}{per_pulse} for {eye.duration:g} s (MPE);"
        f" here it receives {with_ends(eye.exposure, unit)}, which {verb} the limit. The nominal"
        f" ocular hazard distance (NOHD) is {end(eye.distance)} in clear air. A distance that is"
        " safe for a camera may blind people."
    )


def laser_text(estimate: Estimate) -> str:
    """Return one sentence on the laser, its distance and its exposure at the lens."""
    beam, index = estimate.exposures.beams[0], estimate.at
    rate_text = f" at {scaled(beam.repetition_rate, 'Hz')}" if beam.repetition_rate else ""
    output = (
        f"{scaled(beam.power, 'W')}"
        if beam.power and not beam.pulse_energy
        else (
            f"pulses of {scaled(beam.pulse_energy or 0.0, 'J')} in "
            f"{scaled(beam.pulse_duration or 0.0, 's')}{rate_text}"
        )
    )
    quantity = "fluence" if beam.is_pulsed else "irradiance"
    at_lens = (
        estimate.exposures.emitted("fluence" if beam.is_pulsed else "irradiance")[:, 0]
        * estimate.exposures.lens[:, index]
    )
    spread = Spread.of(float(at_lens[0]), at_lens[1:])
    per_pulse = " a pulse" if beam.is_pulsed else ""
    return (
        f"{estimate.safety.name}: {estimate.emission}, {output}, {beam.wavelength * 1e9:.4g} nm,"
        f" divergence {scaled(beam.divergence, 'rad')}, at"
        f" {metres(estimate.safety.laser.distance)}:"
        f" {with_ends(spread, UNITS[quantity] + '/m²')}{per_pulse} at the lens."
    )


def intervals_text(estimate: Estimate) -> str:
    """Return a sentence on the meaning of the numbers in brackets."""
    laws = estimate.draws.laws
    laws_text = f" {', '.join(f'{name} {text}' for name, text in laws.items())};" if laws else ""
    text = f"In brackets: the middle 90 % of {estimate.draws.count} draws of all uncertain values"
    if not estimate.damage:
        return (
            f"{text}:{laws_text.removesuffix(';')}."
            if laws_text
            else f"{text}; no value is uncertain."
        )
    return (
        f"{text}:{laws_text} the thresholds of damage. A published threshold has a bracket and no"
        " probability: a third of the draws each takes its lower end, its middle and its upper"
        " end. A law with data of devices is drawn from its spread."
    )


def dazzled_cells(area: Dazzled) -> list[str]:
    """Return the row of a protection in the table of the dazzled area."""
    low, high = (_pixels(bound) for bound in (area.pixels.low, area.pixels.high))
    number = _pixels(area.pixels.value)
    text = number if low == high else f"{number} ({low} to {high})"
    return [
        area.option,
        text,
        share(area.share),
        "–" if area.times is None else f"{area.times:.3g}",
    ]


def _pixels(number: float) -> str:
    """Return a number of pixels with three digits as text, or a dash for NaN."""
    if math.isnan(number):
        return "–"
    return f"{float(f'{number:.3g}'):.0f}"


def enlarged_text(estimate: Estimate) -> str:
    """Return sentences that compare the dazzled area behind the mask with that behind the plain
    lens; empty if unknown.
    """
    parts = [text for text in (_counted_text(estimate), _sooner_text(estimate)) if text]
    mask = _both(estimate)[1]
    larger = mask.times > 1 if mask and mask.times else any("less light" in text for text in parts)
    return " ".join(["The mask enlarges the dazzled area.", *parts] if larger else parts)


def _both(estimate: Estimate) -> tuple[Dazzled | None, Dazzled | None]:
    """Return the dazzled areas behind the plain lens and behind the mask; None for one that is
    unknown.
    """
    return next(iter(estimate.dazzled), None), next(
        (area for area in estimate.dazzled if area.masked), None
    )


def _counted_text(estimate: Estimate) -> str:
    """Return a sentence with the number of saturated pixels behind mask and plain lens, at the
    distance of the recipe.
    """
    plain, mask = _both(estimate)
    if plain is None or mask is None:
        return ""
    counts = (
        f"{_pixels(mask.pixels.value)} pixels behind the mask and {_pixels(plain.pixels.value)}"
        " behind the plain lens"
    )
    times = "" if mask.times is None else f", {mask.times:.3g} times as many"
    return f"At {metres(estimate.safety.laser.distance)} the laser fills {counts}{times}."


def _sooner_text(estimate: Estimate) -> str:
    """Return a sentence on how much less light at the lens is enough behind the mask to lose the
    stated share of the picture.
    """
    plain_area, mask_area = _both(estimate)
    dazzle_findings = [
        next(
            (
                finding
                for finding in estimate.findings
                if area and finding.option == area.option and finding.limit.effect == "dazzle"
            ),
            None,
        )
        for area in (plain_area, mask_area)
    ]
    if dazzle_findings[0] is None or dazzle_findings[1] is None:
        return ""
    # limit at the lens behind the plain lens over that behind the mask
    factor = dazzle_findings[0].at_lens.value / dazzle_findings[1].at_lens.value
    compared = (
        f"{factor:.3g} times less light" if factor > 1 else f"{1 / factor:.3g} times more light"
    )
    return (
        f"Behind the mask, {compared} at the lens than behind the plain lens reaches this limit:"
        f" {dazzle_findings[1].limit.name}."
    )


# --- damage words ---------------------------------------------------------------------------------

# Sentences and table cells on damage: the verdict, and each part of the light.

_SUBJECTS = {
    "pulse": "one pulse",
    "mean": "the mean light",
    "accumulation": "the accumulated heat of pulses",
    "incubation": "the incubation by pulses",
}
STATES = {
    "above": "above",
    "within": "within the bracket",
    "below": "below",
    "not judged": "not judged",
}


def verdict(estimate: Estimate) -> list[str]:
    """Return the damage verdict behind the plain lens, and a sentence for each dazzle limit
    there.
    """
    lens = estimate.options[0].name
    damage_sentences = [
        damage_sentence(damage_verdict, estimate)
        for damage_verdict in estimate.damage
        if damage_verdict.option == lens
    ]
    dazzle_findings = [
        finding
        for finding in estimate.findings
        if finding.option == lens and finding.limit.effect != "damage"
    ]
    return damage_sentences + [
        f"{finding.limit.name}: exceeded"
        f" {'from ' if finding.zones.zones else ''}{zones_text(finding.zones)}."
        for finding in dazzle_findings
    ]


def damage_sentence(verdict: DamageVerdict, estimate: Estimate) -> str:
    """Return the damage verdict behind one protection, with exposure and threshold in W/cm2 or
    J/cm2 and the zones of the quoted part.
    """
    place_text = f"at {metres(estimate.safety.laser.distance)} behind the {verdict.option}"
    nearest = verdict.nearest
    if nearest is None or nearest.finding is None:
        return f"Damage is not judged {place_text}: {verdict.rows[0].reason}."
    exposure_text, zones_sentence = _compared(nearest, estimate), _zones(verdict, nearest.finding)
    if verdict.state == "above":
        return f"Damage is expected {place_text}: {exposure_text} {zones_sentence}"
    if verdict.state == "not judged":
        parts = " and the ".join(dict.fromkeys(row.part for row in verdict.unjudged))
        text = (
            f"Damage is not judged {place_text}, because no damage law applies to the {parts}:"
            f" {verdict.unjudged[0].reason}."
        )
        if nearest.state == "not judged":
            return text
        return f"{text} Of the judged parts, {exposure_text} {zones_sentence}".rstrip()
    opening = "Damage cannot be excluded" if verdict.state == "within" else "No damage is expected"
    return f"{opening} {place_text}: {exposure_text} {zones_sentence}"


def _compared(row: DamageRow, estimate: Estimate) -> str:
    """Return a sentence with the exposure by one part of the light, and its ratio to the
    threshold.
    """
    finding = row.finding
    assert finding is not None
    unit = f"{UNITS[finding.limit.quantity]}/cm²"
    subject = (
        _SUBJECTS[row.part] if estimate.exposures.beams[0].is_pulsed else "the continuous light"
    )
    exposure = scaled(finding.exposure.value * _PER_CM2, unit)
    threshold = with_ends(finding.at_sensor, unit, _PER_CM2)
    kind = "first damage" if finding.limit.kind == "point" else finding.limit.kind
    return (
        f"{subject} of {exposure} on the sensor is {times(finding)} the threshold of {kind},"
        f" {threshold}."
    )


def times(finding: Finding) -> str:
    """Return the ratio of exposure to limit with its interval as text, such as ``0.34 (0.1 to 1.1)
    times``.
    """
    spread = finding.ratios
    if spread is not None and finding.limit.open_below:
        return f"at least {plain(f'{spread.low:.3g}')} times"
    if spread is None or spread.high <= spread.low * (1 + _LEAST_RELATIVE_WIDTH):
        return f"{plain(f'{finding.ratio:.3g}')} times"
    ratio, low, high = (
        plain(text) for text in (f"{finding.ratio:.3g}", f"{spread.low:.2g}", f"{spread.high:.2g}")
    )
    return f"{ratio} ({low} to {high}) times"


def _zones(verdict: DamageVerdict, finding: Finding) -> str:
    """Return a sentence on the distances at which the threshold is exceeded; empty if a part of the
    light is not judged.
    """
    if finding.zones.zones:
        return f"It exceeds the threshold from {zones_text(finding.zones)}."
    if verdict.unjudged or finding.limit.open_below:
        return ""
    if finding.zones.reach is None:
        return "It exceeds the threshold nowhere."
    return (
        "It exceeds the threshold nowhere at the nominal values, but in some draws up to"
        f" {end(finding.zones.reach)}."
    )


def is_bracket(finding: Finding) -> bool:
    """Return True for a damage limit that is a published bracket without data of devices, and so
    has no probability.
    """
    return finding.limit.effect == "damage" and finding.limit.factor is None


def limit_rows(estimate: Estimate) -> list[list[str]]:
    """Return the rows of the table of limits, followed by those of the parts of the light that are
    not judged.
    """
    rows = [_limit_cells(finding) for finding in estimate.findings]
    for verdict in estimate.damage:
        rows += [_unjudged_cells(verdict, row) for row in _without_limit(verdict)]
    return rows


def zone_rows(estimate: Estimate) -> list[list[str]]:
    """Return the rows of the table of distance zones, followed by those of the parts of the light
    that are not judged.
    """
    partial = {verdict.option for verdict in estimate.damage if verdict.unjudged}
    rows = [_zone_cells(finding, finding.option in partial) for finding in estimate.findings]
    for verdict in estimate.damage:
        rows += [
            [verdict.option, f"damage: {row.part}", "not judged", "–", "–"]
            for row in _without_limit(verdict)
        ]
    return rows


def _without_limit(verdict: DamageVerdict) -> list[DamageRow]:
    """Return the rows of a verdict that have no limit."""
    return [row for row in verdict.rows if row.finding is None]


def _unjudged_cells(verdict: DamageVerdict, row: DamageRow) -> list[str]:
    """Return the row in the table of limits for a part of the light that no law covers."""
    return [verdict.option, f"damage: {row.part}", "no law", "not judged", "–", "–"]


def _limit_cells(finding: Finding) -> list[str]:
    """Return the table row of a limit; for damage with the interval of the ratio and the state."""
    cells = limit_cells(finding)
    if finding.limit.effect != "damage" or finding.ratios is None:
        return cells
    # columns 3 and 5 of `LIMIT_COLUMNS`: the ratio, and the probability
    cells[3] = f"{times(finding)}: {STATES[state_of_finding(finding)]}"
    if is_bracket(finding):
        cells[5] = "none: no device data"
    return cells


def _zone_cells(finding: Finding, partial: bool) -> list[str]:
    """Return the row of a limit in the table of distance zones; without device data its
    probabilities are dashes.
    """
    zones = finding.zones
    text = zones_text(zones)
    if finding.limit.effect == "damage" and not zones.zones and partial:
        text = "not by this part alone"
    shares = ["–", "–"] if is_bracket(finding) else [share(zones.none), share(zones.inside)]
    return [finding.option, finding.limit.name, text, *shares]


# --- eye words ------------------------------------------------------------------------------------

# Table cells and sentences on dazzle of the eye, shared by the page and the terminal.


EYE_DAZZLE_COLUMNS = (
    "surroundings",
    "from the laser",
    "eye receives at most (MDE)",
    "dazzled up to (NODD)",
    "here",
)


def dazzle_cells(row: EyeDazzleRow) -> list[str]:
    """Return the table row for one ambient luminance and one angle."""
    first_cells = [f"{row.background:g} cd/m²", f"{row.angle:.3g}°"]
    if row.distance is None:
        return [*first_cells, "not seen without a laser", "–", "–"]
    return [
        *first_cells,
        scaled(row.limit, "W/m²"),
        end(row.distance),
        "dazzled" if row.dazzled else "seen",
    ]


def distance_table(rows: Sequence[EyeDazzleRow]) -> list[list[str]]:
    """Return the table of dazzle distances, header first: a row for each ambient luminance, a
    column for each angle.
    """
    angles = list(dict.fromkeys(row.angle for row in rows))
    table = [["surroundings", *(f"{angle:.3g}° from the laser" for angle in angles)]]
    for background in dict.fromkeys(row.background for row in rows):
        distances = [row.distance for row in rows if row.background == background]
        table.append(
            [
                f"{background:g} cd/m²",
                *("not seen" if spread is None else metres(spread.value) for spread in distances),
            ]
        )
    return table


def dazzle_text(finding: EyeDazzleFinding, asked: EyeDazzle) -> str:
    """Return a sentence on the viewing task, or why dazzle of the eye is not judged."""
    if finding.reason:
        return f"Dazzle of the eye is not judged: {finding.reason}."
    size = math.degrees(asked.size) * 60
    return (
        f"A target of {size:.3g} arc minutes and the contrast {asked.contrast:g} is hidden from a"
        f" viewer of {asked.age:g} years by the light that the eye scatters, where the irradiance"
        " exceeds the maximum dazzle exposure (MDE), up to the nominal ocular dazzle distance"
        " (NODD) in clear air. Within the NOHD the eye may be injured as well."
    )


# --- helps words ----------------------------------------------------------------------------------

# Table cells and sentences on protective measures, shared by the page and the terminal.


COLUMNS = (
    "limit",
    "means",
    "at the limit",
    "in 95 % of the draws",
    "light of the scene",
    "SNR of the feature",
    "note",
)
_DENSITY = "OD "
EXPLAINED = """Damage, saturation and contrast are three problems, and each is solved apart, for the
    plain lens at the distance of the recipe. A density, a stop or an exposure is the one that
    brings the laser to the limit; in brackets is the middle 90 % of the draws, and beside it the
    value that holds in 95 % of them. The light of the scene is what is left of it in a pixel with
    that value."""


def table(remedies: Sequence[Remedy]) -> list[list[str]]:
    """Return a table row for each protective measure against each limit, and a single row for a
    limit that needs none.
    """
    rows = []
    for limit in dict.fromkeys(remedy.limit for remedy in remedies):
        of_limit = [remedy for remedy in remedies if remedy.limit == limit]
        if all(remedy.reason == MET for remedy in of_limit):
            rows.append([limit, "none", MET, "–", "–", "–", ""])
        else:
            rows += [cells(remedy) for remedy in of_limit]
    return rows


def cells(remedy: Remedy) -> list[str]:
    """Return the table row that compares one protective measure with one limit."""
    cost = remedy.cost
    scene_text = "–" if cost is None else f"{100 * cost.scene:.3g} %"
    return [
        remedy.limit,
        remedy.means,
        _value(remedy),
        "–" if remedy.safe is None or remedy.value is None else _number(remedy.means, remedy.safe),
        scene_text,
        "–" if cost is None else _snr(cost),
        _note(remedy),
    ]


def _value(remedy: Remedy) -> str:
    """Return the value of a measure that meets the limit, with its interval, or that there is
    none.
    """
    if remedy.reason == MET:
        return MET
    if remedy.value is None:
        return "not judged" if remedy.reason.startswith("not judged") else "none helps"
    nominal_text, low_text, high_text = (
        _number(remedy.means, number)
        for number in (remedy.value.value, remedy.value.low, remedy.value.high)
    )
    low_text, high_text = low_text.removeprefix(_DENSITY), high_text.removeprefix(_DENSITY)
    return (
        nominal_text
        if low_text == high_text == nominal_text.removeprefix(_DENSITY)
        else f"{nominal_text} ({low_text} to {high_text})"
    )


def _number(means: str, value: float) -> str:
    """Return an optical density, a diameter (m) or an exposure (s) as text with its unit."""
    if means in ("grey filter", "notch filter"):
        return f"{_DENSITY}{value:.2f}"
    return scaled(value, "m" if means == "stop" else "s")


def _snr(cost: PictureCost) -> str:
    """Return the signal-to-noise ratio of the stated feature without and with the measure."""
    if cost.snr_before is None or cost.snr_after is None:
        return "–"
    return f"{cost.snr_before:.3g} to {cost.snr_after:.3g}"


def _note(remedy: Remedy) -> str:
    """Return the remarks on a value, or why there is none."""
    if remedy.reason == MET:
        return ""
    if remedy.value is None:
        return remedy.reason
    notes = [remedy.reason, _notch_note(remedy), *_picture_notes(remedy)]
    return "; ".join(note for note in notes if note)


def _notch_note(remedy: Remedy) -> str:
    """Return a remark on the band that a notch filter has to block."""
    if remedy.band is None:
        return ""
    low, high = (f"{wavelength * 1e9:.4g}" for wavelength in remedy.band)
    return f"blocks {low} to {high} nm; the wavelength of the laser must be known"


def _picture_notes(remedy: Remedy) -> Iterator[str]:
    """Yield remarks on what a stop, a grey filter or an exposure does to white and to fine
    detail.
    """
    cost = remedy.cost
    if cost is None:
        return
    if cost.white is not None and remedy.means != "notch filter":
        yield f"white falls to {scaled(cost.white, 'e-')}" if cost.scene < 1 else "white saturates"
    if cost.cutoff_after < min(0.5, 0.999 * cost.cutoff_before):
        yield f"diffraction leaves {cost.cutoff_after:.2g} cycles a pixel"


def sentences(remedies: Sequence[Remedy]) -> Iterator[str]:
    """Yield a sentence that exposure never changes damage, and one for each limit that neither grey
    filter nor stop can meet.
    """
    if any(remedy.problem == "damage" for remedy in remedies):
        yield "An exposure never changes damage."
    for limit in dict.fromkeys(remedy.limit for remedy in remedies):
        helpless = {
            remedy.means for remedy in remedies if remedy.limit == limit and remedy.value is None
        }
        if {"grey filter", "stop"} <= helpless:
            yield f"{limit}: neither a grey filter nor a stop helps."


# --- safety text ----------------------------------------------------------------------------------

# An estimate of safety as lines of text for a terminal.


#: lines that stay as they are, or a single text that is wrapped
Paragraphs = Sequence[Sequence[str]]


def paragraphs(estimate: Estimate) -> list[list[str]]:
    """Return the estimate as paragraphs, before lines are wrapped: verdict, tables, eye, notes and
    sources.
    """
    texts = [
        [f"{estimate.recipe.name}: {estimate.recipe.title}", CERTIFICATE, ""],
        [laser_text(estimate)],
    ]
    writers = (
        _damage,
        _limits,
        _dazzled_area,
        _helps,
        _eye,
        _unsaid,
        _counted,
        _intervals,
        _sources,
        _eye_sources,
    )
    for step in writers:
        texts += step(estimate)
    return texts


def _damage(estimate: Estimate) -> Iterator[list[str]]:
    """Yield the verdict of damage behind the plain lens."""
    if estimate.damage:
        yield from (["", "damage"], [damage_sentence(estimate.damage[0], estimate)])


def _limits(estimate: Estimate) -> Iterator[list[str]]:
    """Yield the tables of limits and of distances."""
    rows = limit_rows(estimate)
    if rows:
        yield _table("limits", LIMIT_COLUMNS, rows)
        yield _table("distances", ZONE_COLUMNS, zone_rows(estimate))


def _dazzled_area(estimate: Estimate) -> Iterator[list[str]]:
    """Yield the table of the dazzled area, and whether the mask enlarges it."""
    if not estimate.dazzled:
        return
    distance_text = metres(estimate.safety.laser.distance)
    yield _table(
        f"dazzled area at {distance_text}",
        DAZZLE_COLUMNS,
        [dazzled_cells(area) for area in estimate.dazzled],
    )
    text = enlarged_text(estimate)
    if text:
        yield [text]


def _unsaid(estimate: Estimate) -> Iterator[list[str]]:
    """Yield what the estimate leaves out."""
    if estimate.unsaid:
        yield ["", "not said"]
        yield from ([text] for text in estimate.unsaid)


def _counted(estimate: Estimate) -> Iterator[list[str]]:
    """Yield the effects included along the optical axis."""
    yield from (
        ["", "counted along the axis"],
        [safety_estimate.scatter_text(estimate.veil)],
        [safety_estimate.focus_text(estimate.safety)],
    )
    yield from ([text] for text in safety_estimate.counted(estimate.safety))


def _intervals(estimate: Estimate) -> Iterator[list[str]]:
    """Yield the meaning of the numbers in brackets."""
    yield from (["", "intervals"], [intervals_text(estimate)])


def _sources(estimate: Estimate) -> Iterator[list[str]]:
    """Yield the sources of the limits."""
    yield ["", "sources"]
    yield from ([text] for text in dict.fromkeys(map(_source, estimate.findings)))


def _helps(estimate: Estimate) -> Iterator[list[str]]:
    """Yield the table of protective measures, without the notes column of the page."""
    if estimate.helps:
        cells = [row[:-1] for row in table(estimate.helps)]
        yield _table("what helps, behind the plain lens", COLUMNS[:-1], cells)
        yield from ([text] for text in sentences(estimate.helps))


def _eye(estimate: Estimate) -> Iterator[list[str]]:
    """Yield the limit of the eye and the distances of its dazzle."""
    if estimate.eye:
        yield from (["", "eye"], [eye_text(estimate.eye)])
    if estimate.eye_dazzle.rows:
        header, *cells = distance_table(estimate.eye_dazzle.rows)
        yield _table("dazzle of the eye (NODD)", tuple(header), cells)
    yield [dazzle_text(estimate.eye_dazzle, estimate.safety.settings.eye.dazzle)]


def _eye_sources(estimate: Estimate) -> Iterator[list[str]]:
    """Yield the sources for the eye."""
    if estimate.eye:
        yield [f"eye: {estimate.eye.source}"]
    if estimate.eye_dazzle.rows:
        yield [f"dazzle of the eye: {estimate.eye_dazzle.source}"]


def lines(parts: Paragraphs) -> list[str]:
    """Return paragraphs as lines no wider than the terminal; tables are not wrapped."""
    printed: list[str] = []
    for paragraph in parts:
        printed += wrapped(paragraph[0]) if len(paragraph) == 1 else paragraph
    return printed


def _source(finding: Finding) -> str:
    """Return the source of a limit, with a note on interpolation, extrapolation or assumptions."""
    note = f" ({finding.limit.note})" if finding.limit.note else ""
    return f"{finding.limit.name}: {finding.limit.source}{note}"


def _table(title: str, header: tuple[str, ...], rows: list[list[str]]) -> list[str]:
    """Return a table as lines: an empty line, the title, then header and rows in aligned
    columns.
    """
    return ["", title, *(f"  {line}" for line in columns([list(header), *rows]))]
