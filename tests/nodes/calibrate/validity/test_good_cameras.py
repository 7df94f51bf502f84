"""Frames of real but good cameras, by a simulator of its own: none is refused, and what is
faulty has its own name.
"""

import numpy as np
import pytest
import torch

from neusee.nodes.calibrate import (
    Stack,
    hot_pixels,
    inspect_frames,
    least_squares,
    levels,
    reduce,
    saturation_signal,
)
from tests.workflows.calibration.own_real_camera import RealCamera

SLOW = pytest.mark.slow
#: the camera of which a correction that nobody needs moved the gain by 10 %
UNEVEN = {
    "prnu": 0.01,
    "vignetting": 0.15,
    "flicker": 0.002,
    "lamp": 0.003,
    "brightest": 1.15,
    "gain": 0.03362,
}
UNEVEN |= {"read_noise": 30.0, "well": 90_000.0}
GOOD = {
    "plain": {},
    "a well below the converter's top": UNEVEN,
    "spread of read noise": {"read_spread": 0.4},
    "more spread": {"read_spread": 0.8},
    "vignetting and flicker": {"vignetting": 0.4, "flicker": 0.005, "lamp": 0.005},
    "wells that differ": {"well_spread": 0.04, "vignetting": 0.2},
    "unequal pixels": {"prnu": 0.015, "dsnu": 5.0, "bend": 0.02},
}


def inspected(camera, mask=None, divisor=1):
    stacks = [
        Stack(
            shot.name,
            shot.photons,
            shot.exposure,
            "steady",
            torch.from_numpy(shot.frames // divisor).int(),
            mask,
        )
        for shot in camera.shots()
    ]
    return {test.name: test for test in inspect_frames(stacks, False, 0.7)}


def refused(tests):
    return [test for test in tests.values() if test.verdict == "refused"]


def opened(tests):
    """The largest error that follows of what a test found."""
    return max(
        max(test.shifts.values(), default=0.0)
        for test in tests.values()
        if test.verdict == "widened"
    )


@pytest.mark.parametrize("kind", GOOD)
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=SLOW), pytest.param(3, marks=SLOW)])
def test_good_cameras_pass(kind, seed):
    tests = inspected(RealCamera(seed, size=(96, 96), **GOOD[kind]))
    assert not refused(tests), refused(tests)
    wider = {test.name for test in tests.values() if test.verdict == "widened"}
    assert wider <= {"homogeneity of the light", "no drift within a level"}
    assert not wider or opened(tests) < 0.004


def test_levels_that_the_fit_leaves_out_are_not_tested():
    """Saturated levels, whose neighbours correlate, beside clean ones: only saturation is told
    of them.
    """
    camera = RealCamera(4, size=(96, 96))
    shots = camera.shots()
    top = max(shots, key=lambda shot: shot.photons)
    smooth = np.cumsum(np.random.default_rng(0).normal(0, 3, top.frames.shape), 2)
    top.frames = (np.median(top.frames) + smooth - smooth.mean()).clip(0, 4095).astype(np.uint16)
    stacks = [
        Stack(s.name, s.photons, s.exposure, "steady", torch.from_numpy(s.frames).int())
        for s in shots
    ]
    tests = inspect_frames(stacks, False, 0.7)
    assert not [test.name for test in tests if test.verdict in ("refused", "widened")]
    # if the fit used it
    assert refused({test.name: test for test in inspect_frames(stacks, False, None)})


def test_a_well_below_the_converter_is_told_as_saturation():
    tests = inspected(RealCamera(1, size=(96, 96), **UNEVEN))
    told = tests["saturated levels are told"]
    assert told.verdict == "modelled"
    assert "lit_14, lit_15" in told.sentence
    full = float(told.sentence.split("full at about ")[1].split(" DN")[0])
    assert full == pytest.approx(0.03362 * 90_000 + 100, rel=0.01)
    assert full < 0.8 * 4095


def test_a_spread_of_read_noise_is_told_with_its_size_and_telegraph_pixels_are_not_called_a_spread():
    tests = inspected(RealCamera(5, size=(128, 128), read_spread=0.4))
    told = tests["no telegraph noise"]
    assert told.verdict == "modelled"
    assert float(told.sentence.split("about ")[1].split("%")[0]) == pytest.approx(40, abs=8)
    camera = RealCamera(5, size=(128, 128))
    shots, rng = camera.shots(), np.random.default_rng(1)
    jumping = rng.random(camera.size) < 0.02
    for shot in shots:
        jumps = 15 * jumping * (rng.random(shot.frames.shape) < 0.5)
        shot.frames = (shot.frames + jumps).astype(np.uint16)
    stacks = [
        Stack(s.name, s.photons, s.exposure, "steady", torch.from_numpy(s.frames).int())
        for s in shots
    ]
    (found,) = (
        test for test in inspect_frames(stacks, False, 0.7) if test.name == "no telegraph noise"
    )
    assert found.verdict == "refused"
    assert "jumps" in found.sentence


def test_hot_pixels_are_found_and_the_rest_passes(tmp_path):
    camera = RealCamera(6, size=(96, 96), hot=0.005)
    shots = camera.shots()
    files = []
    for index, frame in enumerate(shots[3].frames):  # the longest dark
        files.append(tmp_path / f"{index}.npy")
        np.save(files[-1], frame)
    mask = hot_pixels(files=files)
    strong = camera._current * 0.4 > 20 * 6  # e- in the longest dark, twenty times the read noise
    assert not bool((mask & ~torch.from_numpy(camera.hot_pixels)).any())
    assert bool((mask | ~torch.from_numpy(strong & camera.hot_pixels)).all())
    assert "differs from pixel to pixel" in inspected(camera)["no telegraph noise"].sentence
    tests = inspected(camera, mask)
    assert {test.verdict for test in tests.values()} <= {"passed", "modelled"}
    assert tests["no telegraph noise"].verdict == "passed"


def test_a_mask_leaves_pixels_out_of_the_statistics():
    rng = np.random.default_rng(2)
    frames = torch.from_numpy(rng.poisson(100, (2, 20, 30)))
    mask = torch.from_numpy(rng.random((20, 30)) < 0.1)
    found = reduce(frames, mask, photons=5.0, exposure=0.1, scatter="steady")
    left = frames.numpy()[:, ~mask.numpy()].astype(float)
    assert float(found.mean) == pytest.approx(left.mean(), rel=1e-12)
    assert float(found.pixels) == left.size
    apart = left[1] - left[0]
    assert float(found.variance) == pytest.approx(apart.var(ddof=1) / 2, rel=1e-12)
    with pytest.raises(ValueError, match="not of the size"):
        reduce(frames, mask[:5], photons=5.0, exposure=0.1, scatter="steady")


def test_shifted_numbers_are_named_and_pass_once_they_are_divided():
    camera = RealCamera(7, size=(96, 96), shift=4)
    (alone,) = inspected(camera).values()
    assert (alone.name, alone.verdict) == ("no missing codes", "refused")
    assert "the divisor 16" in alone.sentence
    assert not refused(inspected(camera, divisor=16))


@pytest.mark.parametrize("colours", [(0.6, 1.0, 0.5), (0.9, 1.0, 0.9), (0.3, 1.0, 0.2)])
def test_a_mosaic_is_named_as_one_and_nothing_else_is_said(colours):
    (alone,) = inspected(RealCamera(8, size=(96, 96), mosaic=colours, vignetting=0.3)).values()
    assert (alone.name, alone.verdict) == ("one colour", "refused")
    assert "2 x 2 pixels, as of Bayer" in alone.sentence
    assert "a mosaic of colours" in alone.sentence


@pytest.mark.parametrize(
    "fault",
    [{"smoothing": 0.05}, {"smoothing": 0.2}, {"lag": 0.05}, {"quality": 95}, {"demosaiced": True}, {"median": True},
     {"sharpening": 0.1}],
    ids=str,
)  # fmt: skip
def test_what_changes_the_noise_is_refused(fault):
    assert refused(inspected(RealCamera(9, size=(128, 128), **fault)))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("vignetting", [0.0, 0.3])
def test_the_signal_of_full_pixels_is_that_of_the_well(seed, vignetting):
    camera = RealCamera(
        seed, size=(64, 64), vignetting=vignetting, well_spread=0.02, lit=14, brightest=1.3
    )
    parts = [
        reduce(
            torch.from_numpy(s.frames).int(),
            photons=s.photons,
            exposure=s.exposure,
            scatter="steady",
        )
        for s in camera.shots()
    ]
    found = saturation_signal(levels(parts))
    assert found.signal == pytest.approx(
        camera.gain * camera.well, abs=max(3 * found.uncertainty, 0.005 * 3500)
    )
    assert found.uncertainty < 0.03 * found.signal
    peak = float(least_squares(levels(parts)).saturation)
    assert peak < 0.97 * camera.well, "the level of the greatest variance lies below"
    assert saturation_signal(levels(parts[:10])) is None


def test_noisy_pixels_are_not_hot(tmp_path):
    camera = RealCamera(10, size=(256, 256), read_spread=0.4)
    files = []
    for index, frame in enumerate(camera.shots()[3].frames):
        files.append(tmp_path / f"{index}.npy")
        np.save(files[-1], frame)
    assert int(hot_pixels(files=files).sum()) <= 6


def test_a_lamp_that_flickers_over_uneven_light_makes_no_row_noise():
    """The difference of two frames is the light itself, times the flicker: said as drift, and as
    nothing else.
    """
    tests = inspected(
        RealCamera(
            11, size=(96, 96), vignetting=0.5, flicker=0.02, gain=0.034, read_noise=30, well=9e4
        )
    )
    for name in ("white noise", "no blocks", "no row noise", "no column noise", "no lag"):
        assert tests[name].verdict == "passed", tests[name].sentence
    drift = tests["no drift within a level"]
    assert drift.verdict in ("widened", "refused")
    assert "whose light is uneven" in drift.sentence
