"""A photograph that is changed under its name is read again, in the process that has read it
before.
"""

import os

import numpy as np
import pytest
from PIL import Image

from neusee.nodes import input_files
from neusee.nodes.scene import crop_photograph, photograph


@pytest.fixture
def settled(monkeypatch):
    """Files of a test are as good as old, so that their content is kept in memory."""
    monkeypatch.setattr(input_files, "_SETTLED", 0)


def save(path, seed, moment):
    """Write a photograph of noise, without compression and so of equal size, with a stated time
    of modification.
    """
    values = np.random.default_rng(seed).integers(0, 256, (40, 50, 3), dtype=np.uint8)
    Image.fromarray(values).save(path, compress_level=0)
    os.utime(path, ns=(moment, moment))
    return values


def test_another_photograph_of_the_same_name_size_and_time_is_another_picture(tmp_path, settled):
    path = tmp_path / "one.png"
    save(path, 1, 10**18)
    size = path.stat().st_size
    first = crop_photograph(path, (20, 20), 3, 0)
    assert crop_photograph(path, (20, 20), 3, 0).equal(first)
    save(path, 2, 10**18)
    assert path.stat().st_size == size
    second = crop_photograph(path, (20, 20), 3, 0)
    assert not second.equal(first)
    assert second.equal(photograph(file=path, shape=(20, 20), crop=(3, 0)))


def test_a_photograph_that_was_changed_just_now_is_not_kept(tmp_path):
    path = tmp_path / "one.png"
    for seed in (1, 2, 3):
        values = save(path, seed, 10**18)
        found = crop_photograph(path, (40, 50), 3, 0)
        np.testing.assert_array_equal(
            np.rint(255 * encoded(found.numpy())), values.transpose(2, 0, 1)
        )


def encoded(linear):
    """IEC 61966-2-1."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("shape", [(20, 30), (60, 55)])
def test_the_part_of_a_photograph_that_an_evaluation_shows_is_a_parameter(tmp_path, shape):
    path = tmp_path / "one.png"
    save(path, 4, 10**18)
    for number in (0, 5):
        assert photograph(file=path, shape=shape, crop=(7, number)).equal(
            crop_photograph(path, shape, 7, number)
        )
    assert not photograph(file=path, shape=(20, 30), crop=(7, 0)).equal(
        photograph(file=path, shape=(20, 30))
    )
