"""The page of an estimate of safety: limits, distances, the eye, what is not said, assumptions and sources."""

from __future__ import annotations

from neusee.workflows.report.study_folder import StudyReport
from neusee.workflows.report.study_page import Mark, Section
from neusee.workflows.safety import safety_figures as figures
from neusee.workflows.safety import safety_words as words
from neusee.workflows.safety.safety_estimate import CERTIFICATE, Estimate, Finding
from neusee.workflows.safety.unsaid_parts import stray_text

_CSV = ("protection", "limit", "effect", "quantity", "limit on the sensor", "5 %", "95 %", "limit at the lens", "5 %",
        "95 %", "ratio", "probability", "zones", "probability of nowhere", "probability here", "source")  # fmt: skip


def report(found: Estimate) -> StudyReport:
    """Return the page of an estimate with its pictures and its table of limits."""
    shown = {"irradiance": figures.over_distance(found)}
    if found.findings or found.eye:
        shown["distances"] = figures.zones(found)
    if found.dazzled:
        shown["dazzle"] = figures.dazzled_share(found)
    if found.patterns:
        shown["pattern"] = figures.spots(found.patterns)
    if found.dead:
        shown["dead_pixels"] = figures.dead_frames(found.dead)
    sections = [_limits(found), _distances(found, shown.get("distances")), _curve(shown["irradiance"])]
    sections += [_dazzled(found, shown.get("dazzle")), _pattern(found, shown.get("pattern"))]
    sections += [_dead(found, shown.get("dead_pixels")), _eye(found), _unsaid(found), _assumed(found), _sources(found)]
    return StudyReport(
        f"{found.recipe.name}: damage, dazzle and distance",
        "\n\n".join([CERTIFICATE, found.recipe.title, words.laser_text(found), " ".join(words.verdict(found))]),
        [each for each in sections if each],
        shown,
        {"limits.csv": (_CSV, [_row(each) for each in found.findings])},
    )


def _limits(found: Estimate) -> Section | None:
    if not found.findings:
        return None
    text = f"""Each limit on the sensor, the share of it that the laser reaches at
        {words.metres(found.safety.laser.distance)}, and the exposure at the lens that reaches it: the maximum
        permissible exposure (MPE_S) for damage, the maximum dazzle exposure (MDE_S) for dazzle of the sensor. The
        probability is that of a device drawn from all devices. {words.intervals_text(found)} {CERTIFICATE}"""
    marks: dict[tuple[int, int], Mark] = {
        (i, 3): "fail" if each.ratio >= 1 else "warn" if each.zones.inside > 0 else "pass"
        for i, each in enumerate(found.findings)
    }
    return Section("Limits", text, words.LIMIT_COLUMNS, [words.limit_cells(e) for e in found.findings], marks=marks)


def _distances(found: Estimate, picture: bytes | None) -> Section | None:
    if not found.findings:
        return None
    near, far = (words.metres(found.exposures.distances[i]) for i in (0, -1))
    text = f"""Where the laser exceeds each limit, from {near} to {far}. A zone may begin away from the laser, because
        close to it a narrow beam fills only a part of the lens. The probability of nowhere is the share of the
        draws in which no distance exceeds the limit; the probability here is that at the distance of the recipe, the
        vertical line. Black lines are the intervals of the ends. {CERTIFICATE}"""
    rows = [words.zone_cells(each) for each in found.findings]
    return Section("Distances", text, words.ZONE_COLUMNS, rows, picture)


def _curve(picture: bytes) -> Section:
    text = f"""The exposure at the lens on the axis of the beam, and the limits at the lens behind the plain lens, with
        their intervals. The vertical line is the distance of the recipe. {CERTIFICATE}"""
    return Section("Exposure over distance", text, picture=picture)


def _dazzled(found: Estimate, picture: bytes | None) -> Section | None:
    if picture is None or found.safety.settings.dazzle is None:
        return None
    text = f"""{words.enlarged_text(found)} The figure shows the share of saturated pixels against the irradiance at the
        lens, the mean over one exposure. The dotted line is the share that may be lost,
        {100 * found.safety.settings.dazzle.share:g} %, and the vertical line the irradiance at
        {words.metres(found.safety.laser.distance)}. A curve ends where the window of the point-spread function does not
        hold the saturated pixels.

        {stray_text(found.ranked)} {CERTIFICATE}"""
    rows = [words.dazzled_cells(each) for each in found.dazzled]
    return Section("Dazzled area", text, words.DAZZLE_COLUMNS, rows, picture)


def _dead(found: Estimate, picture: bytes | None) -> Section | None:
    """Return the section of the dead pixels; without a picture, that no distance damages the median device."""
    if not found.patterns:
        return None
    heading = "Example of damage in the raw frame"
    if picture is None:
        text = "No picture: at no distance does the laser damage the median device behind the plain lens."
        return Section(heading, f"{text} {CERTIFICATE}")
    distance = words.metres(found.dead[0].distance)
    text = f"""An example pattern and no prediction: the raw frame of an evenly grey scene around the spot, after the
        laser has hit the median device at {distance}. A point is white, a destroyed pixel black; lines and crosses are
        black rows and columns (white columns of a CCD). A sensor that gives no valid frame shows nothing of it: the
        picture then shows what else is damaged. Which lines go with a damaged pixel differs from device to device.
        {CERTIFICATE}"""
    columns = ("protection", "damage", "pixels in the light")
    rows = [[each.option, ", ".join(each.kinds) or "none", each.pixels] for each in found.dead]
    return Section(heading, text, columns, rows, picture)


def _pattern(found: Estimate, picture: bytes | None) -> Section | None:
    if picture is None:
        return None
    pitch = found.safety.settings.sensor.pixel_pitch
    text = f"""The exposure on the sensor at {words.metres(found.safety.laser.distance)} over the limit of the median
        device, for the law that is named. Where it is red the limit is exceeded; a pixel is {pitch * 1e6:.3g} um
        wide. A line, a cross or a lost frame is the damage of the circuits around this spot. {CERTIFICATE}"""
    rows = [[each.option, each.limit, each.peak, each.area, each.area / (pitch * 1e6) ** 2] for each in found.patterns]
    columns = ("protection", "limit", "peak over the limit", "area above the limit (um²)", "pixels")
    return Section("Pattern of damage", text, columns, rows, picture)


def _eye(found: Estimate) -> Section | None:
    if found.eye is None:
        return None
    return Section("The eye", f"{words.eye_text(found.eye)} Source: {found.eye.source}. {CERTIFICATE}")


def _unsaid(found: Estimate) -> Section | None:
    return Section("What is not said", "\n\n".join(found.unsaid)) if found.unsaid else None


def _assumed(found: Estimate) -> Section:
    laser = found.safety.laser
    air = "Clear air."
    if laser.air_transmittance is not None:
        air = f"Air that passes {laser.air_transmittance:g} over {words.metres(laser.distance)}, evenly."
    elif laser.visibility is not None:
        air = f"Air with a visibility of {words.metres(laser.visibility)} by the law of {laser.haze.capitalize()}."
    text = f"""The beam is Gaussian, hits the middle of the lens and is in focus at every distance: a camera that is
        focused elsewhere receives less at the peak. {stray_text(found.ranked)} {air}

        Continuous light stays on one place of the sensor for {found.safety.settings.damage.dwell:g} s. A pulse train
        is compared by each pulse and by its mean; heat that pulses leave behind is not added up. Behind a mask the
        threshold of continuous light is that of the published spot, and its largest peak counts.

        Dazzle counts light in a frame that catches a pulse. The wings of a beam that is narrower than the lens are
        weaker than is assumed. Pixels are counted in the point-spread function of a sampled pupil: at n wavelengths
        times f-number from the spot a pupil of 8 n samples across is 1 to 2 % too bright there, one of 6 n samples 5 %
        and one of 4 n samples 9 to 14 %. The limit of dazzle is too low by as much, and its distance too long by half
        of that."""
    return Section("What is assumed", text)


def _sources(found: Estimate) -> Section:
    rows = dict.fromkeys((each.limit.name, each.limit.note, each.limit.source) for each in found.findings)
    eye = [("eye (MPE, NOHD)", "", found.eye.source)] if found.eye else []
    listed = [*map(list, rows), *map(list, eye)]
    return Section("Sources of the limits", CERTIFICATE, ("limit", "spot", "source") if listed else (), listed)


def _row(each: Finding) -> list[object]:
    sensor, lens = each.at_sensor, each.at_lens
    probability = each.probability.value if each.probability else None
    numbers = [sensor.value, sensor.low, sensor.high, lens.value, lens.low, lens.high, each.ratio, probability]
    ends = [each.zones.none, each.zones.inside]
    start = [each.option, each.limit.name, each.limit.effect, each.limit.quantity]
    return [*start, *numbers, words.zones_text(each.zones), *ends, each.limit.source]
