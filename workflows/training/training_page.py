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
from neusee.workflows.report.study_report import Section, page
from neusee.workflows.training.resumable_loop import write_whole

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
    length_of_first_stage = 1 + max(
        (int(r["iteration"]) for r in rows if r["stage"] == "1"), default=-1
    )
    for ax, name in zip(axes.flat, names, strict=False):
        for stage, colour in ((1, BLUE), (2, VERMILION)):
            _draw_loss(ax, rows, name, stage, length_of_first_stage * (stage == 2), colour)
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
    """Draw a loss and its running median over a stage that starts after ``first`` iterations."""
    rows_of_stage = [row for row in rows if row["stage"] == str(stage) and row[name]]
    iterations = [int(row["iteration"]) + first for row in rows_of_stage]
    values = [float(row[name]) for row in rows_of_stage]
    ax.plot(iterations, values, color=colour, alpha=0.25, linewidth=0.7)
    ax.plot(iterations, running_median(values), color=colour, linewidth=1.5, label=f"stage {stage}")


@drawn
def held_out_curves(rows: Sequence[Mapping[str, str]], best: int) -> Any:
    """Draw training loss and held-out PSNR over the iterations of both stages, with the PSNR of the
    network's input.

    ``best`` is the number of stage-2 iterations up to the best state, or 0 without a best state.
    """
    figure, axes = canvas(9.0, 6.4, 2, 1, sharex=True)
    length_of_first_stage = sum(row["stage"] == "1" for row in rows)
    _draw_training(axes[0, 0], rows, length_of_first_stage)
    validated_rows = [row for row in rows if row.get("held_out_PSNR")]
    _draw_held_out(axes[1, 0], validated_rows, length_of_first_stage)
    for ax in axes[:, 0]:
        if 0 < length_of_first_stage < len(rows):
            ax.axvline(length_of_first_stage, color=BLACK, linewidth=0.8, linestyle=":")
            ax.annotate(
                "stage 2",
                (length_of_first_stage, 1),
                (3, -12),
                ("data", "axes fraction"),
                "offset points",
                fontsize=9,
            )
        if best:
            ax.axvline(
                length_of_first_stage + best,
                color=GREEN,
                linewidth=1.0,
                label=f"best: after {best} iterations of stage 2",
            )
    axes[1, 0].set(xlabel="iteration", ylabel="held-out pictures: PSNR (dB)")
    figure.legend(*axes[1, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _draw_training(ax: Any, rows: Sequence[Mapping[str, str]], first: int) -> None:
    """Draw the training loss and its running median over the iterations.

    ``first`` is the number of iterations of stage 1.
    """
    name = "reconstruction" if any(row["reconstruction"] for row in rows) else "L1"
    loss = [(float(_iterations_so_far(row, first)), float(row[name])) for row in rows if row[name]]
    iterations, values = zip(*loss, strict=True)
    ax.plot(iterations, values, color=BLUE, alpha=0.25, linewidth=0.7)
    ax.plot(iterations, running_median(values), color=BLUE, linewidth=1.5)
    ax.set_yscale("log", nonpositive="mask")
    ax.set_ylabel(f"training: {name} loss")


def _draw_held_out(ax: Any, judged: Sequence[Mapping[str, str]], first: int) -> None:
    """Draw the PSNR of the restored held-out pictures with its interval, and of the network's
    input.

    ``judged`` are the rows of the loss table with a validation.
    """
    iterations = [_iterations_so_far(row, first) for row in judged]
    for source, colour, curve_label in (
        ("held_out", VERMILION, "network"),
        ("input", BLACK, "input of the network"),
    ):
        values = [float(row[f"{source}_PSNR"]) for row in judged]
        style = "--" if source == "input" else "-"
        ax.plot(
            iterations,
            values,
            color=colour,
            linestyle=style,
            marker=".",
            linewidth=1.5,
            label=curve_label,
        )
    with_ends = [row for row in judged if row["held_out_PSNR_low"]]
    low_ends, high_ends = (
        [float(row[f"held_out_PSNR_{interval_end}"]) for row in with_ends]
        for interval_end in ("low", "high")
    )
    interval_label = "90 % interval of the mean over photographs"
    ax.fill_between(
        [_iterations_so_far(row, first) for row in with_ends],
        low_ends,
        high_ends,
        color=VERMILION,
        alpha=0.15,
        label=interval_label,
    )


def _iterations_so_far(row: Mapping[str, str], first: int) -> int:
    """Return the number of iterations of both stages up to and including that of a row."""
    return int(row["iteration"]) + 1 + first * (row["stage"] == "2")


def running_median(values: Sequence[float]) -> list[float]:
    """Return the running median in a window of about 1/20 of the sequence length."""
    half_window = max(1, len(values) // 40)
    return [
        statistics.median(values[max(0, i - half_window) : i + half_window + 1])
        for i in range(len(values))
    ]


def strip(pictures: Sequence[Tensor]) -> Any:
    """Place pictures (3, y, x) in linear sRGB side by side, and return one 8-bit sRGB array (y,
    x, 3).
    """
    gap = torch.ones(3, pictures[0].shape[-2], _GAP)
    columns = [pictures[0].detach().cpu()]
    for picture in pictures[1:]:
        columns += [gap, picture.detach().cpu()]
    return (encoded(torch.cat(columns, -1)) * 255).round().astype("uint8")


def png(codes: Any) -> bytes:
    """Encode an 8-bit array (y, x, 3) as a PNG file."""
    from PIL import Image

    memory = io.BytesIO()
    Image.fromarray(codes).save(memory, "PNG")
    return memory.getvalue()


# --- training page --------------------------------------------------------------------------------

# The page of a training as one self-contained file: losses, held-out pictures and the best state.


PAGE = "training.html"
_NAMES = {"PSNR": "PSNR (dB)", "L1": "L1", "SSIM": "SSIM"}


def write_page(
    folder: Path, recipe: str, rows: Sequence[Mapping[str, str]], curves: bytes, facts: Any
) -> None:
    """Write the page of a training, and the figure ``held_out.png`` if photographs are held out."""
    validated_rows = [row for row in rows if row.get("held_out_PSNR")]
    sections = []
    if validated_rows:
        figure = held_out_curves(rows, int(facts.get("best", {}).get("iterations", 0)))
        write_whole(folder / "held_out.png", figure)
        sections.append(Section("Held-out pictures", _meaning(facts), picture=figure))
        sections.append(_table(validated_rows, facts))
    sections.append(
        Section("Losses", "Each loss, and its running median, over both stages.", picture=curves)
    )
    if pictures_of_stages := sorted((folder / "pictures").glob("stage*.png")):
        text = (
            "From the left: the input of the network, what the network makes of it, and the true"
            " picture."
        )
        sections.append(
            Section("A training picture", text, picture=pictures_of_stages[-1].read_bytes())
        )
    page_facts = {
        name: facts[name]
        for name in ("mask", "photographs", "iterations", "mesh", "broken")
        if facts.get(name)
    }
    write_whole(
        folder / PAGE,
        page(f"Training: {recipe}", _lead(validated_rows, facts), sections, page_facts).encode(),
    )


def _lead(judged: Sequence[Mapping[str, str]], facts: Any) -> str:
    """Return the opening of the page: the PSNR of the best network and its gain over the input."""
    if not judged:
        return (
            "No photograph is held out, so that nothing here says how the network restores pictures"
            " it never saw."
        )
    row, best = judged[-1], facts.get("best")
    if best is None:
        return (
            "After the last iteration the held-out pictures have a PSNR of"
            f" {float(row['held_out_PSNR']):.2f} dB."
        )
    text = (
        f"The best network, after {best['iterations']} iterations of stage 2, restores held-out"
        f" pictures with a PSNR of {best['held_out_PSNR']:.2f} dB, {best['gain_PSNR']:+.2f} dB over"
        " its input"
    )
    if "gain_PSNR_low" not in best:
        return f"{text}. One photograph is held out, which gives no interval."
    gain_low, gain_high = best["gain_PSNR_low"], best["gain_PSNR_high"]
    conclusion = (
        "The interval excludes zero."
        if gain_low > 0 or gain_high < 0
        else "The interval includes zero: this is no gain."
    )
    return (
        f"{text} (90 % interval over photographs: {gain_low:+.2f} to {gain_high:+.2f} dB)."
        f" {conclusion}"
    )


def _meaning(facts: Any) -> str:
    """Return a text on what the held-out curves show."""
    text = (
        f"{len(facts['held_out'])} photographs are held out; {facts['judged']} of them are"
        " restored, each with the same scene, laser and noise at every validation. The input is"
        " the picture that the network is given: the developed picture, or that of the filter with"
        " `train.picture: restored`. The best state is chosen on these pictures, so that its PSNR"
        " is a little too high for other pictures: judge it by `neusee evaluate` on photographs of"
        " their own."
    )
    ending = " Stage 2 ended early, because `train.patience` validations had no better PSNR."
    return text + ending if facts.get("stopped_early") else text


def _table(judged: Sequence[Mapping[str, str]], facts: Any) -> Section:
    """Return the table of the best and the last state, next to the numbers of the input."""
    best = facts.get("best")
    states = ([("best", best)] if best else []) + [("last", judged[-1])]
    rows = []
    for name, numbers in states:
        for metric, text in _NAMES.items():
            network_and_input = [
                float(numbers[key]) for key in (f"held_out_{metric}", f"input_{metric}")
            ]
            interval_low, interval_high = (
                _four_digits(numbers.get(f"held_out_{metric}_{interval_end}"))
                for interval_end in ("low", "high")
            )
            rows.append(
                (
                    name,
                    text,
                    f"{network_and_input[0]:.4g}",
                    interval_low,
                    interval_high,
                    f"{network_and_input[1]:.4g}",
                )
            )
    columns = ("state", "metric", "network", "from", "to", "input")
    return Section("Numbers", "Means over photographs, and their 90 % intervals.", columns, rows)


def _four_digits(number: str | float | None) -> str | None:
    """Return a number of the loss table with four digits, or None if it is empty."""
    return f"{float(number):.4g}" if number else None
