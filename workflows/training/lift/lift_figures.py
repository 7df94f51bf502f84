"""Figures of the training of a network that estimates spectra from RGB: error curves, estimated and true spectra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from neusee.workflows.report.figures.point_labels import PointLabel, place_labels
from neusee.workflows.report.figures.style import BLACK, BLUE, ORANGE, canvas, drawn, encoded, picture
from neusee.workflows.training.training_figures import running_median

_SHOWN = ("MRAE", "RMSE", "rate")
_LOOKS = {"mst_plus_plus": {"color": BLUE}, "linear": {"color": ORANGE, "linestyle": "--"}}


@drawn
def lift_curves(rows: Sequence[Mapping[str, str]]) -> Any:
    """Draw each training error and its running median over the iterations of the training."""
    figure, axes = canvas(11.0, 3.0, 1, len(_SHOWN))
    for ax, name in zip(axes.flat, _SHOWN, strict=True):
        values = [float(row[name]) for row in rows]
        ax.plot(values, color=BLUE, alpha=0.25, linewidth=0.7)
        ax.plot(running_median(values), color=BLUE, linewidth=1.5)
        ax.set_yscale("log", nonpositive="mask")
        ax.set_title(name)
    figure.supxlabel("iteration")
    return figure


@drawn
def lifted_spectra(shown: Tensor, truth: Tensor, estimates: Mapping[str, Tensor], centres: Tensor) -> Any:
    """Draw a picture, and the true spectra (black) and the estimated spectra of five pixels of the picture."""
    figure, axes = canvas(13.0, 2.6, 1, 6)
    y, x = shown.shape[-2:]
    at = [(y * (2 * i + 1) // 10, x * (2 * ((3 * i) % 5) + 1) // 10) for i in range(5)]
    picture(axes[0, 0], encoded(shown), "picture")
    axes[0, 0].plot([c for _, c in at], [r for r, _ in at], "o", color=BLACK, markerfacecolor="white", markersize=5)
    nm = (centres * 1e9).cpu().numpy()
    for number, (ax, (row, column)) in enumerate(zip(axes[0, 1:], at, strict=True), 1):
        ax.plot(nm, truth[:, row, column].cpu().numpy(), color=BLACK, linewidth=1.5, label="truth")
        for name, cube in estimates.items():
            ax.plot(nm, cube[:, row, column].cpu().numpy(), linewidth=1.2, label=name, **_LOOKS[name])
        ax.set_title(f"pixel {number}")
        ax.set_ylim(bottom=0)
    axes[0, 1].set_ylabel("reflectance")
    figure.legend(*axes[0, 1].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    figure.supxlabel("wavelength (nm)")
    place_labels(figure, {axes[0, 0]: [PointLabel(c, r, str(i), BLACK) for i, (r, c) in enumerate(at, 1)]})
    return figure
