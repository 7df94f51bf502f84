"""Peak memory of one iteration of learning: `python tests/benchmarks/bench_train_memory.py`.

The recipe `train`, recommended, FFT-Mamba of width 64, on a sensor of SIDE x SIDE pixels; pupil,
window, scene and sensor grow together. Each row is a process of its own, one thread, and its second
iteration (the first compiles and plans): the largest sum of bytes of tensors that live at once,
what lived before among them, and by how much the largest resident size exceeds the size after the
imports. Prints a table in Markdown, a law fitted to all rows but the last by least squares of
relative errors, what it gives for that one, and for 2048 x 2048 x 31, the network at 256 x 256,
eight pictures at a time. The UNet that draws the element has a grid of 64, which is little; the
recipe's has 270.

`... one SIDE BANDS BATCH NET STAGE` is one row.
"""

import json
import subprocess
import sys
import tempfile
import time
from itertools import product
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from live_bytes import LiveBytes

from neusee.nodes.scene import Photographs
from neusee.workflows import Store, load
from neusee.workflows.training.resumable_loop import export
from neusee.workflows.training.run_training import frozen
from neusee.workflows.training.training_iteration import Learner
from neusee.workflows.training.training_pictures import PictureSource, TrainingStream

SIDES, FULL = (128, 192, 256, 384, 512), (2048, 31, 8, 256)
#: side, bands, batch, side of the network's pictures
ROWS = [(side, 31, 2, side // 8 * 2) for side in SIDES]
ROWS += [
    (256, 7, 2, 64),
    (256, 15, 2, 64),
    (256, 31, 1, 64),
    (256, 31, 4, 64),
    (256, 31, 2, 32),
    (256, 31, 2, 128),
]
CHECK = (1024, 31, 2, 128)
APERTURE = 2160 * 3.74  #: um, of a pupil that serves 2048 pixels


def recipe_of(side, bands, batch, net):
    samples = round(side * 2160 / 2048)
    shapes = [
        f"{name}=[{side}, {side}]" for name in ("scene.shape", "sensor.shape", "optics.window")
    ]
    stages = [f"train.stages.{stage}.batch={batch}" for stage in (1, 2)]
    pupil = [
        f"optics.samples={samples}",
        f"optics.pitch={APERTURE / samples} um",
        f"optics.bands={bands}",
    ]
    return load("train", [*shapes, *stages, *pupil, f"train.size=[{net}, {net}]", "doe.grid=64"])


def resident(name):
    (line,) = (x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith(name))
    return int(line.split()[1]) * 1024


def measured(side, bands, batch, net, stage):
    """Bytes alive at the peak, bytes alive before the iteration, bytes resident at the peak,
    seconds.
    """
    torch.set_num_threads(1)
    recipe = recipe_of(side, bands, batch, net)
    how, before = recipe.training, resident("VmRSS")
    with tempfile.TemporaryDirectory() as folder, LiveBytes() as live:
        learner, store = Learner(recipe, how, "cpu"), Store(Path(folder) / "store")
        export(Path(folder), "mask", {"height": learner.height().detach()})
        still = frozen(recipe, how, Path(folder)) if stage == 2 else None
        samples = TrainingStream(
            recipe,
            how,
            PictureSource(Photographs((recipe.steps["scene"].params["file"],)), store),
            still,
        )
        learner.begin(how.stages[stage], stage == 1)
        learner.iterate(samples, stage, 0)
        Path("/proc/self/clear_refs").write_text("5")  # the peak so far no longer counts
        live.again()
        began, there = time.perf_counter(), live.now
        learner.iterate(samples, stage, 1)
        return live.peak, there, resident("VmHWM") - before, time.perf_counter() - began


def apart(*row):
    """A row measured in a process of its own."""
    command = [sys.executable, __file__, "one", *map(str, row)]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def terms(side, bands, batch, net):
    """What the law is a sum of, each times a number of bytes."""
    return side**2 * bands, side**2, batch * net**2, net**2, 1.0


NAMES = (
    "pixel and band",
    "pixel",
    "pixel of the network and picture",
    "pixel of the network",
    "all in all",
)


def law(rows, found):
    """Numbers of bytes, none negative, that make the terms the peaks found."""
    from scipy.optimize import nnls

    scaled = np.array([terms(*row) for row in rows]) / np.array(found)[:, None]
    size = scaled.max(0)
    return nnls(scaled / size, np.ones(len(rows)))[0] / size


def main():
    taken = {}
    print(
        "| stage | pixels | bands | batch | network | alive MB | before MB | resident MB | s |",
        flush=True,
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for stage, row in product((1, 2), (*ROWS, CHECK)):
        peak, there, most, seconds = taken[stage, row] = apart(*row, stage)
        side, bands, batch, net = row
        print(f"| {stage} | {side} | {bands} | {batch} | {net} | {peak / 1e6:.0f} | {there / 1e6:.0f} | "
              f"{most / 1e6:.0f} | {seconds:.1f} |", flush=True)  # fmt: skip
    for stage, (which, name) in product((1, 2), ((0, "alive"), (2, "resident"))):
        found = [taken[stage, row][which] for row in ROWS]
        bytes_ = law(ROWS, found)
        worst = max(
            abs(np.dot(terms(*row), bytes_) / x - 1) for row, x in zip(ROWS, found, strict=True)
        )
        said = ", ".join(f"{x:.3g} a {n}" for x, n in zip(bytes_, NAMES, strict=True))
        print(
            f"\nstage {stage}, {name}: {said}; within {worst:.1%}; {FULL}:"
            f" {np.dot(terms(*FULL), bytes_) / 1e9:.2f} GB"
        )


if __name__ == "__main__":
    if sys.argv[1:2] == ["one"]:
        print(json.dumps(measured(*map(int, sys.argv[2:]))))
    else:
        main()
