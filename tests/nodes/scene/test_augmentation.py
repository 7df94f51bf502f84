"""Changes of photographs: the eight symmetries of NumPy, stops of light, and a saturation by its formula."""

import numpy as np
import pytest
import torch

from neusee.nodes.scene import Change, symmetry

PICTURE = torch.rand(3, 5, 5, generator=torch.Generator().manual_seed(3))


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
        assert change.of(torch.zeros(3, *change.frame((3, 5)))).shape == (3, 3, 5)


def test_light_and_colours_follow_their_formulas():
    assert torch.equal(Change(stops=-1.5).of(PICTURE), PICTURE * 2**-1.5)
    linear = PICTURE.double().numpy()
    code = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    grey = np.tensordot([0.299, 0.587, 0.114], code, 1)
    code = np.clip(grey + 0.6 * (code - grey), 0, 1)
    expected = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    assert Change(saturation=0.6).of(PICTURE).numpy() == pytest.approx(expected, abs=2e-6)


def test_what_is_drawn_stays_in_its_limits_and_nothing_changes_nothing():
    drawn = [Change.drawn((1, n), True, 2.0, 0.3) for n in range(300)]
    assert {x.quarters for x in drawn} == {0, 1, 2, 3}
    assert -2 <= min(x.stops for x in drawn) < -1.9 < -0.1 < max(x.stops for x in drawn) <= 0
    assert 0.7 <= min(x.saturation for x in drawn) < 0.72 < 1.28 < max(x.saturation for x in drawn) <= 1.3
    assert Change.drawn((1, 5), True, 2.0, 0.3) == drawn[5]
    none = Change.drawn((1, 5), False, 0.0, 0.0)
    assert none == Change()
    assert none.of(PICTURE) is PICTURE
