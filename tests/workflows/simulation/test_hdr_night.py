"""The street at night: what the recipe restores is nearer to the scene than the picture before
restoration.
"""

import pytest

import neusee
from neusee.workflows import Store, load

SMALL = [
    "optics.samples=128",
    "optics.pitch=63.11 um",
    "optics.window=[128, 128]",
    "optics.bands=7",
    "scene.shape=[128, 128]",
    "sensor.shape=[112, 112]",
    "outputs=[developed_quality, restored_quality]",
]


def gains(words, folder):
    result = neusee.run(load("hdr_night", words), store=Store(folder))
    before, after = result["developed_quality[mask]"], result["restored_quality"]
    return float(after.psnr - before.psnr), float(after.ssim / before.ssim)


def test_a_small_picture_gains_from_the_restoration_of_the_recipe(tmp_path):
    decibel, alike = gains(SMALL, tmp_path)
    assert decibel > 0
    assert alike > 1.5


@pytest.mark.slow
def test_a_small_picture_loses_by_the_wiener_filter(tmp_path):
    decibel, alike = gains([*SMALL, "restore=wiener"], tmp_path)
    assert decibel < 0
    assert alike < 1


@pytest.mark.slow
def test_the_recipe_gains_five_decibels(tmp_path):
    decibel, alike = gains(["outputs=[developed_quality, restored_quality]"], tmp_path)
    assert decibel == pytest.approx(12.72 - 7.69, abs=0.25)
    assert alike > 1.9
