"""Pictures of the uncertainty study: tornado diagrams, curves with bands, histograms, and means of images."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from neusee.workflows.report.figures.camera_overview import high
from neusee.workflows.report.figures.point_labels import plain_ticks
from neusee.workflows.report.figures.style import BLACK, BLUE, GREEN, ORANGE, VERMILION, canvas, drawn, encoded, picture
from neusee.workflows.studies.uncertainty.scatter_estimate import FloatArray

_GREY = "#777777"
_COLOURS = (BLUE, VERMILION, GREEN, ORANGE)
_WIDE = 30.0  #: ratio of the largest to the least value of curves above which their axis is logarithmic
_BINS = 24
_TICKS = 4  #: numbers below a diagram of a number, at most
_LONGEST = 8  #: characters of such a number without its sign
_APART = 0.1  #: inches around each diagram, so that a title does not touch the numbers above it
_SLIGHT = 1e-6  #: share of a curve's largest element; no ratio to a smaller median is drawn
_ALONG = 200  #: signals of a photon-transfer curve
_CLIPPED = 0.9  #: share of the predicted standard deviation below which flat fields are clipped, and not drawn


@drawn
def tornado(swings: Mapping[str, Sequence[tuple[str, float, float]]], middles: Mapping[str, float]) -> Any:
    """Draw a tornado diagram of each output number: the values with one input at its 5 % and its 95 % quantile."""
    columns = min(2, len(swings))
    rows = -(-len(swings) // columns)
    most = max(map(len, swings.values()))
    figure, axes = canvas(6.6 * columns, (0.34 * most + 1.3) * rows, rows, columns)
    figure.get_layout_engine().set(h_pad=_APART)
    for ax, (name, bars) in zip(axes.flat, swings.items(), strict=False):
        _bars(ax, sorted(bars, key=lambda bar: abs(bar[2] - bar[1])), middles[name])
        ax.set_title(name)
    for ax in list(axes.flat)[len(swings) :]:
        ax.set_axis_off()
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles[:2], labels[:2], loc="outside lower center", ncols=2)
    return figure


def _bars(ax: Any, bars: Sequence[tuple[str, float, float]], middle: float) -> None:
    low = [bar[1] - middle for bar in bars]
    up = [bar[2] - middle for bar in bars]
    ax.barh(range(len(bars)), low, 0.7, left=middle, color=BLUE, label="input at its 5 % quantile")
    ax.barh(range(len(bars)), up, 0.7, left=middle, color=ORANGE, label="input at its 95 % quantile")
    ax.axvline(middle, color=BLACK, linewidth=0.9)
    ax.set_yticks(range(len(bars)), [bar[0] for bar in bars])
    _few_numbers(ax)
    ax.grid(False, axis="y")


def _few_numbers(ax: Any) -> None:
    """Write few numbers below a diagram, and take what all numbers share out of numbers that would be too long."""
    low, high = ax.get_xlim()
    decimals = max(0, math.ceil(-math.log10((high - low) / _TICKS)))
    if len(f"{max(abs(low), abs(high)):.{decimals}f}") > _LONGEST:
        ax.ticklabel_format(axis="x", style="sci", scilimits=(-2, 4), useOffset=True)
    else:
        ax.ticklabel_format(axis="x", useOffset=False)
    ax.locator_params(axis="x", nbins=_TICKS)


@drawn
def bands(curves: Mapping[str, tuple[FloatArray, Mapping[str, FloatArray]]], axis: str) -> Any:
    """Draw the middle 90 % of each family of curves and, in a second row, the same band relative to the median.

    Each family has an abscissa, and draws (draw, element) of each curve by name.
    """
    figure, axes = canvas(5.6 * len(curves), 5.4, 2, len(curves), sharex="col", height_ratios=[2, 1])
    figure.get_layout_engine().set(h_pad=_APART)
    for (ax, below), (family, (x, members)) in zip(axes.T, curves.items(), strict=True):
        for (name, draws), colour in zip(members.items(), _COLOURS * len(members), strict=False):
            _band(ax, below, x, draws, colour, name)
        least, most = min(float(d.min()) for d in members.values()), max(float(d.max()) for d in members.values())
        if least > 0 and most / least > _WIDE:
            ax.set_yscale("log")
        ax.set_title(f"{family}: median and middle 90 %")
        below.set_xlabel(axis)
        below.set_ylabel("over the\nmedian (%)")
        ax.legend()
    return figure


@drawn
def transfer(draws: FloatArray) -> Any:
    """Draw bands of photon-transfer curves in DN from ``draws`` (draw, level, signal | variance | predicted).

    Where the full well or the converter clips flat fields, their noise collapses; there, a grey area takes their place.
    """
    figure, axes = canvas(6.6, 5.8, 2, 1, sharex=True, height_ratios=[2, 1])
    ax, below = axes[:, 0]
    signal, predicted = _at_one_signal(draws, 2)
    flat = _at_one_signal(draws, 1)[1]
    whole = np.median(flat / predicted, axis=0) > _CLIPPED
    _band(ax, below, signal, predicted, BLUE, "predicted: middle 90 %")
    if whole.any():
        _band(ax, below, signal[whole], flat[:, whole], ORANGE, "flat fields: middle 90 %")
    if not whole.all():
        ax.axvspan(
            signal[~whole].min(), signal.max(), color=_GREY, alpha=0.15, linewidth=0, label="clipped flat fields"
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
    """Draw the median and the middle 90 % of the draws in ``ax``, and the band relative to the median in ``below``."""
    low, middle, up = np.quantile(draws, [0.05, 0.5, 0.95], axis=0)
    ax.fill_between(x, low, up, color=colour, alpha=0.35, linewidth=0, label=name)
    ax.plot(x, middle, color=colour, linewidth=1.0)
    seen = np.abs(middle) > _SLIGHT * np.abs(middle).max()
    share = [100 * (end[seen] / middle[seen] - 1) for end in (low, up)]
    below.fill_between(x[seen], *share, color=colour, alpha=0.35, linewidth=0.8)


def _at_one_signal(draws: FloatArray, column: int) -> tuple[FloatArray, FloatArray]:
    """Return signals that the curves of all draws reach, and the curve of each draw interpolated at these signals."""
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
    """Draw a histogram of each output number over all draws, and a line at the value for median inputs."""
    columns = min(3, len(draws))
    rows = -(-len(draws) // columns)
    figure, axes = canvas(3.6 * columns, 2.6 * rows + 0.3, rows, columns)
    figure.get_layout_engine().set(h_pad=_APART)
    for ax, (name, values) in zip(axes.flat, draws.items(), strict=False):
        ax.hist(values, _BINS, color=BLUE, alpha=0.8)
        ax.axvline(middles[name], color=VERMILION, linewidth=1.2, label="value with every input at its median")
        ax.set_title(name)
        _few_numbers(ax)
        ax.locator_params(axis="y", integer=True)
        ax.grid(False)
    for ax in list(axes.flat)[len(draws) :]:
        ax.set_axis_off()
    figure.supylabel("draws", fontsize=10)
    figure.legend(*(found[:1] for found in axes.flat[0].get_legend_handles_labels()), loc="outside lower center")
    return figure


@drawn
def pictures(found: Mapping[str, tuple[Tensor, Tensor]]) -> Any:
    """Draw the mean of each output picture over the draws, and the standard deviation averaged over the colours."""
    figure, axes = canvas(9.6, 4.2 * len(found), len(found), 2)
    for (left, right), (name, (mean, sd)) in zip(axes, found.items(), strict=True):
        white = high(mean.clamp_min(0))
        three = mean.ndim == 3 and mean.shape[0] == 3
        shown = encoded(mean / white) if three else (mean[0] if mean.ndim == 3 else mean).numpy()
        picture(left, shown, f"{name}: mean", **({} if three else {"cmap": "gray", "vmin": 0.0, "vmax": white}))
        spread = sd.mean(0) if sd.ndim == 3 else sd
        image = picture(right, spread.numpy(), f"{name}: standard deviation", cmap="viridis", vmin=0, vmax=high(spread))
        bar = figure.colorbar(image, ax=right, fraction=0.046, pad=0.03, extend="max")
        bar.set_label("in the unit of the picture", fontsize=9)
        bar.ax.tick_params(labelsize=9)
    return figure
