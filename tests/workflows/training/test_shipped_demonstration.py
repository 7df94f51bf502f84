"""What ships trained: it is small, it fits its recipes, and it beats its filter on frames of another camera."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.signal import fftconvolve

from neusee.nodes.restore import informed, wiener
from neusee.nodes.values import Psf
from neusee.workflows import load
from tests.nodes.restore.lasers import own_camera as own
from tests.nodes.restore.lasers.as_inputs import BANDS

SAMPLES = Path(__file__).parents[3] / "recipes" / "samples"


def test_all_data_that_ships_is_less_than_a_megabyte():
    assert sum(path.stat().st_size for path in SAMPLES.rglob("*") if path.is_file()) < 1_000_000


def test_what_ships_fits_its_recipes():
    recipe = load("demonstration")  # refuses a relief of another grid, and weights of another network
    assert recipe.steps["height"].params["file"].name == "demonstration_mask.png"
    assert recipe.steps["deconvolved"].params["weights"].name == "neusee_network.safetensors"
    assert {"restored", "wiener", "wiener_quality"} <= set(recipe.outputs)


def scene_behind(mask, seed, side=64):
    """Electrons (3, y, x) behind the mask, and what a perfect lens would show of the same scene of fallen leaves."""
    whole, rim = own.picture("leaves", 2 * side, np.random.default_rng(seed)), side // 2
    light = own.irradiance(mask, "leaves", side, np.random.default_rng(seed))
    basis = np.stack([np.exp(-0.5 * ((own.BANDS - c) / 45e-9) ** 2) for c in (610e-9, 545e-9, 460e-9)])
    weight = own.band_response() * own.daylight(own.BANDS) * own.BANDS
    each = [weight * b for b in basis / (basis.sum(0) + 0.05)]  # by colour of the picture: (channel, band)
    kernels = [np.tensordot(w, own.scene_psf(mask, side + 1), 1) for w in each]
    blurred = sum(fftconvolve(whole[None, :, :, k], kernels[k], "valid", axes=(1, 2)) for k in range(3))
    perfect = np.stack([w.sum(1) for w in each], 1) @ whole[rim : rim + side, rim : rim + side].reshape(-1, 3).T
    return light, perfect.reshape(3, side, side) * (light.max() / blurred[:, :side, :side].max())


def decibels(found, truth):
    white = truth.max()
    shown = [np.clip(x / white, 0, 1) ** (1 / 2.2) for x in (np.asarray(found, float), truth)]
    return -10 * np.log10(np.mean((shown[0] - shown[1]) ** 2))


@pytest.mark.slow
@pytest.mark.parametrize("mask", ["plain", "half_ring"])
def test_the_network_gains_on_frames_of_a_camera_in_numpy(mask):
    """Scenes that no training had, another lens and well, and a laser that is told half a pixel and 2 nm beside."""
    gains = []
    for seed in range(3):
        light, truth = scene_behind(mask, seed)
        rng = np.random.default_rng([seed, 1])
        spot, wavelength = rng.uniform(-0.3, 0.3, 2) * 64, rng.uniform(450e-9, 640e-9)
        laser = own.Laser(tuple(spot), wavelength, 3e4)
        electrons, clipped = own.digitized(light + laser.electrons(mask, (64, 64)), rng)
        shifts = rng.normal(0, 1, (8, 3)) * [0.5, 0.5, 2e-9]
        told = [own.Laser(tuple(spot + s[:2]), wavelength + s[2], 1.0).electrons(mask, (64, 64)) for s in shifts]
        psf = Psf(torch.from_numpy(own.scene_psf(mask, 65)), torch.ones(31, dtype=torch.float64))
        given = (
            torch.from_numpy(electrons).float(), psf, torch.from_numpy(own.daylight(own.BANDS)),
            torch.from_numpy(own.band_response()), BANDS, torch.from_numpy(clipped),
            [torch.from_numpy(told[0]).float()], [torch.from_numpy(np.stack(told[1:])).float()],
        )  # fmt: skip
        how = {"doubt": None, "read_noise": own.READ}
        restored = informed(*given, weights=SAMPLES / "neusee_network.safetensors", width=12, **how)
        gains.append(decibels(restored, truth) - decibels(wiener(*given, **how), truth))
    print(mask, gains)
    assert min(gains) > -0.1
    assert np.mean(gains) > 0.2
