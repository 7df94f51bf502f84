"""Figures of a training: loss curves, and pictures before and after restoration."""

from __future__ import annotations

import io
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from neusee.workflows.report.figures.style import BLACK, BLUE, GREEN, VERMILION, canvas, drawn, encoded

_SHOWN = ("LSR", "BSR", "L1", "reconstruction", "adversarial", "critics", "penalty", "rate")
_GAP = 4  #: pixels between pictures


@drawn
def curves(rows: Sequence[Mapping[str, str]]) -> Any:
    """Draw each training loss and its running median over the iterations of both training stages."""
    names = [name for name in _SHOWN if any(row[name] for row in rows)]
    figure, axes = canvas(11.0, 2.4 * -(-len(names) // 2), -(-len(names) // 2), 2)
    first = 1 + max((int(r["iteration"]) for r in rows if r["stage"] == "1"), default=-1)
    for ax, name in zip(axes.flat, names, strict=False):
        for stage, colour in ((1, BLUE), (2, VERMILION)):
            shown = [row for row in rows if row["stage"] == str(stage) and row[name]]
            at = [int(row["iteration"]) + first * (stage == 2) for row in shown]
            values = [float(row[name]) for row in shown]
            ax.plot(at, values, color=colour, alpha=0.25, linewidth=0.7)
            ax.plot(at, running_median(values), color=colour, linewidth=1.5, label=f"stage {stage}")
        if name in ("LSR", "L1", "reconstruction", "rate"):
            ax.set_yscale("log", nonpositive="mask")
        ax.set_title(name)
    for ax in list(axes.flat)[len(names) :]:
        ax.set_axis_off()
    axes.flat[0].legend()
    figure.supxlabel("iteration")
    return figure


@drawn
def held_out_curves(rows: Sequence[Mapping[str, str]], best: int) -> Any:
    """Draw training loss and held-out PSNR over the iterations of both stages, with the level of the network's input.

    ``best`` is the number of iterations of stage 2 before the best state, or 0 if no state is the best.
    """
    figure, axes = canvas(9.0, 6.4, 2, 1, sharex=True)
    first = sum(row["stage"] == "1" for row in rows)
    name = "reconstruction" if any(row["reconstruction"] for row in rows) else "L1"
    loss = [(float(_at(row, first)), float(row[name])) for row in rows if row[name]]
    at, values = zip(*loss, strict=True)
    axes[0, 0].plot(at, values, color=BLUE, alpha=0.25, linewidth=0.7)
    axes[0, 0].plot(at, running_median(values), color=BLUE, linewidth=1.5)
    axes[0, 0].set_yscale("log", nonpositive="mask")
    axes[0, 0].set_ylabel(f"training: {name} loss")
    judged = [row for row in rows if row.get("held_out_PSNR")]
    _draw_held_out(axes[1, 0], judged, first)
    for ax in axes[:, 0]:
        if 0 < first < len(rows):
            ax.axvline(first, color=BLACK, linewidth=0.8, linestyle=":")
            ax.annotate("stage 2", (first, 1), (3, -12), ("data", "axes fraction"), "offset points", fontsize=9)
        if best:
            ax.axvline(first + best, color=GREEN, linewidth=1.0, label=f"best: after {best} iterations of stage 2")
    axes[1, 0].set(xlabel="iteration", ylabel="held-out pictures: PSNR (dB)")
    figure.legend(*axes[1, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _draw_held_out(ax: Any, judged: Sequence[Mapping[str, str]], first: int) -> None:
    at = [_at(row, first) for row in judged]
    for who, colour, text in (("held_out", VERMILION, "network"), ("input", BLACK, "input of the network")):
        values = [float(row[f"{who}_PSNR"]) for row in judged]
        style = "--" if who == "input" else "-"
        ax.plot(at, values, color=colour, linestyle=style, marker=".", linewidth=1.5, label=text)
    with_ends = [row for row in judged if row["held_out_PSNR_low"]]
    low, high = ([float(row[f"held_out_PSNR_{end}"]) for row in with_ends] for end in ("low", "high"))
    label = "90 % interval of the mean over photographs"
    ax.fill_between([_at(row, first) for row in with_ends], low, high, color=VERMILION, alpha=0.15, label=label)


def _at(row: Mapping[str, str], first: int) -> int:
    """Return the number of iterations of both stages after the iteration of a row."""
    return int(row["iteration"]) + 1 + first * (row["stage"] == "2")


def running_median(values: Sequence[float]) -> list[float]:
    """Return the running median of a sequence of numbers, in a window of about 1/20 of the sequence length."""
    half = max(1, len(values) // 40)
    return [statistics.median(values[max(0, i - half) : i + half + 1]) for i in range(len(values))]


def strip(pictures: Sequence[Tensor]) -> Any:
    """Place pictures (3, y, x) in linear sRGB side by side, and return one 8-bit sRGB array (y, x, 3)."""
    gap = torch.ones(3, pictures[0].shape[-2], _GAP)
    parts = [part for picture in pictures for part in (picture.detach().cpu(), gap)][:-1]
    return (encoded(torch.cat(parts, -1)) * 255).round().astype("uint8")


def png(codes: Any) -> bytes:
    """Encode an 8-bit array (y, x, 3) as a PNG file."""
    from PIL import Image

    memory = io.BytesIO()
    Image.fromarray(codes).save(memory, "PNG")
    return memory.getvalue()
