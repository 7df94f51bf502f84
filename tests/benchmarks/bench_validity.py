"""Which faults of calibration frames are found, from which amplitude, and from which amplitude they
bias the result.

    python tests/benchmarks/bench_validity.py [cameras] [clean cameras]

The frames come from a camera in NumPy that shares no code with the nodes. A fault is found where a
test of the frames says "widened" or "refused"; the amplitude found half of the time is
interpolated. The bias is that of the system gain and of the dark noise in electrons by the
photon-transfer line of NumPy, in standard deviations of the same line over clean cameras; the
larger one of both counts. The stated error is the error of the same line in single cameras that are
not refused, in stated standard deviations: those of the line and of the faults that may hide. By
chance alone its root mean square is 1 or less.
"""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import torch
from scipy.stats import binomtest

from neusee.nodes.calibrate import Stack, inspect_frames, open_errors

_spec = importlib.util.spec_from_file_location(
    "numpy_camera", Path(__file__).parents[1] / "nodes/calibrate/numpy_camera.py"
)
numpy_camera = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(numpy_camera)

#: amplitudes of each fault, rising
AMPLITUDES = {
    "mixing": (0.003, 0.01, 0.02, 0.03, 0.1),
    "lag": (0.003, 0.01, 0.02, 0.03),
    "telegraph": (0.0001, 0.0003, 0.001, 0.02),
    "black": (-4.0, -3.0, -2.5, -2.0, 0.0),
    "rows": (0.2, 0.4, 0.8, 2.0),
    "columns": (0.2, 0.4, 0.8, 2.0),
    "compression": (0.5, 1.0, 2.0, 4.0),
    "dsnu": (1.0, 8.0),
    "prnu": (0.003, 0.01),
    "hot": (0.001, 0.01),
    "drift": (0.003, 0.01),
    "knee": (0.9, 0.7, 0.5),
    "truncation": (1.0,),
}


def levels(seed, **faults):
    return numpy_camera.Camera(seed, size=96, lit=12, darks=4, faults=faults).levels()


def inspected(found):
    stacks = [
        Stack(name, photons, time, "steady", torch.from_numpy(x))
        for name, photons, time, x in found
    ]
    return inspect_frames(stacks, False, 0.7)


def alarms(tests):
    return [t.name for t in tests if t.verdict in ("widened", "refused")]


def refused(tests):
    return any(test.verdict == "refused" for test in tests)


def stated_errors(found, tests, sd):
    """Return the errors of gain and dark noise in stated standard deviations."""
    hidden = open_errors([hidden for test in tests for hidden in test.hidden])
    shifts = [
        np.hypot.reduce([0.0, *(t.shifts.get(name, 0.0) for t in tests)])
        for name in ("gain", "noise")
    ]
    error = gain_and_noise(found) - np.log([0.125, 8.0])
    stated = [[sd[0], hidden["gain"], shifts[0]], [sd[1], *hidden.values(), *shifts]]
    return error / [np.hypot.reduce(x) for x in stated]


def gain_and_noise(found):
    """Return ln K and ln of the dark noise in electrons, from the levels below 70 % of the
    greatest variance.
    """
    dark = [
        np.diff(x.astype(float), axis=0).var() / 2 for name, photons, _, x in found if not photons
    ]
    base = np.mean([x.mean() for _, photons, _, x in found if not photons])
    lit = [
        (x.mean() - base, np.diff(x.astype(float), axis=0).var() / 2) for _, p, _, x in found if p
    ]
    mean, variance = np.array(lit).T
    used = mean <= 0.7 * mean[variance.argmax()]
    gain = (mean[used] @ (variance[used] - np.mean(dark))) / (mean[used] @ mean[used])
    return np.log([gain, np.sqrt(max(np.mean(dark) - 1 / 12, 1e-9)) / gain])


def crossing(amplitudes, values, bar):
    """Return the amplitude at which values first reach a bar, interpolated, as text."""
    for i, value in enumerate(values):
        if value >= bar:
            if i == 0:
                return f"below {amplitudes[0]:g}"
            low = values[i - 1]
            return f"{amplitudes[i - 1] + (bar - low) / (value - low) * (amplitudes[i] - amplitudes[i - 1]):.2g}"
    return f"above {amplitudes[-1]:g}"


def row(name, amplitudes, seeds, centre, sd):
    """Return the cells of one fault."""
    shares, biases, stated = [], [], []
    for amplitude in amplitudes:
        frames = [levels(seed, **{name: amplitude}) for seed in seeds]
        tests = [inspected(found) for found in frames]
        shares.append(np.mean([bool(alarms(found)) for found in tests]))
        off = (np.array([gain_and_noise(found) for found in frames]) - centre).mean(0)
        biases.append(float(np.abs(off / sd).max()))
        kept = [
            stated_errors(f, t, sd) for f, t in zip(frames, tests, strict=True) if not refused(t)
        ]
        stated.append(
            f"{np.sqrt(np.square(kept).mean(0).max()):.1f} ({len(kept)})" if kept else "refused"
        )
    return (
        " ".join(f"{a:g}" for a in amplitudes),
        " ".join(f"{s:.0%}" for s in shares),
        " ".join(f"{b:.1f}" for b in biases),
        ", ".join(stated),
        crossing(amplitudes, shares, 0.5),
        crossing(amplitudes, biases, 1.0),
    )


def main(cameras=8, clean=400):
    torch.set_num_threads(1)
    seeds = range(int(cameras))
    plain = np.array([gain_and_noise(levels(seed)) for seed in range(24)])
    sd, centre = plain.std(0), plain[: len(seeds)]
    print(
        "| fault | amplitudes | found | bias, sd | stated error (cameras) | found half of the time"
        " at | one sd at |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, amplitudes in {"clean": (0.0,), **AMPLITUDES}.items():
        print(f"| {name} | {' | '.join(row(name, amplitudes, seeds, centre, sd))} |", flush=True)
    uneven = {"prnu": 0.01, "dsnu": 3, "lamp": 0.015}
    tests = (
        inspected(levels(5000 + seed, **(uneven if seed % 2 else {}))) for seed in range(int(clean))
    )
    wrong = sum(bool(alarms(found)) for found in tests)
    ends = binomtest(wrong, int(clean)).proportion_ci(0.95, "exact")
    print(
        f"\n{wrong} of {clean} clean cameras widened or refused ({ends.low:.2%} to"
        f" {ends.high:.2%})."
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
