"""What goes wrong as printed: both presets of learning, in small, on the same pictures.

    python tests/benchmarks/bench_presets.py FOLDER PHOTOGRAPHS

Pictures of 48 x 48, 9 bands, an FFT-Mamba of width 8. Iterations are a fiftieth of the presets'
(200 and 400) and so is what their schedules count; the first rates are ten times as large, for a
small network in few steps. A run that is there is not repeated. Writes `presets.png` and prints a
table.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import Any

import torch

from neusee.workflows import load
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.resumable_loop import TrainingSession
from neusee.workflows.training.run_training import train

SMALL = [
    "optics.samples=96", "optics.pitch=84.1 um", "optics.bands=9", "optics.window=[72, 72]", "scene.shape=[72, 72]",
    "sensor.shape=[48, 48]", "doe.grid=48", "train.network.kind=fft_mamba", "train.network.width=8",
    "train.critics.width=8", "train.rates.weights=2e-3", "train.rates.biases=4e-3", "train.rates.mask=2e-3",
    "train.rates.halve=40", "train.rates.every=20", "train.stages.1.iterations=200", "train.stages.2.iterations=400",
    "train.stages.1.batch=2", "train.stages.2.batch=2", "train.keep=50", "train.show=200",
]  # fmt: skip
PRESETS = {
    "as printed": ["train=as_printed", 'lasers.drawn.strength="uniform(0, 2e6)"'],
    "recommended": ["train=recommended", "train.average=0.98"],
}
SHOWN = ("LSR", "L1", "rate", "critics")
WINDOW = 20  #: iterations that are averaged


def rows(name: str, words: list[str], folder: Path, photographs: str) -> list[dict[str, str]]:
    """The losses of a preset, learned now or found."""
    recipe = load("train_small", [*words, *SMALL, f"train.photographs={photographs}"])
    made = train(
        recipe,
        TrainingSession(
            Store(folder / "cache"),
            folder / name.replace(" ", "_"),
            print,
            command=["bench_presets"],
        ),
    )
    with (made / "losses.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def mean(found: list[dict[str, str]], name: str, at: int) -> float:
    """Of the iterations before ``at``; nothing where a stage does not have it."""
    part = [float(row[name]) for row in found[max(0, at - WINDOW) : at] if row[name]]
    return sum(part) / len(part) if part else float("nan")


def figure(found: dict[str, list[dict[str, str]]]) -> Any:
    """Each loss over the iterations, both presets."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(SHOWN), figsize=(4 * len(SHOWN), 3), layout="constrained")
    for name, axis in zip(SHOWN, axes, strict=True):
        for preset, each in found.items():
            axis.plot([mean(each, name, at + 1) for at in range(len(each))], label=preset)
        axis.axvline(200, color="0.7", lw=0.8)
        axis.set(
            title=name,
            xlabel="iteration; stage 2 from the line on",
            yscale="linear" if name == "critics" else "log",
        )
    axes[0].legend(frameon=False)
    return figure


def main(folder: Path, photographs: str) -> None:
    """Learn, print, draw."""
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    found = {name: rows(name, words, folder, photographs) for name, words in PRESETS.items()}
    print("| preset | iteration | LSR | L1 | rate, of the first | distance of the critics |")
    print("|---|---|---|---|---|---|")
    for name, each in found.items():
        for at in (WINDOW, 100, 200, 300, 600):
            values = " | ".join(f"{mean(each, key, at):.3g}" for key in SHOWN)
            print(f"| {name} | {at} | {values} |")
    figure(found).savefig(folder / "presets.png", dpi=100)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
