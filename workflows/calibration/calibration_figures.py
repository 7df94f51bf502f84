"""The pictures of a calibration: photon-transfer curve, rings about a source, and traces of the chains."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from neusee.workflows.report.figures.style import BLACK, BLUE, ORANGE, VERMILION, canvas, drawn

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from neusee.workflows.calibration.log_posterior import FloatArray

_BAND = (5.0, 50.0, 95.0)  #: percentiles
_POINTS = 1500  #: most points of a chain in the picture
_LEAST = 0.1  #: DN², the variance at which a level without scatter is drawn
_CLIPPED = {"marker": "v", "color": VERMILION, "markerfacecolor": "none"}
COUNTED = "clipped or coarse: numbers counted one by one; variance at most as drawn"


@drawn
def transfer(
    measured: FloatArray,
    predicted: FloatArray,
    whole: NDArray[np.bool_],
    other: str,
    means: FloatArray | None = None,
) -> Any:
    """Draw the photon-transfer curve, and the deviation of each light level from the posterior's prediction.

    ``measured`` (2, level) has mean and variance, and ``predicted`` (2, draw, level) mean and variance of a repeated
    measurement. ``whole`` (level,) is False for levels without a prediction, which the label ``other`` describes.
    ``means`` (level,) are the deviations of the means from the light in standard deviations, if the light is uncertain.
    """
    rows = 2 if means is None else 3
    figure, axes = canvas(9.0, 4.8 + 1.2 * rows, rows, 1, sharex=True, height_ratios=(2.2, *(rows - 1) * (1.0,)))
    above = axes[0, 0]
    order = np.flatnonzero(whole)[np.argsort(predicted[0].mean(0)[whole])]
    mean, (low, middle, high) = predicted[0].mean(0)[order], np.percentile(predicted[1], _BAND, axis=0)[:, order]
    above.fill_between(mean, low, high, color=BLUE, alpha=0.25, linewidth=0, label="predicted, 90 %")
    above.plot(mean, middle, color=BLUE, linewidth=1.2, label="predicted, median")
    lowest = max(_LEAST, 0.5 * float(min([*measured[1, whole], *middle], default=_LEAST)))
    for at, style in (
        (whole, {"marker": "o", "color": BLACK, "label": "measured"}),
        (~whole, {**_CLIPPED, "label": other}),
    ):
        if at.any():
            above.plot(measured[0, at], measured[1, at].clip(lowest), linestyle="", markersize=5, **style)
    above.set(xscale="log", yscale="log", ylabel="temporal variance (DN²)", title="Photon-transfer curve")
    above.set_ylim(bottom=lowest / 2)  # a clipped level does not stretch the axis
    above.legend(loc="upper left")
    distance = (measured[1, whole] - predicted[1].mean(0)[whole]) / predicted[1].std(0)[whole]
    _distances(axes[1, 0], measured[0, whole], distance, "variance: distance\nin sd")
    if means is not None:
        _distances(axes[2, 0], measured[0, whole], means[whole], "mean: distance\nin sd")
    axes[-1, 0].set_xlabel("mean (DN)")
    return figure


def _distances(ax: Any, at: FloatArray, distance: FloatArray, label: str) -> None:
    """Draw distances from a prediction in standard deviations, over a band of two standard deviations."""
    ax.axhspan(-2, 2, color=BLUE, alpha=0.12, linewidth=0)
    ax.axhline(0, color=BLUE, linewidth=1.0)
    ax.plot(at, distance, "o", color=BLACK, markersize=5)
    reach = max(3.5, 1.1 * float(np.abs(distance).max(initial=0.0)))
    ax.set(ylabel=label, ylim=(-reach, reach))


@drawn
def rings(
    radius: FloatArray, cut: FloatArray, measured: FloatArray, predicted: FloatArray, variance: FloatArray
) -> Any:
    """Draw the signal of the rings about an overexposed source over the radius, and its deviation from the prediction.

    ``measured`` (ring,) and ``predicted`` and ``variance`` (draw, ring) are electrons of a pixel and their squares;
    ``cut`` (cut,) are the radii of the rings that are cut off.
    """
    figure, axes = canvas(9.0, 7.2, 2, 1, sharex=True, height_ratios=(2.2, 1.0))
    above, below = axes[0, 0], axes[1, 0]
    low, middle, high = np.percentile(predicted, _BAND, axis=0)
    above.fill_between(radius, low, high, color=BLUE, alpha=0.25, linewidth=0, label="predicted, 90 %")
    above.plot(radius, middle, color=BLUE, linewidth=1.2, label="predicted, median")
    seen = measured > 0
    above.plot(radius[seen], measured[seen], "o", color=BLACK, markersize=4, label="measured")
    if len(cut):
        ends = float(cut.min()) - 0.5, float(cut.max()) + 0.5  # a ring is one pixel wide
        above.axvspan(*ends, color=VERMILION, alpha=0.3, linewidth=0, label="cut off")
    above.set(xscale="log", yscale="log", ylabel="signal (e- of a pixel)", title="Rings about the source")
    above.legend(loc="lower left")
    width = np.sqrt(predicted.var(0) + variance.mean(0))
    _distances(below, radius, (measured - predicted.mean(0)) / width, "distance in sd\nof the prediction")
    below.set_xlabel("distance from the source (pixels)")
    below.xaxis.set_major_formatter("{x:g}")
    below.xaxis.set_minor_formatter("{x:g}")
    return figure


@drawn
def traces(draws: FloatArray, labels: Sequence[str]) -> Any:
    """Draw a trace plot of each coordinate: the median and the middle 90 % of the walkers of each ensemble."""
    count = len(labels)
    figure, axes = canvas(9.0, 1.35 * count + 0.5, count, 1, sharex=True)
    every = max(1, draws.shape[1] // _POINTS)
    for i, label in enumerate(labels):
        ax = axes[i, 0]
        for ensemble, colour in zip(draws[:, ::every, :, i], (BLUE, ORANGE, "#009E73", VERMILION), strict=False):
            low, middle, high = np.percentile(ensemble, _BAND, axis=1)
            steps = np.arange(len(middle)) * every
            ax.fill_between(steps, low, high, color=colour, alpha=0.12, linewidth=0)
            ax.plot(steps, middle, color=colour, linewidth=0.8)
        ax.set_ylabel(label, fontsize=9, rotation=0, ha="right", va="center", labelpad=8)
        ax.ticklabel_format(axis="y", useOffset=False)
    axes[-1, 0].set_xlabel("step after the discarded steps")
    return figure
