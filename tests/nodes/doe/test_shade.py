"""Shades: the grey filter, the smaller stop and the notch act in the pupil of one arm, and in
every figure of merit.
"""

import math

import pytest
import torch

import neusee
from neusee.nodes import ParameterError
from neusee.nodes.doe import shade
from neusee.nodes.metrics import light_outside, lsr
from neusee.nodes.optics import psf, pupil, stop
from neusee.nodes.spectra import bands
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store

STOP = stop(samples=270, pitch=29.92e-6, diameter=8.0784e-3)
BANDS = bands(start=500e-9, stop=600e-9, count=3)
LENS = {"focal_length": 0.11, "pixel_pitch": 2.9e-6, "shape": (48, 48)}
SMALL = [
    "scene.shape=[64, 64]",
    "sensor.shape=[48, 48]",
    "optics.samples=64",
    "optics.pitch=126 um",
    "optics.window=[32, 32]",
    "optics.bands=4",
]


def shaded(**given):
    height = torch.zeros(270, 270)
    return pupil(height, 0.46 + 0 * BANDS.centres, BANDS, STOP, shade=shade(STOP, **given))


def test_a_filter_passes_its_share_and_a_stop_the_fourth_power_of_its_diameter():
    assert lsr(psf(shaded(transmittance=0.037), **LENS)).tolist() == pytest.approx(
        [0.037] * 3, rel=1e-6
    )
    assert lsr(psf(shaded(diameter=0.5), **LENS)).tolist() == pytest.approx([0.5**4] * 3, rel=0.01)
    both = shaded(diameter=0.5, transmittance=0.1)
    assert lsr(psf(both, **LENS)).tolist() == pytest.approx([0.1 * 0.5**4] * 3, rel=0.01)


def test_a_notch_passes_what_its_formula_says_at_each_wavelength_and_no_colour_counts_as_light_outside():
    found = shaded(notches=(550e-9, 500e-9), width=60e-9, depth=0.9)
    at = [500e-9, 550e-9, 600e-9]
    passed = [
        math.prod(
            1 - 0.9 * math.exp(-((x - c) ** 2) * 4 * math.log(2) / 60e-9**2)
            for c in (550e-9, 500e-9)
        )
        for x in at
    ]
    focused = psf(found, **LENS)
    assert lsr(focused).tolist() == pytest.approx(passed, rel=1e-6)
    assert light_outside(focused, found).tolist() == pytest.approx(
        light_outside(psf(shaded(), **LENS), shaded()).tolist(), abs=1e-6
    )


@pytest.mark.parametrize("sampling", ["point", "integrated"])
def test_the_fast_transform_of_a_shaded_pupil_agrees_with_the_definition(sampling):
    small = stop(samples=32, pitch=252.5e-6, diameter=8.08e-3)
    height = 2e-6 * torch.rand(32, 32, generator=torch.Generator().manual_seed(3))
    given = pupil(
        height,
        0.46 + 0 * BANDS.centres,
        BANDS,
        small,
        shade=shade(small, transmittance=0.3, diameter=0.7, notches=(540e-9,), width=70e-9),
    )
    lens = {**LENS, "shape": (12, 12), "sensor": sampling}
    fast, slow = psf(given, **lens, precision="double"), psf.hooks.reference(given, **lens)
    assert (fast.intensity - slow.intensity).abs().max() < 1e-5 * slow.intensity.max()
    assert fast.clear_peak.tolist() == pytest.approx(slow.clear_peak.tolist(), rel=2e-5)


def test_only_the_arm_of_the_mask_is_shaded(tmp_path):
    store, outputs = Store(tmp_path), ["outputs=[lsr, bsr]", *SMALL]
    plain, grey = (
        neusee.run(load("plain_lens", [f"doe={name}", *outputs]), store=store)
        for name in ("flat", "grey_filter")
    )
    assert torch.equal(grey["bsr[plain]"], plain["bsr[plain]"])
    assert torch.allclose(grey["lsr[mask]"], 0.01 * plain["lsr[mask]"], rtol=1e-5)
    assert torch.allclose(grey["bsr[mask]"], 0.01 * plain["bsr[mask]"], rtol=1e-4)


def test_a_mask_and_a_shade_compose_in_one_group(tmp_path):
    store = Store(tmp_path)
    both, alone = (
        neusee.run(
            load("axicon", [f"doe={n}", "doe.waves=5", "outputs=[lsr]", *SMALL]), store=store
        )["lsr[mask]"]
        for n in ("axicon_and_filter", "axicon")
    )
    assert torch.allclose(both, 0.1 * alone, rtol=1e-5)


def test_a_notch_in_the_laser_dims_the_laser_and_tints_the_scene(tmp_path):
    outputs = ["outputs=[peak, image, spot]", *SMALL, "optics.bands=16", "lasers.green.fwhm=1 nm"]
    found = neusee.run(load("plain_lens", ["doe=notch", *outputs]), store=Store(tmp_path))
    ratio = found["spot[mask,green]"].max() / found["spot[plain,green]"].max()
    assert float(ratio) == pytest.approx(0.01, rel=0.2)
    scene = found["image[mask]"].sum((-2, -1)) / found["image[plain]"].sum((-2, -1))
    assert float(scene.min()) == pytest.approx(1 - 0.99 * 2**-0.64, rel=1e-3)  # 540 nm
    assert float(scene.max()) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("doe.transmittance=0", "greater than 0"),
        ("doe.transmittance=2", "less than or equal to 1"),
        ("doe.diameter=1.5", "less than or equal to 1"),
        ("doe.notches=[532]", "needs a unit"),
        ("doe.notch_depth=1.1", "less than or equal to 1"),
    ],
)
def test_a_wrong_shade_is_refused_before_the_run(change, said):
    with pytest.raises(RecipeError, match=said):
        load("plain_lens", ["doe=notch", change])


def test_a_notch_wider_than_its_centre_is_refused():
    with pytest.raises(ParameterError, match="wider than its centre"):
        shade.hooks.preflight(width=700e-9, notches=(532e-9,))


def test_a_shade_of_another_grid_is_refused():
    other = shade(stop(samples=32, pitch=252.5e-6, diameter=8.08e-3))
    with pytest.raises(ValueError, match=r"shade is .* and height is"):
        pupil(torch.zeros(270, 270), 0.46 + 0 * BANDS.centres, BANDS, STOP, shade=other)
