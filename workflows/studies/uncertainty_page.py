"""The result of the uncertainty study, and the page and pictures that show it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from neusee.workflows.engine.runner import run
from neusee.workflows.engine.wanted_steps import BANDS
from neusee.workflows.recipe.uncertain_inputs import InputDraws, Inputs
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
    panels,
    picture,
    plain_ticks,
)
from neusee.workflows.report.study_report import (
    Mark,
    Marked,
    Section,
    with_uncertainty,
)
from neusee.workflows.studies.output_draws import FloatArray, Scatter, worst_known
from neusee.workflows.studies.sobol_indices import IndexInterval, SobolIndices

# --- uncertainty figures --------------------------------------------------------------------------

# Pictures of the uncertainty study: tornado diagrams, curves with bands, histograms, and mean
# images.


_GREY = "#777777"
_COLOURS = (BLUE, VERMILION, GREEN, ORANGE)
#: ratio of the largest to the least value of curves above which their axis is logarithmic
_WIDE = 30.0
_BINS = 24
_TICKS = 4  #: largest number of labels on the horizontal axis of a diagram
_MOST_CHARACTERS = 8  #: largest number of characters in such a label, without its sign
_DIAGRAM_MARGIN = (
    0.1  #: inches around each diagram, so that a title does not touch the numbers above it
)
#: fraction of a curve's largest element; where the median is smaller, no relative band is drawn
_SLIGHT = 1e-6
_ALONG = 200  #: number of signals along a photon-transfer curve
#: flat fields with less than this fraction of the predicted standard deviation count as clipped,
#: and are not drawn
_CLIPPED = 0.9


@drawn
def tornado(
    swings: Mapping[str, Sequence[tuple[str, float, float]]], middles: Mapping[str, float]
) -> Any:
    """Draw a tornado diagram of each output number: its values with one input at its 5 % and its 95
    % quantile.
    """
    most_bars = max(map(len, swings.values()))
    figure, axes = panels(len(swings), 2, 6.6, 0.34 * most_bars + 1.3)
    figure.get_layout_engine().set(h_pad=_DIAGRAM_MARGIN)
    for ax, (name, bars) in zip(axes, swings.items(), strict=True):
        # a bar is (input, value at its 5 %, value at its 95 %)
        _bars(ax, sorted(bars, key=lambda bar: abs(bar[2] - bar[1])), middles[name])
        ax.set_title(name)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles[:2], labels[:2], loc="outside lower center", ncols=2)
    return figure


def _bars(ax: Any, bars: Sequence[tuple[str, float, float]], middle: float) -> None:
    """Draw the bars of one number around ``middle``, its value with every input at its median.

    A bar is (input, value with the input at its 5 % quantile, value at its 95 % quantile).
    """
    low_offsets = [bar[1] - middle for bar in bars]
    high_offsets = [bar[2] - middle for bar in bars]
    ax.barh(
        range(len(bars)),
        low_offsets,
        0.7,
        left=middle,
        color=BLUE,
        label="input at its 5 % quantile",
    )
    ax.barh(
        range(len(bars)),
        high_offsets,
        0.7,
        left=middle,
        color=ORANGE,
        label="input at its 95 % quantile",
    )
    ax.axvline(middle, color=BLACK, linewidth=0.9)
    ax.set_yticks(range(len(bars)), [bar[0] for bar in bars])
    _few_numbers(ax)
    ax.grid(False, axis="y")


def _few_numbers(ax: Any) -> None:
    """Put few labels on the horizontal axis, with a common offset or power of ten if they would be
    too long.
    """
    least, greatest = ax.get_xlim()
    # as many decimals as the step between two labels needs
    decimals = max(0, math.ceil(-math.log10((greatest - least) / _TICKS)))
    if len(f"{max(abs(least), abs(greatest)):.{decimals}f}") > _MOST_CHARACTERS:
        ax.ticklabel_format(axis="x", style="sci", scilimits=(-2, 4), useOffset=True)
    else:
        ax.ticklabel_format(axis="x", useOffset=False)
    ax.locator_params(axis="x", nbins=_TICKS)


@drawn
def bands(curves: Mapping[str, tuple[FloatArray, Mapping[str, FloatArray]]], axis: str) -> Any:
    """Draw the central 90 % of each family of curves and, in a second row, the same band relative
    to the median.

    Each family has an abscissa, and the draws (draw, element) of each curve by name.
    """
    figure, axes = canvas(
        5.6 * len(curves), 5.4, 2, len(curves), sharex="col", height_ratios=[2, 1]
    )
    figure.get_layout_engine().set(h_pad=_DIAGRAM_MARGIN)
    for (ax, relative_axis), (family, (abscissa, curves_by_name)) in zip(
        axes.T, curves.items(), strict=True
    ):
        for (name, draws), colour in zip(
            curves_by_name.items(), _COLOURS * len(curves_by_name), strict=False
        ):
            _band(ax, relative_axis, abscissa, draws, colour, name)
        lowest, highest = (
            min(float(curve_draws.min()) for curve_draws in curves_by_name.values()),
            max(float(curve_draws.max()) for curve_draws in curves_by_name.values()),
        )
        if lowest > 0 and highest / lowest > _WIDE:
            ax.set_yscale("log")
        ax.set_title(f"{family}: median and middle 90 %")
        relative_axis.set_xlabel(axis)
        relative_axis.set_ylabel("over the\nmedian (%)")
        ax.legend()
    return figure


@drawn
def transfer(draws: FloatArray) -> Any:
    """Draw bands of photon-transfer curves in DN from ``draws`` (draw, level, signal | variance |
    predicted).

    Where the full well or the converter clips flat fields, their noise collapses; there a grey area
    is drawn instead.
    """
    figure, axes = canvas(6.6, 5.8, 2, 1, sharex=True, height_ratios=[2, 1])
    ax, relative_axis = axes[:, 0]
    # columns: 0 signal, 1 variance, 2 predicted variance
    signal, predicted = _at_one_signal(draws, 2)
    # element 1: the signals are the same
    flat_deviation = _at_one_signal(draws, 1)[1]
    unclipped = np.median(flat_deviation / predicted, axis=0) > _CLIPPED
    _band(ax, relative_axis, signal, predicted, BLUE, "predicted: middle 90 %")
    if unclipped.any():
        _band(
            ax,
            relative_axis,
            signal[unclipped],
            flat_deviation[:, unclipped],
            ORANGE,
            "flat fields: middle 90 %",
        )
    if not unclipped.all():
        ax.axvspan(
            signal[~unclipped].min(),
            signal.max(),
            color=_GREY,
            alpha=0.15,
            linewidth=0,
            label="clipped flat fields",
        )
    ax.set_xscale("log")
    ax.set_yscale("log")
    plain_ticks(ax.yaxis)
    ax.set_title("photon-transfer curve: middle 90 % of the draws")
    ax.set_ylabel("standard deviation (DN)")
    relative_axis.set_xlabel("mean above dark (DN)")
    relative_axis.set_ylabel("over the\nmedian (%)")
    ax.legend()
    return figure


def _band(ax: Any, below: Any, x: FloatArray, draws: FloatArray, colour: str, name: str) -> None:
    """Draw the median and the middle 90 % of the draws in ``ax``, and the band relative to the
    median in ``below``.
    """
    low_curve, median, high_curve = np.quantile(draws, [0.05, 0.5, 0.95], axis=0)
    ax.fill_between(x, low_curve, high_curve, color=colour, alpha=0.35, linewidth=0, label=name)
    ax.plot(x, median, color=colour, linewidth=1.0)
    visible = np.abs(median) > _SLIGHT * np.abs(median).max()
    relative_ends = [100 * (end[visible] / median[visible] - 1) for end in (low_curve, high_curve)]
    below.fill_between(x[visible], *relative_ends, color=colour, alpha=0.35, linewidth=0.8)


def _at_one_signal(draws: FloatArray, column: int) -> tuple[FloatArray, FloatArray]:
    """Return signals (signal,) that all draws cover, and the standard deviation of each draw (draw,
    signal) at these signals.

    ``column`` is 1 for the variance of the flat fields, 2 for the predicted variance.
    """
    # the first level is dark
    lit_levels = draws[:, 1:]
    # range covered by all draws: from the largest minimum to the smallest maximum
    signal_range = (
        float(lit_levels[..., 0].clip(1e-9).min(1).max()),
        float(lit_levels[..., 0].max(1).min()),
    )
    signal = np.geomspace(*signal_range, _ALONG)
    curves = [
        np.interp(np.log(signal), np.log(signals.clip(1e-9)), np.sqrt(variances.clip(0)))
        for signals, variances in lit_levels[..., [0, column]].transpose(0, 2, 1)
    ]
    return signal, np.stack(curves)


@drawn
def histograms(draws: Mapping[str, FloatArray], middles: Mapping[str, float]) -> Any:
    """Draw a histogram of each output number over all draws, with a line at the value for median
    inputs.
    """
    figure, axes = panels(len(draws), 3, 3.6, 2.6, below=0.3)
    figure.get_layout_engine().set(h_pad=_DIAGRAM_MARGIN)
    for ax, (name, values) in zip(axes, draws.items(), strict=True):
        ax.hist(values, _BINS, color=BLUE, alpha=0.8)
        ax.axvline(
            middles[name],
            color=VERMILION,
            linewidth=1.2,
            label="value with every input at its median",
        )
        ax.set_title(name)
        _few_numbers(ax)
        ax.locator_params(axis="y", integer=True)
        ax.grid(False)
    figure.supylabel("draws", fontsize=10)
    figure.legend(
        *(legend[:1] for legend in axes[0].get_legend_handles_labels()),
        loc="outside lower center",
    )
    return figure


@drawn
def pictures(moments: Mapping[str, tuple[Tensor, Tensor]]) -> Any:
    """Draw the mean of each output picture over the draws, and its standard deviation averaged over
    the colours.
    """
    figure, axes = canvas(9.6, 4.2 * len(moments), len(moments), 2)
    for (mean_axis, deviation_axis), (name, (mean, sd)) in zip(axes, moments.items(), strict=True):
        white = high(mean.clamp_min(0))
        is_colour = mean.ndim == 3 and mean.shape[0] == 3
        shown_mean = (
            encoded(mean / white) if is_colour else (mean[0] if mean.ndim == 3 else mean).numpy()
        )
        picture(
            mean_axis,
            shown_mean,
            f"{name}: mean",
            **({} if is_colour else {"cmap": "gray", "vmin": 0.0, "vmax": white}),
        )
        spread = sd.mean(0) if sd.ndim == 3 else sd
        image = picture(
            deviation_axis,
            spread.numpy(),
            f"{name}: standard deviation",
            cmap="viridis",
            vmin=0,
            vmax=high(spread),
        )
        bar = figure.colorbar(image, ax=deviation_axis, fraction=0.046, pad=0.03, extend="max")
        bar.set_label("in the unit of the picture", fontsize=9)
        bar.ax.tick_params(labelsize=9)
    return figure


# --- uncertainty page -----------------------------------------------------------------------------

# The result of the uncertainty study, and the page that shows the result.


MOST_NUMBERS = 12  #: largest number of output numbers in the pictures and in the summary
_LITTLE = 0.01  #: inputs with a smaller share of a variance have no row
#: a polynomial must predict this share of a variance, or its indices are not listed
_TOO_LITTLE = 0.5
_TRANSFER = "sensor.photon_transfer"
_CONSTRAINT = {"upper": "only an upper limit", "lower": "only a lower limit", "none": "nothing"}


@dataclass(frozen=True)
class Rung:
    """How accurate a method is, and what it took."""

    name: str
    runs: int  #: of the recipe
    seconds_a_run: float | None  #: s; None if all runs were stored
    error: float  #: relative error of the standard deviation that is known least
    holds: bool  #: whether the error is within the requested one


@dataclass(frozen=True)
class UncertaintyResult:
    """The result of the uncertainty study: draws of all inputs, with values and statistics of each
    quantity.
    """

    inputs: Inputs
    points: InputDraws  #: the used draws
    values: Mapping[str, FloatArray]  #: by quantity (draw, element)
    scatter: Mapping[str, Scatter]
    middle: Mapping[str, Sequence[float]]  #: by quantity, with every input at its median
    #: for each output number: (input, value at its 5 %, value at its 95 %)
    swings: Mapping[str, Sequence[tuple[str, float, float]]]
    shares: Mapping[str, SobolIndices]  #: by number
    pictures: Mapping[str, tuple[Tensor, Tensor]]  #: mean and standard deviation by output
    is_constant: tuple[str, ...]  #: outputs that depend on no input
    wanted: float  #: the requested relative error
    sequences: int  #: number of Sobol sequences; 0 for independent draws
    deciding: tuple[str, ...]  #: quantities whose standard deviations decided when to stop
    #: statement on draws whose values the recipe does not allow together; empty for none
    left_out: str
    rungs: tuple[Rung, ...] = ()  #: the methods that were tried, the cheapest first

    @property
    def worst(self) -> str:
        """Return the deciding quantity whose standard deviation has the largest relative error."""
        return worst_known({name: self.scatter[name] for name in self.deciding})

    @property
    def error(self) -> float:
        """Return the largest relative error of the standard deviations that decide when to stop."""
        return self.scatter[self.worst].error

    @property
    def strange(self) -> list[str]:
        """Return the names of output quantities that are NaN or infinite in at least one draw."""
        return [name for name, values in self.values.items() if not np.isfinite(values).all()]

    @property
    def failed(self) -> int:
        """Return the number of quantities with NaN or infinity, plus 1 if a standard deviation is
        too inaccurate.
        """
        return len(self.strange) + (not self.error <= self.wanted)

    @property
    def input_rows(self) -> list[dict[str, Any]]:
        """Return the name, label, distribution, mean and standard deviation of each uncertain
        input.
        """
        law_text_of, columns = self.inputs.uncertain.said, self.points.values.T
        return [
            {
                "name": name,
                "label": label,
                "law": law_text_of(name),
                "mean": float(column.mean()),
                "sd": float(column.std(ddof=1)),
            }
            for name, label, column in zip(
                self.inputs.names, self.inputs.labels, columns, strict=True
            )
        ]

    @property
    def numbers(self) -> list[str]:
        """Return the scalar quantities that vary between draws, only one of each group of
        proportional ones.
        """
        return list(self.swings)


def draw_pictures(result: UncertaintyResult) -> dict[str, bytes]:
    """Return the pictures of the uncertainty study's page by name, as PNG bytes."""
    pictures_by_name = {}
    numbers = result.numbers[:MOST_NUMBERS]
    if numbers:
        median_values = {name: result.middle[name][0] for name in numbers}
        pictures_by_name["tornado"] = tornado(
            {name: result.swings[name] for name in numbers}, median_values
        )
        pictures_by_name["numbers"] = histograms(
            {name: result.values[name][:, 0] for name in numbers}, median_values
        )
    if curves := _curves(result):
        pictures_by_name["bands"] = bands(*curves)
    for name, values in result.values.items():
        if _node_of(result, name) == _TRANSFER and np.isfinite(values).all():
            pictures_by_name["transfer"] = transfer(values.reshape(len(values), -1, 3))
    if result.pictures:
        pictures_by_name["pictures"] = pictures(result.pictures)
    return pictures_by_name


def _curves(
    result: UncertaintyResult,
) -> tuple[dict[str, tuple[FloatArray, dict[str, FloatArray]]], str] | None:
    """Return the curves that vary between draws, with their abscissas, by step; and the label of
    the abscissa.
    """
    wavelengths = _wavelengths_nm(result)
    curves: dict[str, tuple[FloatArray, dict[str, FloatArray]]] = {}
    spectral = True
    for name, values in result.values.items():
        # columns are the elements of a curve
        count = values.shape[1]
        varies = np.isfinite(values).all() and not result.scatter[name].is_constant
        if count < 3 or not varies or _node_of(result, name) == _TRANSFER:
            continue
        has_bands = len(wavelengths) == count
        spectral &= has_bands
        abscissa = wavelengths if has_bands else np.arange(count, dtype=np.float64)
        # curves such as lsr[mask] and lsr[plain] share one diagram
        family, _, arm = name.partition("[")
        curves.setdefault(family, (abscissa, {}))[1][arm.rstrip("]") or family] = values
    return (curves, "wavelength (nm)" if spectral else "element") if curves else None


def _wavelengths_nm(result: UncertaintyResult) -> FloatArray:
    """Return the wavelengths of the recipe's bands in nm; empty without bands."""
    recipe = result.inputs.recipe
    if BANDS not in recipe.steps:
        return np.zeros(0)
    centres: FloatArray = run(recipe, None, [BANDS])[BANDS].centres.double().numpy()
    return centres * 1e9


def _node_of(result: UncertaintyResult, quantity: str) -> str:
    """Return the path of the node that computes a quantity named ``step`` or ``step.field``; empty
    if unknown.
    """
    steps = result.inputs.recipe.steps
    step = steps.get(quantity) or steps.get(quantity.rpartition(".")[0])
    return step.node.path if step else ""


def lead(result: UncertaintyResult) -> str:
    """Return the summary of the uncertainty study in a few sentences."""
    count, kind_of_draws = (
        len(result.points.z),
        "Sobol points" if result.sequences else "independent draws",
    )
    numbers = {name: result.scatter[name] for name in result.numbers[:MOST_NUMBERS]}
    # numbers have one element
    values = [
        f"{name} {with_uncertainty(float(scattered.mean[0]), float(scattered.sd[0]))}"
        for name, scattered in numbers.items()
    ]
    strange = (
        f" NaN or infinite in some draw: {', '.join(result.strange)}." if result.strange else ""
    )
    precision = "; ".join([*_known(result), *_exceptions(result)])
    return (
        f"{count} {kind_of_draws} of {', '.join(result.inputs.names)}:"
        f" {precision}.{strange}\n\n{'; '.join(values)}."
    )


def _known(result: UncertaintyResult) -> list[str]:
    """Return phrases on the accuracy of the standard deviations."""
    if len(result.deciding) == len(result.scatter):
        which_deviations, on_others = "every standard deviation", []
    else:
        which_deviations, least_known = (
            f"the standard deviation of {', '.join(result.deciding)}",
            worst_known(result.scatter),
        )
        on_others = [
            f"others did not decide, the least known is {least_known} to"
            f" {result.scatter[least_known].error:.1%}"
        ]
    if result.error <= result.wanted:
        return [f"{which_deviations} is known to {result.error:.1%}", *on_others]
    sentence = f"the standard deviation of {result.worst} is known to {result.error:.1%} only"
    return [sentence, f"{result.wanted:.1%} was requested", *on_others]


def _exceptions(result: UncertaintyResult) -> list[str]:
    """Return phrases on the numbers that do not vary, and on the omitted draws."""
    constant = [name for name, scattered in result.scatter.items() if scattered.is_constant]
    parts = (
        [f"{', '.join(constant)} {'does' if len(constant) == 1 else 'do'} not vary"]
        if constant
        else []
    )
    return [*parts, f"left out: {result.left_out}"] if result.left_out else parts


def sections(result: UncertaintyResult, shown: Mapping[str, bytes]) -> list[Section]:
    """Return the sections of the uncertainty study's page; ``shown`` maps names to the PNG bytes of
    pictures.
    """
    listed_sections = [_inputs(result), *_posterior(result), _numbers(result, shown.get("numbers"))]
    listed_sections += _moves(result, shown.get("tornado"))
    if "bands" in shown:
        listed_sections.append(
            Section(
                "Curves",
                "The middle 90 % of the draws, element by element.",
                picture=shown["bands"],
            )
        )
    if "transfer" in shown:
        text = """The curves that a laboratory would measure with the drawn sensors, simulated by
            the recipe's steps. The prediction has no noise. Flat fields have the noise of their
            pixels, because each draw has its own light."""
        listed_sections.append(Section("Photon-transfer curve", text, picture=shown["transfer"]))
    if "pictures" in shown:
        text = """Mean and standard deviation of each pixel over the first 32 draws; the standard
            deviation is known to 13 %. The noise is the same in all draws, so only the inputs
            matter. pictures.npz has the numbers."""
        listed_sections.append(Section("Pictures", text, picture=shown["pictures"]))
    return [*listed_sections, rung_section(result.rungs), *_rest(result)]


def rung_section(rungs: Sequence[Rung]) -> Section:
    """Return the section that compares the methods by error and run time."""
    text = """The error is that of the standard deviation that is known least, relative. All methods
        share the runs at the medians and at the ends of each input; a row counts every run that its
        method needs. The time is that of one process, from the mean time of the runs of this
        command; a dash: all runs were stored."""
    rows = [
        (
            rung.name,
            rung.runs,
            None if rung.seconds_a_run is None else rung.runs * rung.seconds_a_run,
            Marked(f"{rung.error:.2%}", "pass" if rung.holds else "warn"),
        )
        for rung in rungs
    ]
    return Section("Error against run time", text, ("method", "runs", "time (s)", "error"), rows)


def _inputs(result: UncertaintyResult) -> Section:
    """Return the section on the drawn inputs, their distributions, and the omitted draws."""
    text = """The drawn values, in SI units. A joint distribution is drawn from independent inputs:
        the first input moves all correlated values, and each further input the part of its value
        that the inputs before it leave free. The same noise is drawn every time, so that only the
        inputs make a difference."""
    notes = result.inputs.notes
    notes_on_draws = [
        f"{name} = {result.inputs.uncertain.said(name)}: {note}." for name, note in notes.items()
    ]
    if result.left_out:
        notes_on_draws.append(f"Left out: {result.left_out}; all numbers hold for the other draws.")
    text = "\n\n".join([text, *notes_on_draws])
    rows = [
        (
            input_row["name"],
            input_row["label"],
            input_row["law"],
            f"{input_row['mean']:.6g}",
            input_row["sd"],
        )
        for input_row in result.input_rows
    ]
    return Section("Inputs", text, ("value", "drawn as", "law", "mean", "sd"), rows)


def _posterior(result: UncertaintyResult) -> list[Section]:
    """Return the section that locates the recipe's values in the posterior; empty without a
    posterior.
    """
    standings = [
        standing
        for standing in result.inputs.uncertain.standings
        if standing.path in result.inputs.names
    ]
    if not standings:
        return []
    text = """The position of the recipe's own value in the posterior. A value that the frames only
        limit, or do not determine, is drawn mostly from the prior of the calibration."""
    rows = []
    for standing in standings:
        is_estimate = standing.kind == "estimate"
        share_below = Marked(standing.below)
        if is_estimate:
            share_below = Marked(standing.below, "warn" if standing.far else "pass")
        limit = _CONSTRAINT.get(standing.kind, "estimate")
        constraint = Marked(limit, None if is_estimate else "warn")
        rows.append(
            (
                standing.path,
                standing.own,
                f"{standing.mean:.6g}",
                standing.sd,
                share_below,
                constraint,
            )
        )
    columns = ("value", "recipe", "posterior mean", "sd", "posterior below it", "told")
    return [Section("The recipe beside its posterior", text, columns, rows)]


def _numbers(result: UncertaintyResult, picture: bytes | None) -> Section:
    """Return the section on the scatter of each quantity; for a curve, at its most uncertain
    element.
    """
    method = (
        f"from {result.sequences} scrambled Sobol sequences"
        if result.sequences
        else "by the jackknife"
    )
    text = (
        f"Error: the relative error of the standard deviation, {method}. For a curve, the worst"
        " element counts."
    )
    columns = ("quantity", "at the medians", "mean", "sd", "error", "5 %", "95 %")
    rows = list[Sequence[Any]]()
    for name, scattered in result.scatter.items():
        # the element of the largest standard deviation
        element = int(scattered.sd.argmax())
        label = name if len(scattered.sd) == 1 else f"{name}, element {element}"
        numbers = (
            f"{result.middle[name][element]:.6g}",
            f"{scattered.mean[element]:.6g}",
            float(scattered.sd[element]),
        )
        holds = scattered.error <= result.wanted and name not in result.strange
        text_of_error = "does not vary" if scattered.is_constant else f"{scattered.error:.1%}"
        error = Marked(text_of_error, "pass" if holds else "fail")
        rows.append(
            (
                label,
                *numbers,
                error,
                f"{scattered.low[element]:.6g}",
                f"{scattered.high[element]:.6g}",
            )
        )
    return Section("Numbers", text, columns, rows, picture)


def _moves(result: UncertaintyResult, picture: bytes | None) -> list[Section]:
    """Return the section on the influence of the inputs, with their Sobol indices; empty without a
    picture.
    """
    if picture is None:
        return []
    text = f"""Each input alone at its 5 % and its 95 % quantile, all others at their medians. The
        table has Sobol indices, the shares of the inputs in the variance, with 95 % intervals.
        First: the effect of the input alone. Total: the effect alone and together with other
        inputs. Both are those of one polynomial, fitted to the draws. Explained: the share of the
        variance that this polynomial predicts for draws outside its fit. What is left may belong to
        any input, so that every interval contains it; below {_TOO_LITTLE:.0%} the inputs are not
        judged. Inputs with a total of less than {_LITTLE:.0%} have no row; provenance.json has
        all."""
    columns = ("quantity", "input", "first", "interval", "total", "interval", "explained")
    rows: list[Sequence[Any]] = []
    for name, shares in result.shares.items():
        rows += _influence(name, result.inputs.labels, shares)
    return [Section("Influence of the inputs", text, columns, rows, picture)]


def _influence(name: str, labels: Sequence[str], shares: SobolIndices) -> list[Sequence[Any]]:
    """Return a table row for each input that affects a quantity; the first row is marked if the
    polynomial explains too little.
    """
    mark_of_polynomial: Mark | None = None if shares.explains_enough else "warn"
    if shares.explained < _TOO_LITTLE:
        explained = Marked(f"{shares.explained:.0%}", mark_of_polynomial)
        return [(name, "not judged", None, None, None, None, explained)]
    rows: list[Sequence[Any]] = []
    for label, first_index, total_index in zip(labels, shares.first, shares.total, strict=True):
        if total_index.value > _LITTLE:
            # only the first row is marked
            explained = Marked(f"{shares.explained:.1%}", None if rows else mark_of_polynomial)
            effects = (
                first_index.value,
                _between(first_index),
                total_index.value,
                _between(total_index),
            )
            rows.append((name, label, *effects, explained))
    return rows


def _between(index: IndexInterval) -> str:
    """Return the interval of an index as text."""
    return f"{index.low:.2g} to {index.high:.2g}"


def _rest(result: UncertaintyResult) -> list[Section]:
    """Return the section on outputs and inputs that do not vary; empty if all vary."""
    sentences = (
        [f"Outputs that depend on no input: {', '.join(result.is_constant)}."]
        if result.is_constant
        else []
    )
    if result.inputs.idle:
        sentences.append(
            f"Inputs that change no output and were not drawn: {', '.join(result.inputs.idle)}."
        )
    return [Section("What does not vary", "\n\n".join(sentences))] if sentences else []
