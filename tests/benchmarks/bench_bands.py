"""Results by band: `python tests/benchmarks/bench_bands.py [SIZE ...]`, 31 bands of SIZE x SIZE
pixels (1024 2048).

Three tables in Markdown. Time: a step computed whole and written in one piece, as a store without
bands has it, beside the same step in which one band of 31 has changed: hashed, computed, written
and read by band. Memory: what a step takes beside its inputs, whole and in parts, each in a process
of its own; pages of files that are mapped can be dropped when memory is short and are not counted.
Reading: a payload in one file beside 31 blobs, mapped and summed, with pages in the cache.
"""

import os
import subprocess
import sys
import tempfile
import threading
import time
from functools import partial
from pathlib import Path

import torch

from neusee.nodes.optics import image, psf
from neusee.nodes.spectra import illuminate
from neusee.nodes.values import Psf, Pupil
from neusee.workflows.engine.node_call import call, call_by_band, plain_of
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.store import serialization
from neusee.workflows.store.band_files import Blobs, Stacked

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


def one_changed(inputs):
    """The inputs with another band 7."""
    first = inputs[0]
    if isinstance(first, Pupil):
        index = first.index.clone()
        index[7] += 1e-3
        return [first._replace(index=index), *inputs[1:]]
    first = first.clone()
    first[7] *= 1.01
    return [first, *inputs[1:]]


def by_band(step, inputs, blobs, parts=1):
    """Compute what is missing, and keep it."""
    value = call_by_band(
        step, inputs, lambda given: call(step, given, step.params, 0, "cpu"), "code", blobs, parts
    )
    serialization.pack(value, blobs)
    return plain_of(value)


def whole(step, inputs, folder):
    """Compute all of it, and keep it in one file."""
    value = call(step, inputs, step.params, 0, "cpu")
    write_file(folder / "payload", serialization.pack(value)[1])
    return value


def write_file(path, tensors):
    with open(path, "wb") as file:
        found = serialization.write(file, tensors)
        file.flush()
        os.fsync(file.fileno())
    return found


def seconds(work):
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def times(size):
    print(
        f"\n| step, 31 x {size} x {size} | whole, s | by band, all new, s | 1 of 31 changed, s |"
        " ratio | MB written |"
    )
    print("|---|---|---|---|---|---|")
    for name in STEPS[:3]:
        step, inputs = step_of(name, size)
        with tempfile.TemporaryDirectory() as folder:
            first, cold, again, written = _times(step, inputs, Path(folder))
        print(
            f"| {name} | {first:.2f} | {cold:.2f} | {again:.3f} | {first / again:.1f} |"
            f" {written:.1f} |",
            flush=True,
        )


def _times(step, inputs, root):
    """Seconds: in one file, by band, by band with one changed (each the least of three); and MB
    written for it.
    """
    call(step, inputs, step.params, 0, "cpu")  # tables and buffers
    found, before = [], 0
    for i in range(3):
        blobs = Blobs(root / str(i) / "bands")
        first = seconds(lambda: whole(step, inputs, root))
        cold = seconds(partial(by_band, step, inputs, blobs))
        before = _bytes(blobs)
        found.append((first, cold, seconds(partial(by_band, step, one_changed(inputs), blobs))))
    return *map(min, zip(*found, strict=True)), (_bytes(blobs) - before) / 1e6


def _bytes(blobs):
    return sum(path.stat().st_size for path in blobs.root.glob("*/*"))


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
    with tempfile.TemporaryDirectory() as folder:
        value = by_band(step, inputs, Blobs(Path(folder) / "bands"), parts)
        over.set()
        thread.join()
        del value
    print((most[0] - before) / 1e6)


def _anonymous():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon")) * 1024


def reads(size):
    x = torch.rand(BANDS, size, size)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        names = tuple(f"{i:032x}.0" for i in range(BANDS))
        in_file = min(seconds(lambda: write_file(root / "payload", [x])) for _ in range(3))
        fresh = [Blobs(root / str(i) / "bands") for i in range(3)]
        by_blob = min(
            seconds(partial(serialization.pack, Stacked(x, names), blobs)) for blobs in fresh
        )
        blobs, xxh3 = fresh[0], write_file(root / "payload", [x])
        print(f"\n| 31 x {size} x {size} | one file, s | 31 blobs, s |\n|---|---|---|")
        print(f"| write and sync | {in_file:.3f} | {by_blob:.3f} |")
        for verify in (True, False):
            expected = xxh3 if verify else None
            pairs = [
                (
                    seconds(
                        lambda e=expected: serialization.read(str(root / "payload"), e)[0].sum()
                    ),
                    seconds(lambda v=verify: blobs.read(names, x.shape, x.dtype, v).sum()),
                )
                for _ in range(5)
            ]
            plain, stacked = (min(column) for column in zip(*pairs, strict=True))
            print(
                f"| read{', verified,' if verify else ''} and sum | {plain:.3f} | {stacked:.3f} |",
                flush=True,
            )


def main(sizes):
    for size in sizes:
        reads(size)
        times(size)
        memory(size)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--peak"]:
        peak(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
    else:
        main([int(arg) for arg in sys.argv[1:]] or [1024, 2048])
