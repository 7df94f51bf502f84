"""Figures of an evaluation of masks: pictures by laser, error by laser strength, laser suppression, and contrast."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from neusee.nodes.metrics import most_contrast
from neusee.workflows.evaluation.confidence_intervals import MetricTable, Numbers
from neusee.workflows.report.figures.camera_overview import high
from neusee.workflows.report.figures.style import BLACK, BLUE, GREEN, ORANGE, VERMILION, canvas, drawn, encoded, picture

if TYPE_CHECKING:
    from neusee.workflows.evaluation.comparison_pictures import Panel
    from neusee.workflows.evaluation.evaluation_result import EvaluationResult
    from neusee.workflows.evaluation.mask_optics import MaskOptics

_COLOURS = (BLUE, VERMILION, GREEN, ORANGE, "#56B4E9", "#CC79A7", BLACK, "#777777")
_STYLES = ("-", "--", ":", "-.")  #: line styles, of which the next begins when all colours are used
_MARKERS = dict(zip(_STYLES, "osD^", strict=True))  #: marker of a point beside the line style of a curve
_GREY = "#777777"
_LETTERS = 16  #: characters of the longest row name that stays on one line


def _looks(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the colour and the line style of the curve of each mask, or of each mask with restorer."""
    count = len(_COLOURS)
    return {
        name: {"color": _COLOURS[i % count], "linestyle": _STYLES[i // count % len(_STYLES)]}
        for i, name in enumerate(names)
    }


@drawn
def cases(panels: Sequence[Panel]) -> Any:
    """Draw the pictures of the plain lens, and of every mask with restorer, in rows below the true picture.

    The columns have different lasers. All pictures have the same scale.
    """
    rows = list(panels[0].pictures)
    white = high(panels[0].pictures["truth"])
    figure, axes = canvas(1.95 * len(panels) + 0.6, 2.0 * len(rows) + 0.3, len(rows), len(panels))
    for i, panel in enumerate(panels):
        for j, (name, shown) in enumerate(panel.pictures.items()):
            title = f"{panel.case}, {_power(panel.strength)}" if panel.strength else "no laser"
            picture(axes[j, i], encoded(shown / white), "" if j else title)
            if i == 0:
                axes[j, i].set_ylabel(_broken(name), fontsize=10)
    return figure


def _power(strength: float) -> str:
    return f"$10^{{{np.log10(strength):.3g}}}$"


def _broken(name: str) -> str:
    return name if len(name) <= _LETTERS else re.sub(r" ?\+ ?", "\n+ ", name).replace(", ", ",\n").replace("@", "\n@ ")


@drawn
def strengths(tables: Mapping[str, MetricTable], small: int) -> Any:
    """Draw the L1 error of every mask and restorer with its 95 % interval over the laser strength.

    The left plot is for pictures of full size, the right plot for reduced pictures. Intervals of few scenes are much
    wider than the means are apart; they do not stretch the axis.
    """
    figure, axes = canvas(11.0, 4.2, 1, 2, sharex=True)
    looks = _looks(list(tables))
    titles = {"l1": "full size", "l1 small": f"shorter side {small} pixels"}
    for ax, (metric, title) in zip(axes[0], titles.items(), strict=True):
        for name, table in tables.items():
            _line(ax, table, metric, looks[name], name)
        ax.set_title(f"L1, {title}")
        ax.set_xlabel("laser strength (multiples of saturation)")
        values = next(iter(tables.values())).strengths
        ax.set_xticks(_places(values), ["none" if k == 0 else _power(k) for k in values])
        ax.set_ylim(0, _top(tables.values(), metric))
    axes[0, 0].set_ylabel("L1 (sRGB, 0 to 1)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(3, len(labels)))
    return figure


def _line(ax: Any, table: MetricTable, metric: str, look: Mapping[str, Any], name: str) -> None:
    intervals = [table.at(metric, i) for i in range(len(table.strengths))]
    at = _places(table.strengths)
    ax.plot(at, [x.mean for x in intervals], marker="o", markersize=4, linewidth=1.4, label=name, **look)
    low, up = [x.low for x in intervals], [x.high for x in intervals]
    ax.fill_between(at, low, up, color=look["color"], alpha=0.15, linewidth=0)


def _top(tables: Iterable[MetricTable], metric: str) -> float:
    """Return the end of an axis that shows every mean, and intervals up to three times the largest mean."""
    found = [table.at(metric, i) for table in tables for i in range(len(table.strengths))]
    largest = max((x.mean for x in found if x.mean > 0), default=0.0)
    return 1.05 * max(largest, min(3 * largest, max([x.high for x in found if x.high > 0], default=0.0))) or 1.0


def _places(values: Sequence[float]) -> list[float]:
    """Return the positions of laser strengths on a logarithmic axis, with strength 0 one decade below the others."""
    logs = [float(np.log10(k)) for k in values if k > 0]
    return [float(np.log10(k)) if k > 0 else (min(logs) - 1 if logs else 0.0) for k in values]


@drawn
def wavelengths(result: EvaluationResult) -> Any:
    """Draw the L1 error of the reduced pictures at the largest strength over the drawn wavelength of each scene."""
    figure, axes = canvas(11.0, 4.2)
    ax, looks = axes[0, 0], _looks([p.name for p in result.pipelines])
    x = np.array([math.nan if metres is None else metres * 1e9 for metres in result.wavelengths])
    for p in result.pipelines:
        y = result.tables[p.name].values["l1 small"][:, -1]
        ax.plot(x, y, ".", markersize=5, alpha=0.6, color=looks[p.name]["color"])
        ax.plot(*_means(x, y), linewidth=1.6, label=p.name, **looks[p.name])
    ax.set_xlabel("wavelength of the laser (nm)")
    ax.set_ylabel("L1 (sRGB, 0 to 1)")
    ax.set_ylim(bottom=0)
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(3, len(labels)))
    return figure


def _means(x: Numbers, y: Numbers) -> tuple[Numbers, Numbers]:
    """Return the mean of x and y in each sixth of the range of x that has a value."""
    kept = ~np.isnan(x + y)
    x, y = x[kept], y[kept]
    if not len(x):
        return x, y
    part = np.minimum((6 * (x - x.min()) / max(float(np.ptp(x)), 1e-9)).astype(int), 5)
    each = [i for i in range(6) if (part == i).any()]
    return np.array([x[part == i].mean() for i in each]), np.array([y[part == i].mean() for i in each])


@drawn
def curves(masks: Mapping[str, MaskOptics]) -> Any:
    """Draw the laser and background suppression ratios (LSR, BSR) of every mask over the wavelength."""
    figure, axes = canvas(11.0, 4.2, 1, 2, sharex=True)
    looks = _looks(list(masks))
    left, right = axes[0]
    for name, mask in masks.items():
        left.plot(mask.wavelengths, mask.lsr, linewidth=1.6, label=name, **looks[name])
        right.plot(mask.wavelengths, mask.bsr, linewidth=1.6, **looks[name])
    one = next(iter(masks.values()))
    left.plot(one.wavelengths, one.floor, color=_GREY, linewidth=1.2, linestyle=(0, (1, 2)), label="energy floor")
    left.set_yscale("log")
    left.set_title("laser suppression ratio: less is better")
    right.set_title("background suppression ratio: 1 is best")
    right.set_ylim(0, max(1.1, 1.05 * max(float(mask.bsr.max()) for mask in masks.values())))
    for ax, name in ((left, "LSR"), (right, "BSR")):
        ax.set_xlabel("wavelength (nm)")
        ax.set_ylabel(name)
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(5, len(labels)))
    return figure


@drawn
def plane(masks: Mapping[str, MaskOptics]) -> Any:
    """Draw the image contrast of each mask over its mean laser suppression ratio, and shade what no mask can reach."""
    figure, axes = canvas(8.4, 5.2)
    ax = axes[0, 0]
    floor = float(np.mean([mask.floor.mean() for mask in masks.values()]))
    least = min(floor, *(float(mask.lsr.mean()) for mask in masks.values()))
    x = np.geomspace(least / 3, 1.6, 200)
    unsuppressed = float(next(iter(masks.values())).unsuppressed.mean())
    bound = most_contrast(unsuppressed, torch.from_numpy(x)).numpy()
    ax.fill_between(x, bound, 1.5, color=_GREY, alpha=0.15, linewidth=0)
    ax.plot(
        x, bound, color=_GREY, linewidth=1.2, label="rms contrast: no mask that keeps its light is above (Parseval)"
    )
    ax.axvspan(x[0], floor, color=BLUE, alpha=0.12, linewidth=0, label="LSR: no mask that keeps its light is here")
    looks = _looks(list(masks))
    for name, mask in masks.items():
        at, colour, mark = float(mask.lsr.mean()), looks[name]["color"], _MARKERS[looks[name]["linestyle"]]
        ax.plot([at, at], [mask.median.mean(), mask.rms.mean()], color=colour, linewidth=0.8)
        ax.plot(at, mask.rms.mean(), mark, markersize=6, markerfacecolor="none", color=colour)
        ax.plot(at, mask.median.mean(), mark, markersize=7, color=colour, label=name)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlim(x[0], x[-1])
    lowest = min(float(mask.median.mean()) for mask in masks.values())
    ax.set_ylim(max(min(lowest, float(bound[0])) / 2, 1e-6), 1.2)
    ax.set_xlabel("mean LSR: to the left, lasers are weaker")
    ax.set_ylabel("contrast: dot median, ring rms")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure
