"""What a point of a long sweep costs beside its nodes, and whether a sweep uses the processors.

    python tests/benchmarks/bench_sweep.py [--points 1000]

Two recipes: three trivial steps, and first_light with small pictures, of which 58 steps lead to the
output. The overhead is the processor time of this process in planning and running, less that within
nodes, per point; it is told for each fifth of the points. One thread; the load of the machine is
recorded.
"""

from __future__ import annotations

import argparse
import itertools
import os
import shutil

os.environ.update(
    {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
)

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch

from neusee.workflows import load
from neusee.workflows.engine import node_call, step_job
from neusee.workflows.recipe.uncertain_inputs import Inputs
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.output_draws import OutputDraws
from neusee.workflows.sweeps.axes import read_axes, read_words
from neusee.workflows.sweeps.sweep_points import outcomes
from neusee.workflows.sweeps.sweep_run import Sweeping

THREE = """# Three trivial steps
sensor: {photons: 10 e-, noise: 5 e-}
steps:
  light: {node: own.light, with: {level: "${sensor.photons}"}}
  noisy: {node: own.noisy, from: light, with: {noise: "${sensor.noise}"}}
  mean: {node: own.mean, from: noisy}
outputs: [mean]
nodes: [own: own_nodes.py]
"""
NODES = '''"""Nodes of the benchmark."""
import torch
from torch import Tensor

from neusee.nodes import node
from neusee.nodes.units import Electrons


@node()
def light(*, level: Electrons = 1.0) -> Tensor:
    return torch.full((8, 8), level, dtype=torch.float64)


@node()
def noisy(image: Tensor, *, noise: Electrons = 0.0) -> Tensor:
    return image + noise


@node()
def mean(image: Tensor) -> Tensor:
    return image.mean()
'''
SMALL = [
    "optics.samples=128",
    "optics.pitch=63.11 um",
    "optics.bands=5",
    "optics.window=[48, 48]",
    "scene.shape=[28, 28]",
    "sensor.shape=[24, 24]",
    "outputs=[saturated]",
]
FIFTHS = 5
RECIPES = {
    "three": "three trivial steps",
    "first_light": "first_light with small pictures, 58 steps",
}
LAWS = (
    "sensor.quantum_efficiency=lognormal(0.56, 1.01)",
    "sensor.read_noise=lognormal(10.5 e-, 1.01)",
    "sensor.full_well=lognormal(25500 e-, 1.01)",
    "outputs=[saturated, lsr, transfer]",
)


@dataclass(frozen=True)
class Overhead:
    """Milliseconds of one point beside its nodes: planning, and running in each fifth of the
    points.
    """

    plan: float
    run: list[float]
    load: float

    @property
    def point(self) -> float:
        """Return the mean of all points."""
        return self.plan + statistics.mean(self.run)


def _sweeping(
    recipe: str, axis: str, values: str, words: list[str], folder: Path, store: Store
) -> Sweeping:
    arguments = [*read_words(words, folder), *read_axes({axis: values}, folder)]
    return Sweeping(recipe, arguments, folder, store, False, "cpu")


def overhead(which: str, points: int) -> Overhead:
    """Return the overhead of the points of a sweep of ``three`` steps or of ``first_light``, in
    an empty store.
    """
    busy = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as place, _nodes_timed() as within:
        folder, store = Path(place), Store(Path(place) / "cache")
        (folder / "own_nodes.py").write_text(NODES, encoding="utf-8")
        (folder / "three.yaml").write_text(THREE, encoding="utf-8")
        name, axis, words = ("three.yaml", "sensor.noise", []) if which == "three" else LARGE
        began = time.process_time()
        work = _sweeping(name, axis, f"linspace(5 e-, 20 e-, {points})", words, folder, store)
        plan = time.process_time() - began
        spent = []
        began, nodes = time.process_time(), within[0]
        for _ in outcomes(work.plan, store):
            now = time.process_time()
            spent.append(now - began - (within[0] - nodes))
            began, nodes = now, within[0]
    return Overhead(1e3 * plan / points, _fifths(spent[1:]), busy)


LARGE = ("first_light", "sensor.read_noise", SMALL)


def _fifths(spent: list[float]) -> list[float]:
    size = len(spent)
    parts = [spent[i * size // FIFTHS : (i + 1) * size // FIFTHS] for i in range(FIFTHS)]
    return [1e3 * statistics.mean(part) for part in parts]


class _nodes_timed:
    """Adds up the processor seconds within nodes, in the only item of a list."""

    def __enter__(self) -> list[float]:
        found, self._call = [0.0], node_call.call

        def timed(*arguments, **how):
            began = time.process_time()
            try:
                return self._call(*arguments, **how)
            finally:
                found[0] += time.process_time() - began

        step_job.call = timed
        return found

    def __exit__(self, *error: object) -> None:
        step_job.call = self._call


@contextmanager
def draws(count: int = 64) -> Iterator[Callable[[int], object]]:
    """Yield a function that computes draws of first_light for a study with a number of workers."""
    inputs = Inputs.of(load("first_light", LAWS))
    values = inputs.independent(count, 1).values
    with tempfile.TemporaryDirectory() as place:
        OutputDraws(inputs, Store(Path(place) / "fixed")).ready()
        copies = itertools.count()

        def once(workers: int) -> None:
            store = Path(place) / str(next(copies))
            shutil.copytree(Path(place) / "fixed", store)
            OutputDraws(inputs, Store(store), "cpu", workers).numbers(values)

        yield once


@contextmanager
def sweep_of(points: int) -> Iterator[Callable[[int], object]]:
    """Yield a function that runs a sweep of first_light in an empty store with a number of
    workers.
    """
    with tempfile.TemporaryDirectory() as place:
        copies, axis = itertools.count(), ("sensor.read_noise", f"linspace(5 e-, 20 e-, {points})")

        def once(workers: int) -> None:
            store = Store(Path(place) / str(next(copies)))
            work = _sweeping("first_light", *axis, ["outputs=[saturated]"], Path(place), store)
            list(outcomes(work.plan, store, workers=workers))

        yield once


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=1000)
    torch.set_num_threads(1)
    points = parser.parse_args().points
    for which, what in RECIPES.items():
        found = overhead(which, points)
        fifths = ", ".join(f"{each:.2f}" for each in found.run)
        print(
            f"{what}: {found.point:.2f} ms a point; plan {found.plan:.2f}, run {fifths}; load"
            f" {found.load:.1f}",
            flush=True,
        )
