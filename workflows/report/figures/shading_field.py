"""The smooth transmission that frames share, and how far it is known."""

from __future__ import annotations

from typing import Any

from neusee.nodes.values import Shading
from neusee.workflows.report.figures.style import canvas, drawn, picture

NORMAL = 1.645  #: standard deviations at the ends of an interval of 90 %


@drawn
def transmission(*, shading: Shading) -> Any:
    """Draw the estimated transmission at each knot, and half the width of its 90 % interval."""
    figure, axes = canvas(8.0, 4.0, 1, 2)
    wide = NORMAL * shading.deviation
    applied = "frame divided by it" if bool(shading.identifiable) else "not identifiable: frame left as it is"
    fields = (
        (shading.estimate.exp(), f"transmission, {applied}"),
        (shading.estimate.exp() * wide.sinh(), "90 % interval, ±"),
    )
    for ax, (values, title) in zip(axes[0], fields, strict=True):
        shown = picture(ax, values.cpu().numpy(), title, cmap="viridis")
        bar = figure.colorbar(shown, ax=ax, fraction=0.046, pad=0.03)
        bar.set_label("relative to the geometric mean", fontsize=9)
        bar.ax.tick_params(labelsize=9)
    return figure
