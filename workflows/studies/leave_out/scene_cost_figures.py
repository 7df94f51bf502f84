"""The picture of what simpler scenes cost."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from neusee.workflows.report.figures.style import BLUE, canvas, drawn
from neusee.workflows.studies.leave_out.scene_costs import Cost

_WAITING = "#9DB8CC"


@drawn
def bars(costs: Sequence[Cost]) -> Any:
    """Seconds of each scene: in its steps, and in the engine beside them."""
    figure, axes = canvas(8.0, 0.42 * len(costs) + 1.0)
    ax = axes[0, 0]
    names = [cost.scene for cost in costs]
    inside = [min(cost.computing, cost.seconds) for cost in costs]
    ax.barh(names, inside, color=BLUE, label="in the steps")
    beside = [cost.seconds - part for cost, part in zip(costs, inside, strict=True)]
    ax.barh(names, beside, left=inside, color=_WAITING, label="reading, keeping, choosing")
    for row, cost in enumerate(costs):
        ax.annotate(f" {cost.seconds:.3g} s", (cost.seconds, row), va="center", fontsize=9)
    ax.invert_yaxis()
    ax.grid(False, axis="y")
    ax.set_xlabel("seconds, from an empty store")
    ax.set_xlim(0, 1.15 * max(cost.seconds for cost in costs))
    ax.legend(loc="lower right")
    return figure
