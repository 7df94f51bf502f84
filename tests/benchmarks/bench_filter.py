"""Time and error of the Wiener filter, as shipped and as before: `bench_filter.py [SIDE [MASKS
[SCENES [STRENGTHS]]]]`.

    python tests/benchmarks/bench_filter.py 96
    python tests/benchmarks/bench_filter.py 384 five_half_rings,half_ring china 0,1e5

The camera of `first_light` behind several masks, with several scenes and a green laser of several
strengths; every case has its own seed. The filter runs on the same problem with the numbers of its
grids and steps as before (`BEFORE`), as shipped, and until it has converged in float64. A table in
Markdown, with a row for each mask: processor seconds, rms error from the converged answer over the
contrast (median and largest), PSNR in dB, and the mean change of the PSNR with a 90 % interval over
the cases. `bench_filter.py pictures` measures pictures of `neusee train train_demonstration`.
"""

import math
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean, median, stdev

import torch
from scipy import stats

from neusee.nodes import metrics, restore
from neusee.nodes.restore.inverse import (
    _conjugate_gradients,
    _hidden_pixels,
    _masked_blur,
    _wiener,
    descend,
    most_likely,
)
from neusee.workflows.engine.runner import run
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.run_training import training_photographs
from neusee.workflows.training.training_pictures import PictureSource, TrainingStream

MASKS, SCENES, STRENGTHS = (
    "flat,half_ring,five_half_rings,demonstration",
    "china,siemens",
    "0,1e2,1e4,1e6",
)
NAMES = [
    "signal[mask]",
    "clipped[mask]",
    "truth",
    "matrix",
    "illuminant",
    "responses",
    "bands",
    "psf[mask]",
    "laser_photons[mask,green]",
]
BEFORE = {
    (_masked_blur, "DENSE"): 40,
    (_conjugate_gradients, "MODES"): 1000,
    (_conjugate_gradients, "LOWEST"): 256,
    (_hidden_pixels, "ENOUGH"): 1e-5,
}
CONVERGED = 300  #: steps from the answer as before


def values(side, mask, scene, strength, seed, store):
    """The results of the steps of the camera that the filter reads."""
    small = [
        f"scene.shape=[{side + 96},{side + 96}]",
        f"sensor.shape=[{side},{side}]",
        "optics.window=[512,512]",
    ]
    options = [
        f"doe={mask}",
        f"scene={scene}",
        f"lasers.green.strength={strength:g}",
        f"seed={seed}",
    ]
    found = run(load("first_light", [*options, *small], Path()), store, NAMES)
    return {name: found[name] for name in NAMES}


@contextmanager
def numbers(those):
    """Other numbers of the grids and steps."""
    shipped = {place: getattr(*place) for place in those}
    for (module, name), value in those.items():
        setattr(module, name, value)
    try:
        yield
    finally:
        for (module, name), value in shipped.items():
            setattr(module, name, value)


def before(problem, coarser=True):
    """The answer with the numbers as before, for the grid as shipped."""
    with numbers(BEFORE):
        return most_likely(problem, enough=_hidden_pixels.ENOUGH)


def shipped(problem, coarser=True):
    """The answer as shipped."""
    return most_likely(problem)


def converged(problem, coarser=True):
    """The answer after many steps, with a preconditioner on every grid."""
    with numbers({(_conjugate_gradients, "LOWEST"): 512}):
        return descend(problem, before(problem), CONVERGED, 0.0)


def filtered(seen, solve):
    """The restored picture in float64 and the seconds of processor time."""
    exact = {(_wiener, "PRECISE"): 10**9} if solve is converged else {}
    with numbers({(_wiener, "most_likely"): solve, **exact}):
        began = time.process_time()
        found = restore.wiener(
            seen["signal[mask]"],
            seen["psf[mask]"],
            seen["illuminant"],
            seen["responses"],
            seen["bands"],
            seen["clipped[mask]"],
            [seen["laser_photons[mask,green]"]],
            read_noise=10.5,
        )
        return found.double(), time.process_time() - began


def case(seen):
    """Seconds, errors and PSNR of one case: as before and as shipped, and the PSNR of the
    converged answer.
    """
    (old, then), (new, now), (right, _) = (
        filtered(seen, solve) for solve in (before, shipped, converged)
    )
    psnr = [
        float(metrics.quality(restore.colour(x.float(), seen["matrix"]), seen["truth"]).psnr)
        for x in (old, new, right)
    ]
    errors = [float((x - right).square().mean().sqrt() / right.std()) for x in (old, new)]
    return then, now, *errors, *psnr


def interval(changes):
    """The mean and half of the 90 % interval of the mean, by Student's t."""
    half = (
        stats.t.ppf(0.95, len(changes) - 1) * stdev(changes) / math.sqrt(len(changes))
        if changes[1:]
        else math.nan
    )
    return f"{fmean(changes):+.3f} ± {half:.3f}"


def row(name, cases):
    then, now, old, new, psnr_old, psnr_new, psnr_right = zip(*cases, strict=True)
    change = interval([b - a for a, b in zip(psnr_old, psnr_new, strict=True)])
    errors = [f"{median(each):.1e} ({max(each):.1e})" for each in (old, new)]
    means = [f"{fmean(each):.2f}" for each in (then, now, psnr_old, psnr_new, psnr_right)]
    print(
        "|",
        " | ".join([name, str(len(cases)), *means[:2], *errors, *means[2:], change]),
        "|",
        flush=True,
    )


def main(side, masks=MASKS, scenes=SCENES, strengths=STRENGTHS):
    store, every = Store(), []
    print(
        "| mask | cases | s before | s now | error before | error now | PSNR before | now |"
        " converged | change |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|", flush=True)
    for mask in masks.split(","):
        wanted = [
            (scene, float(strength))
            for scene in scenes.split(",")
            for strength in strengths.split(",")
        ]
        cases = [
            case(values(int(side), mask, *each, 7 + n, store)) for n, each in enumerate(wanted)
        ]
        row(mask, cases)
        every += cases
    row("all", every)


def pictures(count=3):
    """Seconds of processor time of a training picture of `train_demonstration`: simulation and
    filter, filter alone.
    """
    recipe = load("train_demonstration", ["train.laser_free=0"], Path())
    photographs = training_photographs(recipe, recipe.training, True)
    stream = TrainingStream(recipe, recipe.training, PictureSource(photographs, Store()), recipe)
    spent = []

    def timed(*args, **how):
        began = time.process_time()
        found = solve(*args, **how)
        spent.append(time.process_time() - began)
        return found

    for solve in (shipped, before):
        with numbers({(_wiener, "most_likely"): timed}):
            for number in range(count + 1):
                began = time.process_time()
                stream._alone({}, 2, number)
                whole = time.process_time() - began
                print(
                    f"{solve.__name__} {number}: {whole:.2f} s, deconvolution {spent[-1]:.2f} s",
                    flush=True,
                )


if __name__ == "__main__":
    torch.set_num_threads(1)
    pictures() if sys.argv[1:] == ["pictures"] else main(*(sys.argv[1:] or ["96"]))
