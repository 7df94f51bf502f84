"""Coverage of a lens's stray light: `python tests/benchmarks/bench_stray_light.py [CAMERAS] [FILE]
[PRIOR] [FIRST]`.

A table in Markdown of CAMERAS (200), from number FIRST (0) on, whose lens is drawn from PRIOR:
`wide` (that of the recipe `calibrate_stray_light`) or `narrow` (that of the tests). How many 90 %
intervals of b0, l and s hold the truth, the effective sample size, and how often a misfit is told.
Pictures are those of tests/workflows/calibration/simulated_lenses.py, by NumPy and SciPy alone, of
128 x 128 pixels of 4 to 6.5 um in light of 10 to 40 nm. FILE keeps a line for each camera that is
done; a second call goes on from there.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
import torch

from neusee.workflows.calibration.identifiability import identify
from neusee.workflows.calibration.importance_sampling import draw_samples
from neusee.workflows.calibration.log_posterior import find_mode, initial_theta
from neusee.workflows.calibration.posterior_checks import LARGEST_SURPRISE, SLOW_P_VALUE, slow_waves
from neusee.workflows.calibration.posterior_mixture import normalised
from tests.workflows.calibration.simulated_lenses import (
    PRIOR,
    drawn_camera,
    problem_of,
    recipe_prior,
)

SHAPE = ("b0", "l", "s")


def fitted(seed, prior):
    """Return what the fit of one camera says of its lens, as plain numbers."""
    truth, lens, rings = drawn_camera(seed, prior)
    problem = problem_of(rings, prior, lens)
    began = time.process_time()
    mode = find_mode(problem, initial_theta(problem))
    try:
        samples, log = draw_samples(problem, mode, np.random.default_rng(seed))
    except ValueError as error:
        return {"seed": seed, "truth": truth, "refused": str(error)}
    weight = normalised(log)
    samples, weight = samples[weight > 0], weight[weight > 0]
    found = problem.parameters(samples)
    below = {name: float(weight @ (found[name].numpy() < truth[name])) for name in SHAPE}
    top = samples[[int(problem.log_posterior(samples).argmax())]]
    look, z = problem.likelihood(top), problem.whitened(samples)
    middle = weight @ z
    return {
        "seed": seed,
        "truth": truth,
        "below": below,
        "kinds": identify(problem, mode).kinds,
        "effective": float(1 / (weight**2).sum()),
        "settled": bool(mode.settled),
        "residuals": (
            ((rings.mean - look.mean.reshape(-1)) / look.variance.reshape(-1).sqrt()).tolist()
        ),
        "ends": [[_quantile(column, weight, share) for column in z.T] for share in (0.05, 0.95)],
        "middle": middle.tolist(),
        "width": np.sqrt(weight @ (z - middle) ** 2).tolist(),
        "seconds": time.process_time() - began,
    }


def _quantile(values, weight, share):
    order = np.argsort(values)
    return float(values[order][np.searchsorted(np.cumsum(weight[order]), share)])


def main(count=200, file="stray_light_coverage.jsonl", prior="wide", first=0):
    torch.set_num_threads(1)
    path, prior = Path(file), {"wide": recipe_prior, "narrow": lambda: PRIOR}[prior]()
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {row["seed"] for row in rows}
    for seed in sorted(set(range(int(first), int(first) + int(count))) - done):
        rows.append(fitted(seed, prior))
        with path.open("a") as kept:
            kept.write(json.dumps(rows[-1]) + "\n")
    refused, rows = len(rows), [row for row in rows if "refused" not in row]
    refused -= len(rows)
    below = np.array([[row["below"][name] for name in SHAPE] for row in rows])
    held = ((below >= 0.05) & (below <= 0.95)).mean(0)
    sizes = np.array([row["effective"] for row in rows])
    misfits = sum(slow_waves(np.array(row["residuals"]))[1] < SLOW_P_VALUE for row in rows)
    surprises = sum(np.abs(row["middle"]).max() > LARGEST_SURPRISE for row in rows)
    print(
        "| cameras | refused | b0 | l | s | misfit told | prior said to be wrong | effective size:"
        " least, median | s |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    shares = " | ".join(f"{100 * share:.1f} %" for share in held)
    spent = np.median([row["seconds"] for row in rows])
    size = f"{sizes.min():.0f}, {np.median(sizes):.0f}"
    print(
        f"| {len(rows)} | {refused} | {shares} | {misfits} | {surprises} | {size} | {spent:.1f} |"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
