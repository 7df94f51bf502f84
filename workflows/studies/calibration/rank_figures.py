"""The picture of simulation-based calibration: how the truth ranks among draws, parameter by parameter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from neusee.workflows.report.figures.style import BLUE, VERMILION, canvas, drawn
from neusee.workflows.studies.calibration.independent_draws import DRAWS
from neusee.workflows.studies.calibration.rank_uniformity import BINS, Verdict, band

_SURE = 0.99
_GREY = "#777777"


@drawn
def ranks(verdicts: Sequence[Verdict]) -> Any:
    """A histogram each; the band holds 99 of 100 bins of uniform ranks."""
    columns = min(3, len(verdicts))
    rows = -(-len(verdicts) // columns)
    figure, axes = canvas(3.4 * columns, 2.4 * rows + 0.4, rows, columns, sharex=True)
    for ax, verdict in zip(axes.flat, verdicts, strict=False):
        _histogram(ax, verdict)
    for ax in list(axes.flat)[len(verdicts) :]:
        ax.set_axis_off()
    figure.supxlabel(f"draws below the truth, of {DRAWS}", fontsize=10)
    figure.supylabel("simulations", fontsize=10)
    return figure


def _histogram(ax: Any, verdict: Verdict) -> None:
    total, width = sum(verdict.counts), (DRAWS + 1) / BINS
    low, high = band(total, 1.0 / BINS, _SURE)
    ax.axhspan(low, high, color="#cccccc", alpha=0.6, linewidth=0)
    ax.axhline(total / BINS, color=_GREY, linewidth=0.8)
    colour = BLUE if verdict.uniform else VERMILION
    ax.bar([(i + 0.5) * width for i in range(BINS)], verdict.counts, 0.92 * width, color=colour, alpha=0.85)
    ax.set_title(f"{verdict.name.replace('_', ' ')}: p = {verdict.p:.2g}")
    ax.set_ylim(0, 1.15 * max(high, *verdict.counts))
    ax.grid(False, axis="x")
    ax.set_axisbelow(True)
