"""The page of an estimate of safety: limits, distances, the eye, what is not said, assumptions and sources."""

from __future__ import annotations

from neusee.workflows.report.study_folder import StudyReport
from neusee.workflows.report.study_page import Mark, Section
from neusee.workflows.safety import counted_parts as parts
from neusee.workflows.safety import eye_words, helps_words
from neusee.workflows.safety import safety_figures as figures
from neusee.workflows.safety import safety_words as words
from neusee.workflows.safety.damage_verdict import state_of_finding
from neusee.workflows.safety.damage_words import is_bracket, limit_rows, verdict, zone_rows
from neusee.workflows.safety.safety_estimate import CERTIFICATE, Estimate, Finding

_CSV = ("protection", "limit", "effect", "quantity", "limit on the sensor", "5 %", "95 %", "limit at the lens", "5 %",
        "95 %", "ratio", "probability", "zones", "probability of nowhere", "probability here", "source", "state",
        "ratio 5 %", "ratio 95 %", "note")  # fmt: skip


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
    sections += [_dead(found, shown.get("dead_pixels")), _helps(found), _eye(found), _eye_dazzle(found)]
    sections += [_unsaid(found), _assumed(found), _sources(found)]
    return StudyReport(
        f"{found.recipe.name}: damage, dazzle and distance",
        "\n\n".join([CERTIFICATE, found.recipe.title, words.laser_text(found), " ".join(verdict(found))]),
        [each for each in sections if each],
        shown,
        {"limits.csv": (_CSV, [*map(_row, found.findings), *_unjudged(found)])},
    )


def _limits(found: Estimate) -> Section | None:
    rows = limit_rows(found)
    if not rows:
        return None
    text = f"""Each limit on the sensor, the share of it that the laser reaches at
        {words.metres(found.safety.laser.distance)}, and the exposure at the lens that reaches it: the maximum
        permissible exposure (MPE_S) for damage, the maximum dazzle exposure (MDE_S) for dazzle of the sensor. Damage
        has a row for each part of the light: one pulse, the mean over the dwell time, the heat of both together
        (accumulation) and, for a train, the incubation of many pulses. A probability is stated for a law with data of
        devices alone, and is that of a device drawn from all devices. {words.intervals_text(found)} {CERTIFICATE}"""
    marks: dict[tuple[int, int], Mark] = {(i, 3): "warn" for i in range(len(found.findings), len(rows))}
    marks |= {(i, 3): _mark(each) for i, each in enumerate(found.findings)}
    return Section("Limits", text, words.LIMIT_COLUMNS, rows, marks=marks)


def _mark(finding: Finding) -> Mark:
    """Return the mark of a limit; a limit of damage passes only if its exposure is below the whole bracket."""
    if finding.ratio >= 1:
        return "fail"
    if finding.limit.effect == "damage":
        return "pass" if state_of_finding(finding) == "below" else "warn"
    return "warn" if finding.zones.inside > 0 else "pass"


def _distances(found: Estimate, picture: bytes | None) -> Section | None:
    if not found.findings:
        return None
    near, far = (words.metres(found.exposures.distances[i]) for i in (0, -1))
    text = f"""Where the laser exceeds each limit, from {near} to {far}. A zone may begin away from the laser, because
        close to it a narrow beam fills only a part of the lens. The probability of nowhere is the share of the
        draws in which no distance exceeds the limit; the probability here is that at the distance of the recipe, the
        vertical line. Black lines are the intervals of the ends. {CERTIFICATE}"""
    return Section("Distances", text, words.ZONE_COLUMNS, zone_rows(found), picture)


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
        {words.metres(found.safety.laser.distance)}.

        {parts.scatter_text(found.veil)} {CERTIFICATE}"""
    rows = [words.dazzled_cells(each) for each in found.dazzled]
    return Section("Dazzled area", text, words.DAZZLE_COLUMNS, rows, picture)


def _dead(found: Estimate, picture: bytes | None) -> Section | None:
    """Return the section of the dead pixels; without a picture, that no distance damages the median device."""
    if not found.patterns:
        return None
    heading = "Example of damage in the raw frame"
    if picture is None:
        text = "No picture: at no distance does a judged part of the light exceed its threshold behind the plain lens."
        return Section(heading, f"{text} {CERTIFICATE}")
    distance = words.metres(found.dead[0].distance)
    text = f"""An example pattern and no prediction: the raw frame of an evenly grey scene around the spot, after the
        laser has hit a device whose thresholds are those stated, at {distance}. A point is white, a destroyed pixel
        black; lines and crosses are black rows and columns (white columns of a CCD). A sensor that gives no valid frame
        shows nothing of it: the picture then shows what else is damaged. Which lines go with a damaged pixel differs
        from device to device. {CERTIFICATE}"""
    columns = ("protection", "damage", "pixels in the light")
    rows = [[each.option, ", ".join(each.kinds) or "none", each.pixels] for each in found.dead]
    return Section(heading, text, columns, rows, picture)


def _pattern(found: Estimate, picture: bytes | None) -> Section | None:
    if picture is None:
        return None
    pitch = found.safety.settings.sensor.pixel_pitch
    text = f"""The exposure on the sensor at {words.metres(found.safety.laser.distance)} over the limit that is named,
        that of the part of the light with the largest ratio. Where it is red the limit is exceeded; a pixel is
        {pitch * 1e6:.3g} um wide. A line, a cross or a lost frame is the damage of the circuits around this spot.
        {CERTIFICATE}"""
    rows = [[each.option, each.limit, each.peak, each.area, each.area / (pitch * 1e6) ** 2] for each in found.patterns]
    columns = ("protection", "limit", "peak over the limit", "area above the limit (um²)", "pixels")
    return Section("Pattern of damage", text, columns, rows, picture)


def _eye(found: Estimate) -> Section | None:
    if found.eye is None:
        return None
    return Section("The eye", f"{words.eye_text(found.eye)} Source: {found.eye.source}. {CERTIFICATE}")


def _helps(found: Estimate) -> Section | None:
    if not found.helps:
        return None
    text = " ".join([helps_words.EXPLAINED, *helps_words.sentences(found.helps), CERTIFICATE])
    return Section("What helps", text, helps_words.COLUMNS, helps_words.table(found.helps))


def _eye_dazzle(found: Estimate) -> Section:
    dazzle = found.eye_dazzle
    text = f"{eye_words.dazzle_text(dazzle, found.safety.settings.eye.dazzle)} Source: {dazzle.source}. {CERTIFICATE}"
    rows = [eye_words.dazzle_cells(each) for each in dazzle.rows]
    return Section("Dazzle of the eye", text, eye_words.DAZZLE_COLUMNS if rows else (), rows)


def _unsaid(found: Estimate) -> Section | None:
    return Section("What is not said", "\n\n".join(found.unsaid)) if found.unsaid else None


def _assumed(found: Estimate) -> Section:
    laser = found.safety.laser
    air = "Clear air."
    if laser.air_transmittance is not None:
        air = f"Air that passes {laser.air_transmittance:g} over {words.metres(laser.distance)}, evenly."
    elif laser.visibility is not None:
        air = f"Air with a visibility of {words.metres(laser.visibility)} by the law of {laser.haze.capitalize()}."
    text = f"""The beam is Gaussian and hits the middle of the lens: a narrow beam beside the middle gives
        less. The share of its power that passes the lens, the width and the curvature of its wavefront, and with
        them the peak and every pixel, are those of each distance. {parts.focus_text(found.safety)}
        {parts.scatter_text(found.veil)} {air}

        {" ".join(parts.counted(found.safety))}

        {parts.ladder_text(found.ranked, found.peaks)} Between two distances the largest peak counts.

        {_damage_assumed(found)}

        Dazzle counts light in a frame that catches a pulse, on all pixels of the sensor, with the spot in its middle.
        Where the window of a point-spread function is smaller than the sensor, its light goes on as the third power of
        the distance. Pixels behind a mask are counted in the point-spread function of a sampled pupil: at n wavelengths
        times f-number from the spot a pupil of 8 n samples across is 1 to 2 % too bright there, one of 6 n samples 5 %
        and one of 4 n samples 9 to 14 %. The limit of dazzle is too low by as much, and its distance too long by half
        of that."""
    return Section("What is assumed", text)


def _damage_assumed(found: Estimate) -> str:
    """Return what is assumed of damage."""
    damage = found.safety.settings.damage
    if damage is None:
        return "Damage is not asked for."
    bonus = "gets no bonus"
    if damage.small_spot_exponent > 0:
        bonus = f"gets the bonus (published spot / spot) to the power of {damage.small_spot_exponent:g}"
    return f"""The light stays on one place of the sensor for {damage.dwell:g} s. The threshold of first damage is 0.1
        J/cm² for pulses of 10 ns and tens of kW/cm² from 10 us on, interpolated between both in logarithms. A spot that
        is wider than the published one lowers the threshold of continuous light by equal heat; a narrower one {bonus}.
        Behind a mask its largest peak counts, and the heat of its whole spot. A burst is a train whose dwell time is
        the length of the burst. Hot pixels, bleached filters and slow ageing are not in these laws."""


def _sources(found: Estimate) -> Section:
    rows = dict.fromkeys((each.limit.name, each.limit.note, each.limit.source) for each in found.findings)
    eye = [("eye (MPE, NOHD)", "", found.eye.source)] if found.eye else []
    listed = [*map(list, rows), *map(list, eye)]
    return Section("Sources of the limits", CERTIFICATE, ("limit", "note", "source") if listed else (), listed)


def _row(each: Finding) -> list[object]:
    sensor, lens = each.at_sensor, each.at_lens
    probability = each.probability.value if each.probability else None
    numbers = [sensor.value, sensor.low, sensor.high, lens.value, lens.low, lens.high, each.ratio, probability]
    ends = [None, None] if is_bracket(each) else [each.zones.none, each.zones.inside]
    start = [each.option, each.limit.name, each.limit.effect, each.limit.quantity]
    return [*start, *numbers, words.zones_text(each.zones), *ends, each.limit.source, *_beside(each)]


def _beside(finding: Finding) -> list[object]:
    """Return the last columns of a limit: state, ends of the ratio, and the note of its law."""
    low, high = (finding.ratios.low, finding.ratios.high) if finding.ratios else (None, None)
    state = state_of_finding(finding) if finding.limit.effect == "damage" else ""
    return [state, low, high, finding.limit.note]


def _unjudged(found: Estimate) -> list[list[object]]:
    """Return the rows of limits.csv for the parts of the light that no law judges."""
    return [
        [verdict.option, f"damage: {row.part}", "damage", *[""] * 10, "", "", row.reason, "not judged", "", "", ""]
        for verdict in found.damage
        for row in verdict.rows
        if row.finding is None
    ]
