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
from neusee.workflows.report.study_page import (
    Mark,
    Marked,
    Section,
    with_uncertainty,
)
from neusee.workflows.studies.uncertainty.output_draws import FloatArray, Scatter, worst_known
from neusee.workflows.studies.uncertainty.sobol_indices import IndexInterval, SobolIndices

# --- uncertainty figures --------------------------------------------------------------------------

# Pictures of the uncertainty study: tornado diagrams, curves with bands, histograms, and means of
# images.


_GREY = "#777777"
_COLOURS = (BLUE, VERMILION, GREEN, ORANGE)
#: ratio of the largest to the least value of curves above which their axis is logarithmic
_WIDE = 30.0
_BINS = 24
_TICKS = 4  #: numbers below a diagram of a number, at most
_LONGEST = 8  #: characters of such a number without its sign
_APART = 0.1  #: inches around each diagram, so that a title does not touch the numbers above it
_SLIGHT = 1e-6  #: share of a curve's largest element; no ratio to a smaller median is drawn
_ALONG = 200  #: signals of a photon-transfer curve
#: share of the predicted standard deviation below which flat fields are clipped, and not drawn
_CLIPPED = 0.9


@drawn
def tornado(
    swings: Mapping[str, Sequence[tuple[str, float, float]]], middles: Mapping[str, float]
) -> Any:
    """Draw a tornado diagram of each output number: the values with one input at its 5 % and its
    95 % quantile.
    """
    longest = max(map(len, swings.values()))
    figure, axes = panels(len(swings), 2, 6.6, 0.34 * longest + 1.3)
    figure.get_layout_engine().set(h_pad=_APART)
    for ax, (name, bars) in zip(axes, swings.items(), strict=True):
        _bars(ax, sorted(bars, key=lambda bar: abs(bar[2] - bar[1])), middles[name])
        ax.set_title(name)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles[:2], labels[:2], loc="outside lower center", ncols=2)
    return figure


def _bars(ax: Any, bars: Sequence[tuple[str, float, float]], middle: float) -> None:
    low = [bar[1] - middle for bar in bars]
    up = [bar[2] - middle for bar in bars]
    ax.barh(range(len(bars)), low, 0.7, left=middle, color=BLUE, label="input at its 5 % quantile")
    ax.barh(
        range(len(bars)), up, 0.7, left=middle, color=ORANGE, label="input at its 95 % quantile"
    )
    ax.axvline(middle, color=BLACK, linewidth=0.9)
    ax.set_yticks(range(len(bars)), [bar[0] for bar in bars])
    _few_numbers(ax)
    ax.grid(False, axis="y")


def _few_numbers(ax: Any) -> None:
    """Write few numbers below a diagram, and take what all numbers share out of numbers that
    would be too long.
    """
    low, high = ax.get_xlim()
    decimals = max(0, math.ceil(-math.log10((high - low) / _TICKS)))
    if len(f"{max(abs(low), abs(high)):.{decimals}f}") > _LONGEST:
        ax.ticklabel_format(axis="x", style="sci", scilimits=(-2, 4), useOffset=True)
    else:
        ax.ticklabel_format(axis="x", useOffset=False)
    ax.locator_params(axis="x", nbins=_TICKS)


@drawn
def bands(curves: Mapping[str, tuple[FloatArray, Mapping[str, FloatArray]]], axis: str) -> Any:
    """Draw the middle 90 % of each family of curves and, in a second row, the same band relative to
    the median.

    Each family has an abscissa, and draws (draw, element) of each curve by name.
    """
    figure, axes = canvas(
        5.6 * len(curves), 5.4, 2, len(curves), sharex="col", height_ratios=[2, 1]
    )
    figure.get_layout_engine().set(h_pad=_APART)
    for (ax, below), (family, (x, members)) in zip(axes.T, curves.items(), strict=True):
        for (name, draws), colour in zip(members.items(), _COLOURS * len(members), strict=False):
            _band(ax, below, x, draws, colour, name)
        lowest, highest = (
            min(float(d.min()) for d in members.values()),
            max(float(d.max()) for d in members.values()),
        )
        if lowest > 0 and highest / lowest > _WIDE:
            ax.set_yscale("log")
        ax.set_title(f"{family}: median and middle 90 %")
        below.set_xlabel(axis)
        below.set_ylabel("over the\nmedian (%)")
        ax.legend()
    return figure


@drawn
def transfer(draws: FloatArray) -> Any:
    """Draw bands of photon-transfer curves in DN from ``draws`` (draw, level, signal | variance |
    predicted).

    Where the full well or the converter clips flat fields, their noise collapses; there, a grey
    area takes their place.
    """
    figure, axes = canvas(6.6, 5.8, 2, 1, sharex=True, height_ratios=[2, 1])
    ax, below = axes[:, 0]
    signal, predicted = _at_one_signal(draws, 2)
    flat = _at_one_signal(draws, 1)[1]
    unclipped = np.median(flat / predicted, axis=0) > _CLIPPED
    _band(ax, below, signal, predicted, BLUE, "predicted: middle 90 %")
    if unclipped.any():
        _band(ax, below, signal[unclipped], flat[:, unclipped], ORANGE, "flat fields: middle 90 %")
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
    below.set_xlabel("mean above dark (DN)")
    below.set_ylabel("over the\nmedian (%)")
    ax.legend()
    return figure


def _band(ax: Any, below: Any, x: FloatArray, draws: FloatArray, colour: str, name: str) -> None:
    """Draw the median and the middle 90 % of the draws in ``ax``, and the band relative to the
    median in ``below``.
    """
    low, middle, up = np.quantile(draws, [0.05, 0.5, 0.95], axis=0)
    ax.fill_between(x, low, up, color=colour, alpha=0.35, linewidth=0, label=name)
    ax.plot(x, middle, color=colour, linewidth=1.0)
    visible = np.abs(middle) > _SLIGHT * np.abs(middle).max()
    share = [100 * (end[visible] / middle[visible] - 1) for end in (low, up)]
    below.fill_between(x[visible], *share, color=colour, alpha=0.35, linewidth=0.8)


def _at_one_signal(draws: FloatArray, column: int) -> tuple[FloatArray, FloatArray]:
    """Return signals that the curves of all draws reach, and the curve of each draw interpolated
    at these signals.
    """
    lit = draws[:, 1:]
    ends = float(lit[..., 0].clip(1e-9).min(1).max()), float(lit[..., 0].max(1).min())
    signal = np.geomspace(*ends, _ALONG)
    curves = [
        np.interp(np.log(signal), np.log(x.clip(1e-9)), np.sqrt(y.clip(0)))
        for x, y in lit[..., [0, column]].transpose(0, 2, 1)
    ]
    return signal, np.stack(curves)


@drawn
def histograms(draws: Mapping[str, FloatArray], middles: Mapping[str, float]) -> Any:
    """Draw a histogram of each output number over all draws, and a line at the value for median
    inputs.
    """
    figure, axes = panels(len(draws), 3, 3.6, 2.6, below=0.3)
    figure.get_layout_engine().set(h_pad=_APART)
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
    """Draw the mean of each output picture over the draws, and the standard deviation averaged
    over the colours.
    """
    figure, axes = canvas(9.6, 4.2 * len(moments), len(moments), 2)
    for (left, right), (name, (mean, sd)) in zip(axes, moments.items(), strict=True):
        white = high(mean.clamp_min(0))
        three = mean.ndim == 3 and mean.shape[0] == 3
        shown = encoded(mean / white) if three else (mean[0] if mean.ndim == 3 else mean).numpy()
        picture(
            left,
            shown,
            f"{name}: mean",
            **({} if three else {"cmap": "gray", "vmin": 0.0, "vmax": white}),
        )
        spread = sd.mean(0) if sd.ndim == 3 else sd
        image = picture(
            right,
            spread.numpy(),
            f"{name}: standard deviation",
            cmap="viridis",
            vmin=0,
            vmax=high(spread),
        )
        bar = figure.colorbar(image, ax=right, fraction=0.046, pad=0.03, extend="max")
        bar.set_label("in the unit of the picture", fontsize=9)
        bar.ax.tick_params(labelsize=9)
    return figure


# --- uncertainty page -----------------------------------------------------------------------------

# The result of the uncertainty study, and the page that shows the result.


_MOST = 12  #: numbers in the pictures and in the lead
_LITTLE = 0.01  #: share of a variance; inputs with a smaller share have no row
_TOO_LITTLE = 0.5  #: share of a variance that a polynomial must predict for a row of indices
_TRANSFER = "sensor.photon_transfer"
_CONSTRAINT = {"upper": "only an upper limit", "lower": "only a lower limit", "none": "nothing"}


@dataclass(frozen=True)
class UncertaintyResult:
    """The result of the uncertainty study: draws of all inputs, and values and statistics of
    each quantity.
    """

    inputs: Inputs
    points: InputDraws  #: the used draws
    values: Mapping[str, FloatArray]  #: by quantity (draw, element)
    scatter: Mapping[str, Scatter]
    middle: Mapping[str, Sequence[float]]  #: by quantity, with every input at its median
    #: by number: input, value at its 5 %, value at its 95 %
    swings: Mapping[str, Sequence[tuple[str, float, float]]]
    shares: Mapping[str, SobolIndices]  #: by number
    pictures: Mapping[str, tuple[Tensor, Tensor]]  #: mean and standard deviation by output
    is_constant: tuple[str, ...]  #: outputs that depend on no input
    wanted: float  #: the requested relative error
    sequences: int  #: number of Sobol sequences; 0 for independent draws
    deciding: tuple[str, ...]  #: quantities whose standard deviations decided when to stop
    left_out: str  #: draws whose values the recipe does not allow together; empty for none

    @property
    def worst(self) -> str:
        """Return the name of the deciding quantity whose standard deviation has the largest
        relative error.
        """
        return worst_known({name: self.scatter[name] for name in self.deciding})

    @property
    def error(self) -> float:
        """Return the largest relative error of the standard deviations that decided when to
        stop.
        """
        return self.scatter[self.worst].error

    @property
    def strange(self) -> list[str]:
        """Return the names of output quantities that are NaN or infinite in at least one draw."""
        return [name for name, x in self.values.items() if not np.isfinite(x).all()]

    @property
    def failed(self) -> int:
        """Return the number of quantities with NaN or infinity, plus 1 if a standard deviation
        is too inaccurate.
        """
        return len(self.strange) + (not self.error <= self.wanted)

    @property
    def input_rows(self) -> list[dict[str, Any]]:
        """Return the name, label, distribution, mean and standard deviation of each uncertain
        input.
        """
        said, columns = self.inputs.uncertain.said, self.points.values.T
        return [
            {
                "name": name,
                "label": label,
                "law": said(name),
                "mean": float(x.mean()),
                "sd": float(x.std(ddof=1)),
            }
            for name, label, x in zip(self.inputs.names, self.inputs.labels, columns, strict=True)
        ]

    @property
    def numbers(self) -> list[str]:
        """Return the names of scalar quantities that vary between draws, one from each group of
        proportional ones.
        """
        return list(self.swings)


def draw_pictures(result: UncertaintyResult) -> dict[str, bytes]:
    """Draw the pictures of the uncertainty study's page, and return the pictures by name as PNG
    bytes.
    """
    shown = {}
    numbers = result.numbers[:_MOST]
    if numbers:
        middle = {name: result.middle[name][0] for name in numbers}
        shown["tornado"] = tornado({name: result.swings[name] for name in numbers}, middle)
        shown["numbers"] = histograms({name: result.values[name][:, 0] for name in numbers}, middle)
    if curves := _curves(result):
        shown["bands"] = bands(*curves)
    for name, values in result.values.items():
        if _node_of(result, name) == _TRANSFER and np.isfinite(values).all():
            shown["transfer"] = transfer(values.reshape(len(values), -1, 3))
    if result.pictures:
        shown["pictures"] = pictures(result.pictures)
    return shown


def _curves(
    result: UncertaintyResult,
) -> tuple[dict[str, tuple[FloatArray, dict[str, FloatArray]]], str] | None:
    """Return the curves that vary between draws, with their abscissas, by step, and the label of
    the abscissa.
    """
    wavelengths = _wavelengths_nm(result)
    curves: dict[str, tuple[FloatArray, dict[str, FloatArray]]] = {}
    spectral = True
    for name, values in result.values.items():
        count = values.shape[1]
        varies = np.isfinite(values).all() and not result.scatter[name].is_constant
        if count < 3 or not varies or _node_of(result, name) == _TRANSFER:
            continue
        over_bands = len(wavelengths) == count
        spectral &= over_bands
        x = wavelengths if over_bands else np.arange(count, dtype=np.float64)
        family, _, arm = name.partition("[")
        curves.setdefault(family, (x, {}))[1][arm.rstrip("]") or family] = values
    return (curves, "wavelength (nm)" if spectral else "element") if curves else None


def _wavelengths_nm(result: UncertaintyResult) -> FloatArray:
    recipe = result.inputs.recipe
    if BANDS not in recipe.steps:
        return np.zeros(0)
    centres: FloatArray = run(recipe, None, [BANDS])[BANDS].centres.double().numpy()
    return centres * 1e9


def _node_of(result: UncertaintyResult, quantity: str) -> str:
    steps = result.inputs.recipe.steps
    step = steps.get(quantity) or steps.get(quantity.rpartition(".")[0])
    return step.node.path if step else ""


def lead(result: UncertaintyResult) -> str:
    """Return the summary of the uncertainty study in a few sentences."""
    count, kind = len(result.points.z), "Sobol points" if result.sequences else "independent draws"
    numbers = {name: result.scatter[name] for name in result.numbers[:_MOST]}
    values = [
        f"{name} {with_uncertainty(float(s.mean[0]), float(s.sd[0]))}"
        for name, s in numbers.items()
    ]
    strange = (
        f" NaN or infinite in some draw: {', '.join(result.strange)}." if result.strange else ""
    )
    precision = "; ".join([*_known(result), *_exceptions(result)])
    return (
        f"{count} {kind} of {', '.join(result.inputs.names)}:"
        f" {precision}.{strange}\n\n{'; '.join(values)}."
    )


def _known(result: UncertaintyResult) -> list[str]:
    """Return how well the standard deviations are known."""
    if len(result.deciding) == len(result.scatter):
        which, others = "every standard deviation", []
    else:
        which, other = (
            f"the standard deviation of {', '.join(result.deciding)}",
            worst_known(result.scatter),
        )
        others = [
            f"others did not decide, the least known is {other} to"
            f" {result.scatter[other].error:.1%}"
        ]
    if result.error <= result.wanted:
        return [f"{which} is known to {result.error:.1%}", *others]
    sentence = f"the standard deviation of {result.worst} is known to {result.error:.1%} only"
    return [sentence, f"{result.wanted:.1%} was requested", *others]


def _exceptions(result: UncertaintyResult) -> list[str]:
    """Return which numbers do not vary, and how many draws were left out."""
    constant = [name for name, s in result.scatter.items() if s.is_constant]
    parts = (
        [f"{', '.join(constant)} {'does' if len(constant) == 1 else 'do'} not vary"]
        if constant
        else []
    )
    return [*parts, f"left out: {result.left_out}"] if result.left_out else parts


def sections(result: UncertaintyResult, shown: Mapping[str, bytes]) -> list[Section]:
    """Return the sections of the uncertainty study's page; ``shown`` has the PNG bytes of each
    picture by name.
    """
    parts = [_inputs(result), *_posterior(result), _numbers(result, shown.get("numbers"))]
    parts += _moves(result, shown.get("tornado"))
    if "bands" in shown:
        parts.append(
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
        parts.append(Section("Photon-transfer curve", text, picture=shown["transfer"]))
    if "pictures" in shown:
        text = """Mean and standard deviation of each pixel over the first 32 draws; the standard
            deviation is known to 13 %. The noise is the same in all draws, so only the inputs
            matter. pictures.npz has the numbers."""
        parts.append(Section("Pictures", text, picture=shown["pictures"]))
    return [*parts, *_rest(result)]


def _inputs(result: UncertaintyResult) -> Section:
    text = """The drawn values, in SI units. A joint distribution is drawn from independent inputs:
        the first input moves all correlated values, and each further input the part of its value
        that the inputs before it leave free. The same noise is drawn every time, so that only the
        inputs make a difference."""
    notes = result.inputs.notes
    cut = [
        f"{name} = {result.inputs.uncertain.said(name)}: {note}." for name, note in notes.items()
    ]
    if result.left_out:
        cut.append(f"Left out: {result.left_out}; all numbers hold for the other draws.")
    text = "\n\n".join([text, *cut])
    rows = [
        (r["name"], r["label"], r["law"], f"{r['mean']:.6g}", r["sd"]) for r in result.input_rows
    ]
    return Section("Inputs", text, ("value", "drawn as", "law", "mean", "sd"), rows)


def _posterior(result: UncertaintyResult) -> list[Section]:
    standings = [s for s in result.inputs.uncertain.standings if s.path in result.inputs.names]
    if not standings:
        return []
    text = """The position of the recipe's own value in the posterior. A value that the frames only
        limit, or do not determine, is drawn mostly from the prior of the calibration."""
    rows = []
    for s in standings:
        is_estimate = s.kind == "estimate"
        below = Marked(s.below)
        if is_estimate:
            below = Marked(s.below, "warn" if s.far else "pass")
        limit = _CONSTRAINT.get(s.kind, "estimate")
        constraint = Marked(limit, None if is_estimate else "warn")
        rows.append((s.path, s.own, f"{s.mean:.6g}", s.sd, below, constraint))
    columns = ("value", "recipe", "posterior mean", "sd", "posterior below it", "told")
    return [Section("The recipe beside its posterior", text, columns, rows)]


def _numbers(result: UncertaintyResult, picture: bytes | None) -> Section:
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
    for name, s in result.scatter.items():
        i = int(s.sd.argmax())
        label = name if len(s.sd) == 1 else f"{name}, element {i}"
        numbers = (f"{result.middle[name][i]:.6g}", f"{s.mean[i]:.6g}", float(s.sd[i]))
        holds = s.error <= result.wanted and name not in result.strange
        text_of_error = "does not vary" if s.is_constant else f"{s.error:.1%}"
        error = Marked(text_of_error, "pass" if holds else "fail")
        rows.append((label, *numbers, error, f"{s.low[i]:.6g}", f"{s.high[i]:.6g}"))
    return Section("Numbers", text, columns, rows, picture)


def _moves(result: UncertaintyResult, picture: bytes | None) -> list[Section]:
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
    """Return a row for each input that moves a quantity; the first row has the mark of the
    polynomial.
    """
    mark: Mark | None = None if shares.explains_enough else "warn"
    if shares.explained < _TOO_LITTLE:
        explained = Marked(f"{shares.explained:.0%}", mark)
        return [(name, "not judged", None, None, None, None, explained)]
    rows: list[Sequence[Any]] = []
    for label, first, total in zip(labels, shares.first, shares.total, strict=True):
        if total.value > _LITTLE:
            explained = Marked(f"{shares.explained:.1%}", None if rows else mark)
            effects = (first.value, _between(first), total.value, _between(total))
            rows.append((name, label, *effects, explained))
    return rows


def _between(index: IndexInterval) -> str:
    return f"{index.low:.2g} to {index.high:.2g}"


def _rest(result: UncertaintyResult) -> list[Section]:
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
