"""The page of a training: losses, held-out pictures and the best state."""

from __future__ import annotations

import io
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neusee.workflows.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    VERMILION,
    canvas,
    drawn,
    encoded,
)
from neusee.workflows.report.study_page import Section, page
from neusee.workflows.training.loop.resumable_loop import write_whole

# --- training figures -----------------------------------------------------------------------------

# Figures of a training: loss curves, and pictures before and after restoration.


_SHOWN = ("LSR", "BSR", "L1", "reconstruction", "adversarial", "critics", "penalty", "rate")
_GAP = 4  #: pixels between pictures


@drawn
def curves(rows: Sequence[Mapping[str, str]]) -> Any:
    """Draw each training loss and its running median over the iterations of both training
    stages.
    """
    names = [name for name in _SHOWN if any(row[name] for row in rows)]
    figure, axes = canvas(11.0, 2.4 * -(-len(names) // 2), -(-len(names) // 2), 2)
    first = 1 + max((int(r["iteration"]) for r in rows if r["stage"] == "1"), default=-1)
    for ax, name in zip(axes.flat, names, strict=False):
        for stage, colour in ((1, BLUE), (2, VERMILION)):
            _draw_loss(ax, rows, name, stage, first * (stage == 2), colour)
        if name in ("LSR", "L1", "reconstruction", "rate"):
            ax.set_yscale("log", nonpositive="mask")
        ax.set_title(name)
    for ax in list(axes.flat)[len(names) :]:
        ax.set_axis_off()
    axes.flat[0].legend()
    figure.supxlabel("iteration")
    return figure


def _draw_loss(
    ax: Any, rows: Sequence[Mapping[str, str]], name: str, stage: int, first: int, colour: str
) -> None:
    """Draw a loss and its running median over the iterations of a stage that begins after
    ``first`` iterations.
    """
    shown = [row for row in rows if row["stage"] == str(stage) and row[name]]
    iterations = [int(row["iteration"]) + first for row in shown]
    values = [float(row[name]) for row in shown]
    ax.plot(iterations, values, color=colour, alpha=0.25, linewidth=0.7)
    ax.plot(iterations, running_median(values), color=colour, linewidth=1.5, label=f"stage {stage}")


@drawn
def held_out_curves(rows: Sequence[Mapping[str, str]], best: int) -> Any:
    """Draw training loss and held-out PSNR over the iterations of both stages, with the level of
    the network's input.

    ``best`` is the number of iterations of stage 2 before the best state, or 0 if no state is the
    best.
    """
    figure, axes = canvas(9.0, 6.4, 2, 1, sharex=True)
    first = sum(row["stage"] == "1" for row in rows)
    _draw_training(axes[0, 0], rows, first)
    judged = [row for row in rows if row.get("held_out_PSNR")]
    _draw_held_out(axes[1, 0], judged, first)
    for ax in axes[:, 0]:
        if 0 < first < len(rows):
            ax.axvline(first, color=BLACK, linewidth=0.8, linestyle=":")
            ax.annotate(
                "stage 2",
                (first, 1),
                (3, -12),
                ("data", "axes fraction"),
                "offset points",
                fontsize=9,
            )
        if best:
            ax.axvline(
                first + best,
                color=GREEN,
                linewidth=1.0,
                label=f"best: after {best} iterations of stage 2",
            )
    axes[1, 0].set(xlabel="iteration", ylabel="held-out pictures: PSNR (dB)")
    figure.legend(*axes[1, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _draw_training(ax: Any, rows: Sequence[Mapping[str, str]], first: int) -> None:
    name = "reconstruction" if any(row["reconstruction"] for row in rows) else "L1"
    loss = [(float(_at(row, first)), float(row[name])) for row in rows if row[name]]
    iterations, values = zip(*loss, strict=True)
    ax.plot(iterations, values, color=BLUE, alpha=0.25, linewidth=0.7)
    ax.plot(iterations, running_median(values), color=BLUE, linewidth=1.5)
    ax.set_yscale("log", nonpositive="mask")
    ax.set_ylabel(f"training: {name} loss")


def _draw_held_out(ax: Any, judged: Sequence[Mapping[str, str]], first: int) -> None:
    iterations = [_at(row, first) for row in judged]
    for who, colour, text in (
        ("held_out", VERMILION, "network"),
        ("input", BLACK, "input of the network"),
    ):
        values = [float(row[f"{who}_PSNR"]) for row in judged]
        style = "--" if who == "input" else "-"
        ax.plot(
            iterations, values, color=colour, linestyle=style, marker=".", linewidth=1.5, label=text
        )
    with_ends = [row for row in judged if row["held_out_PSNR_low"]]
    low, high = (
        [float(row[f"held_out_PSNR_{end}"]) for row in with_ends] for end in ("low", "high")
    )
    label = "90 % interval of the mean over photographs"
    ax.fill_between(
        [_at(row, first) for row in with_ends], low, high, color=VERMILION, alpha=0.15, label=label
    )


def _at(row: Mapping[str, str], first: int) -> int:
    """Return the number of iterations of both stages after the iteration of a row."""
    return int(row["iteration"]) + 1 + first * (row["stage"] == "2")


def running_median(values: Sequence[float]) -> list[float]:
    """Return the running median of a sequence of numbers, in a window of about 1/20 of the
    sequence length.
    """
    half = max(1, len(values) // 40)
    return [statistics.median(values[max(0, i - half) : i + half + 1]) for i in range(len(values))]


def strip(pictures: Sequence[Tensor]) -> Any:
    """Place pictures (3, y, x) in linear sRGB side by side, and return one 8-bit sRGB array (y,
    x, 3).
    """
    gap = torch.ones(3, pictures[0].shape[-2], _GAP)
    parts = [pictures[0].detach().cpu()]
    for picture in pictures[1:]:
        parts += [gap, picture.detach().cpu()]
    return (encoded(torch.cat(parts, -1)) * 255).round().astype("uint8")


def png(codes: Any) -> bytes:
    """Encode an 8-bit array (y, x, 3) as a PNG file."""
    from PIL import Image

    memory = io.BytesIO()
    Image.fromarray(codes).save(memory, "PNG")
    return memory.getvalue()


# --- training page --------------------------------------------------------------------------------

# The page of a training: losses, held-out pictures and the best state, as one file that loads no
# other file.


PAGE = "training.html"
_NAMES = {"PSNR": "PSNR (dB)", "L1": "L1", "SSIM": "SSIM"}


def write_page(
    folder: Path, recipe: str, rows: Sequence[Mapping[str, str]], curves: bytes, facts: Any
) -> None:
    """Write the page of a training, and the figure ``held_out.png`` if photographs are held out."""
    judged = [row for row in rows if row.get("held_out_PSNR")]
    sections = []
    if judged:
        figure = held_out_curves(rows, int(facts.get("best", {}).get("iterations", 0)))
        write_whole(folder / "held_out.png", figure)
        sections.append(Section("Held-out pictures", _meaning(facts), picture=figure))
        sections.append(_table(judged, facts))
    sections.append(
        Section("Losses", "Each loss, and its running median, over both stages.", picture=curves)
    )
    if shown := sorted((folder / "pictures").glob("stage*.png")):
        text = (
            "From the left: the input of the network, what the network makes of it, and the true"
            " picture."
        )
        sections.append(Section("A training picture", text, picture=shown[-1].read_bytes()))
    about = {
        name: facts[name]
        for name in ("mask", "photographs", "iterations", "mesh", "broken")
        if facts.get(name)
    }
    write_whole(
        folder / PAGE, page(f"Training: {recipe}", _lead(judged, facts), sections, about).encode()
    )


def _lead(judged: Sequence[Mapping[str, str]], facts: Any) -> str:
    if not judged:
        return (
            "No photograph is held out, so that nothing here says how the network restores pictures"
            " it never saw."
        )
    row, gain = judged[-1], facts.get("best")
    if gain is None:
        return (
            "After the last iteration the held-out pictures have a PSNR of"
            f" {float(row['held_out_PSNR']):.2f} dB."
        )
    text = (
        f"The best network, after {gain['iterations']} iterations of stage 2, restores held-out"
        f" pictures with a PSNR of {gain['held_out_PSNR']:.2f} dB, {gain['gain_PSNR']:+.2f} dB over"
        " its input"
    )
    if "gain_PSNR_low" not in gain:
        return f"{text}. One photograph is held out, which gives no interval."
    low, high = gain["gain_PSNR_low"], gain["gain_PSNR_high"]
    sure = (
        "The interval excludes zero."
        if low > 0 or high < 0
        else "The interval includes zero: this is no gain."
    )
    return f"{text} (90 % interval over photographs: {low:+.2f} to {high:+.2f} dB). {sure}"


def _meaning(facts: Any) -> str:
    text = (
        f"{len(facts['held_out'])} photographs are held out; {facts['judged']} of them are"
        " restored, each with the same scene, laser and noise at every validation. The input is"
        " the picture that the network is given: the developed picture, or that of the filter with"
        " `train.picture: restored`. The best state is chosen on these pictures, so that its PSNR"
        " is a little too high for other pictures: judge it by `neusee evaluate` on photographs of"
        " their own."
    )
    early = " Stage 2 ended early, because `train.patience` validations had no better PSNR."
    return text + early if facts.get("stopped_early") else text


def _table(judged: Sequence[Mapping[str, str]], facts: Any) -> Section:
    """Return the table of the best and the last state, with the numbers of the input beside
    them.
    """
    best = facts.get("best")
    states = ([("best", best)] if best else []) + [("last", judged[-1])]
    rows = []
    for name, numbers in states:
        for metric, text in _NAMES.items():
            own = [float(numbers[key]) for key in (f"held_out_{metric}", f"input_{metric}")]
            low, high = (
                _four_digits(numbers.get(f"held_out_{metric}_{end}")) for end in ("low", "high")
            )
            rows.append((name, text, f"{own[0]:.4g}", low, high, f"{own[1]:.4g}"))
    columns = ("state", "metric", "network", "from", "to", "input")
    return Section("Numbers", "Means over photographs, and their 90 % intervals.", columns, rows)


def _four_digits(number: str | float | None) -> str | None:
    """Return a number of the loss table with four digits, or None where the table has none."""
    return f"{float(number):.4g}" if number else None
