"""Figures of a training: loss curves, and pictures before and after restoration."""

from __future__ import annotations

import io
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from neusee.workflows.report.figures.style import BLUE, VERMILION, canvas, drawn, encoded

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
