"""Changes of photographs: the eight symmetries of NumPy, stops of light, and a saturation by its
formula.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from neusee.nodes.scene import Change, symmetry

PICTURE = torch.rand(3, 5, 5, generator=torch.Generator().manual_seed(3))
SIZE = (5, 5)


def eight(array):
    turned = [np.rot90(array, k, (-2, -1)) for k in range(4)]
    return [x.tobytes() for one in turned for x in (one, one[..., ::-1])]


def test_a_pair_is_turned_by_one_of_eight_symmetries_each_as_often():
    expected = eight(PICTURE.numpy())
    assert len(set(expected)) == 8
    counts = [0] * 8
    for number in range(800):
        counts[expected.index(symmetry(PICTURE, (7, 2, number, 4)).numpy().tobytes())] += 1
    assert min(counts) > 60  # 100 ± 9.4: four and a quarter deviations, of a fixed seed
    assert torch.equal(symmetry(PICTURE, (7, 2, 5, 4)), symmetry(PICTURE, (7, 2, 5, 4)))


def test_a_picture_with_two_sizes_keeps_them():
    wide = PICTURE[:, :3]
    assert {symmetry(wide, (number,)).shape for number in range(40)} == {wide.shape}
    for quarters in range(4):
        change = Change(quarters=quarters)
        assert change.of(torch.zeros(3, *change.frame((3, 5))), (3, 5)).shape == (3, 3, 5)


def test_light_and_colours_follow_their_formulas():
    assert torch.equal(Change(stops=-1.5).of(PICTURE, SIZE), PICTURE * 2**-1.5)
    linear = PICTURE.double().numpy()
    code = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    grey = np.tensordot([0.299, 0.587, 0.114], code, 1)
    code = np.clip(grey + 0.6 * (code - grey), 0, 1)
    expected = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    assert Change(saturation=0.6).of(PICTURE, SIZE).numpy() == pytest.approx(expected, abs=2e-6)


def test_what_is_drawn_stays_in_its_limits_and_nothing_changes_nothing():
    drawn = [Change.drawn((1, n), True, 2.0, 0.3) for n in range(300)]
    assert {x.quarters for x in drawn} == {0, 1, 2, 3}
    assert -2 <= min(x.stops for x in drawn) < -1.9 < -0.1 < max(x.stops for x in drawn) <= 0
    assert (
        0.7
        <= min(x.saturation for x in drawn)
        < 0.72
        < 1.28
        < max(x.saturation for x in drawn)
        <= 1.3
    )
    assert Change.drawn((1, 5), True, 2.0, 0.3) == drawn[5]
    none = Change.drawn((1, 5), False, 0.0, 0.0)
    assert none == Change()
    assert none.of(PICTURE, SIZE) is PICTURE


@pytest.mark.parametrize("quarters", range(4))
def test_an_enlarged_part_is_that_of_pillow_and_has_no_detail_of_one_pixel(quarters):
    rng = np.random.default_rng(3)
    part = torch.from_numpy(rng.uniform(0.2, 1.0, (3, 20, 12)).astype(np.float32))
    change = Change(quarters=quarters, enlarged=2.5)
    shape = (50, 30) if quarters % 2 == 0 else (30, 50)
    assert change.frame(shape) == (20, 12)
    found = change.of(part, shape)
    turned = np.rot90(part[0].numpy(), quarters)
    with Image.fromarray(np.ascontiguousarray(turned)) as small:
        expected = np.asarray(small.resize(shape[::-1], Image.Resampling.BICUBIC))
    np.testing.assert_allclose(found[0].numpy(), np.maximum(expected, 0), atol=1e-5)


def test_the_factor_of_size_is_drawn_by_its_logarithm_and_changes_no_other_value():
    drawn = [Change.drawn((1, n), True, 2.0, 0.3, 4.0) for n in range(400)]
    logs = np.log([x.enlarged for x in drawn]) / np.log(4.0)
    assert 0 <= logs.min() < 0.02 < 0.98 < logs.max() <= 1
    assert abs(logs.mean() - 0.5) < 0.06  # 0.014 is its deviation
    assert [replace(x, enlarged=1.0) for x in drawn] == [
        Change.drawn((1, n), True, 2.0, 0.3) for n in range(400)
    ]
