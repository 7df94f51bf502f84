"""What a GPU gives beside the processor of the same machine: `python tests/benchmarks/bench_gpu.py
[FOLDER] [PART…]`.

Parts: `scan` (the selective scan beside mambapy and torch), `psf` (31 bands, 2160 x 2160 pupil,
        2048 x 2048 pixels),
`recipes` (whole recipes with a warm process and an empty cache, and the largest difference of their
results), `train` (iterations of the recipe `train` in the size of the paper; FOLDER holds
photographs). A part that fails says so and the next begins. Prints tables in Markdown. Times are
medians of several turns, the GPU waited for.
"""

import os
import statistics
import sys
import tempfile
import time
import traceback
import warnings
from itertools import pairwise
from pathlib import Path

import torch

warnings.simplefilter("ignore")

from neusee.nodes import doe as masks  # noqa: E402
from neusee.nodes import optics, spectra  # noqa: E402
from neusee.nodes.restore.networks import reference, selective_scan  # noqa: E402
from neusee.workflows import Store, load  # noqa: E402
from neusee.workflows.engine.runner import run  # noqa: E402

DEVICE = "cuda:0"
RECIPES = ("first_light", "six_lasers", "paper_table1")
COMPARED = (
    "psf",
    "image",
    "lsr",
    "deconvolved",
    "restored",
    "developed_quality",
    "restored_quality",
)


def seconds(work, repeats=5):
    """Median time of a call after one that does not count, and half of the spread of the others."""
    taken = []
    for _ in range(repeats + 1):
        torch.cuda.synchronize()
        began = time.perf_counter()
        work()
        torch.cuda.synchronize()
        taken.append(time.perf_counter() - began)
    return statistics.median(taken[1:]), (max(taken[1:]) - min(taken[1:])) / 2


# --- the scan -------------------------------------------------------------------------------------


def mambapy(u, dt, A, B, C):
    from mambapy.pscan import pscan

    states = pscan(torch.exp(dt[..., None] * A), (dt * u)[..., None] * B[:, :, None])
    return (states @ C[..., None])[..., 0]


def scan():
    from tests.benchmarks.bench_scan import draw

    print("| length | who | forward and backward ms | error |\n|---|---|---|---|")
    for length in (4096, 65_536):
        values = [x.detach().cuda().requires_grad_() for x in draw(length)]
        truth = reference(*(x.detach() for x in values))
        for name, chosen_scan in (("torch", selective_scan), ("mambapy", mambapy)):

            def once(chosen_scan=chosen_scan, values=values):
                y = chosen_scan(*values)
                y.sum().backward()
                return y

            middle, spread = seconds(once)
            error = float((once().detach() - truth).abs().max() / truth.abs().max())
            print(
                f"| {length} | {name} | {1e3 * middle:.2f} ± {1e3 * spread:.2f} | {error:.0e} |",
                flush=True,
            )


# --- point-spread functions -----------------------------------------------------------------------


def psf():
    found = {}
    print("| device | 31 bands ms |\n|---|---|")
    for device in ("cpu", DEVICE):
        bands = spectra.bands(start=400e-9, stop=700e-9, count=31)
        stop = optics.stop(samples=2160, pitch=3.74e-6, diameter=8e-3)
        height = masks.half_rings(stop, waves=(60.0,))
        pupil = optics.pupil(
            height, masks.material(bands, material="fused silica"), bands, stop, None
        )
        pupil = type(pupil)(*(x.to(device) if isinstance(x, torch.Tensor) else x for x in pupil))

        def once(pupil=pupil):
            return optics.psf(pupil, focal_length=0.11, pixel_pitch=2.9e-6, shape=(2048, 2048))

        middle, spread = seconds(once, 3)
        found[device] = once().intensity[::10].cpu()
        print(f"| {device} | {1e3 * middle:.0f} ± {1e3 * spread:.0f} |", flush=True)
    one, other = found.values()
    print(f"\nLargest difference over the peak: {float((one - other).abs().max() / one.max()):.1e}")


# --- whole recipes --------------------------------------------------------------------------------


def each_tensor(value):
    if isinstance(value, torch.Tensor):
        yield value.detach().cpu().double()
    elif isinstance(value, list | tuple):
        for part in value:
            yield from each_tensor(part)


def difference(one, other):
    """Largest difference of two results over the largest value of each tensor."""
    pairs = zip(each_tensor(one), each_tensor(other), strict=True)
    return max(
        (
            float((a - b).abs().max() / b.abs().max().clamp_min(1e-30))
            for a, b in pairs
            if a.numel()
        ),
        default=0.0,
    )


def recipes():
    print("| recipe | processor s | GPU s | ratio | PSNR restored, both | largest difference |")
    print("|---|---|---|---|---|---|")
    for name in RECIPES:
        recipe = load(name, ["sensor.arrivals=gaussian"])
        outputs = [step for step in recipe.steps if step.partition("[")[0] in COMPARED]
        taken, found = {}, {}
        for device in ("cpu", DEVICE, DEVICE):  # the first run on the GPU compiles
            with tempfile.TemporaryDirectory() as folder:
                began = time.perf_counter()
                found[device] = run(recipe, Store(Path(folder)), outputs, device=device).values
                taken[device] = time.perf_counter() - began
        here, there = found["cpu"], found[DEVICE]
        alike = {
            n: difference(there[n], here[n])
            for n in outputs
            if n.startswith(("psf", "image", "lsr"))
        }
        quality = [
            f"{float(x['restored_quality'].psnr):.2f}"
            for x in (here, there)
            if "restored_quality" in x
        ]
        worst = max(alike, key=alike.get)
        ratio = taken["cpu"] / taken[DEVICE]
        print(f"| {name} | {taken['cpu']:.1f} | {taken[DEVICE]:.1f} | {ratio:.1f} | {', '.join(quality)} | "
              f"{alike[worst]:.0e} ({worst}) |", flush=True)  # fmt: skip


# --- a training in the size of the paper ----------------------------------------------------------


def train():
    from neusee.workflows.api import verbs

    photographs = next((x for x in sys.argv[1:] if Path(x).is_dir()), None)
    words = [
        f"train.photographs={photographs}",
        "train.held_out=null",
        "train.stages.1.iterations=4",
        "train.stages.2.iterations=6",
        "train.pool=8",
    ]
    recipe = load("train", words)
    marks = []
    torch.cuda.reset_peak_memory_stats()

    def watch(stage, done, losses):
        torch.cuda.synchronize()
        marks.append((stage, time.perf_counter()))

    with tempfile.TemporaryDirectory() as folder:
        where = {"store": Store(Path(folder) / "cache"), "out": Path(folder) / "runs"}
        verbs.train(recipe, device=DEVICE, watch=watch, **where)
    for stage in (1, 2):
        times = [t for s, t in marks if s == stage]
        steps = [b - a for a, b in pairwise(times)]
        batch = recipe.training.stages[stage].batch
        middle, ends = statistics.median(steps), f"{min(steps):.2f} to {max(steps):.2f}"
        print(f"stage {stage}: {middle:.2f} s an iteration of {batch} pictures ({ends})")
    print(f"peak of the GPU's memory {torch.cuda.max_memory_allocated() / 1e9:.1f} GB")


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[2]))
    parts = {"scan": scan, "psf": psf, "recipes": recipes, "train": train}
    chosen = [x for x in sys.argv[1:] if x in parts] or list(parts)
    print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}, {os.cpu_count()} cores\n")
    for part in chosen:
        print(f"\n### {part}\n", flush=True)
        try:
            parts[part]()
        except Exception:
            print(f"\nfailed: {traceback.format_exc(limit=-3)}", flush=True)
