"""Figures of an estimate of safety: irradiance over distance with its limits, and zones of distance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from neusee.workflows.report.figures.style import BLACK, BLUE, GREEN, ORANGE, VERMILION, canvas, drawn
from neusee.workflows.safety.damage_pattern import DamagePattern
from neusee.workflows.safety.dead_pixels import DeadPixels
from neusee.workflows.safety.distance_zones import QUANTILES
from neusee.workflows.safety.safety_estimate import Estimate, Finding

_COLOURS = (VERMILION, ORANGE, "#CC79A7", "#56B4E9", "#8c510a", "#7f7f7f")
_BELOW = 1.5  #: decades below the peak of a spot that a picture of the spot shows at least
_DASHES = ("-", "--", ":", "-.", (0, (5, 1)), (0, (1, 1)))
_NAMES = {"irradiance": "irradiance at the lens (W/m2)", "fluence": "fluence of a pulse at the lens (J/m2)"}


@drawn
def over_distance(found: Estimate) -> Any:
    """Draw the exposure at the lens over the distance, and the limits at the lens behind the plain lens."""
    plain = [each for each in found.findings if each.option == found.options[0].name]
    kinds = list(dict.fromkeys(["fluence" if found.exposures.beams[0].is_pulsed else "irradiance",
                                *(each.limit.quantity for each in plain if _has_mean(found))]))  # fmt: skip
    figure, axes = canvas(9.0, 4.6 * len(kinds), len(kinds), 1)
    for axis, kind in zip(axes[:, 0], kinds, strict=True):
        _panel(axis, found, kind, [each for each in plain if each.limit.quantity == kind])
    return figure


def _has_mean(found: Estimate) -> bool:
    return found.exposures.beams[0].power is not None


def _panel(axis: Any, found: Estimate, kind: Any, findings: list[Finding]) -> None:
    at = found.exposures.distances
    curve = found.exposures.emitted(kind) * found.exposures.lens
    low, high = np.quantile(curve[1:], QUANTILES, axis=0)
    axis.fill_between(at, low, high, color=BLUE, alpha=0.25, linewidth=0)
    axis.plot(at, curve[0], color=BLUE, linewidth=2, label="laser")
    for i, each in enumerate(findings):
        colour, dash = _COLOURS[i % len(_COLOURS)], _DASHES[i % len(_DASHES)]
        axis.fill_between(at, each.curve[1], each.curve[2], color=colour, alpha=0.15, linewidth=0)
        axis.plot(at, each.curve[0], color=colour, linestyle=dash, label=each.limit.name)
    if found.eye and found.eye.quantity == kind:
        axis.plot(at, np.full_like(at, found.eye.limit), color=GREEN, linewidth=2, label="eye (MPE)")
    axis.axvline(found.safety.laser.distance, color=BLACK, linewidth=0.8)
    axis.set(xscale="log", yscale="log", xlabel="distance (m)", ylabel=_NAMES[kind], xlim=(at[0], at[-1]))
    shown = np.concatenate([curve[0], *(each.curve[0] for each in findings)])
    axis.set_ylim(shown.min() / 5, shown.max() * 5)
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


@drawn
def spots(patterns: Sequence[DamagePattern]) -> Any:
    """Draw the exposure on the sensor over the limit of damage: red above the limit, blue below."""
    figure, axes = canvas(4.6 * len(patterns), 4.0, 1, len(patterns))
    for axis, each in zip(axes[0], patterns, strict=True):
        half, brightest = each.width / 2 * 1e6, float(np.log10(each.peak))
        decades = max(1.0, brightest, _BELOW - brightest)  # a spot far below the limit is seen too
        light = np.log10(np.maximum(each.ratio, 10.0**-decades))
        limits = {"vmin": -decades, "vmax": decades}
        shown = axis.imshow(light, cmap="RdBu_r", extent=(-half, half, -half, half), **limits)
        axis.set(title=f"{each.option}: {each.limit}", xlabel="um", ylabel="um")
        axis.grid(False)
        figure.colorbar(shown, ax=axis, label="log10 of exposure over limit", shrink=0.8)
    return figure


@drawn
def zones(found: Estimate) -> Any:
    """Draw the zones of distance of each limit behind each protection, with the intervals of their ends."""
    rows = list(found.findings)
    figure, axes = canvas(9.0, 1.2 + 0.32 * (len(rows) + 1))
    axis, at = axes[0, 0], found.exposures.distances
    labels = []
    for i, each in enumerate(rows):
        labels.append(f"{each.option}, {each.limit.name}")
        colour = VERMILION if each.limit.effect == "damage" else ORANGE
        for zone in each.zones.zones:
            axis.barh(i, zone.far.value - zone.near.value, left=zone.near.value, height=0.6, color=colour)
            for end in (zone.near, zone.far):
                axis.plot([end.low, end.high], [i, i], color=BLACK, linewidth=1.5)
    if found.eye:
        labels.append("eye, unaided (NOHD)")
        reach = min(found.eye.distance.value, at[-1])
        axis.barh(len(rows), max(reach - at[0], 0.0), left=at[0], height=0.6, color=GREEN)
        ends = np.clip([found.eye.distance.low, found.eye.distance.high], at[0], at[-1])
        axis.plot(ends, [len(rows)] * 2, color=BLACK, linewidth=1.5)
    axis.axvline(found.safety.laser.distance, color=BLACK, linewidth=0.8)
    axis.set(xscale="log", xlabel="distance (m)", xlim=(at[0], at[-1]), ylim=(len(labels) - 0.4, -0.6))
    axis.set_yticks(range(len(labels)), labels)
    axis.grid(False, axis="y")
    return figure


@drawn
def dazzled_share(found: Estimate) -> Any:
    """Draw the share of the picture that the laser saturates against the mean irradiance at the lens."""
    figure, axes = canvas(9.0, 4.4)
    axis = axes[0, 0]
    for i, each in enumerate(found.dazzled):
        shown = each.curve > 0
        look = {"color": (BLUE, *_COLOURS)[i], "linestyle": _DASHES[i % len(_DASHES)]}
        axis.plot(each.at_lens[shown], each.curve[shown], label=each.option, **look)
    assert found.safety.settings.dazzle is not None
    axis.axhline(found.safety.settings.dazzle.share, color=BLACK, linewidth=0.8, linestyle=":")
    axis.axvline(found.mean_at_lens, color=BLACK, linewidth=0.8)
    axis.set(
        xscale="log", yscale="log", xlabel="mean irradiance at the lens (W/m2)", ylabel="share of saturated pixels"
    )
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


@drawn
def dead_frames(dead: Sequence[DeadPixels]) -> Any:
    """Draw a part of the raw frame of an evenly grey scene with its dead pixels, behind each protection."""
    figure, axes = canvas(3.6 * len(dead), 3.8, 1, len(dead))
    for axis, each in zip(axes[0], dead, strict=True):
        half = each.frame.shape[0] / 2
        axis.imshow(each.frame, cmap="gray", vmin=0, vmax=1, extent=(-half, half, -half, half), interpolation="nearest")
        axis.set(title=f"{each.option}\n{', '.join(each.kinds) or 'no damage'}", xlabel="pixels", ylabel="pixels")
        if "frame" in each.kinds:
            box = {"facecolor": "white", "edgecolor": "none"}
            axis.text(0.5, 0.9, "no valid frame", transform=axis.transAxes, ha="center", va="center", bbox=box)
        axis.grid(False)
    return figure
