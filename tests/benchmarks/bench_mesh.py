"""Learning in several processes: how far their gradients are from those of one, and seconds an
iteration.

    python tests/benchmarks/bench_mesh.py [1 2 4 ...]

Errors: one iteration in float64, of each part |difference| / |gradient|. Seconds: `train_small`
        with pictures of all
31 bands (`tolerance=0`) and as it stands, batch 4, float32, median of four iterations after the
first, of the first process. All processes run on this machine with one thread each: with fewer
cores than processes nothing is gained.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "workflows"))
import mesh_processes
from mesh_processes import DO, _photographs, start

from neusee.workflows import Store, load
from neusee.workflows.training.process_mesh import Mesh
from neusee.workflows.training.training_iteration import Learner
from neusee.workflows.training.training_pictures import PictureSource, TrainingStream

DOUBLE = [
    "train.precision=float64",
    "steps.psf.with.precision=double",
    "steps.laser_psf.with.precision=double",
]
PLAIN = ["train.network.kind=unet", "train.stages.1.batch=4"]
CASES = {"each band": ["tolerance=0"], "few planes": []}
TIMES = 4


def timed(job: dict[str, Any], mesh: Mesh) -> None:
    """Seconds of some iterations after the first."""
    recipe = load("train_small", job["words"])
    how = recipe.training
    learner = Learner(recipe, how, "cpu", mesh=mesh)
    learner.begin(how.stages[1], True)
    samples = TrainingStream(
        recipe,
        how,
        PictureSource(_photographs(recipe, how, True), Store(Path(job["store"])), mesh=mesh),
        None,
    )
    seconds = []
    for iteration in range(1 + TIMES):
        began = time.perf_counter()
        learner.iterate(samples, 1, iteration)
        seconds.append(time.perf_counter() - began)
    if mesh.first:
        torch.save({"seconds": statistics.median(seconds[1:])}, Path(job["folder"], "timed.pt"))


def done(place: Path, count: int, case: str, do: str, words: list[str]) -> dict[str, Any]:
    """What a job in processes of its own left."""
    folder = place / f"{do} {case} {count}"
    start(
        {
            "folder": str(folder),
            "store": str(place / "store"),
            "processes": count,
            "do": do,
            "words": words,
        }
    )
    found: dict[str, Any] = torch.load(folder / f"{do}.pt", weights_only=True)
    return found


def error(found: dict[str, Any], one: dict[str, Any], part: str) -> float:
    """How far the gradient of a part is off, as a share of it."""
    names = [name for name in one["grads"] if name.startswith(f"{part}.")]
    off, whole = (
        torch.cat([x.flatten() for x in each]).norm()
        for each in (
            [found["grads"][n] - one["grads"][n] for n in names],
            [one["grads"][n] for n in names],
        )
    )
    return float(off / whole)


def main(counts: list[int]) -> None:
    """One line for each case and number of processes."""
    mesh_processes.LONGEST = 600.0
    DO["timed"] = timed
    print(
        "| imaged | processes | element | network | critics | s an iteration"
        " |\n|---|---|---|---|---|---|",
        flush=True,
    )
    with tempfile.TemporaryDirectory() as folder:
        for case, words in CASES.items():
            one = None
            for count in counts:
                found = done(Path(folder), count, case, "step", [*PLAIN, *words, *DOUBLE])
                one = one or found
                errors = " | ".join(
                    f"{error(found, one, part):.1e}" for part in ("mask", "net", "critics")
                )
                seconds = done(Path(folder), count, case, "timed", [*PLAIN, *words])["seconds"]
                print(f"| {case} | {count} | {errors} | {seconds:.2f} |", flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main([int(count) for count in sys.argv[1:]] or [1, 2, 4])
