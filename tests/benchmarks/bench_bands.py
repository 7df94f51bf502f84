"""Memory of a step in passes over its bands: `python tests/benchmarks/bench_bands.py [SIZE ...]`, 31
bands of SIZE x SIZE pixels (1024 2048).

A table in Markdown: what a step takes beside its inputs, whole and in parts, each in a process of
its own.
"""

import subprocess
import sys
import threading
from pathlib import Path

import torch

from neusee.nodes.optics import image, psf
from neusee.nodes.spectra import illuminate
from neusee.nodes.values import Psf, Pupil
from neusee.workflows.engine.node_call import call, call_in_parts
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Step

BANDS, PARTS = 31, 8
LENS = {"focal_length": 0.11, "pixel_pitch": 2.9e-6}
STEPS = ("illuminate", "psf", "image", "image, reflect")


def step_of(name, size):
    """A step and its inputs."""
    light = torch.rand(BANDS, dtype=torch.float64)
    if name == "psf":
        return _step(psf, **LENS, shape=(size, size)), [_pupil(), None]
    scene = torch.rand(BANDS, size, size)
    if name == "illuminate":
        return _step(illuminate), [scene, light]
    border = "reflect" if "reflect" in name else "zero"
    return _step(image, border=border), [scene, Psf(torch.rand(BANDS, size, size) / size**2, light)]


def _step(node, **params):
    return Step(node.fn.__name__, node, params, {}, Location("bench"), {})


def _pupil(n=2160):
    x = (torch.arange(n) - (n - 1) / 2) / (n / 2)
    disc = ((x[:, None] ** 2 + x**2) <= 1).float()
    waves = torch.linspace(400e-9, 700e-9, BANDS, dtype=torch.float64)
    pitch = torch.tensor(3.74e-6, dtype=torch.float64)
    return Pupil(disc, disc, torch.rand(n, n) * 1e-6, 0 * disc, 0.46 + 0 * waves, waves, pitch)


def memory(size):
    print(f"\n| step, 31 x {size} x {size} | whole, MB | in {PARTS} parts, MB | in 31 parts, MB |")
    print("|---|---|---|---|")
    for name in STEPS:
        found = [_in_a_process(name, size, parts) for parts in (1, PARTS, BANDS)]
        print(f"| {name} | {' | '.join(f'{x:.0f}' for x in found)} |", flush=True)


def _in_a_process(name, size, parts):
    command = [sys.executable, __file__, "--peak", name, str(size), str(parts)]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def peak(name, size, parts):
    """Print the most memory, in MB, that a step had beside its inputs."""
    step, inputs = step_of(name, size)
    most, over = [0], threading.Event()

    def watch():
        while not over.wait(0.002):
            most[0] = max(most[0], _anonymous())

    before = _anonymous()
    thread = threading.Thread(target=watch)
    thread.start()
    value = call_in_parts(
        step, inputs, lambda taken: call(step, taken, step.params, 0, "cpu"), parts
    )
    over.set()
    thread.join()
    del value
    print((most[0] - before) / 1e6)


def _anonymous():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon")) * 1024


def main(sizes):
    for size in sizes:
        memory(size)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--peak"]:
        peak(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
    else:
        main([int(arg) for arg in sys.argv[1:]] or [1024, 2048])
