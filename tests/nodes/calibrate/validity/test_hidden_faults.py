"""Faults that frames may hide: the posterior of their size against SciPy, and what it leaves
open in NumPy frames.
"""

import importlib.util
import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.stats import cauchy, norm

from neusee.nodes.calibrate import (
    CLEAN_PAIRS,
    Hidden,
    Stack,
    chance_of_no_fault,
    inspect_frames,
    open_errors,
)

DATA = Path(
    os.environ.get("NEUSEE_EMVA1288", Path(__file__).parents[4] / "../shared/data/emva1288")
)
CCD = DATA / "EMVA1288_ReferenceSet_001_CCD_12Bit_pairs_64x64.npz"
_spec = importlib.util.spec_from_file_location(
    "numpy_camera", Path(__file__).parents[1] / "numpy_camera.py"
)
numpy_camera = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(numpy_camera)


def exact(estimate, error, scale, positive, sound):
    """The root mean square of a posterior with a Cauchy prior and an atom at 0."""
    low, high = (
        (0.0 if positive else min(0.0, estimate) - 9 * error),
        max(0.0, estimate) + 9 * error,
    )

    def density(x):
        return (
            (1 - sound)
            * norm.pdf(estimate, x, error)
            * cauchy.pdf(x, 0, scale)
            * (2 if positive else 1)
        )

    ends = {"points": [estimate] if low < estimate < high else None, "epsrel": 1e-9}
    whole = quad(density, low, high, **ends)[0] + sound * norm.pdf(estimate, 0, error)
    return math.sqrt(quad(lambda x: x * x * density(x), low, high, **ends)[0] / whole)


@pytest.mark.parametrize("sound", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("positive", [False, True])
@pytest.mark.parametrize("estimate", [-0.03, 0.0, 0.004, 0.05])
def test_the_size_of_a_hidden_fault_is_that_of_an_integral(estimate, positive, sound):
    hidden = Hidden("lag", estimate, 0.01, 0.02, 1.0, 0.5, positive=positive, sound=sound)
    size = exact(estimate, 0.01, 0.02, positive, sound)
    assert hidden.size() == pytest.approx(size, rel=0.01, abs=1e-6)
    errors = open_errors([hidden])
    assert errors["gain"] == pytest.approx(size, rel=0.01, abs=1e-6)
    assert errors["noise"] == pytest.approx(size / 2, rel=0.01, abs=1e-6)


def test_independent_faults_add_as_errors_and_shift_nothing():
    one = Hidden("mixing", 0.02, 0.001, 0.02, gain=1.0)
    other = Hidden("pattern", 0.01, 0.001, 0.01, gain=-1.0, positive=True)
    alone = [open_errors([fault])["gain"] for fault in (one, other)]
    assert open_errors([one, other])["gain"] == pytest.approx(math.hypot(*alone))
    # a fault that is found counts with its whole size
    assert alone == pytest.approx([0.02, 0.01], rel=0.02)
    assert open_errors([]) == {"gain": 0.0, "noise": 0.0}


def test_frames_of_few_pixels_leave_their_whole_error_open_and_many_almost_nothing():
    few, many = (
        Hidden("mixing", 0.0, 0.004, 0.02, gain=1.0, sound=chance_of_no_fault(n))
        for n in (1e4, CLEAN_PAIRS)
    )
    assert few.size() > 0.95 * 0.004
    assert many.size() < 0.2 * 0.004
    seen = Hidden("mixing", 0.02, 0.004, 0.02, gain=1.0, sound=chance_of_no_fault(CLEAN_PAIRS))
    assert seen.size() == pytest.approx(0.02, rel=0.1)


def inspected(seed, scatter="steady", size=96, **faults):
    found = numpy_camera.Camera(seed, size=size, lit=12, darks=4, faults=faults).levels()
    stacks = [
        Stack(name, photons, time, scatter, torch.from_numpy(x)) for name, photons, time, x in found
    ]
    exact = scatter == "all"
    return found, {
        test.name: test for test in inspect_frames(stacks, exact, None if exact else 0.7)
    }


def line(found):
    """The logarithm of the gain by a line of photon transfer through all levels, and its
    standard error.
    """
    mean, variance = np.array(
        [(x.mean(), np.diff(x.astype(float), axis=0).var() / 2) for *_, x in found]
    ).T
    design = np.stack([np.ones_like(mean), mean], 1) / variance[:, None]
    slope = np.linalg.pinv(design)[1] / variance
    gain = slope @ variance
    return math.log(gain), float(
        np.linalg.norm(slope * variance * math.sqrt(2 / found[0][3][0].size))
    ) / gain


@pytest.mark.parametrize(
    "faults",
    [
        pytest.param({}, marks=pytest.mark.slow),
        {"mixing": 0.01},
        pytest.param({"lag": 0.01}, marks=pytest.mark.slow),
        {"lag": 0.01, "prnu": 0.01, "dsnu": 4},
    ],
)
def test_a_fault_too_small_to_be_found_is_in_the_interval(faults):
    """Root mean squares over six cameras, in stated standard deviations; of statistics alone up
    to nine.
    """
    alone, stated = [], []
    for seed in range(6):
        found, tests = inspected(seed, **faults)
        if any(test.verdict == "refused" for test in tests.values()):
            continue
        gain, error = line(found)
        width = open_errors([h for test in tests.values() for h in test.hidden])["gain"]
        alone.append((gain - math.log(0.125)) / error)
        stated.append((gain - math.log(0.125)) / math.hypot(error, width))
    assert len(stated) >= 3
    assert np.sqrt(np.square(stated).mean()) < 1.6
    if faults:
        assert np.sqrt(np.square(alone).mean()) > 4


@pytest.mark.parametrize(
    ("faults", "share"), [({"mixing": 0.02}, 0.0402), ({"lag": 0.015}, 0.0451)]
)
def test_what_is_found_has_the_size_of_what_was_planted(faults, share):
    """-ln of (1 - m)**2 + m**2 / 4, and of (1 - L)**2 / (1 + L), on frames large enough for 2 %."""
    _, tests = inspected(3, **faults)
    name = "white noise" if "mixing" in faults else "no lag"
    near = tests[name].hidden[0]
    assert near.estimate == pytest.approx(share, abs=3.5 * near.error)
    assert near.error < 0.015
    assert tests[name].verdict in ("passed", "refused")


def darkened(found):
    """The standard deviation of the noise of the darks, DN, without rounding."""
    darks = [
        np.diff(x.astype(float), axis=0).var() / 2 - 1 / 12
        for _, photons, _, x in found
        if not photons
    ]
    return math.sqrt(np.mean(darks))


def test_noise_of_the_readout_counts_as_dark_noise_and_is_no_filter():
    found, tests = inspected(4, size=256, coloured=0.05)
    test = tests["white noise"]
    assert test.verdict == "modelled"
    assert "as noise of the readout does" in test.sentence
    # 8 e- of 0.125 DN/e-, as the camera has them
    assert darkened(found) == pytest.approx(1.0, rel=0.01)
    errors = open_errors(test.hidden)
    assert errors["noise"] == 0.0
    assert errors["gain"] < 0.01


@pytest.mark.skipif(
    not CCD.exists(), reason="the reference sets of EMVA 1288 are not there: set NEUSEE_EMVA1288"
)
def test_a_real_ccd_has_noise_of_the_readout():
    """Set 001: its darks correlate, its light does not."""
    with np.load(CCD) as pairs:
        stacks = [
            Stack(
                name,
                float(name.split("_")[2]),
                1e-9 * float(name.split("_")[1]),
                "steady",
                torch.from_numpy(x.astype(int)),
            )
            for name, x in pairs.items()
        ]
    (test,) = (test for test in inspect_frames(stacks, False, 0.7) if test.name == "white noise")
    assert test.verdict == "modelled"
    assert "as noise of the readout does" in test.sentence
    assert open_errors(test.hidden)["noise"] == 0.0


def test_sharpened_frames_are_no_noise_of_the_readout():
    """A filter that makes neighbours unlike acts in the dark and in light: -ln of (1 + m)**2 +
    m**2 / 4.
    """
    _, tests = inspected(4, mixing=-0.05)
    test = tests["white noise"]
    assert test.verdict == "refused"
    assert "readout" not in test.sentence
    near = test.hidden[0]
    assert near.estimate == pytest.approx(-0.0982, abs=3.5 * near.error)
    assert test.sentence.endswith(
        "take raw frames: without denoising, sharpening, interpolation and compression"
    )


def test_patterns_that_count_as_noise_refuse_with_their_size():
    """A DSNU of 3 e- adds 9 to 64 e-2: the dark noise is too large by 6.6 %."""
    _, tests = inspected(2, "all", dsnu=3)
    test = tests["total against temporal variance"]
    assert test.verdict == "refused"
    errors = open_errors(test.hidden)
    assert errors["noise"] == pytest.approx(math.log(73.0 / 64) / 2, abs=0.015)
    assert errors["gain"] < 0.015
