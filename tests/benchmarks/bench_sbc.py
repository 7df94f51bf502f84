"""Simulation-based calibration: `python tests/benchmarks/bench_sbc.py MODE [SIMULATIONS] [MOVE]
[FILE]`.

MODE is density (pixels alike) or camera (a drifting lamp, a bent response). SIMULATIONS (200)
cameras are drawn from the priors below; `plain_camera`, which shares no code with neusee, takes
their frames; `neusee calibrate` searches the mode and draws as ever. A table in Markdown: p of the
ranks, coverage and z of each parameter, with the bars that a right posterior misses in 1 of 1000
studies. MOVE is de, stretch, or snooker: the snooker of emcee 3.1.6, which must fail, walks without
the density that guides the other moves. Rows are kept in FILE, so that what was stopped goes on.
"""

import json
import math
import sys
import tempfile
import time
from pathlib import Path

import emcee
import numpy as np
import torch
from plain_camera import PlainCamera, frames_recipe, table

from neusee.workflows.calibration import emcee_sampler
from neusee.workflows.calibration.importance_sampling import draw_guide
from neusee.workflows.calibration.log_posterior import SensorPosterior, search_mode
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.posterior_tests import (
    DRAWS,
    PosteriorDraws,
    rank_tests,
    rank_truth,
    walk_draws,
)

#: by mode and parameter: median and factor; mean and standard deviation of those in `LINEAR`
PRIORS = {
    "density": {"gain": (0.25, 1.1), "offset": (240.0, 20.0), "read_noise": (12.0, 1.1), "dark_current": (40.0, 1.5),
                "full_well": (14000.0, 1.05), "quantum_efficiency": (0.5, 1.05)},
    "camera": {"gain": (0.25, 1.1), "quantum_efficiency": (0.5, 1.05), "dark_signal": (60.0, 3.0),
               "temporal_dark_noise": (12.0, 1.2), "dark_current": (40.0, 1.3), "scatter": (0.004, 1.5),
               "lamp": (0.01, 1.5), "drift": (0.04, 1.5), "bend": (0.0, 0.02), "twist": (0.0, 0.02)},
}  # fmt: skip
UNITS = {"gain": "DN/e-", "offset": "e-"} | dict.fromkeys(
    ("read_noise", "temporal_dark_noise", "dark_current", "full_well"), "e-"
)
LINEAR = ("offset", "dark_signal", "bend", "twist")
GUIDED = {"de": True, "stretch": True, "snooker": False}
TOP = 1900.0  #: DN, signal at which the response of the camera bends by bend and twist
STEPS = 60  #: of 4 x 64 walkers, of which 99 draws are taken; `neusee calibrate` walks at least 250


def drawn_from(mode, rng):
    """A camera of the prior, by the names of the posterior."""
    normal = {name: rng.standard_normal() for name in PRIORS[mode]}
    return {
        name: a + b * normal[name] if name in LINEAR else a * math.exp(math.log(b) * normal[name])
        for name, (a, b) in PRIORS[mode].items()
    }


def measured(mode, truth, number, folder):
    """The recipe of a measurement of the camera ``truth``."""
    prior = [
        f"steps.prior.with.{name}=[{a!r} {UNITS.get(name, '')},"
        f" {b!r}{' e-' if name == 'offset' else ''}]"
        for name, (a, b) in PRIORS[mode].items()
    ]
    if mode == "camera":
        camera = PlainCamera(**truth, top=TOP)
        file = table(camera, [number, 2], folder / "levels.csv", size=64, lit=15, beyond=1.5)
        return load("calibrate_camera", [f"table.file={file}", *prior])
    camera = PlainCamera(
        gain=truth["gain"],
        quantum_efficiency=truth["quantum_efficiency"],
        temporal_dark_noise=truth["read_noise"],
        dark_current=truth["dark_current"],
        dark_signal=truth["gain"] * truth["offset"],
        full=truth["full_well"] - truth["offset"],
        first=0.0,
    )
    return load(str(frames_recipe(camera, [number, 2], folder, size=48, lit=10, darks=4)), prior)


def at_the_top(problem, truth):
    """Return the truth with bend and twist at the brightest level that the calibration uses, and
    not at TOP.
    """
    lit, mean, variance = (
        problem.levels.photons.numpy() > 0,
        problem.levels.mean.numpy(),
        problem.levels.variance.numpy(),
    )
    signal = mean - mean[0]  # the first level is the shortest dark
    share = signal[signal <= 0.7 * signal[lit][variance[lit].argmax()]].max() / TOP
    return truth | {"bend": truth["bend"] * share, "twist": truth["twist"] * share**2}


def simulated(mode, number, move):
    truth = drawn_from(mode, np.random.default_rng([number, 1]))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        problem = SensorPosterior.of(measured(mode, truth, number, folder), Store(folder / "store"))
        truth = at_the_top(problem, truth) if mode == "camera" else truth
        began = time.process_time()
        best = search_mode(problem)
        if GUIDED[move]:
            guide = draw_guide(problem, best, np.random.default_rng(number))
            emcee_sampler._FIRST_STEPS = emcee_sampler._MOST_STEPS = STEPS
            chains = emcee_sampler.sample(
                problem,
                best,
                folder / "c.h5",
                emcee_sampler.Sampling(seed=number, move=move),
                guide=guide,
            )
            rng = np.random.default_rng([number, 3])
            flat = chains.flat[rng.choice(len(chains.flat), DRAWS, replace=False)]
            found = PosteriorDraws(
                flat, chains.tau, chains.steps > 10 * chains.tau, emcee_sampler.stranded(chains.log)
            )
        else:
            found = walk_draws(problem, best, number, move_name=move)
        row = rank_truth(problem, truth, found)
    return {"number": number, **vars(row), "seconds": time.process_time() - began}


class Row:
    """A kept row, by the names that `rank_tests` reads."""

    def __init__(self, row):
        self.__dict__.update(row)


def main(mode="camera", count=200, move="de", file=None):
    torch.set_num_threads(1)
    if move == "snooker":  # a planted fault, which `move` refuses
        emcee_sampler._MOVES[move] = emcee.moves.DESnookerMove
    path = Path(file or f"sbc_{mode}_{move}.jsonl")
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {row["number"] for row in rows}
    for number in range(int(count)):
        if number not in done:
            rows.append(simulated(mode, number, move))
            with path.open("a") as opened:
                opened.write(json.dumps(rows[-1]) + "\n")
    print(
        "| parameter | p | at least | coverage | bar | z mean | z sd |"
        " |\n|---|---|---|---|---|---|---|---|"
    )
    found = [Row(row) for row in rows[: int(count)]]
    for v in rank_tests(found):
        held = "fails" if v.failed else "holds"
        print(
            f"| {v.name} | {v.p:.3f} | {v.least_p:.4f} | {v.coverage:.3f} | {v.bar[0]:.3f} to"
            f" {v.bar[1]:.3f} | {v.z_mean:+.2f} | {v.z_sd:.2f} | {held} |"
        )
    short = sum(not row.independent for row in found)
    print(
        f"\n{len(found)} simulations in mode {mode}, {np.median([r.seconds for r in found]):.1f} s"
        f" of processor time each; {short} chains too short, {sum(r.stranded > 0 for r in found)}"
        f" with stranded walkers; tau {np.median([r.tau for r in found]):.1f}, at most"
        f" {max(r.tau for r in found):.1f}."
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
