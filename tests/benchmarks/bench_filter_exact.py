"""Error of the Wiener filter against the exact minimum of its problem: `bench_filter_exact.py [SIDE
[FILE]]`.

Four masks, two scenes and four strengths of a laser, every case with its own seed, as in
`bench_filter.py`. The exact answer is that of a dense covariance of all seen pixels, factorised in
float64 by SciPy: it has no iteration, no coarse grid and no code of the filter. Compared with it
are the filter with the numbers of its grids as before, as shipped, as shipped in float32, and after
300 further steps. SIDE (48) is that of the picture; 3 SIDE^2 unknowns take 72 SIDE^4 bytes. FILE
keeps each case, so that a run goes on where it was stopped.

A table in Markdown with a row for each mask: rms error over the contrast (median, and the largest
in brackets), and the PSNR as shipped less that of the exact answer in dB, with a 90 % interval over
the cases.
"""

import json
import sys
from pathlib import Path
from statistics import fmean, median

import numpy as np
import torch
from bench_filter import (
    MASKS,
    SCENES,
    STRENGTHS,
    before,
    converged,
    filtered,
    interval,
    numbers,
    shipped,
    values,
)
from scipy.linalg import cho_factor, cho_solve

from neusee.nodes import metrics, restore
from neusee.nodes.restore.inverse import _wiener
from neusee.workflows.store.result_store import Store

WAYS = ("before", "shipped", "float32", "converged")


def exact(problem, coarser=True):
    """The half spectrum of the most likely picture, from the covariance of all seen pixels of
    all channels.
    """
    transfer, power = problem.transfer.numpy().astype(complex), problem.power.numpy().astype(float)
    weight, size = problem.weight.numpy().astype(float), problem.torus
    channels = len(weight)
    colours = np.full((channels, channels), problem.grey) + (1 - problem.grey) * np.eye(channels)
    seen = [np.nonzero(weight[c]) for c in range(channels)]
    matrix = np.block(
        [
            [
                colours[c, d]
                * _covariance(transfer[c] * transfer[d].conj() * power, size, seen[c], seen[d])
                for d in range(channels)
            ]
            for c in range(channels)
        ]
    )
    matrix[np.diag_indices_from(matrix)] += np.concatenate(
        [1 / weight[c][seen[c]] for c in range(channels)]
    )
    factor = cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)
    told = _flat(problem.picture.numpy(), seen)
    pull = cho_solve(factor, told)
    if problem.glare:  # patterns of any strength: generalised least squares
        shapes = np.stack([_flat(pattern.numpy(), seen) for pattern in problem.glare], 1)
        shapes = shapes / np.linalg.norm(shapes, axis=0)
        through = cho_solve(factor, shapes)
        pull = pull - through @ np.linalg.lstsq(shapes.T @ through, shapes.T @ pull, rcond=None)[0]
    spectra, first = [], 0
    for c in range(channels):
        plane = np.zeros(size)
        plane[seen[c]] = pull[first : first + len(seen[c][0])]
        first += len(seen[c][0])
        spectra.append(transfer[c].conj() * np.fft.rfft2(plane))
    return torch.from_numpy(np.tensordot(colours, np.stack(spectra), 1) * power)


def _covariance(spectrum, size, one, other):
    """The covariance of the seen pixels of two channels, from its half spectrum on a periodic
    grid.
    """
    lags = np.fft.irfft2(spectrum, s=size)
    return lags[one[0][:, None] - other[0], one[1][:, None] - other[1]]


def _flat(planes, seen):
    return np.concatenate([plane.astype(float)[at] for plane, at in zip(planes, seen, strict=True)])


def case(seen):
    """The error of each way, the PSNR as shipped and exact, and the largest slope that the exact
    answer leaves.
    """
    right, _ = filtered(seen, exact)
    found = {"before": before, "shipped": shipped, "converged": converged}
    errors = {}
    for name in WAYS:
        with numbers(
            {(_wiener, "PRECISE"): 0} if name == "float32" else {(_wiener, "PRECISE"): 10**9}
        ):
            picture, seconds = filtered(seen, found.get(name, shipped))
        errors[name] = [float((picture - right).square().mean().sqrt() / right.std()), seconds]
        if name == "shipped":
            answer = picture
    psnr = [
        float(metrics.quality(restore.colour(x.float(), seen["matrix"]), seen["truth"]).psnr)
        for x in (answer, right)
    ]
    return {"errors": errors, "psnr": psnr}


def row(name, cases):
    errors = {way: [each["errors"][way][0] for each in cases] for way in WAYS}
    told = [f"{median(errors[way]):.1e} ({max(errors[way]):.1e})" for way in WAYS]
    times = [
        f"{fmean(each['errors'][way][1] for each in cases):.2f}"
        for way in ("before", "shipped", "float32")
    ]
    change = interval([now - right for now, right in (each["psnr"] for each in cases)])
    print("|", " | ".join([name, str(len(cases)), *told, *times, change]), "|", flush=True)


def main(side="48", file=None):
    store, known = Store(), {}
    if file and Path(file).exists():
        known = {
            tuple(key): rest for key, rest in map(json.loads, Path(file).read_text().splitlines())
        }
    wanted = [
        (scene, float(strength)) for scene in SCENES.split(",") for strength in STRENGTHS.split(",")
    ]
    masks = MASKS.split(",")
    # all masks in turn: a table that was stopped has cases of each
    for n, each in enumerate(wanted):
        for mask in masks:
            key = (mask, *each)
            if key not in known:
                known[key] = case(values(int(side), *key, 107 + n, store))
                if file:
                    with Path(file).open("a") as out:
                        out.write(json.dumps([key, known[key]]) + "\n")
    table({mask: [known[mask, *each] for each in wanted] for mask in masks})


def table(cases):
    columns = ("mask", "cases", "error before", "now", "now in float32", "300 more steps")
    columns += ("s before", "now", "in float32", "PSNR now - exact")
    print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    for mask, each in cases.items():
        row(mask, each)
    row("all", [one for each in cases.values() for one in each])


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(*sys.argv[1:])
