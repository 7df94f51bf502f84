"""Figure of the photon-transfer curve: standard deviation over mean signal of simulated flat fields of the sensor."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from neusee.workflows.report.figures.style import BLACK, BLUE, GREEN, VERMILION, canvas, drawn

_CLIPPED = 0.5  #: a level with less than this share of the predicted variance is clipped by the well or the converter
_OPEN = {"color": VERMILION, "markersize": 6, "markerfacecolor": "none"}


@drawn
def transfer(*, measured: Tensor) -> Any:
    """Draw the photon-transfer curve of a sensor from a table of signal DN, variance DN² and predicted variance DN².

    The first row is measured without light. The axes follow the levels that are not clipped, and a triangle marks each
    clipped level.
    """
    signal, variance, predicted = measured.detach().double().cpu().unbind(1)
    figure, axes = canvas(6.6, 4.4)
    ax = axes[0, 0]
    lit = signal > 0
    clipped = lit & (variance < _CLIPPED * predicted)
    seen = lit & ~clipped & (variance > 0)
    light, floor = signal[seen], float(predicted[0].sqrt())
    ax.loglog(light.numpy(), variance[seen].sqrt().numpy(), "o", color=BLACK, markersize=4, label="flat fields")
    ax.loglog(light.numpy(), predicted[seen].sqrt().numpy(), "-", color="#777777", linewidth=1.2, label="predicted")
    shot = (predicted[seen] - predicted[0]).clamp_min(0.0).sqrt()
    ax.loglog(light.numpy(), shot.numpy(), "--", color=BLUE, label="shot noise, slope ½")
    if floor > 0:  # a sensor without noise has no floor, which a logarithmic axis could not show
        ax.axhline(floor, color=GREEN, linestyle="-.", label=f"dark noise, {floor:.3g} DN, slope 0")
    full = float(signal.max())
    ax.axvline(full, color=VERMILION, linestyle=":", label=f"largest signal, {full:,.0f} DN above dark")
    least = min([x for x in (floor, *variance[seen].sqrt().tolist()) if x > 0], default=1.0) / 3
    if bool(clipped.any()):
        heights = variance[clipped].sqrt().clamp_min(1.3 * least)
        ax.loglog(signal[clipped].numpy(), heights.numpy(), "v", label="clipped: noise at most as drawn", **_OPEN)
    ax.set_ylim(least, 3 * max(float(predicted.max().sqrt()), least))
    title = "photon-transfer curve of this sensor"
    ax.set(title=title, xlabel="mean above dark (DN)", ylabel="standard deviation (DN)")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=2)
    return figure
