"""The page of a training: losses, held-out pictures and the best state, as one file that loads no other file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neusee.workflows.report.study_page import Section, page
from neusee.workflows.training.loop.checkpoint import write_whole
from neusee.workflows.training.training_figures import held_out_curves

PAGE = "training.html"
_NAMES = {"PSNR": "PSNR (dB)", "L1": "L1", "SSIM": "SSIM"}


def write_page(folder: Path, recipe: str, rows: Sequence[Mapping[str, str]], curves: bytes, facts: Any) -> None:
    """Write the page of a training, and the figure ``held_out.png`` if photographs are held out."""
    judged = [row for row in rows if row.get("held_out_PSNR")]
    sections = []
    if judged:
        figure = held_out_curves(rows, int(facts.get("best", {}).get("iterations", 0)))
        write_whole(folder / "held_out.png", figure)
        sections.append(Section("Held-out pictures", _meaning(facts), picture=figure))
        sections.append(_table(judged, facts))
    sections.append(Section("Losses", "Each loss, and its running median, over both stages.", picture=curves))
    if shown := sorted((folder / "pictures").glob("stage*.png")):
        text = "From the left: the input of the network, what the network makes of it, and the true picture."
        sections.append(Section("A training picture", text, picture=shown[-1].read_bytes()))
    about = {name: facts[name] for name in ("mask", "photographs", "iterations", "mesh", "broken") if facts.get(name)}
    write_whole(folder / PAGE, page(f"Training: {recipe}", _lead(judged, facts), sections, about).encode())


def _lead(judged: Sequence[Mapping[str, str]], facts: Any) -> str:
    if not judged:
        return "No photograph is held out, so that nothing here says how the network restores pictures it never saw."
    row, gain = judged[-1], facts.get("best")
    if gain is None:
        return f"After the last iteration the held-out pictures have a PSNR of {float(row['held_out_PSNR']):.2f} dB."
    text = (
        f"The best network, after {gain['iterations']} iterations of stage 2, restores held-out pictures with a PSNR "
        f"of {gain['held_out_PSNR']:.2f} dB, {gain['gain_PSNR']:+.2f} dB over its input"
    )
    if "gain_PSNR_low" not in gain:
        return f"{text}. One photograph is held out, which gives no interval."
    low, high = gain["gain_PSNR_low"], gain["gain_PSNR_high"]
    sure = "The interval excludes zero." if low > 0 or high < 0 else "The interval includes zero: this is no gain."
    return f"{text} (90 % interval over photographs: {low:+.2f} to {high:+.2f} dB). {sure}"


def _meaning(facts: Any) -> str:
    text = (
        f"{len(facts['held_out'])} photographs are held out; {facts['judged']} of them are restored, each with the "
        "same scene, laser and noise at every validation. The input is the picture that the network is given: the "
        "developed picture, or that of the filter with `train.picture: restored`. The best state is chosen on these "
        "pictures, so that its PSNR is a little too high for other pictures: judge it by `neusee evaluate` on "
        "photographs of their own."
    )
    early = " Stage 2 ended early, because `train.patience` validations had no better PSNR."
    return text + early if facts.get("stopped_early") else text


def _table(judged: Sequence[Mapping[str, str]], facts: Any) -> Section:
    """Return the table of the best and the last state, with the numbers of the input beside them."""
    best = facts.get("best")
    states = ([("best", best)] if best else []) + [("last", judged[-1])]
    rows = []
    for name, found in states:
        for metric, text in _NAMES.items():
            own = [float(found[key]) for key in (f"held_out_{metric}", f"input_{metric}")]
            ends = [float(x) if (x := found.get(f"held_out_{metric}_{end}")) else None for end in ("low", "high")]
            rows.append((name, text, f"{own[0]:.4g}", *(x if x is None else f"{x:.4g}" for x in ends), f"{own[1]:.4g}"))
    columns = ("state", "metric", "network", "from", "to", "input")
    return Section("Numbers", "Means over photographs, and their 90 % intervals.", columns, rows)
