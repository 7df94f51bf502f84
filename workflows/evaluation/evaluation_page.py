"""The page of an evaluation of masks and restorers, with its figures and tables."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, astuple
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from neusee.nodes.metrics import most_contrast
from neusee.workflows.evaluation.confidence_intervals import (
    METRICS,
    Interval,
    MetricTable,
    Numbers,
    gains_by_strength,
    mean,
)
from neusee.workflows.evaluation.evaluation_points import shown_commands
from neusee.workflows.evaluation.pipelines import CASES, DRAWN, protection_section
from neusee.workflows.report.figures.camera_pictures import high
from neusee.workflows.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    VERMILION,
    canvas,
    drawn,
    encoded,
    picture,
)
from neusee.workflows.report.study_report import Marked, Section

if TYPE_CHECKING:
    from neusee.workflows.evaluation.evaluation_result import (
        EvaluationResult,
        MaskOptics,
        MistoldPoint,
        Panel,
    )


# --- evaluation figures ---------------------------------------------------------------------------

# Figures of an evaluation of masks: pictures by laser, error by laser strength, laser suppression,
# and contrast.


_COLOURS = (BLUE, VERMILION, GREEN, ORANGE, "#56B4E9", "#CC79A7", BLACK, "#777777")
_STYLES = ("-", "--", ":", "-.")  #: line styles; the next one is used once all colours are used
#: marker of a point by the line style of the curve
_MARKERS = dict(zip(_STYLES, "osD^", strict=True))
_GREY = "#777777"
_ROW_NAME_LETTERS = 16  #: longest row name, in characters, that stays on one line


def _looks(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return colour and line style for the curve of each name."""
    count = len(_COLOURS)
    return {
        name: {
            "color": _COLOURS[number % count],
            "linestyle": _STYLES[number // count % len(_STYLES)],
        }
        for number, name in enumerate(names)
    }


@drawn
def cases(panels: Sequence[Panel]) -> Any:
    """Draw pictures in a grid: the true picture, the plain lens, and every pipeline in rows.

    The columns have different lasers. All pictures have the same brightness scale.
    """
    rows = list(panels[0].pictures)
    white = high(panels[0].pictures["truth"])
    figure, axes = canvas(1.95 * len(panels) + 0.6, 2.0 * len(rows) + 0.3, len(rows), len(panels))
    for column, panel in enumerate(panels):
        for row, (name, picture_of_row) in enumerate(panel.pictures.items()):
            title = f"{panel.case}, {_power(panel.strength)}" if panel.strength else "no laser"
            # a title only above the first row
            picture(axes[row, column], encoded(picture_of_row / white), "" if row else title)
            if column == 0:
                axes[row, column].set_ylabel(_broken(name), fontsize=10)
    return figure


def _power(strength: float) -> str:
    """Return a strength as a power of ten in figure markup."""
    return f"$10^{{{np.log10(strength):.3g}}}$"


def _broken(name: str) -> str:
    """Return an axis label, broken into several lines if it is long."""
    return (
        name
        if len(name) <= _ROW_NAME_LETTERS
        else re.sub(r" ?\+ ?", "\n+ ", name).replace(", ", ",\n").replace("@", "\n@ ")
    )


@drawn
def strengths(tables: Mapping[str, MetricTable], small: int) -> Any:
    """Draw the L1 error of every pipeline with its 95 % interval against the laser strength.

    The left plot is for pictures of full size, the right plot for reduced pictures. Intervals of
    few scenes are much wider than the differences of the means; they do not extend the axis.
    """
    figure, axes = canvas(11.0, 4.2, 1, 2, sharex=True)
    looks = _looks(list(tables))
    titles = {"l1": "full size", "l1 small": f"shorter side {small} pixels"}
    for ax, (metric, title) in zip(axes[0], titles.items(), strict=True):
        for name, table in tables.items():
            _line(ax, table, metric, looks[name], name)
        ax.set_title(f"L1, {title}")
        ax.set_xlabel("laser strength (multiples of saturation)")
        tick_strengths = next(iter(tables.values())).strengths
        ax.set_xticks(
            _places(tick_strengths),
            ["none" if strength == 0 else _power(strength) for strength in tick_strengths],
        )
        ax.set_ylim(0, _axis_end(tables.values(), metric))
    axes[0, 0].set_ylabel("L1 (sRGB, 0 to 1)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(3, len(labels)))
    return figure


def _line(ax: Any, table: MetricTable, metric: str, look: Mapping[str, Any], name: str) -> None:
    """Draw the mean of a metric against the laser strength, with its interval."""
    intervals = [table.at(metric, strength_index) for strength_index in range(len(table.strengths))]
    positions = _places(table.strengths)
    ax.plot(
        positions,
        [interval.mean for interval in intervals],
        marker="o",
        markersize=4,
        linewidth=1.4,
        label=name,
        **look,
    )
    low_ends, high_ends = (
        [interval.low for interval in intervals],
        [interval.high for interval in intervals],
    )
    ax.fill_between(positions, low_ends, high_ends, color=look["color"], alpha=0.15, linewidth=0)


def _axis_end(tables: Iterable[MetricTable], metric: str) -> float:
    """Return the upper axis limit that shows every mean, and intervals up to three times the
    largest mean.
    """
    intervals: list[Interval] = []
    for table in tables:
        intervals += [
            table.at(metric, strength_index) for strength_index in range(len(table.strengths))
        ]
    largest = max((interval.mean for interval in intervals if interval.mean > 0), default=0.0)
    return (
        1.05
        * max(
            largest,
            min(
                3 * largest,
                max([interval.high for interval in intervals if interval.high > 0], default=0.0),
            ),
        )
        or 1.0
    )


def _places(values: Sequence[float]) -> list[float]:
    """Return the positions of laser strengths on a logarithmic axis; strength 0 is one decade below
    the others.
    """
    logarithms = [float(np.log10(strength)) for strength in values if strength > 0]
    place_of_none = min(logarithms) - 1 if logarithms else 0.0
    return [float(np.log10(strength)) if strength > 0 else place_of_none for strength in values]


@drawn
def wavelengths(result: EvaluationResult) -> Any:
    """Draw the L1 error of the reduced pictures at the largest strength against the drawn
    wavelength.
    """
    figure, axes = canvas(11.0, 4.2)
    ax, looks = axes[0, 0], _looks([pipeline.name for pipeline in result.pipelines])
    wavelengths_nm = np.array(
        [math.nan if metres is None else metres * 1e9 for metres in result.wavelengths]
    )
    for pipeline in result.pipelines:
        # the last strength is the largest
        errors = result.tables[pipeline.name].values["l1 small"][:, -1]
        ax.plot(
            wavelengths_nm,
            errors,
            ".",
            markersize=5,
            alpha=0.6,
            color=looks[pipeline.name]["color"],
        )
        ax.plot(
            *_means(wavelengths_nm, errors),
            linewidth=1.6,
            label=pipeline.name,
            **looks[pipeline.name],
        )
    ax.set_xlabel("wavelength of the laser (nm)")
    ax.set_ylabel("L1 (sRGB, 0 to 1)")
    ax.set_ylim(bottom=0)
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(3, len(labels)))
    return figure


def _means(x: Numbers, y: Numbers) -> tuple[Numbers, Numbers]:
    """Return the means of x and y in each sixth of the range of x; empty sixths are omitted."""
    has_both = ~np.isnan(x + y)
    x, y = x[has_both], y[has_both]
    if not len(x):
        return x, y
    # six bins; the largest x belongs to the last
    bin_numbers = np.minimum((6 * (x - x.min()) / max(float(np.ptp(x)), 1e-9)).astype(int), 5)
    filled = [bin_number for bin_number in range(6) if (bin_numbers == bin_number).any()]
    return np.array([x[bin_numbers == bin_number].mean() for bin_number in filled]), np.array(
        [y[bin_numbers == bin_number].mean() for bin_number in filled]
    )


@drawn
def curves(masks: Mapping[str, MaskOptics]) -> Any:
    """Draw the laser and background suppression ratios (LSR, BSR) of every mask against the
    wavelength.
    """
    figure, axes = canvas(11.0, 4.2, 1, 2, sharex=True)
    looks = _looks(list(masks))
    lsr_axis, bsr_axis = axes[0]
    for name, mask in masks.items():
        lsr_axis.plot(mask.wavelengths, mask.lsr, linewidth=1.6, label=name, **looks[name])
        bsr_axis.plot(mask.wavelengths, mask.bsr, linewidth=1.6, **looks[name])
    first_mask = next(iter(masks.values()))
    lsr_axis.plot(
        first_mask.wavelengths,
        first_mask.floor,
        color=_GREY,
        linewidth=1.2,
        linestyle=(0, (1, 2)),
        label="energy floor",
    )
    lsr_axis.set_yscale("log")
    lsr_axis.set_title("laser suppression ratio: less is better")
    bsr_axis.set_title("background suppression ratio: 1 is best")
    bsr_axis.set_ylim(0, max(1.1, 1.05 * max(float(mask.bsr.max()) for mask in masks.values())))
    for ax, name in ((lsr_axis, "LSR"), (bsr_axis, "BSR")):
        ax.set_xlabel("wavelength (nm)")
        ax.set_ylabel(name)
    handles, labels = lsr_axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(5, len(labels)))
    return figure


@drawn
def plane(masks: Mapping[str, MaskOptics]) -> Any:
    """Draw the contrast of each mask against its mean laser suppression ratio; shade the region
    that no mask can reach.
    """
    figure, axes = canvas(8.4, 5.2)
    ax = axes[0, 0]
    floor = float(np.mean([mask.floor.mean() for mask in masks.values()]))
    smallest = min(floor, *(float(mask.lsr.mean()) for mask in masks.values()))
    laser_ratios = np.geomspace(smallest / 3, 1.6, 200)
    unsuppressed = float(next(iter(masks.values())).unsuppressed.mean())
    contrast_bound = most_contrast(unsuppressed, torch.from_numpy(laser_ratios)).numpy()
    ax.fill_between(laser_ratios, contrast_bound, 1.5, color=_GREY, alpha=0.15, linewidth=0)
    ax.plot(
        laser_ratios,
        contrast_bound,
        color=_GREY,
        linewidth=1.2,
        label="rms contrast: no mask that keeps its light is above (Parseval)",
    )
    ax.axvspan(
        laser_ratios[0],
        floor,
        color=BLUE,
        alpha=0.12,
        linewidth=0,
        label="LSR: no mask that keeps its light is here",
    )
    looks = _looks(list(masks))
    for name, mask in masks.items():
        laser_ratio, colour, marker = (
            float(mask.lsr.mean()),
            looks[name]["color"],
            _MARKERS[looks[name]["linestyle"]],
        )
        ax.plot(
            # a line from the median to the rms of each mask
            [laser_ratio, laser_ratio],
            [mask.median.mean(), mask.rms.mean()],
            color=colour,
            linewidth=0.8,
        )
        ax.plot(
            laser_ratio, mask.rms.mean(), marker, markersize=6, markerfacecolor="none", color=colour
        )
        ax.plot(laser_ratio, mask.median.mean(), marker, markersize=7, color=colour, label=name)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlim(laser_ratios[0], laser_ratios[-1])
    lowest = min(float(mask.median.mean()) for mask in masks.values())
    ax.set_ylim(max(min(lowest, float(contrast_bound[0])) / 2, 1e-6), 1.2)
    ax.set_xlabel("mean LSR: to the left, lasers are weaker")
    ax.set_ylabel("contrast: dot median, ring rms")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


# --- evaluation page ------------------------------------------------------------------------------

# The report page of an evaluation of masks and restorers, with tables, pictures and explanations.


_STATISTICS = ("mean", "low", "high")
COLUMNS = (
    "pipeline",
    "mask",
    "restorer",
    "scenes",
    *map(" ".join, itertools.product(METRICS, _STATISTICS)),
    *map(" ".join, itertools.product(("l1 less", "l1 gain", "l1 small gain"), _STATISTICS)),
)
#: factor on a bound, because a circular aperture is sampled on a square grid of frequencies
_COARSE = 1.05
_DIGITS = {"psnr": ".2f", "l1": ".4f", "ssim": ".3f", "saturated": ".0f", "above": ".2f"}


def draw_pictures(result: EvaluationResult) -> dict[str, bytes]:
    """Return the figures of the evaluation page by name, as PNG bytes."""
    wavelength_figure = {"wavelengths": wavelengths(result)} if _drawn(result) else {}
    return wavelength_figure | {
        "cases": cases(result.panels),
        "strengths": strengths(result.tables, result.small),
        "curves": curves(result.masks),
        "plane": plane(result.masks),
    }


def summary(result: EvaluationResult) -> dict[str, Any]:
    """Return mean and interval of every metric, and the gain over the reference, for each
    pipeline.
    """
    return {
        pipeline.name: {
            "mask": pipeline.front,
            "restorer": pipeline.back,
            **{metric: asdict(result.tables[pipeline.name].mean(metric)) for metric in METRICS},
            "against": {
                name: asdict(interval) for name, interval in result.against[pipeline.name].items()
            },
        }
        for pipeline in result.pipelines
    }


def rows(result: EvaluationResult) -> list[Sequence[Any]]:
    """Return the rows of ``table.csv``, one for each pipeline, with the numbers of `summary`."""
    table_rows: list[Sequence[Any]] = []
    for pipeline in result.pipelines:
        intervals = [result.tables[pipeline.name].mean(metric) for metric in METRICS] + list(
            result.against[pipeline.name].values()
        )
        numbers = itertools.chain(*map(astuple, intervals))
        table_rows.append(
            (
                pipeline.name,
                pipeline.front,
                pipeline.back,
                len(result.scenes),
                *("" if math.isnan(number) else number for number in numbers),
            )
        )
    return table_rows


def lead(result: EvaluationResult) -> str:
    """Return a few sentences with the main result of the evaluation."""
    leader = min(result.pipelines, key=lambda p: float(result.tables[p.name].scenes("l1").mean()))
    lowest = _with_interval(result.tables[leader.name].mean("l1"), "l1")
    strengths = ", ".join(_strength_names(result))
    return f"""{len(result.scenes)} scenes, laser strengths {strengths} (1 saturates a pixel of the
        plain lens), {len(result.pipelines)} pipelines of a mask and a restorer. Lowest L1:
        {leader.name}, {lowest}. {_few_text(result)}{_drawn_text(result)}{_equal_text(result)}"""


def _few_text(result: EvaluationResult) -> str:
    """Return a sentence if there are too few scenes for all lasers; else an empty text."""
    if len(result.scenes) >= len(CASES) or _drawn(result):
        return ""
    return f" These are too few scenes for all {len(CASES)} lasers of the protocol."


def _drawn_text(result: EvaluationResult) -> str:
    """Return sentences on the values that are drawn for each scene."""
    laser_sentence = ""
    if _drawn(result):
        laser_sentence = (
            " The wavelength of the laser of each scene is drawn by the law of the recipe."
        )
    uncertain = result.recipe.uncertain
    drawn_names = uncertain.names if uncertain else ()
    names = [name for name in drawn_names if not name.startswith("lasers.")]
    return (
        f"{laser_sentence} These values are drawn for each scene: {', '.join(names)}."
        if names
        else laser_sentence
    )


def _equal_text(result: EvaluationResult) -> str:
    """Return a sentence on the peak at equal protection; empty if none was requested."""
    level = result.protection.level if result.protection else 0.0
    if not level:
        return ""
    which_pipelines = (
        "every pipeline"
        if all(pipeline.shade for pipeline in result.pipelines)
        else "each of them once more"
    )
    return f" Filters and stops bring {which_pipelines} to a peak of {level:g} of the plain lens's."


def sections(result: EvaluationResult, shown: Mapping[str, bytes]) -> list[Section]:
    """Return all sections of the report page of an evaluation."""
    comparison_tables = (
        _compared(result, name) for name in dict.fromkeys(result.references.values())
    )
    gain_tables = (_gained(result, name) for name in dict.fromkeys(result.references.values()))
    parts = [
        *protection_section(result),
        _crossed(result),
        _by_strength(result),
        *gain_tables,
        _numbers(result),
        *comparison_tables,
    ]
    parts += _mistold(result)
    text = """Mean over scenes and its 95 % interval. A scene without a laser counts only at the
        strength none, so that every scene of the other points has a laser. The axis ends at most at
        three times the largest mean; an interval of few scenes may reach beyond."""
    parts.append(Section("Error over strength", text, picture=shown["strengths"]))
    if "wavelengths" in shown:
        text = f"""One dot for each scene: its drawn wavelength, and its L1 at the strength
            {max(result.strengths):g} at {result.small} pixels. Lines: means over sixths of the
            range."""
        parts.append(Section("Error over wavelength", text, picture=shown["wavelengths"]))
    text = """The first scene with each laser of the protocol and without a laser, all with the same
        scale. The rows are the truth, the picture of the plain lens without restoration, and every
        pipeline; the figure with six lasers has the pictures of the sensor behind each mask too."""
    parts.append(Section("With each laser and without a laser", text, picture=shown["cases"]))
    return [
        *parts,
        _suppression(result, shown["curves"]),
        _plane(result, shown["plane"]),
        *_data(result),
    ]


def _crossed(result: EvaluationResult) -> Section:
    """Return the section with the L1 error of each mask (row) with each restorer (column)."""
    masks = list(dict.fromkeys(pipeline.front for pipeline in result.pipelines))
    restorers = list(dict.fromkeys(pipeline.back for pipeline in result.pipelines))
    l1_texts = {
        (pipeline.front, pipeline.back): _with_interval(
            result.tables[pipeline.name].mean("l1"), "l1"
        )
        for pipeline in result.pipelines
    }
    table_rows = [
        (mask, *(l1_texts.get((mask, restorer)) for restorer in restorers)) for mask in masks
    ]
    text = """L1 at full size (sRGB from 0 to 1, as a display shows it): the mean over the strengths
        of each scene, then mean and 95 % confidence interval (Student's t). Scenes of one
        photograph count as one draw."""
    return Section("Mask by restorer", text, ("mask", *restorers), table_rows)


def _drawn(result: EvaluationResult) -> bool:
    """Return True if the wavelength of the laser is drawn for each scene."""
    return any(scene.case == DRAWN for scene in result.scenes)


def _strength_names(result: EvaluationResult) -> list[str]:
    """Return the strengths as text, such as ``none`` and ``1e4``."""
    return [
        "none" if strength == 0 else f"{strength:g}".replace("e+0", "e")
        for strength in result.strengths
    ]


def _by_strength(result: EvaluationResult) -> Section:
    """Return the section with the L1 error of the reduced pictures at each strength."""
    text = f"""L1 of the pictures reduced to {result.small} pixels of their shorter side, at each
        laser strength: mean and 95 % interval."""
    columns = ("pipeline", *_strength_names(result))
    table_rows = [
        (
            pipeline.name,
            *(
                _with_interval(result.tables[pipeline.name].at("l1 small", strength_index), "l1")
                for strength_index in range(len(columns) - 1)
            ),
        )
        for pipeline in result.pipelines
    ]
    return Section(f"L1 by strength, {result.small} pixels", text, columns, table_rows)


def _gained(result: EvaluationResult, reference: str) -> Section:
    """Return the section with the gain of each pipeline over one reference, by strength."""
    text = f"""By which fraction the L1 of the reduced pictures lies below that of {reference} on
        the same pictures, at each laser strength, with 95 % intervals as below. A colour marks an
        interval without zero."""
    table_rows: list[Sequence[Any]] = []
    for name in (name for name, other in result.references.items() if other == reference != name):
        gains = gains_by_strength(result.tables[name], result.tables[reference], result.recipe.seed)
        table_rows.append((name, *(_judged(interval, ".1%") for interval in gains)))
    columns = ("pipeline", *_strength_names(result))
    return Section(f"Gain by strength over {reference}", text, columns, table_rows)


def _judged(x: Interval, digits: str) -> Marked:
    """Return an interval as a table cell, marked if the interval excludes zero."""
    interval_text = _between(x, digits)
    if not x.excludes_zero:
        return Marked(interval_text)
    return Marked(interval_text, "pass" if x.mean > 0 else "fail")


def _with_interval(x: Interval, metric: str) -> str:
    """Return a mean with the half-width of its interval as text, with the digits of the metric."""
    digits = _DIGITS.get(metric.partition(" ")[0], ".3g")
    half_text = "" if math.isnan(x.half) else f" ±\N{NO-BREAK SPACE}{x.half:{digits}}"
    return f"{x.mean:{digits}}{half_text}"


def _numbers(result: EvaluationResult) -> Section:
    """Return the section with the mean of every metric for each pipeline."""
    text = f"""Mean and 95 % interval over scenes. Small: the picture that a display shows, reduced
        to {result.small} pixels of its shorter side in linear light, antialiased. Saturated: number
        of saturated pixels of the raw picture. Above: fraction of the points whose brightest pixel
        exceeds `reading.damage_multiple` times saturation, where the paper expects damage: a
        reading of the paper and no verdict, because 1e6 are 2 W/cm2 at its exposure, which damages
        nothing that is known. PSNR is a mean of decibels."""
    metrics = [metric for metric in METRICS if metric != "peak"]
    columns = ("pipeline", *(_column(metric) for metric in metrics))
    table_rows = [
        (
            pipeline.name,
            *(
                _with_interval(result.tables[pipeline.name].mean(metric), metric)
                for metric in metrics
            ),
        )
        for pipeline in result.pipelines
    ]
    return Section("All numbers", text, columns, table_rows)


def _mistold(result: EvaluationResult) -> list[Section]:
    """Return the section on restorers with erroneous optics or laser data; empty if there
    are none.
    """
    if not result.mistold:
        return []
    errors = list(dict.fromkeys(point.error for point in result.mistold))
    names = dict.fromkeys(point.pipeline for point in result.mistold)
    strength = result.mistold[0].strength
    table_rows = [_mistold_row(result.mistold, name, errors) for name in names]
    text = f"""PSNR in dB of the restored picture at the strength {strength:g}, in the first scenes
        with a laser: mean and 95 % interval. In every other table the restorer is told the exact
        PSF and the exact pattern of the laser, which no camera knows. Here it is told one of them
        with the error of the column. The recipe sets these errors in `evaluate.mismatch`;
        mistold.csv has every point."""
    return [
        Section(
            "What the restorer is not told", text, ("pipeline", "told exactly", *errors), table_rows
        )
    ]


def _mistold_row(
    points: Sequence[MistoldPoint], name: str, errors: Sequence[str]
) -> tuple[str, ...]:
    """Return the PSNR of one pipeline with exact data, and with each error."""
    points_of_pipeline = [point for point in points if point.pipeline == name]
    # once per scene, because the points of all errors repeat it
    exact_psnr = {point.scene.number: point.true["psnr"] for point in points_of_pipeline}
    cells = [_with_interval(mean(list(exact_psnr.values())), "psnr")]
    for error in errors:
        values = [point.wrong["psnr"] for point in points_of_pipeline if point.error == error]
        cells.append(_with_interval(mean(values), "psnr") if values else "")
    return (name, *cells)


def _column(metric: str) -> str:
    """Return the column heading of a metric, with its unit."""
    units = {"psnr": " (dB)", "saturated": " (pixels)"}
    name = re.sub("l1|psnr|ssim", lambda match: match[0].upper(), metric)
    return name + units.get(metric.partition(" ")[0], "")


def _compared(result: EvaluationResult, reference: str) -> Section:
    """Return the section on the differences of each pipeline from one reference."""
    text = f"""Differences from {reference} in the same scenes. L1 less: by how much L1 is lower.
        Gain: the same as a fraction of the mean L1 of the reference. Intervals of 95 % come from 10
        000 draws of the photographs (bootstrap-t); fewer than five photographs have no interval. A
        colour marks an interval without zero. If many pipelines are compared with one reference,
        about one in twenty is marked by chance."""
    table_rows: list[Sequence[Any]] = []
    for pipeline in result.pipelines:
        if pipeline.name == reference or result.references[pipeline.name] != reference:
            continue
        lower_l1, relative_gain, small_gain = result.against[pipeline.name].values()
        table_rows.append(
            (
                pipeline.name,
                _judged(lower_l1, ".4f"),
                _judged(relative_gain, ".1%"),
                _judged(small_gain, ".1%"),
            )
        )
    columns = ("pipeline", "L1 less", "gain", "gain, small")
    return Section(f"Against {reference}", text, columns, table_rows)


def _between(x: Interval, digits: str) -> str:
    """Return a mean with its interval as text; without the interval for too few photographs."""
    return f"{x.mean:{digits}}" + (
        "" if math.isnan(x.low) else f" ({x.low:{digits}} to {x.high:{digits}})"
    )


def _suppression(result: EvaluationResult, picture: bytes) -> Section:
    """Return the section on the suppression ratios of each mask, with their figure."""
    base_mask = next(p.front for p in result.pipelines if p.name == result.reference)
    text = f"""LSR: the brightest pixel of a laser with the mask, divided by the brightest pixel
        without the mask; BSR: share of the scene's light that stays in the field, at most 1, mean
        over scenes. Energy floor: the LSR of light that is spread evenly over the window of the
        PSF. Stronger: the mean LSR of {base_mask} divided by the mean LSR of the mask. The file
        suppression.csv has LSR and BSR by wavelength."""
    reference_lsr = float(result.masks[base_mask].lsr.mean())
    table_rows: list[Sequence[Any]] = []
    for name, mask_optics in result.masks.items():
        mean_lsr = float(mask_optics.lsr.mean())
        numbers = (
            mask_optics.lsr.min(),
            mask_optics.lsr.max(),
            reference_lsr / mean_lsr,
            mask_optics.floor.mean(),
            mask_optics.bsr.mean(),
        )
        table_rows.append((name, mean_lsr, *map(float, numbers)))
    columns = ("mask", "mean LSR", "least", "greatest", "stronger", "floor", "mean BSR")
    return Section("Suppression by wavelength", text, columns, table_rows, picture)


def _plane(result: EvaluationResult, picture: bytes) -> Section:
    """Return the section that compares suppression and contrast of each mask with their bounds."""
    text = """Means over wavelengths, with the contrast within the band that the clear aperture
        passes. A low peak costs contrast: by Parseval the rms over all sampled frequencies is at
        most sqrt(LSR p0), where p0 is the fraction of light in the brightest pixel of the clear
        lens, and the rms within the band, a fraction 4 p0 of the frequencies, is at most sqrt(LSR)
        / 2; the median is at most 1.41 times the rms. If a mask sends light out of the window, the
        contrast is that of the remaining light, and the bound of the mask, in the table, is
        higher."""
    table_rows: list[Sequence[Any]] = []
    for name, mask_optics in result.masks.items():
        bound_holds = bool((mask_optics.rms <= _COARSE * mask_optics.most).all())
        bound_cell = Marked(float(mask_optics.most.mean()), "pass" if bound_holds else "fail")
        table_rows.append(
            (
                name,
                *(
                    float(values_of_bands.mean())
                    for values_of_bands in (mask_optics.lsr, mask_optics.median, mask_optics.rms)
                ),
                bound_cell,
            )
        )
    columns = ("mask", "mean LSR", "median", "rms", "rms at most")
    return Section("Suppression and contrast", text, columns, table_rows, picture)


def _commands(result: EvaluationResult) -> list[Section]:
    """Return the section with the command of one point of each pipeline, next to its numbers."""
    table_rows: list[Sequence[Any]] = []
    for name, scene_index, strength, command in shown_commands(result.commands):
        point = result.points[name][scene_index][strength]
        numbers = (
            f"{point['l1']:.6g}",
            f"{point['psnr']:.6g}",
            f"{point['ssim']:.6g}",
            f"{point['saturated']:.0f}",
        )
        command_text = (
            command
            or "no command: a random part of the camera, such as dirt, has "
            "the seed of the evaluation"
        )
        table_rows.append(
            (name, result.scenes[scene_index].number, f"{strength:g}", *numbers, command_text)
        )
    if not table_rows:
        return []
    text = """One point of each pipeline, with the command that gives its numbers at full size, in
        the folder in which this evaluation was started: `metrics.csv` of the run has them. Each
        point has its command in `points.csv`. The same recipe with another seed, another part of
        the photograph, or another direction of the laser gives other numbers."""
    columns = ("pipeline", "scene", "strength", "L1", "PSNR", "SSIM", "saturated", "command")
    return [Section("The same numbers again", text, columns, table_rows)]


def _data(result: EvaluationResult) -> list[Section]:
    """Return the sections on scenes, commands and unreadable photographs."""
    text = """Scenes in the order of their numbers. The seed of the recipe chooses part of a
        photograph for each scene. The seed of a scene decides the direction of the laser and the
        noise, which are the same for every pipeline."""
    listed = [(scene.number, scene.name, scene.case, scene.seed) for scene in result.scenes]
    parts = [
        Section("Scenes", text, ("scene", "photograph", "laser", "seed"), listed),
        *_commands(result),
    ]
    if result.broken:
        unreadable = [(path.name, reason) for path, reason in result.broken]
        parts.append(Section("Photographs that cannot be read", "", ("file", "why"), unreadable))
    return parts
