"""Contrast of a PSF against the autocorrelation of a disc, and energy within a radius."""

import math

import pytest
import torch

from neusee.nodes.metrics import encircled, encircled_curve, mtf, over_clear_peak
from neusee.nodes.values import Psf

DIAMETER, FOCAL, WAVE, PITCH = 8.0784e-3, 0.11, 550e-9, 2.9e-6


def lens(turns=None, window=512, samples=432):
    """PSF of a disc by the plain Fourier sum; ``turns`` gives the phase at (u, v) in units of the radius."""
    u = (torch.arange(samples, dtype=torch.float64) - (samples - 1) / 2) * (DIAMETER / samples)
    v, w = torch.meshgrid(u / (DIAMETER / 2), u / (DIAMETER / 2), indexing="ij")
    disc = (torch.hypot(v, w) <= 1).double()
    field = disc * torch.exp(2j * math.pi * (turns(v, w) if turns else 0 * v))
    x = (torch.arange(window, dtype=torch.float64) - window // 2) * PITCH
    kernel = torch.exp(-2j * math.pi * x[:, None] * u / (WAVE * FOCAL))
    focus = (kernel @ field @ kernel.T) * (DIAMETER / samples) ** 2 / (WAVE * FOCAL)
    area = disc.sum() * (DIAMETER / samples) ** 2
    peak = area * PITCH**2 / (WAVE * FOCAL) ** 2
    return Psf((focus.abs() ** 2 * PITCH**2 / area)[None], peak[None])


def half_ring(waves):
    return lambda v, u: waves * torch.hypot(v, u) * torch.sign(u)


def test_the_clear_lens_has_the_contrast_of_a_disc():
    found = mtf(lens())
    # mean of MTF^2 and median of MTF over the disc of passed frequencies, from the closed form
    x = (torch.arange(200_000, dtype=torch.float64) + 0.5).div(200_000).sqrt()
    closed = 2 / math.pi * (x.acos() - x * (1 - x**2).sqrt())
    assert float(found.rms) == pytest.approx(float(closed.square().mean().sqrt()), rel=0.02)
    assert float(found.median) == pytest.approx(float(closed.median()), rel=0.03)
    assert float(found.rms) == pytest.approx(0.346, rel=0.02)


@pytest.mark.parametrize(("waves", "rms", "median"), [(10, 0.047, 0.032), (20, 0.034, 0.023)])
def test_a_half_ring_keeps_its_median_contrast(waves, rms, median):
    found = mtf(lens(half_ring(waves)))
    assert float(found.rms) == pytest.approx(rms, rel=0.05)
    assert float(found.median) == pytest.approx(median, rel=0.06)
    assert mtf.hooks.check(found)[0].ok


def test_an_axicon_of_the_same_slope_falls_into_nulls_where_a_half_ring_does_not():
    ring, axicon = (mtf(lens(turns)) for turns in (half_ring(20), lambda v, u: 20 * torch.hypot(v, u)))
    assert float(ring.median) > 30 * float(axicon.median)
    assert float(ring.low) > 10 * float(axicon.low)


def test_parseval_bounds_the_contrast_by_the_suppression():
    psf = lens(half_ring(20))
    p0, kept = float(psf.clear_peak), float(psf.intensity.sum())
    passed = 4 * p0  # share of all sampled frequencies inside the band: pi (4 p0 / pi)
    overall = float(mtf(psf).rms) * math.sqrt(passed)
    assert overall <= math.sqrt(float(psf.intensity.max()) / kept) * 1.02


def test_a_delta_passes_everything_and_nothing_passes_nothing():
    kernel = torch.zeros(2, 7, 6)
    kernel[0, 3, 3] = 0.25
    found = mtf(Psf(kernel, torch.tensor([0.1, 0.1], dtype=torch.float64)))
    assert [float(x[0]) for x in found] == pytest.approx([1.0, 1.0, 1.0])
    assert all(torch.isfinite(x).all() for x in found)
    assert float(found.rms[1]) == 0.0


def test_encircled_energy_of_an_airy_pattern():
    first_zero = 1.2197 * WAVE * FOCAL / DIAMETER
    # whole pixels of 0.3 radii: the shares hold to a few per cent
    assert float(encircled(lens(), pixel_pitch=PITCH, radius=first_zero)) == pytest.approx(0.838, abs=0.03)
    found = encircled(lens(), pixel_pitch=PITCH, radius=200 * PITCH)
    assert float(found) == pytest.approx(
        1 - 2 / (math.pi * math.pi * DIAMETER * 200 * PITCH / (WAVE * FOCAL)), abs=2e-3
    )
    assert encircled.hooks.check(found)[0].ok


@pytest.mark.parametrize("pixels", [0, 1, 7])
def test_the_curve_of_encircled_light_has_what_lies_within_each_radius(pixels):
    spread = lens(half_ring(2.0), window=32, samples=64)
    curve = encircled_curve(spread.intensity[0])
    within = encircled(spread, pixel_pitch=PITCH, radius=(pixels + 1e-3) * PITCH)
    assert float(curve[pixels]) == pytest.approx(float(within), rel=1e-9)
    assert float(curve[-1]) == pytest.approx(float(spread.intensity.sum()), rel=1e-12)


def test_the_clear_lens_over_its_own_peak_is_one_on_the_axis():
    clear = lens(window=32, samples=64)
    assert float(over_clear_peak(clear, 0)[16, 16]) == pytest.approx(1.0, rel=1e-9)
