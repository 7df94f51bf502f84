"""Sentences and cells on damage: one verdict, and what is said of each part of the light."""

from __future__ import annotations

from neusee.workflows.safety.damage_verdict import DamageRow, DamageVerdict, state_of_finding
from neusee.workflows.safety.safety_estimate import Estimate, Finding
from neusee.workflows.safety.safety_words import (
    UNITS,
    end,
    limit_cells,
    metres,
    plain,
    scaled,
    share,
    with_ends,
    zones_text,
)

_PER_CM2 = 1e-4  #: of a quantity per m2
_SAME = 0.01  #: relative width of an interval that is not written
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


def verdict(found: Estimate) -> list[str]:
    """Return the verdict of damage behind the plain lens, and a sentence for each limit of dazzle behind it."""
    lens = found.options[0].name
    damage = [damage_sentence(each, found) for each in found.damage if each.option == lens]
    dazzle = [each for each in found.findings if each.option == lens and each.limit.effect != "damage"]
    return damage + [
        f"{each.limit.name}: exceeded {'from ' if each.zones.zones else ''}{zones_text(each.zones)}." for each in dazzle
    ]


def damage_sentence(verdict: DamageVerdict, found: Estimate) -> str:
    """Return the verdict of damage behind one protection in W/cm2 or J/cm2, with the distances of the worst part."""
    at = f"at {metres(found.safety.laser.distance)} behind the {verdict.option}"
    nearest = verdict.nearest
    if nearest is None or nearest.finding is None:
        return f"Damage is not judged {at}: {verdict.rows[0].reason}."
    near, zones = _compared(nearest, found), _zones(verdict, nearest.finding)
    if verdict.state == "above":
        return f"Damage is expected {at}: {near} {zones}"
    if verdict.state == "not judged":
        parts = " and the ".join(dict.fromkeys(row.part for row in verdict.unjudged))
        text = f"Damage is not judged {at}, because no law judges the {parts}: {verdict.unjudged[0].reason}."
        if nearest.state == "not judged":
            return text
        return f"{text} Of what is judged, {near} {zones}".rstrip()
    opening = "Damage cannot be excluded" if verdict.state == "within" else "No damage is expected"
    return f"{opening} {at}: {near} {zones}"


def _compared(row: DamageRow, found: Estimate) -> str:
    """Return the exposure of one part of the light, and its ratio to the threshold."""
    finding = row.finding
    assert finding is not None
    unit = f"{UNITS[finding.limit.quantity]}/cm²"
    part = _SUBJECTS[row.part] if found.exposures.beams[0].is_pulsed else "the continuous light"
    exposure = scaled(finding.exposure.value * _PER_CM2, unit)
    threshold = with_ends(finding.at_sensor, unit, _PER_CM2)
    kind = "first damage" if finding.limit.kind == "point" else finding.limit.kind
    return f"{part} of {exposure} on the sensor is {times(finding)} the threshold of {kind}, {threshold}."


def times(finding: Finding) -> str:
    """Return the ratio of exposure to limit with its interval, such as ``0.34 (0.1 to 1.1) times``."""
    spread = finding.ratios
    if spread is not None and finding.limit.open_below:
        return f"at least {plain(f'{spread.low:.3g}')} times"
    if spread is None or spread.high <= spread.low * (1 + _SAME):
        return f"{plain(f'{finding.ratio:.3g}')} times"
    ratio, low, high = (plain(text) for text in (f"{finding.ratio:.3g}", f"{spread.low:.2g}", f"{spread.high:.2g}"))
    return f"{ratio} ({low} to {high}) times"


def _zones(verdict: DamageVerdict, finding: Finding) -> str:
    """Return where the worst part of the light exceeds its threshold; nothing where a part is not judged."""
    if finding.zones.zones:
        return f"It exceeds the threshold from {zones_text(finding.zones)}."
    if verdict.unjudged or finding.limit.open_below:
        return ""
    if finding.zones.reach is None:
        return "It exceeds the threshold nowhere."
    return (
        f"It exceeds the threshold nowhere at the nominal values, but in some draws out to {end(finding.zones.reach)}."
    )


def is_bracket(finding: Finding) -> bool:
    """Return True for a limit of damage without data of devices, which has no probability."""
    return finding.limit.effect == "damage" and finding.limit.factor is None


def limit_rows(found: Estimate) -> list[list[str]]:
    """Return the table of limits, with the parts of the light that are not judged."""
    rows = [_limit_cells(each) for each in found.findings]
    for verdict in found.damage:
        rows += [_unjudged_cells(verdict, row) for row in _without_limit(verdict)]
    return rows


def zone_rows(found: Estimate) -> list[list[str]]:
    """Return the table of distances, with the parts of the light that are not judged."""
    partial = {verdict.option for verdict in found.damage if verdict.unjudged}
    rows = [_zone_cells(each, each.option in partial) for each in found.findings]
    for verdict in found.damage:
        rows += [[verdict.option, f"damage: {row.part}", "not judged", "–", "–"] for row in _without_limit(verdict)]
    return rows


def _without_limit(verdict: DamageVerdict) -> list[DamageRow]:
    """Return the rows without a limit."""
    return [row for row in verdict.rows if row.finding is None]


def _unjudged_cells(verdict: DamageVerdict, row: DamageRow) -> list[str]:
    """Return the row of a part of the light without a law in the table of limits."""
    return [verdict.option, f"damage: {row.part}", "no law", "not judged", "–", "–"]


def _limit_cells(finding: Finding) -> list[str]:
    """Return the row of a limit, for damage with the ratio's bracket and where the exposure is beside the limit."""
    cells = limit_cells(finding)
    if finding.limit.effect != "damage" or finding.ratios is None:
        return cells
    cells[3] = f"{times(finding)}: {STATES[state_of_finding(finding)]}"
    if is_bracket(finding):
        cells[5] = "none: no device data"
    return cells


def _zone_cells(finding: Finding, partial: bool) -> list[str]:
    """Return the row of a limit in the table of distances; without device data it has no probabilities."""
    zones = finding.zones
    text = zones_text(zones)
    if finding.limit.effect == "damage" and not zones.zones and partial:
        text = "not by this part alone"
    shares = ["–", "–"] if is_bracket(finding) else [share(zones.none), share(zones.inside)]
    return [finding.option, finding.limit.name, text, *shares]
