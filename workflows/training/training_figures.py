"""Figures of a training: the curves of its losses, and pictures before and after the network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from neusee.workflows.report.figures.style import BLUE, VERMILION, canvas, drawn
from neusee.workflows.training.loop.checkpoint import loss_curve

_SHOWN = ("LSR", "BSR", "L1", "reconstruction", "adversarial", "critics", "penalty", "rate")
_GAP = 4  #: pixels between pictures


@drawn
def curves(rows: Sequence[Mapping[str, str]]) -> Any:
    """Draw each loss over the iterations, the second stage after the first: pale as it is, full as a running median."""
    names = [name for name in _SHOWN if any(row[name] for row in rows)]
    figure, axes = canvas(11.0, 2.4 * -(-len(names) // 2), -(-len(names) // 2), 2)
    first = 1 + max((int(r["iteration"]) for r in rows if r["stage"] == "1"), default=-1)
    for ax, name in zip(axes.flat, names, strict=False):
        for stage, colour in ((1, BLUE), (2, VERMILION)):
            at, values = loss_curve(rows, stage, name)
            at = [i + first * (stage == 2) for i in at]
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
    """Return the running median, over about a twentieth of the values."""
    import statistics

    half = max(1, len(values) // 40)
    return [statistics.median(values[max(0, i - half) : i + half + 1]) for i in range(len(values))]


def strip(pictures: Sequence[Tensor]) -> bytes:
    """Return linear pictures (3, y, x) side by side as an sRGB PNG."""
    import io

    from kornia.color import linear_rgb_to_rgb
    from PIL import Image

    gap = torch.ones(3, pictures[0].shape[-2], _GAP)
    parts = [part for p in pictures for part in (p.detach().cpu().float().clamp(0, 1), gap)][:-1]
    codes = (linear_rgb_to_rgb(torch.cat(parts, -1)[None])[0].clamp(0, 1) * 255).round().to(torch.uint8)
    memory = io.BytesIO()
    Image.fromarray(codes.permute(1, 2, 0).numpy()).save(memory, "PNG")
    return memory.getvalue()
