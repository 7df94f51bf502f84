"""The page of an estimate of safety, with its figures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from neusee.workflows.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    VERMILION,
    canvas,
    drawn,
)
from neusee.workflows.report.study_report import Mark, Section, StudyReport, marked_column
from neusee.workflows.safety import safety_estimate, safety_text
from neusee.workflows.safety.damage_pattern import DamagePattern, DeadPixels
from neusee.workflows.safety.exposures import QUANTILES
from neusee.workflows.safety.safety_estimate import (
    CERTIFICATE,
    DamageRow,
    Estimate,
    Finding,
    state_of_finding,
)
from neusee.workflows.safety.safety_text import is_bracket, limit_rows, verdict, zone_rows

# --- safety figures -------------------------------------------------------------------------------

# Figures of a safety estimate: irradiance as a function of distance with its limits, and zones of
# distance.


_COLOURS = (VERMILION, ORANGE, "#CC79A7", "#56B4E9", "#8c510a", "#7f7f7f")
_BELOW = 1.5  #: least number of decades below the peak that a picture of a spot shows
_DASHES = ("-", "--", ":", "-.", (0, (5, 1)), (0, (1, 1)))
_NAMES = {
    "irradiance": "irradiance at the lens (W/m2)",
    "fluence": "fluence of a pulse at the lens (J/m2)",
}


@drawn
def over_distance(estimate: Estimate) -> Any:
    """Draw the exposure at the lens as a function of distance, with the limits behind the plain
    lens.
    """
    plain_findings = [
        finding for finding in estimate.findings if finding.option == estimate.options[0].name
    ]
    quantities = list(
        dict.fromkeys(
            [
                "fluence" if estimate.exposures.beams[0].is_pulsed else "irradiance",
                *(finding.limit.quantity for finding in plain_findings if _has_mean(estimate)),
            ]
        )
    )
    figure, axes = canvas(9.0, 4.6 * len(quantities), len(quantities), 1)
    for axis, quantity in zip(axes[:, 0], quantities, strict=True):
        _panel(
            axis,
            estimate,
            quantity,
            [finding for finding in plain_findings if finding.limit.quantity == quantity],
        )
    return figure


def _has_mean(estimate: Estimate) -> bool:
    return estimate.exposures.beams[0].power is not None


def _panel(axis: Any, estimate: Estimate, kind: Any, findings: list[Finding]) -> None:
    """Draw one panel: the exposure as a function of distance, and the limits of the same quantity.

    ``kind`` is ``irradiance`` or ``fluence``; ``findings`` are those of this quantity.
    """
    distances = estimate.exposures.distances
    curve = estimate.exposures.emitted(kind) * estimate.exposures.lens
    low_curve, high_curve = np.quantile(curve[1:], QUANTILES, axis=0)
    axis.fill_between(distances, low_curve, high_curve, color=BLUE, alpha=0.25, linewidth=0)
    axis.plot(distances, curve[0], color=BLUE, linewidth=2, label="laser")
    # rows of `finding.curve`: nominal, 5 % and 95 %
    for number, finding in enumerate(findings):
        colour, dash = _COLOURS[number % len(_COLOURS)], _DASHES[number % len(_DASHES)]
        axis.fill_between(
            distances, finding.curve[1], finding.curve[2], color=colour, alpha=0.15, linewidth=0
        )
        axis.plot(
            distances, finding.curve[0], color=colour, linestyle=dash, label=finding.limit.name
        )
    if estimate.eye and estimate.eye.quantity == kind:
        axis.plot(
            distances,
            np.full_like(distances, estimate.eye.limit),
            color=GREEN,
            linewidth=2,
            label="eye (MPE)",
        )
    axis.axvline(estimate.safety.laser.distance, color=BLACK, linewidth=0.8)
    axis.set(
        xscale="log",
        yscale="log",
        xlabel="distance (m)",
        ylabel=_NAMES[kind],
        xlim=(distances[0], distances[-1]),
    )
    nominal_curves = np.concatenate([curve[0], *(finding.curve[0] for finding in findings)])
    axis.set_ylim(nominal_curves.min() / 5, nominal_curves.max() * 5)
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


@drawn
def spots(patterns: Sequence[DamagePattern]) -> Any:
    """Draw the ratio of the exposure on the sensor to the damage limit: red above the limit, blue
    below.
    """
    figure, axes = canvas(4.6 * len(patterns), 4.0, 1, len(patterns))
    for axis, pattern in zip(axes[0], patterns, strict=True):
        half_width, log_peak = pattern.width / 2 * 1e6, float(np.log10(pattern.peak))
        decades = max(1.0, log_peak, _BELOW - log_peak)  # a spot far below the limit is seen too
        log_ratio = np.log10(np.maximum(pattern.ratio, 10.0**-decades))
        limits = {"vmin": -decades, "vmax": decades}
        image = axis.imshow(
            log_ratio,
            cmap="RdBu_r",
            extent=(-half_width, half_width, -half_width, half_width),
            **limits,
        )
        axis.set(title=f"{pattern.option}: {pattern.limit}", xlabel="um", ylabel="um")
        axis.grid(False)
        figure.colorbar(image, ax=axis, label="log10 of exposure over limit", shrink=0.8)
    return figure


@drawn
def zones(estimate: Estimate) -> Any:
    """Draw the zones of distance of each limit behind each protection, with the intervals of
    their ends.
    """
    rows = list(estimate.findings)
    figure, axes = canvas(9.0, 1.2 + 0.32 * (len(rows) + 1))
    axis, distances = axes[0, 0], estimate.exposures.distances
    labels = []
    for row, finding in enumerate(rows):
        labels.append(f"{finding.option}, {finding.limit.name}")
        colour = VERMILION if finding.limit.effect == "damage" else ORANGE
        for zone in finding.zones.zones:
            axis.barh(
                row,
                zone.far.value - zone.near.value,
                left=zone.near.value,
                height=0.6,
                color=colour,
            )
            for end in (zone.near, zone.far):
                axis.plot([end.low, end.high], [row, row], color=BLACK, linewidth=1.5)
    if estimate.eye:
        labels.append("eye, unaided (NOHD)")
        # the eye is in the row below all limits
        reach = min(estimate.eye.distance.value, distances[-1])
        axis.barh(
            len(rows), max(reach - distances[0], 0.0), left=distances[0], height=0.6, color=GREEN
        )
        ends = np.clip(
            [estimate.eye.distance.low, estimate.eye.distance.high], distances[0], distances[-1]
        )
        axis.plot(ends, [len(rows)] * 2, color=BLACK, linewidth=1.5)
    axis.axvline(estimate.safety.laser.distance, color=BLACK, linewidth=0.8)
    axis.set(
        xscale="log",
        xlabel="distance (m)",
        xlim=(distances[0], distances[-1]),
        ylim=(len(labels) - 0.4, -0.6),
    )
    axis.set_yticks(range(len(labels)), labels)
    axis.grid(False, axis="y")
    return figure


@drawn
def dazzled_share(estimate: Estimate) -> Any:
    """Draw the share of the picture that the laser saturates against the mean irradiance at the
    lens.
    """
    figure, axes = canvas(9.0, 4.4)
    axis = axes[0, 0]
    for number, area in enumerate(estimate.dazzled):
        is_positive = area.curve > 0
        line_style = {
            "color": (BLUE, *_COLOURS)[number],
            "linestyle": _DASHES[number % len(_DASHES)],
        }
        axis.plot(
            area.at_lens[is_positive], area.curve[is_positive], label=area.option, **line_style
        )
    assert estimate.safety.settings.dazzle is not None
    axis.axhline(estimate.safety.settings.dazzle.share, color=BLACK, linewidth=0.8, linestyle=":")
    axis.axvline(estimate.mean_at_lens, color=BLACK, linewidth=0.8)
    axis.set(
        xscale="log",
        yscale="log",
        xlabel="mean irradiance at the lens (W/m2)",
        ylabel="share of saturated pixels",
    )
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


@drawn
def dead_frames(dead: Sequence[DeadPixels]) -> Any:
    """Draw the part of a raw frame of a uniform grey scene with its dead pixels, behind each
    protection.
    """
    figure, axes = canvas(3.6 * len(dead), 3.8, 1, len(dead))
    for axis, example in zip(axes[0], dead, strict=True):
        half = example.frame.shape[0] / 2
        axis.imshow(
            example.frame,
            cmap="gray",
            vmin=0,
            vmax=1,
            extent=(-half, half, -half, half),
            interpolation="nearest",
        )
        axis.set(
            title=f"{example.option}\n{', '.join(example.kinds) or 'no damage'}",
            xlabel="pixels",
            ylabel="pixels",
        )
        if "frame" in example.kinds:
            box = {"facecolor": "white", "edgecolor": "none"}
            axis.text(
                0.5,
                0.9,
                "no valid frame",
                transform=axis.transAxes,
                ha="center",
                va="center",
                bbox=box,
            )
        axis.grid(False)
    return figure


# --- safety page ----------------------------------------------------------------------------------

# The page of a safety estimate: limits, distances, the eye, what is left out, assumptions and
# sources.


_CSV = (
    "protection",
    "limit",
    "effect",
    "quantity",
    "limit on the sensor",
    "5 %",
    "95 %",
    "limit at the lens",
    "5 %",
    "95 %",
    "ratio",
    "probability",
    "zones",
    "probability of nowhere",
    "probability here",
    "source",
    "state",
    "ratio 5 %",
    "ratio 95 %",
    "note",
)


def report(estimate: Estimate) -> StudyReport:
    """Return the page of an estimate with its pictures and its table of limits."""
    pictures = {"irradiance": over_distance(estimate)}
    if estimate.findings or estimate.eye:
        pictures["distances"] = zones(estimate)
    if estimate.dazzled:
        pictures["dazzle"] = dazzled_share(estimate)
    if estimate.patterns:
        pictures["pattern"] = spots(estimate.patterns)
    if estimate.dead:
        pictures["dead_pixels"] = dead_frames(estimate.dead)
    sections = [
        _limits(estimate),
        _distances(estimate, pictures.get("distances")),
        _curve(pictures["irradiance"]),
    ]
    sections += [
        _dazzled(estimate, pictures.get("dazzle")),
        _pattern(estimate, pictures.get("pattern")),
    ]
    sections += [
        _dead(estimate, pictures.get("dead_pixels")),
        _helps(estimate),
        _eye(estimate),
        _eye_dazzle(estimate),
    ]
    sections += [_unsaid(estimate), _assumed(estimate), _sources(estimate)]
    return StudyReport(
        f"{estimate.recipe.name}: damage, dazzle and distance",
        "\n\n".join(
            [
                CERTIFICATE,
                estimate.recipe.title,
                safety_text.laser_text(estimate),
                " ".join(verdict(estimate)),
            ]
        ),
        [section for section in sections if section],
        pictures,
        {"limits.csv": (_CSV, [*map(_row, estimate.findings), *_unjudged(estimate)])},
    )


def _limits(estimate: Estimate) -> Section | None:
    """Return the section with the table of limits; None without any limit."""
    rows = limit_rows(estimate)
    if not rows:
        return None
    text = f"""Each limit on the sensor, the share of it that the laser reaches at
        {safety_text.metres(estimate.safety.laser.distance)}, and the exposure at the lens that
        reaches it: the maximum permissible exposure (MPE_S) for damage, the maximum dazzle exposure
        (MDE_S) for dazzle of the sensor. Damage has a row for each part of the light: one pulse,
        the mean over the dwell time, the heat of both together (accumulation) and, for a train, the
        incubation of many pulses. A probability is stated for a law with data of devices alone, and
        is that of a device drawn from all devices. {safety_text.intervals_text(estimate)}
        {CERTIFICATE}"""
    marks_of_limits = list(map(_mark, estimate.findings))
    marks_of_unjudged: list[Mark] = ["warn"] * (len(rows) - len(marks_of_limits))
    # column 3 of `LIMIT_COLUMNS` is the ratio
    marked = marked_column(rows, 3, [*marks_of_limits, *marks_of_unjudged])
    return Section("Limits", text, safety_text.LIMIT_COLUMNS, marked)


def _mark(finding: Finding) -> Mark:
    """Return the mark of a limit; a damage limit passes only if the exposure is below the whole
    bracket.
    """
    if finding.ratio >= 1:
        return "fail"
    if finding.limit.effect == "damage":
        return "pass" if state_of_finding(finding) == "below" else "warn"
    return "warn" if finding.zones.inside > 0 else "pass"


def _distances(estimate: Estimate, picture: bytes | None) -> Section | None:
    """Return the section with the zones of distance of each limit; None without any limit."""
    if not estimate.findings:
        return None
    near, far = (safety_text.metres(estimate.exposures.distances[i]) for i in (0, -1))
    text = f"""Where the laser exceeds each limit, from {near} to {far}. A zone may begin away from
        the laser, because close to it a narrow beam fills only a part of the lens. The probability
        of nowhere is the share of the draws in which no distance exceeds the limit; the probability
        here is that at the distance of the recipe, the vertical line. Black lines are the intervals
        of the ends. {CERTIFICATE}"""
    return Section("Distances", text, safety_text.ZONE_COLUMNS, zone_rows(estimate), picture)


def _curve(picture: bytes) -> Section:
    text = f"""The exposure at the lens on the axis of the beam, and the limits at the lens behind
        the plain lens, with their intervals. The vertical line is the distance of the recipe.
        {CERTIFICATE}"""
    return Section("Exposure over distance", text, picture=picture)


def _dazzled(estimate: Estimate, picture: bytes | None) -> Section | None:
    """Return the section on the dazzled area; None if dazzle is not judged."""
    if picture is None or estimate.safety.settings.dazzle is None:
        return None
    text = f"""{safety_text.enlarged_text(estimate)} The figure shows the share of saturated pixels
        against the irradiance at the lens, the mean over one exposure. The dotted line is the share
        that may be lost, {100 * estimate.safety.settings.dazzle.share:g} %, and the vertical line
        the irradiance at {safety_text.metres(estimate.safety.laser.distance)}.

        {safety_estimate.scatter_text(estimate.veil)} {CERTIFICATE}"""
    rows = [safety_text.dazzled_cells(area) for area in estimate.dazzled]
    return Section("Dazzled area", text, safety_text.DAZZLE_COLUMNS, rows, picture)


def _dead(estimate: Estimate, picture: bytes | None) -> Section | None:
    """Return the section on dead pixels; without a picture it says that no damage occurs at any
    distance.
    """
    if not estimate.patterns:
        return None
    heading = "Example of damage in the raw frame"
    if picture is None:
        text = (
            "No picture: at no distance does a judged part of the light exceed its threshold behind"
            " the plain lens."
        )
        return Section(heading, f"{text} {CERTIFICATE}")
    distance = safety_text.metres(estimate.dead[0].distance)
    text = f"""An example pattern and no prediction: the raw frame of an evenly grey scene around
        the spot, after the laser has hit a device whose thresholds are those stated, at {distance}.
        A point is white, a destroyed pixel black; lines and crosses are black rows and columns
        (white columns of a CCD). A sensor that gives no valid frame shows nothing of it: the
        picture then shows what else is damaged. Which lines go with a damaged pixel differs from
        device to device. {CERTIFICATE}"""
    columns = ("protection", "damage", "pixels in the light")
    rows = [
        [example.option, ", ".join(example.kinds) or "none", example.pixels]
        for example in estimate.dead
    ]
    return Section(heading, text, columns, rows, picture)


def _pattern(estimate: Estimate, picture: bytes | None) -> Section | None:
    """Return the section on the pattern of damage; None without a picture of it."""
    if picture is None:
        return None
    pitch = estimate.safety.settings.sensor.pixel_pitch
    text = f"""The exposure on the sensor at {safety_text.metres(estimate.safety.laser.distance)}
        over the limit that is named, that of the part of the light with the largest ratio. Where it
        is red the limit is exceeded; a pixel is {pitch * 1e6:.3g} um wide. A line, a cross or a
        lost frame is the damage of the circuits around this spot. {CERTIFICATE}"""
    rows = [
        [
            pattern.option,
            pattern.limit,
            pattern.peak,
            pattern.area,
            pattern.area / (pitch * 1e6) ** 2,
        ]
        for pattern in estimate.patterns
    ]
    columns = ("protection", "limit", "peak over the limit", "area above the limit (um²)", "pixels")
    return Section("Pattern of damage", text, columns, rows, picture)


def _eye(estimate: Estimate) -> Section | None:
    """Return the section on the limit of the eye; None if it is not judged."""
    if estimate.eye is None:
        return None
    return Section(
        "The eye",
        f"{safety_text.eye_text(estimate.eye)} Source: {estimate.eye.source}. {CERTIFICATE}",
    )


def _helps(estimate: Estimate) -> Section | None:
    """Return the section on protective measures; None if there are none."""
    if not estimate.helps:
        return None
    text = " ".join([safety_text.EXPLAINED, *safety_text.sentences(estimate.helps), CERTIFICATE])
    return Section("What helps", text, safety_text.COLUMNS, safety_text.table(estimate.helps))


def _eye_dazzle(estimate: Estimate) -> Section:
    """Return the section on the dazzle of the eye, or on why it is not judged."""
    dazzle = estimate.eye_dazzle
    text = (
        f"{safety_text.dazzle_text(dazzle, estimate.safety.settings.eye.dazzle)} Source:"
        f" {dazzle.source}. {CERTIFICATE}"
    )
    rows = [safety_text.dazzle_cells(row) for row in dazzle.rows]
    return Section("Dazzle of the eye", text, safety_text.EYE_DAZZLE_COLUMNS if rows else (), rows)


def _unsaid(estimate: Estimate) -> Section | None:
    return Section("What is not said", "\n\n".join(estimate.unsaid)) if estimate.unsaid else None


def _assumed(estimate: Estimate) -> Section:
    """Return the section on the assumptions: beam, air, focus, scatter, spots and damage."""
    laser = estimate.safety.laser
    air = "Clear air."
    if laser.air_transmittance is not None:
        air = (
            f"Air that passes {laser.air_transmittance:g} over "
            f"{safety_text.metres(laser.distance)},"
            " evenly."
        )
    elif laser.visibility is not None:
        air = (
            f"Air with a visibility of {safety_text.metres(laser.visibility)} by the law of"
            f" {laser.haze.capitalize()}."
        )
    text = f"""The beam is Gaussian and hits the middle of the lens: a narrow beam beside the middle
        gives less. The share of its power that passes the lens, the width and the curvature of its
        wavefront, and with them the peak and every pixel, are those of each distance.
        {safety_estimate.focus_text(estimate.safety)} {safety_estimate.scatter_text(estimate.veil)}
        {air}

        {" ".join(safety_estimate.counted(estimate.safety))}

        {safety_estimate.ladder_text(estimate.ranked, estimate.peaks)} Between two distances the
        largest peak counts.

        {_damage_assumed(estimate)}

        Dazzle counts light in a frame that catches a pulse, on all pixels of the sensor, with the
        spot in its middle. Where the window of a point-spread function is smaller than the sensor,
        its light goes on as the third power of the distance. Pixels behind a mask are counted in
        the point-spread function of a sampled pupil: at n wavelengths times f-number from the spot
        a pupil of 8 n samples across is 1 to 2 % too bright there, one of 6 n samples 5 % and one
        of 4 n samples 9 to 14 %. The limit of dazzle is too low by as much, and its distance too
        long by half of that."""
    return Section("What is assumed", text)


def _damage_assumed(estimate: Estimate) -> str:
    """Return the assumptions on damage as text."""
    damage = estimate.safety.settings.damage
    if damage is None:
        return "Damage is not asked for."
    bonus = "gets no bonus"
    if damage.small_spot_exponent > 0:
        bonus = (
            f"gets the bonus (published spot / spot) to the power of {damage.small_spot_exponent:g}"
        )
    return f"""The light stays on one place of the sensor for {damage.dwell:g} s. The threshold of
        first damage is 0.1 J/cm² for pulses of 10 ns and tens of kW/cm² from 10 us on, interpolated
        between both in logarithms. A spot that is wider than the published one lowers the threshold
        of continuous light by equal heat; a narrower one {bonus}. Behind a mask its largest peak
        counts, and the heat of its whole spot. A burst is a train whose dwell time is the length of
        the burst. Hot pixels, bleached filters and slow ageing are not in these laws."""


def _sources(estimate: Estimate) -> Section:
    """Return the section with the note and the source of each limit."""
    rows = dict.fromkeys(
        (finding.limit.name, finding.limit.note, finding.limit.source)
        for finding in estimate.findings
    )
    eye = [("eye (MPE, NOHD)", "", estimate.eye.source)] if estimate.eye else []
    listed = [*map(list, rows), *map(list, eye)]
    return Section(
        "Sources of the limits", CERTIFICATE, ("limit", "note", "source") if listed else (), listed
    )


def _row(finding: Finding) -> list[object]:
    """Return the row of a limit in limits.csv, with the columns of `_CSV`."""
    sensor_limit, lens_limit = finding.at_sensor, finding.at_lens
    probability = finding.probability.value if finding.probability else None
    numbers = [
        sensor_limit.value,
        sensor_limit.low,
        sensor_limit.high,
        lens_limit.value,
        lens_limit.low,
        lens_limit.high,
        finding.ratio,
        probability,
    ]
    # a bracket has no probabilities
    zone_shares = (
        [None, None] if is_bracket(finding) else [finding.zones.none, finding.zones.inside]
    )
    names = [finding.option, finding.limit.name, finding.limit.effect, finding.limit.quantity]
    return [
        *names,
        *numbers,
        safety_text.zones_text(finding.zones),
        *zone_shares,
        finding.limit.source,
        *_beside(finding),
    ]


def _beside(finding: Finding) -> list[object]:
    """Return the last columns of a limit's row: state, ends of the ratio, and the note of its
    law.
    """
    low, high = (finding.ratios.low, finding.ratios.high) if finding.ratios else (None, None)
    state = state_of_finding(finding) if finding.limit.effect == "damage" else ""
    return [state, low, high, finding.limit.note]


def _unjudged(estimate: Estimate) -> list[list[object]]:
    """Return the rows of limits.csv for the parts of the light that no law judges."""
    rows = []
    for verdict_of_option in estimate.damage:
        rows += [
            _unjudged_row(verdict_of_option.option, row)
            for row in verdict_of_option.rows
            if row.finding is None
        ]
    return rows


def _unjudged_row(option: str, row: DamageRow) -> list[object]:
    """Return the row of an unjudged part of the light in limits.csv, with the columns of `_CSV`."""
    # cells from "quantity" up to "source"; the reason takes the place of the source
    empty_cells = [""] * 12
    names = [option, f"damage: {row.part}", "damage"]
    return [*names, *empty_cells, row.reason, "not judged", "", "", ""]
