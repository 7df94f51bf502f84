"""A picture under attack, heat and detail: histograms against pixel by pixel, and closed forms."""

import math

import numpy as np
import pytest
import torch

from neusee.nodes import metrics
from neusee.nodes.metrics import (
    Attack,
    PixelNoise,
    attacked_picture,
    channel_psf,
    detail_energy,
    detail_targets,
    detection_snr,
    glare_levels,
    heat_ratio,
    noise_variance,
    picture_spectrum,
    remaining_error,
)
from neusee.nodes.spectra import bands
from neusee.nodes.values import Psf

GREEN = bands(start=500e-9, stop=600e-9, count=1)
ONE = torch.ones(1, dtype=torch.float64)


def spot(width, side=64, light=1.0):
    """A Gaussian PSF and the peak of the clear lens, whose width is 1."""
    at = torch.arange(side, dtype=torch.float64) - side // 2
    one = torch.exp(-(at[:, None].square() + at.square()) / (2 * width**2))
    return Psf(
        (light * one / one.sum())[None], torch.tensor([1 / (2 * math.pi)], dtype=torch.float64)
    )


def test_a_picture_under_attack_is_the_mean_over_its_pixels():
    one = spot(2.0)
    channels = channel_psf(one, ONE, ONE[None], GREEN)
    spectrum = picture_spectrum(channels, channels)
    sensor = PixelNoise(read_noise=5.0, full_well=1e4, prnu=0.01, residual_glare=0.03)
    found = attacked_picture(
        spectrum,
        glare_levels(one.intensity[0], float(one.clear_peak)),
        sensor,
        Attack(torch.tensor([10.0, 1e3]), ONE),
        electrons=200.0,
        transmittance=0.1,
    )
    for number, strength in enumerate((10.0, 1e3)):
        glare = 0.1 * strength * 1e4 * (one.intensity[0] / one.clear_peak).flatten()[:, None]
        noise = noise_variance(20.0, glare, 5.0, 0.01, 0.03)
        full = glare + 20.0 >= 1e4
        error = torch.where(full, 1.0, remaining_error(spectrum, 20.0, noise))
        assert float(found.error[number]) == pytest.approx(float(error.mean()), rel=5e-3)
        assert float(found.seen[number]) == pytest.approx(float((~full).double().mean()), abs=0.02)


def test_a_laser_too_weak_to_matter_leaves_the_quiet_picture_and_a_strong_one_leaves_none():
    one = spot(2.0)
    channels = channel_psf(one, ONE, ONE[None], GREEN)
    spectrum = picture_spectrum(channels, channels)
    even = glare_levels(torch.full((8, 8), 1e-4, dtype=torch.float64), 0.1)
    sensor = PixelNoise(5.0, 1e4, 0.0, 0.0)
    found = attacked_picture(
        spectrum,
        even,
        sensor,
        Attack(torch.tensor([0.0, 1e9]), ONE),
        electrons=50.0,
        transmittance=1.0,
    )
    quiet = metrics.filtered_picture(one, ONE, ONE[None], GREEN, electrons=50.0, read_noise=5.0)
    assert float(found.error[0]) == pytest.approx(float(quiet.error), rel=1e-3)
    assert found.seen.tolist() == [1.0, 0.0]
    assert float(found.error[1]) == 1.0
    assert float(found.information[1]) == 0.0


def test_the_heat_of_a_pulse_is_its_peak_and_that_of_continuous_light_falls_less_with_a_wider_spot():
    wide, clear = spot(6.0), spot(2.0)
    pulse = heat_ratio(wide, clear, pixel_pitch=3e-6, dwell=1e-12)
    steady = heat_ratio(wide, clear, pixel_pitch=3e-6, dwell=10.0)
    assert float(pulse) == pytest.approx(1 / 9, rel=1e-6)  # of the peaks
    # as 1 / width, as the threshold of small spots
    assert float(steady) == pytest.approx(1 / 3, rel=0.02)


def test_the_heat_agrees_with_its_reference():
    rng = torch.Generator().manual_seed(2)
    one, other = (
        Psf(torch.rand(2, 11, 9, generator=rng).double(), ONE.expand(2)) for _ in range(2)
    )
    given = {"pixel_pitch": 3e-6, "dwell": 2e-7}
    assert heat_ratio(one, other, **given) == pytest.approx(
        heat_ratio.hooks.reference(one, other, **given), rel=1e-6
    )


def test_psfs_of_other_windows_are_refused():
    with pytest.raises(ValueError, match="use one window"):
        heat_ratio(spot(2.0), spot(2.0, side=32), pixel_pitch=3e-6, dwell=1.0)


@pytest.mark.parametrize("size", [7.0, 12.5, 20.0])
def test_targets_have_no_mean_and_their_height(size):
    targets = detail_targets(size)
    assert set(targets) == {"tri-bar", "edge", "text"}
    for target in targets.values():
        assert abs(float(target.sum())) < 1e-9
        assert target.shape[0] == math.ceil(size)
        assert 0.5 < float(target.max() - target.min()) <= 1 + 1e-9


def test_detection_is_the_norm_of_the_seen_target_over_the_noise():
    one, size = spot(1.5), 10.0
    energy = detail_energy(one, ONE, ONE[None], GREEN, size)
    for name, target in detail_targets(size).items():
        canvas = np.zeros((64, 64))
        canvas[: target.shape[0], : target.shape[1]] = target.numpy()
        seen = np.fft.ifft2(np.fft.fft2(canvas) * np.fft.fft2(one.intensity[0].numpy())).real
        wanted = 300 * 0.2 * np.linalg.norm(seen) / math.sqrt(90)
        assert float(
            detection_snr(energy[name], 300.0, 0.2, torch.tensor([[90.0]]))
        ) == pytest.approx(wanted, rel=1e-6)
    assert energy["tri-bar"] < detail_energy(spot(0.5), ONE, ONE[None], GREEN, size)["tri-bar"]


def test_a_target_larger_than_the_window_is_refused():
    with pytest.raises(ValueError, match="does not fit the PSF window"):
        detail_energy(spot(1.5), ONE, ONE[None], GREEN, 30.0)
