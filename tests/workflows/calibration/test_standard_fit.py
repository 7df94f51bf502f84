"""The standard's least squares beside the posterior: against sums in NumPy, and only for what
the frames determine.
"""

import numpy as np
import pytest
import torch

from neusee.nodes.values import Levels
from neusee.workflows.calibration.calibration_page import (
    ParameterEstimate,
    agreement,
    compared,
    comparisons,
    least_squares_section,
)

GAIN, ETA, DARK, OFFSET = 0.5, 0.6, 4.0, 20.0
PHOTONS = np.array([0.0, 500, 1000, 2000, 4000, 8000, 16000, 20000])


def measured(gain=GAIN):
    """Levels of a camera that clips its brightest level, with the scatter of one million pixels
    in two frames.
    """
    rng, electrons, count = np.random.default_rng(3), ETA * PHOTONS, 1e6
    variance = gain**2 * (electrons + DARK**2) + 1 / 12
    variance[-1] *= 0.1
    mean = (
        OFFSET + gain * electrons + np.sqrt(variance / count) * rng.standard_normal(len(electrons))
    )
    variance = variance * (1 + np.sqrt(4 / count) * rng.standard_normal(len(electrons)))
    columns = (
        PHOTONS,
        0 * PHOTONS + 0.01,
        0 * PHOTONS + count,
        mean,
        variance,
        0 * PHOTONS + count / 2,
    )
    none = torch.empty(0, dtype=torch.float64)
    return Levels(*map(torch.from_numpy, columns), none.long(), none, none)


def estimate(name, mean, sd, kind="estimate"):
    return ParameterEstimate(name, "", kind, mean, sd, mean - sd, mean + sd, mean, 0.5, 0.1)


def test_values_are_those_of_lines_through_the_origin_in_numpy():
    levels = measured()
    dark, mean, variance = (x.numpy() for x in (levels.mean[0], levels.mean, levels.variance))
    used = slice(1, -2)  # up to 70 % of the level of the largest variance, the last but one
    y, v, q = mean[used] - dark, variance[used] - variance[0], PHOTONS[used]
    gain, response = (y @ v) / (y @ y), (q @ y) / (q @ q)
    noise = np.sqrt(variance[0] - 1 / 12) / gain
    names = ("gain", "quantum_efficiency", "read_noise")
    rows = [
        estimate(n, m, s)
        for n, m, s in zip(names, (GAIN, ETA, DARK), (2e-3, 3e-3, 1e-2), strict=True)
    ]
    beside = comparisons(levels, rows, None)
    found = compared(beside)
    assert [found[name]["value"] for name in names] == pytest.approx(
        [gain, response / gain, noise], rel=1e-9
    )
    for name, true in zip(names, (GAIN, ETA, DARK), strict=True):
        assert 0 < found[name]["error"] < 0.01 * true
        assert abs(found[name]["value"] - true) < 5 * found[name]["error"]
    table = least_squares_section(levels, rows, beside)
    apart = []
    for row in rows:
        width = row.mean * np.hypot(
            row.sd / row.mean, found[row.name]["error"] / found[row.name]["value"]
        )
        apart.append((found[row.name]["value"] - row.mean) / width)
    assert [row[-1] for row in table.rows] == pytest.approx(apart)


def test_what_the_frames_do_not_determine_has_no_value():
    rows = [
        estimate("gain", GAIN, 1e-3, "none"),
        estimate("read_noise", DARK, 1e-2),
        estimate("full_well", 1e4, 1.0),
    ]
    beside = comparisons(measured(), rows, None)
    assert set(compared(beside)) == {"read_noise"}
    assert [row[0] for row in least_squares_section(measured(), rows, beside).rows] == [
        "temporal dark noise σ_d"
    ]
    nothing = least_squares_section(measured(), rows[:1], [])
    assert not nothing.rows
    assert "determine none" in nothing.text


def test_frames_that_the_standard_cannot_fit_say_why():
    levels = measured()._replace(photons=torch.from_numpy(PHOTONS + 1.0))
    section = least_squares_section(levels, [estimate("gain", GAIN, 1e-3)], [])
    assert "without dark frames" in section.text
    assert not section.rows
    assert comparisons(levels, [estimate("gain", GAIN, 1e-3)], None) == []


CAMERA = {
    "scatter": 0.001,
    "lamp": 0.001,
    "drift": 0.0,
    "dark_current": 0.0,
    "dark_exposure": 1.0,
    "share": 0.7,
}
CAMERA |= {
    "rounding": "nearest",
    "gain": GAIN,
    "quantum_efficiency": ETA,
    "temporal_dark_noise": DARK,
}
CAMERA |= {"dark_signal": OFFSET, "bend": 0.0, "twist": 0.0}


def test_a_posterior_that_its_least_squares_contradict_is_refused():
    """A gain of 10 % too much with a width of 2 %: 5 combined deviations; half as much passes."""
    levels = measured()
    for gain, mark in ((1.0, "pass"), (1.05, "pass"), (1.1, "fail")):
        rows = [estimate("gain", gain * GAIN, 0.02 * GAIN)]
        (check,) = agreement(comparisons(levels, rows, CAMERA))
        assert check.mark == mark, check.found
    assert "refused" in check.found
    assert agreement([]) == []


def test_a_bent_camera_agrees_with_a_line_through_its_own_levels():
    """The line of the standard lies far from the gain at no signal, and so does a line through
    the predicted levels.
    """
    bend, camera = -0.05, CAMERA | {"bend": -0.05}
    levels = measured()
    electrons = ETA * PHOTONS[:-2]
    signal = GAIN * electrons
    for _ in range(50):
        # the brightest level of the fit is at 1
        signal = GAIN * electrons * (1 + bend * signal / signal[-1])
    slope = GAIN * (1 + bend * signal / signal[-1]) ** 2
    variance = slope**2 * (electrons + DARK**2) + 1 / 12
    mean = levels.mean.clone()
    mean[:-2], levels.variance[:-2] = torch.from_numpy(OFFSET + signal), torch.from_numpy(variance)
    levels = levels._replace(mean=mean)
    rows = [estimate("gain", GAIN, 0.002 * GAIN)]
    (alone,) = comparisons(levels, rows, None)
    assert abs(alone.apart) > 5
    (own,) = comparisons(levels, rows, camera)
    assert abs(own.apart) < 0.1, own
