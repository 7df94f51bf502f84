"""Cells and sentences of an estimate, which its page and the terminal share."""

from __future__ import annotations

import math

from neusee.workflows.safety.dazzle_curves import Dazzled
from neusee.workflows.safety.distance_zones import Spread, Zone, Zones
from neusee.workflows.safety.eye_findings import EyeFinding
from neusee.workflows.safety.safety_estimate import Estimate, Finding

_PREFIXES = {-15: "f", -12: "p", -9: "n", -6: "u", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}
_PER_CM2 = 1e-4  #: of a quantity per m2
_SAME = 0.01  #: relative width of an interval that is not written
_NEVER = 1e-4  #: smallest share that is written as a number
UNITS = {"irradiance": "W", "fluence": "J"}

LIMIT_COLUMNS = ("protection", "limit", "on the sensor", "of it now", "limit at the lens", "probability")
DAZZLE_COLUMNS = ("protection", "saturated pixels", "of the picture", "times the plain lens")
ZONE_COLUMNS = ("protection", "limit", "exceeded from … to …", "probability of nowhere", "probability here")


def scaled(value: float, unit: str) -> str:
    """Return a positive number with three digits and a prefix of its unit, such as ``20.4 MW``."""
    if not (math.isfinite(value) and value > 0):
        return f"{value:g} {unit}"
    power = min(max(3 * math.floor(math.log10(value) / 3 + 1e-12), -15), 12)
    text = f"{value / 10.0**power:.3g}"
    if float(text) >= 1000 and power < 12:
        power, text = power + 3, f"{value / 10.0 ** (power + 3):.3g}"
    return f"{float(text):g} {_PREFIXES[power]}{unit}" if 0.1 <= float(text) < 1e4 else f"{value:.3g} {unit}"


def with_ends(spread: Spread, unit: str, factor: float = 1.0) -> str:
    """Return a number with the interval of its draws in brackets, or alone if nothing is uncertain."""
    middle = scaled(factor * spread.value, unit)
    if math.isclose(spread.low, spread.high, rel_tol=_SAME):
        return middle
    number, _, prefixed = middle.partition(" ")
    one = factor * spread.value / float(number)
    low, high = (f"{factor * x / one:.3g}" for x in (spread.low, spread.high))
    return f"{number} ({plain(low)} to {plain(high)}) {prefixed}"


def plain(number: str) -> str:
    """Return a number of three digits without an exponent where this is short, such as 1020 for 1.02e+03."""
    return f"{float(number):.0f}" if "e+" in number and abs(float(number)) < 1e5 else number


def metres(distance: float) -> str:
    """Return a distance with three digits, in m or km."""
    return f"{distance / 1e3:.3g} km" if distance >= 999.5 else f"{distance:.3g} m"


def end(spread: Spread) -> str:
    """Return a distance with the interval of its draws."""
    if math.isclose(spread.low, spread.high, rel_tol=_SAME):
        return metres(spread.value)
    return f"{metres(spread.value)} ({metres(spread.low)} to {metres(spread.high)})"


def zone_text(zone: Zone) -> str:
    """Return the ends of a zone, with their intervals."""
    near = f"below {metres(zone.near.value)}" if zone.begins_before else end(zone.near)
    far = f"beyond {metres(zone.far.value)}" if zone.ends_beyond else end(zone.far)
    return f"{near} to {far}"


def zones_text(zones: Zones) -> str:
    """Return the zones of a limit as text; without one at the nominal values, how far one reaches in some draws."""
    if zones.zones:
        return "; ".join(map(zone_text, zones.zones))
    if zones.reach is None:
        return "nowhere"
    return f"nowhere at the nominal values; in some draws out to {end(zones.reach)}"


def share(value: float) -> str:
    """Return a probability as a percentage with two digits, and nothing more exact than 0.01 %."""
    if value in (0.0, 1.0):
        return f"{100 * value:.0f} %"
    if value < _NEVER:
        return "< 0.01 %"
    if value > 1 - _NEVER:
        return "> 99.99 %"
    return f"{100 * value:.2g} %" if value < 0.995 else f"{100 * value:.2f} %"


def probability(finding: Finding) -> str:
    """Return the probability that a device is damaged, with its interval; a dash where no probability is stated."""
    spread = finding.probability
    if spread is None:
        return "–" if finding.limit.effect == "dazzle" else "not known: no spread published"
    middle, low, high = map(share, (spread.value, spread.low, spread.high))
    return middle if low == high == middle else f"{middle} ({low} to {high})"


def limit_cells(finding: Finding) -> list[str]:
    """Return the row of a limit: protection, limit, limit on the sensor, its share that is reached, at the lens."""
    unit = UNITS[finding.limit.quantity]
    now = f"{plain(f'{finding.ratio:.2g}')} times" if finding.ratio >= 1 else f"{finding.ratio:.2g}"
    sensor = with_ends(finding.at_sensor, f"{unit}/cm²", _PER_CM2)
    return [
        finding.option, finding.limit.name, sensor, now, with_ends(finding.at_lens, f"{unit}/m²"), probability(finding),
    ]  # fmt: skip


def zone_cells(finding: Finding) -> list[str]:
    """Return the row of a limit in the table of distances."""
    zones = finding.zones
    return [finding.option, finding.limit.name, zones_text(zones), share(zones.none), share(zones.inside)]


def eye_text(eye: EyeFinding) -> str:
    """Return what is said of the eye in two sentences."""
    unit = f"{UNITS[eye.quantity]}/m²"
    each = " of each pulse" if eye.quantity == "fluence" else ""
    now = "exceeds" if eye.exposure.value > eye.limit else "does not exceed"
    return (
        f"The eye may receive {scaled(eye.limit, unit)}{each} for {eye.duration:g} s (MPE); here it receives "
        f"{with_ends(eye.exposure, unit)}, which {now} the limit. The nominal ocular hazard distance (NOHD) is "
        f"{end(eye.distance)} in clear air. A distance that is safe for a camera may blind people."
    )


def laser_text(found: Estimate) -> str:
    """Return the laser, its distance and its exposure at the lens in one sentence."""
    beam, at = found.exposures.beams[0], found.at
    train = f" at {scaled(beam.repetition_rate, 'Hz')}" if beam.repetition_rate else ""
    light = f"{scaled(beam.power, 'W')}" if beam.power and not beam.pulse_energy else (
        f"pulses of {scaled(beam.pulse_energy or 0.0, 'J')} in {scaled(beam.pulse_duration or 0.0, 's')}{train}"
    )  # fmt: skip
    quantity = "fluence" if beam.is_pulsed else "irradiance"
    here = found.exposures.emitted("fluence" if beam.is_pulsed else "irradiance")[:, 0] * found.exposures.lens[:, at]
    spread = Spread.of(float(here[0]), here[1:])
    each = " a pulse" if beam.is_pulsed else ""
    return (
        f"{found.safety.name}: {found.emission}, {light}, {beam.wavelength * 1e9:.4g} nm, divergence "
        f"{scaled(beam.divergence, 'rad')}, at {metres(found.safety.laser.distance)}: "
        f"{with_ends(spread, UNITS[quantity] + '/m²')}{each} at the lens."
    )


def intervals_text(found: Estimate) -> str:
    """Return what the numbers in brackets mean."""
    laws = found.draws.laws
    named = f" {', '.join(f'{name} {text}' for name, text in laws.items())};" if laws else ""
    text = f"In brackets: the middle 90 % of {found.draws.count} draws of all that is uncertain"
    if not found.damage:
        return f"{text}:{named.removesuffix(';')}." if named else f"{text}; nothing is."
    return (
        f"{text}:{named} the thresholds of damage. A published threshold has a bracket and no probability: a third of "
        "the draws each takes its lower end, its middle and its upper end. A law with data of devices is drawn from "
        "its spread."
    )


def dazzled_cells(each: Dazzled) -> list[str]:
    """Return the row of a protection in the table of the dazzled area."""
    low, high = (_pixels(x) for x in (each.pixels.low, each.pixels.high))
    number = _pixels(each.pixels.value)
    text = number if low == high else f"{number} ({low} to {high})"
    return [each.option, text, share(each.share), "–" if each.times is None else f"{each.times:.3g}"]


def _pixels(number: float) -> str:
    """Return a number of pixels with three digits, or a dash for one that is not known."""
    if math.isnan(number):
        return "–"
    return f"{float(f'{number:.3g}'):.0f}"


def enlarged_text(found: Estimate) -> str:
    """Return whether the mask makes the dazzled area larger than the plain lens, and by how much; empty: not known."""
    parts = [text for text in (_counted_text(found), _sooner_text(found)) if text]
    mask = _both(found)[1]
    larger = mask.times > 1 if mask and mask.times else any("less light" in text for text in parts)
    return " ".join(["The mask enlarges the dazzled area.", *parts] if larger else parts)


def _both(found: Estimate) -> tuple[Dazzled | None, Dazzled | None]:
    """Return the dazzled area behind the plain lens and behind the mask."""
    return next(iter(found.dazzled), None), next((each for each in found.dazzled if each.masked), None)


def _counted_text(found: Estimate) -> str:
    """Return the filled pixels behind mask and plain lens at the distance of the recipe."""
    plain, mask = _both(found)
    if plain is None or mask is None:
        return ""
    counts = (
        f"{_pixels(mask.pixels.value)} pixels behind the mask and {_pixels(plain.pixels.value)} behind the plain lens"
    )
    times = "" if mask.times is None else f", {mask.times:.3g} times as many"
    return f"At {metres(found.safety.laser.distance)} the laser fills {counts}{times}."


def _sooner_text(found: Estimate) -> str:
    """Return by how much less light at the lens the stated share of the picture is lost behind the mask."""
    plain, mask = _both(found)
    limits = [
        next((f for f in found.findings if each and f.option == each.option and f.limit.effect == "dazzle"), None)
        for each in (plain, mask)
    ]
    if limits[0] is None or limits[1] is None:
        return ""
    factor = limits[0].at_lens.value / limits[1].at_lens.value
    compared = f"{factor:.3g} times less light" if factor > 1 else f"{1 / factor:.3g} times more light"
    return f"Behind the mask {compared} at the lens than behind the plain lens gives: {limits[1].limit.name}."
