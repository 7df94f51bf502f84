"""The shading of frames from a camera in NumPy: found within its interval, and left alone where
frames cannot tell.
"""

import numpy as np
import pytest
import torch

from neusee.nodes import ParameterError
from neusee.nodes.restore import electrons, shading, wiener_spread

SIDE, GAIN, OFFSET, NOISE = 48, 2.0, 100.0, 8.0
CAMERA = {
    "shape": (SIDE, SIDE),
    "gain": GAIN,
    "offset": OFFSET,
    "full_well": 25000.0,
    "read_noise": NOISE,
}
THREE = torch.ones(3, 4)


def grains(rng, depth):
    """Soft shadows of a few grains, at least ``1 - depth``."""
    y, x = np.mgrid[:SIDE, :SIDE] / SIDE
    shadow = np.zeros((SIDE, SIDE))
    for _ in range(6):
        (cy, cx), size = rng.uniform(size=2), rng.uniform(0.12, 0.25)
        shadow += rng.uniform(0.3, 1) * np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * size**2))
    return 1 - depth * shadow / shadow.max()


def scene(rng):
    """Rectangles and discs of random reflectance, one above the other, in three channels; at
    most 12 000 e-.
    """
    y, x = np.mgrid[:SIDE, :SIDE]
    picture = np.full((3, SIDE, SIDE), rng.uniform(0.1, 1))
    for _ in range(150):
        (cy, cx), size = rng.uniform(0, SIDE, 2), min(1.5 / rng.uniform(0.03, 1), SIDE)
        inside = (
            np.hypot(y - cy, x - cx) < size
            if rng.random() < 0.5
            else np.maximum(abs(y - cy), abs(x - cx)) < size
        )
        picture[:, inside] = (rng.uniform(0.15, 1) * rng.uniform(0.7, 1, 3))[:, None]
    return 12000 * picture


def shots(folder, rng, count, transmission, scenes=None, spots=0):
    """Digital numbers of ``count`` frames in files: shot noise, read noise, offset, gain, well
    and converter.
    """
    for number in range(count):
        light = (scene(rng) if scenes is None else scenes[number]) * transmission
        if spots:
            light[:, :spots, :spots] = 1e6
        filled = np.minimum(rng.poisson(light) + rng.normal(0, NOISE, light.shape), 25000)
        values = np.clip(np.round(GAIN * (filled + OFFSET)), 0, 65535).astype(np.uint16)
        np.save(folder / f"f{number:02}.npy", values)
    return folder


def truth_at(found, transmission):
    """The logarithm of a transmission in each cell, relative to its mean."""
    rows, columns = found.estimate.shape
    log = np.log(transmission).reshape(rows, SIDE // rows, columns, SIDE // columns).mean((1, 3))
    return log - log.mean()


def score(found, transmission):
    """Share of knots in the 90 % interval, and the rms error of the estimate over that of no
    estimate.
    """
    error = found.estimate.numpy() - truth_at(found, transmission)
    held = np.abs(error) <= 1.645 * found.deviation.numpy()
    return held.mean(), np.sqrt((error**2).mean()) / truth_at(found, transmission).std()


@pytest.mark.slow
def test_dirt_is_found_from_many_frames_within_its_interval(tmp_path):
    rng = np.random.default_rng(3)
    dirty = grains(rng, 0.7)
    found = shading(THREE, files=list(shots(tmp_path, rng, 32, dirty).iterdir()), **CAMERA)
    held, left = score(found, dirty)
    assert held >= 0.75
    assert left < 0.6
    assert bool(found.identifiable)
    assert float(found.clean) < 0.05
    assert float(found.alike) < 0.05
    raw = torch.full((3, SIDE, SIDE), GAIN * (5000 + OFFSET))
    flat = electrons(raw, found, gain=GAIN, offset=OFFSET)
    torch.testing.assert_close(flat * found.transmission, torch.full_like(flat, 5000.0))
    ratio = np.log(dirty) - np.log(found.transmission.numpy())
    assert np.std(ratio) < 0.6 * np.std(np.log(dirty))


@pytest.mark.slow
def test_the_interval_holds_the_field_of_other_cameras(tmp_path):
    held, left = [], []
    for seed in range(8):
        rng = np.random.default_rng(100 + seed)
        dirty, folder = grains(rng, rng.uniform(0.2, 0.8)), tmp_path / str(seed)
        folder.mkdir()
        found = shading(THREE, files=list(shots(folder, rng, 24, dirty).iterdir()), **CAMERA)
        one = score(found, dirty)
        held.append(one[0])
        left.append(one[1])
    assert np.mean(held) >= 0.8
    assert np.mean(left) < 0.8


@pytest.mark.parametrize("count", [1, pytest.param(24, marks=pytest.mark.slow)])
def test_a_clean_lens_is_left_as_it_is(tmp_path, count):
    rng = np.random.default_rng(7)
    found = shading(THREE, files=list(shots(tmp_path, rng, count, 1.0).iterdir()), **CAMERA)
    assert not bool(found.identifiable)
    assert bool((found.transmission == 1).all())
    assert float((found.estimate.abs() <= 1.645 * found.deviation).double().mean()) >= 0.8
    assert float(found.clean) > 0.2


def test_one_frame_says_how_little_it_tells(tmp_path):
    rng = np.random.default_rng(5)
    dirty = grains(rng, 0.5)
    found = shading(THREE, files=list(shots(tmp_path, rng, 1, dirty).iterdir()), **CAMERA)
    assert not bool(found.identifiable)
    assert bool((found.transmission == 1).all())
    assert float(found.told) < 0.5
    assert score(found, dirty)[0] >= 0.8
    assert float(found.spread.mean()) > 0.1


def test_frames_of_one_scene_count_as_one_frame(tmp_path):
    rng = np.random.default_rng(11)
    found = shading(
        THREE, files=list(shots(tmp_path, rng, 12, 1.0, [scene(rng)] * 12).iterdir()), **CAMERA
    )
    assert float(found.alike) > 0.9
    assert not bool(found.identifiable)


@pytest.mark.slow
def test_saturated_cells_are_left_out(tmp_path):
    rng = np.random.default_rng(3)
    dirty = grains(rng, 0.7)
    found = shading(
        THREE, files=list(shots(tmp_path, rng, 32, dirty, spots=12).iterdir()), **CAMERA
    )
    held, left = score(found, dirty)
    assert held >= 0.75
    assert left < 0.75
    middle, corner = found.deviation[5:7, 5:7].mean(), found.deviation[:2, :2].mean()
    assert corner > 1.2 * middle


def test_the_uncertainty_of_the_shading_reaches_the_picture(tmp_path):
    from neusee.nodes.values import Bands, Psf

    rng = np.random.default_rng(5)
    found = shading(THREE, files=list(shots(tmp_path, rng, 1, 1.0).iterdir()), **CAMERA)
    one = torch.ones(4).double()
    bands, psf = (
        Bands(torch.linspace(4e-7, 7e-7, 4).double(), 1e-7 * one, one),
        torch.zeros(4, 9, 9),
    )
    psf[:, 4, 4] = 1.0
    frame = torch.from_numpy(scene(rng)).float()
    inputs = (frame, Psf(psf, one), one, torch.eye(3, 4), bands, frame > 1e9, torch.eye(3) / 12000)
    given = {"read_noise": NOISE, "draws": 2}
    plain = wiener_spread(*inputs, **given, rng=torch.Generator().manual_seed(0))
    restored = frame / 12000
    wide = wiener_spread(
        *inputs, None, None, None, restored, found, **given, rng=torch.Generator().manual_seed(0)
    )
    expected = np.sqrt(plain.numpy() ** 2 + (restored.numpy() * found.spread.numpy()) ** 2)
    np.testing.assert_allclose(wide.numpy(), expected, rtol=1e-5)
    assert float(wide.mean()) > 1.2 * float(plain.mean())


def test_a_file_that_is_no_frame_is_one_located_mistake(tmp_path):
    shots(tmp_path, np.random.default_rng(0), 2, 1.0)
    np.save(tmp_path / "g.npy", np.ones((4, 4, 3), np.uint16))
    with pytest.raises(
        ParameterError, match=r"g.npy has 4 x 4 pixels \(y, x\), but sensor.shape is \[48, 48\]"
    ) as said:
        shading.hooks.preflight(files=sorted(tmp_path.iterdir()), **CAMERA)
    assert said.value.parameter == "files"
    with pytest.raises(ParameterError, match="401 frames are more than 400"):
        shading.hooks.preflight(files=[tmp_path / "f00.npy"] * 401, **CAMERA)
