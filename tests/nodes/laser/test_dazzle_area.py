"""The dazzled area against the Airy pattern by SciPy, and behind masks against their own Fourier
integrals.
"""

import numpy as np
import pytest
import torch
from scipy.integrate import dblquad
from scipy.special import j0, j1

from neusee.nodes import doe, optics
from neusee.nodes.laser import (
    beam,
    counted_pixels,
    dazzle_curve,
    dazzle_exposure_limit,
    dazzle_strength,
    dazzled_pixels,
    peak_on_sensor,
    pixel_share,
    sensor_gain,
)
from neusee.nodes.values import Bands

DIAMETER, PITCH, WAVELENGTH = 8.08e-3, 2.9e-6, 550e-9  #: the paper's camera
PAPER = WAVELENGTH * 0.11 / DIAMETER / PITCH  #: 2.58, lambda N / p
LINE = Bands(*(torch.tensor([x], dtype=torch.float64) for x in (WAVELENGTH, 1e-9, 1.0)))
DECADES = (1e2, 1e3, 1e4, 1e5, 1e6)


def airy(spread, half, points):
    """The Airy pattern over the pixels (y, x), the mean of points x points samples of each, by
    SciPy.
    """
    inside = (np.arange(points) - (points - 1) / 2) / points
    at = (np.arange(-half, half + 1)[:, None] + inside).ravel()
    reach = np.hypot(at[:, None], at[None, :]) * np.pi / spread
    reach[reach == 0] = 1e-9
    pixels = 2 * half + 1
    return ((2 * j1(reach) / reach) ** 2).reshape(pixels, points, pixels, points).mean((1, 3))


def counted(pattern, strength, top):
    return int((pattern >= top / strength).sum())


def psf(spread, window, sensor="point", mask=doe.flat, samples=540):
    stop = optics.stop(samples=samples, pitch=DIAMETER / samples, diameter=DIAMETER)
    pupil = optics.pupil(mask(stop), doe.material(LINE), LINE, stop)
    focal_length = spread * DIAMETER * PITCH / WAVELENGTH
    return optics.psf(
        pupil, focal_length=focal_length, pixel_pitch=PITCH, shape=(window, window), sensor=sensor
    )


@pytest.mark.parametrize(
    ("spread", "half", "points"),
    [(0.35, 32, 21), (0.64, 40, 15), (1.3, 70, 9), (PAPER, 122, 5), (5.0, 230, 3)],
)
def test_the_clear_lens_dazzles_the_pixels_of_the_airy_pattern(spread, half, points):
    pattern = airy(spread, half, points)
    assert pattern.max() == pytest.approx(pixel_share(spread), rel=6e-3)
    for strength in DECADES:
        expected = counted(pattern, strength, pattern.max())
        assert counted_pixels(strength, spread) == pytest.approx(expected, rel=0.02), strength
        if strength >= 1e4:
            assert dazzled_pixels(strength, spread) == pytest.approx(expected, rel=0.075), strength


@pytest.mark.parametrize(
    ("spread", "half", "points"),
    [
        pytest.param(0.35, 32, 21, marks=pytest.mark.slow),
        pytest.param(1.3, 70, 9, marks=pytest.mark.slow),
        pytest.param(5.0, 230, 3, marks=pytest.mark.slow),
    ],
)
def test_the_psf_of_the_clear_lens_dazzles_the_same_pixels(spread, half, points):
    pattern = airy(spread, half, points)
    found = dazzle_curve(psf(spread, 2 * half + 1, "integrated"), LINE, strengths=DECADES)
    expected = [counted(pattern, strength, pattern.max()) for strength in DECADES]
    np.testing.assert_allclose(found.pixels.numpy(), expected, rtol=0.02)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_psf_that_is_not_finite_has_no_curve(value):
    found = psf(PAPER, 33)
    found.intensity[0, 4, 5] = value
    with pytest.raises(
        ValueError, match="psf holds values that are not finite: its pixels cannot be counted"
    ):
        dazzle_curve(found, LINE)


def test_the_area_of_the_papers_camera_grows_with_the_power_0_64():
    strengths = tuple(np.logspace(1, 6, 21))
    pattern = airy(PAPER, 116, 1)
    found = dazzle_curve(psf(PAPER, 233), LINE, strengths=strengths)
    expected = [counted(pattern, strength, 1.0) for strength in strengths]
    np.testing.assert_allclose(found.pixels.numpy(), expected, rtol=0.02)
    assert [counted_pixels(strength, PAPER, "point") for strength in strengths] == expected
    slope = np.polyfit(np.log(strengths), np.log(found.pixels.numpy()), 1)[0]
    assert slope == pytest.approx(0.64, abs=0.02)
    np.testing.assert_allclose(found.clear[-9:].numpy(), expected[-9:], rtol=0.1)
    np.testing.assert_allclose(found.share.numpy(), found.pixels.numpy() / 233**2, rtol=1e-12)


def test_an_axicon_dazzles_the_pixels_of_its_own_integral_and_more_than_the_clear_lens():
    """The Hankel integral of the pupil exp(2 pi i 5 r), by Gauss-Legendre and SciPy's J0, at
    every pixel.
    """
    at, weights = np.polynomial.legendre.leggauss(300)
    radius = (at + 1) / 2
    side = np.arange(-90, 91)
    distance, where = np.unique(np.hypot(side[:, None], side[None, :]), return_inverse=True)
    field = j0(np.outer(np.pi / PAPER * distance, radius)) @ (
        radius * weights * np.exp(2j * np.pi * 5 * radius)
    )
    pattern = (np.abs(field) ** 2)[where].reshape(181, 181)
    strengths = (5e2, 1e3, 1e4, 5e4)
    found = dazzle_curve(
        psf(PAPER, 181, mask=lambda s: doe.axicon(s, waves=5, wavelength=550e-9)),
        LINE,
        strengths=strengths,
    )
    expected = [counted(pattern, strength, 1.0) for strength in strengths]
    np.testing.assert_allclose(found.pixels.numpy(), expected, rtol=0.02)
    assert found.pixels[2] > 3 * counted_pixels(1e4, PAPER, "point")


def test_a_half_ring_dazzles_the_pixels_of_its_own_integral():
    """The Fourier integral of the pupil exp(2 pi i 4 r sgn(cos t)) over radius and azimuth, at
    every pixel.
    """
    (at, one), (turn, other) = (np.polynomial.legendre.leggauss(n) for n in (50, 60))
    radius, angle = (at + 1) / 2, np.concatenate([turn * np.pi / 2, turn * np.pi / 2 + np.pi])
    side, weight = np.sign(np.cos(angle)), np.outer(radius * one / 2, np.tile(other * np.pi / 2, 2))
    pupil = (weight * np.exp(2j * np.pi * 4 * np.outer(radius, side))).ravel()
    u, v = (np.outer(radius, f(angle)).ravel() for f in (np.cos, np.sin))
    pixels = np.arange(-18, 19) * np.pi / PAPER
    across = np.exp(-1j * np.outer(pixels, u))
    pattern = np.abs((across * pupil) @ np.exp(-1j * np.outer(v, pixels))).T ** 2 / np.pi**2
    strengths = (7e2, 1e3, 3e3, 1e4)
    mask = psf(PAPER, 37, mask=lambda s: doe.half_rings(s, waves=(4,), wavelength=550e-9))
    found = dazzle_curve(mask, LINE, strengths=strengths)
    expected = [counted(pattern, strength, 1.0) for strength in strengths]
    assert expected[0] >= 10
    np.testing.assert_allclose(found.pixels.numpy(), expected, rtol=0.02, atol=1.0)


@pytest.mark.parametrize("spread", [0.35, 1.3, 5.2])
def test_the_mean_over_the_brightest_pixel_is_the_integral_of_the_airy_pattern(spread):
    def irradiance(y, x):
        reach = np.hypot(y, x) * np.pi / spread
        return (2 * j1(reach) / reach) ** 2 if reach else 1.0

    expected = 4 * dblquad(irradiance, 0, 0.5, 0, 0.5, epsabs=1e-7)[0]
    assert pixel_share(spread) == pytest.approx(expected, rel=1e-5)


def test_the_strength_for_an_area_is_the_inverse_of_the_area():
    for sampling in ("integrated", "point"):
        for strength in (1e2, 1e5, 1e9):
            pixels = dazzled_pixels(strength, 1.3, sampling)
            assert dazzle_strength(pixels, 1.3, sampling) == pytest.approx(strength, rel=1e-12)
    assert dazzled_pixels(1.0, 1.3) == 0.0
    assert dazzle_strength(0.0, 1.3) == 1.0


def test_the_dazzle_limit_at_the_lens_dazzles_the_share_of_the_field_that_it_states():
    """Through the lens to the sensor and the Airy pattern, by another way than the limit was
    computed.
    """
    saturation, pixels, transmittance = 0.0196, 0.01 * 2048**2, 0.9
    gain = sensor_gain(WAVELENGTH, 0.11, DIAMETER, transmittance)
    limit = dazzle_exposure_limit(saturation, gain, pixels, PAPER)
    far = beam(WAVELENGTH, power=1.0, divergence=1e-3)
    area = np.pi * DIAMETER**2 / 4
    distance = 1e4
    per_watt = peak_on_sensor(far, distance, DIAMETER, 0.11, transmittance) / (
        2 / (np.pi * (far.waist**2 + (distance * 5e-4) ** 2))
    )
    top = limit * per_watt  # peak irradiance on the sensor, of a point
    assert gain == pytest.approx(transmittance * (area / (WAVELENGTH * 0.11)) ** 2, rel=1e-12)
    pattern = airy(PAPER, 150, 3)
    assert int((pattern * top >= saturation).sum()) == pytest.approx(pixels, rel=0.07)


def test_a_spot_that_is_too_wide_to_count_is_refused_with_the_way_out():
    with pytest.raises(ValueError, match="use dazzled_pixels"):
        counted_pixels(1e12, 5.0)
