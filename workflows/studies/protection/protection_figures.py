"""Pictures of the protection study: where the mask wins, NEQ by frequency, bounds, and pictures under attack."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from neusee.workflows.protection.equal_rivals import MEASURES
from neusee.workflows.protection.protection_result import (
    DRAWN,
    LEVELS,
    LIGHTS,
    SHOWN_AT,
    STRENGTHS,
    ProtectionResult,
)
from neusee.workflows.report.figures.style import BLACK, BLUE, GREEN, ORANGE, VERMILION, canvas, drawn

_LOOKS: Mapping[str, tuple[str, str]] = {
    "open lens": (BLACK, ":"),
    "grey filter": ("#777777", "-"),
    "stop and filter": (BLUE, "-"),
    "smaller stop": (GREEN, "--"),
    "mask": (VERMILION, "-"),
    "mask and stop": (ORANGE, "-."),
}
_LIGHT = "scene light (e- a pixel)"
_FINE = 121  #: values along each side of the maps
_MOST = 8.0  #: dB, at which the colours of the maps end


@drawn
def winning_region(result: ProtectionResult) -> Any:
    """Draw the gain of the mask over the best stop-and-filter by scene light and protection; hatched: the mask wins."""
    figure, axes = canvas(11.6, 4.1, 1, len(DRAWN), sharey=True)
    levels = sorted({result.own, *LEVELS})
    light, level = (np.geomspace(min(ends), max(ends), _FINE) for ends in (LIGHTS, levels))
    for ax, measure in zip(axes[0], DRAWN, strict=True):
        gain = _between(levels, [[result.gain[level][n][measure] for n in LIGHTS] for level in levels])
        shown = ax.pcolormesh(light, level, gain.clip(-_MOST, _MOST), cmap="RdBu", vmin=-_MOST, vmax=_MOST,
                              shading="gouraud", rasterized=True)  # fmt: skip
        if gain.max() > 0 > gain.min():
            ax.contour(light, level, gain, levels=[0.0], colors=BLACK, linewidths=1.4)
        if gain.max() > 0:
            ax.contourf(light, level, gain, levels=[0.0, gain.max() + 1], colors="none", hatches=["//"])
        ax.axhline(result.own, color=BLACK, linewidth=1.0, linestyle="--")
        ax.set(xscale="log", yscale="log", xlabel=_LIGHT, title=MEASURES[measure])
        ax.title.set_fontsize(10)
        ax.grid(False)
    axes[0, 0].set_ylabel("protection: share of the harm\nof the open lens")
    figure.colorbar(shown, ax=list(axes[0]), label="gain of the mask (dB)", pad=0.01, extend="both")
    return figure


def _between(levels: Sequence[float], gain: Sequence[Sequence[float]]) -> Any:
    """Return a gain (level, light) on a finer grid, by linear interpolation in the logarithms of level and light."""
    x, y = (np.linspace(np.log(min(ends)), np.log(max(ends)), _FINE) for ends in (LIGHTS, levels))
    rows = np.array([np.interp(x, np.log(LIGHTS), row) for row in gain])
    return np.array([np.interp(y, np.log(levels), column) for column in rows.T]).T


@drawn
def gain_with_bounds(result: ProtectionResult) -> Any:
    """Draw the gain of the mask by scene light, with the middle 90 % of the draws, and the bound of its gain in NEQ."""
    figure, axes = canvas(11.0, 4.2, 1, 2)
    left, right = axes[0]
    for measure, colour in zip(DRAWN, (BLUE, ORANGE, VERMILION), strict=True):
        low, up = np.quantile([result.drawn[n][measure] for n in LIGHTS], [0.05, 0.95], axis=1)
        left.fill_between(LIGHTS, low, up, color=colour, alpha=0.3, linewidth=0)
        own = [result.gain[result.own][n][measure] for n in LIGHTS]
        left.plot(LIGHTS, own, color=colour, label=MEASURES[measure])
    left.axhline(0.0, color=BLACK, linewidth=0.9)
    left.set(xscale="log", xlabel=_LIGHT, ylabel="gain of the mask (dB)")
    left.set_title("over the best stop-and-filter, all wavelengths")
    left.legend()
    value, bound = (10 * np.log10([result.bound[n][i] for n in LIGHTS]) for i in (0, 1))
    right.plot(LIGHTS, value, color=VERMILION, label="this mask")
    right.plot(LIGHTS, bound, color=BLACK, linestyle="--", label="bound of every mask of this peak")
    right.fill_between(
        LIGHTS, bound, max(bound) + 3, color="#777777", alpha=0.2, linewidth=0, label="no mask can be here"
    )
    right.axhline(0.0, color=BLACK, linewidth=0.9)
    right.set(xscale="log", xlabel=_LIGHT, ylabel="gain in mean NEQ (dB)", ylim=(None, max(bound) + 3))
    right.set_title("one wavelength, whole lens band, no glare")
    right.legend(loc="upper right")
    return figure


@drawn
def neq_by_frequency(result: ProtectionResult) -> Any:
    """Draw the noise equivalent quanta of each rival by spatial frequency, at one scene light."""
    figure, axes = canvas(7.4, 4.8)
    ax = axes[0, 0]
    for name, label in _labels(result).items():
        colour, line = _LOOKS[name]
        ax.plot(result.radius, result.curves[name], color=colour, linestyle=line, label=label)
    top = max(map(max, result.curves.values()))
    ax.set(yscale="log", ylim=(top * 1e-8, top * 3), xlabel="spatial frequency (cycles a pixel)", ylabel="NEQ (e-)")
    ax.set_title(f"quiet frame, {SHOWN_AT:g} e- a pixel: mean over directions")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


@drawn
def under_attack(result: ProtectionResult) -> Any:
    """Draw information and seen pixels of each rival by strength of the laser: median and middle 90 % of the draws."""
    figure, axes = canvas(11.0, 4.4, 1, 2)
    for name, label in _labels(result).items():
        colour, line = _LOOKS[name]
        _band(axes[0, 0], result.attack[name]["information"], colour, line, label)
        _band(axes[0, 1], [[100 * x for x in row] for row in result.attack[name]["seen"]], colour, line, label)
    for ax, shown in zip(axes[0], ("information (bits a pixel)", "pixels that are not full (%)"), strict=True):
        ax.set(xscale="log", xlabel="strength of the laser (wells in the brightest pixel, open lens)", ylabel=shown)
        ax.xaxis.label.set_fontsize(9)
    axes[0, 0].set_yscale("log")
    top = max(max(map(max, one["information"])) for one in result.attack.values())
    axes[0, 0].set_ylim(top * 1e-5, top * 2)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def _labels(result: ProtectionResult) -> dict[str, str]:
    """Return the rivals to draw, with their labels; where the best stop needs no filter, two rivals are one curve."""
    labels = {name: name for name in _LOOKS if name in result.rivals}
    both, stop = (result.rivals[name].said for name in ("stop and filter", "smaller stop"))
    if both == stop:
        del labels["smaller stop"]
        labels["stop and filter"] = "smaller stop, the best stop and filter"
    return labels


def _band(ax: Any, rows: Sequence[Sequence[float]], colour: str, line: str, name: str) -> None:
    low, middle, up = np.quantile(np.maximum(rows, 1e-12), [0.05, 0.5, 0.95], axis=0)
    ax.fill_between(STRENGTHS, low, up, color=colour, alpha=0.15, linewidth=0)
    ax.plot(STRENGTHS, middle, color=colour, linestyle=line, label=name)
