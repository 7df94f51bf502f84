"""Rings about an overexposed point source: means, place, what they leave out, and bad pictures."""

import numpy as np
import pytest

from neusee.nodes import ParameterError, calibrate
from neusee.nodes.calibrate import PointCamera, reduce_rings

CAMERA = {"gain": 0.5, "offset": 100.0, "full_well": 20000.0, "read_noise": 5.0, "bits": 14}


def frame(size=96, centre=(47.5, 47.5), bright=6e7, seed=1):
    y, x = np.ogrid[:size, :size]
    square = (y - centre[0]) ** 2 + (x - centre[1]) ** 2
    light = np.random.default_rng(seed).poisson(bright / np.maximum(square, 1) ** 1.5 + 50)
    return np.clip(np.round((light + 100) * 0.5), 0, 10000)


def rings(numbers, centre=None, **camera):
    return reduce_rings(numbers[None].astype(float), PointCamera(**CAMERA | camera), centre)


def test_rings_have_the_mean_signal_of_their_pixels():
    found = rings(frame(bright=1e8))
    ring, weight, square = (x.numpy() for x in (found.ring, found.weight, found.square))
    expected = np.bincount(ring, weight * (1e8 / square**1.5 + 50)) / np.bincount(ring, weight)
    width = np.sqrt(expected / found.pixels.numpy())
    assert np.abs((found.mean.numpy() - expected) / width).max() < 5
    assert float(found.square[0]) >= 16**2
    assert float(found.mean.max()) < 0.95 * 20000


def test_the_source_is_found_in_the_middle_of_the_saturated_pixels_beside_a_hot_pixel():
    picture = frame(centre=(40.3, 52.6))
    picture[3, 4] = 10000
    assert np.abs(rings(picture).centre.numpy() - (40.3, 52.6)).max() < 0.2


def test_a_lone_bright_pixel_is_left_out():
    clean, hot = frame(), frame()
    hot[10, 20] = 10000
    one, other = rings(clean, (47.5, 47.5)), rings(hot, (47.5, 47.5))
    assert float(one.pixels.sum() - other.pixels.sum()) == 1
    assert np.abs(one.mean.numpy() / other.mean.numpy() - 1).max() < 0.05


def test_rings_of_cut_pixels_are_kept_as_a_limit():
    assert len(rings(frame(bright=6e7)).cut_square) == 0  # saturated to 14.5 pixels
    found = rings(frame(bright=3e8))  # to 24.8
    assert 5 <= len(found.cut_square) <= 9
    assert float(found.cut_square.max()) < 25**2 < float(found.square.min())
    assert float(found.cut) == pytest.approx(0.95 * 20000 - 100)


@pytest.mark.parametrize(
    ("numbers", "params", "message"),
    [
        (frame() * 0.5, {}, "no pixel is saturated: the brightest has 5000 DN of 10000 DN"),
        (
            frame(),
            {"bits": 12},
            "the frames hold 10000 DN, which 12 bits cannot: give the `bits` of the files",
        ),
        (frame(), {"full_well": 40000.0}, "no pixel is saturated"),
        (
            frame(),
            {"centre": (200.0, 3.0)},
            r"the source at \(200, 3\) is not in the frame of 96 x 96 pixels",
        ),
        (frame(24, (12, 12)), {}, "rings of pixels lie between the saturated pixels and the edge"),
        (np.full((64, 64), 10000.0), {}, "only 0 rings of pixels lie between"),
    ],
)
def test_pictures_that_tell_nothing_are_refused_before_the_run(numbers, params, message, tmp_path):
    np.save(tmp_path / "point.npy", numbers.astype(np.uint16))
    given = {"files": [tmp_path / "point.npy"], "centre": None, **CAMERA, **params}
    with pytest.raises(ParameterError, match=message) as error:
        calibrate.point_source.hooks.preflight(**given)
    assert error.value.parameter == "files"
    with pytest.raises(ValueError, match=message):
        calibrate.point_source(**given)


def test_a_file_that_is_no_picture_is_refused_before_the_run(tmp_path):
    (tmp_path / "point.png").write_text("no picture")
    with pytest.raises(ParameterError, match=r"point\.png"):
        calibrate.point_source.hooks.preflight(
            files=[tmp_path / "point.png"], centre=None, **CAMERA
        )
