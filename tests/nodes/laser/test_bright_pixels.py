"""Pixels ranked by the light of a laser, against Hankel integrals, Airy's pattern and Harvey and Shack's scatter."""

import numpy as np
import pytest
import torch
from scipy.special import j0, j1

from neusee.nodes import ParameterError, doe, flare, optics
from neusee.nodes.laser import bright_pixels, dazzle
from neusee.nodes.values import Bands, Psf

DIAMETER, PITCH, WAVELENGTH = 8.08e-3, 2.9e-6, 550e-9
LINE = Bands(*(torch.tensor([x], dtype=torch.float64) for x in (WAVELENGTH, 1e-9, 1.0)))


def lens(spread, samples=540, mask=doe.flat):
    stop = optics.stop(samples=samples, pitch=DIAMETER / samples, diameter=DIAMETER)
    return optics.pupil(mask(stop), doe.material(LINE), LINE, stop), spread * DIAMETER * PITCH / WAVELENGTH


def places(half, points):
    """Distances from the axis, in pixels, of points x points samples in each pixel of a window."""
    inside = (np.arange(points) - (points - 1) / 2) / points
    at = (np.arange(-half, half + 1)[:, None] + inside).ravel()
    return np.hypot(at[:, None], at[None, :])


def averaged(image, points):
    pixels = len(image) // points
    return image.reshape(pixels, points, pixels, points).mean((1, 3))


def ranked(image, pixels):
    return np.sort(image.ravel())[::-1][np.array(pixels) - 1]


def between(found, pixels):
    return np.exp(np.interp(np.log(pixels), np.log(found.pixels.numpy()), np.log(found.level.numpy())))


def test_pixels_behind_an_axicon_have_the_light_of_its_hankel_integral():
    """The field of exp(2 pi i 5 r) by Gauss-Legendre and SciPy's J0, averaged over 5 x 5 points of each pixel."""
    spread, half, points = 1.3, 70, 5
    at, weights = np.polynomial.legendre.leggauss(400)
    radius = (at + 1) / 2
    distance, where = np.unique(np.round(places(half, points), 6), return_inverse=True)
    rows = np.concatenate([
        j0(np.outer(np.pi / spread * part, radius)) @ (radius * weights * np.exp(2j * np.pi * 5 * radius))
        for part in np.array_split(distance, 40)
    ])  # fmt: skip
    expected = averaged((np.abs(rows) ** 2)[where].reshape((2 * half + 1) * points, -1), points)
    pupil, focal = lens(spread, mask=lambda s: doe.axicon(s, waves=5, wavelength=WAVELENGTH))
    size, fine = 2 * half + 1, {"focal_length": focal, "pixel_pitch": PITCH / 3}
    psf = optics.psf(pupil, **fine, shape=(3 * size, 3 * size))
    found = bright_pixels(psf, LINE, shape=(size, size), pixel_pitch=PITCH, sample_pitch=PITCH / 3)
    expected *= np.pi / (4 * spread**2)  # of the light, in a pixel at the peak of the clear lens
    pixels = [30, 100, 300, 3000, 10000]
    np.testing.assert_allclose(between(found, pixels), ranked(expected, pixels), rtol=0.02)
    for level in ranked(expected, [1000, 3000, 10000]):  # at 1000 pixels the light falls steeply
        bright = np.interp(-level, -found.level.numpy(), found.pixels.numpy())
        assert bright == pytest.approx((expected >= level).sum(), rel=0.02, abs=1)


def test_the_light_that_a_lens_scatters_lies_beside_the_spot_and_counts_as_dazzle():
    """Airy's pattern from SciPy, less what is scattered, and Harvey and Shack's law at the middle of each pixel."""
    spread, half, (b0, width, s) = 2.58, 100, (1e4, 5e-4, -2.2)
    pupil, focal = lens(spread)
    scattered = 2 * np.pi * b0 * ((width**2 + 1) ** ((s + 2) / 2) - width ** (s + 2)) / (width**s * (s + 2))
    away = places(half, 1)
    v = np.where(away > 0, away, 1) * np.pi / spread
    airy = np.where(away > 0, (2 * j1(v) / v) ** 2, 1.0) * np.pi / (4 * spread**2)
    veil = b0 * (1 + (away * PITCH / (focal * width)) ** 2) ** (s / 2) * (PITCH / focal) ** 2
    expected = (1 - scattered) * airy + veil
    size = 2 * half + 1
    clear = optics.psf(pupil, focal_length=focal, pixel_pitch=PITCH, shape=(size, size))
    camera = {"focal_length": focal, "pixel_pitch": PITCH, "diameter": DIAMETER}
    psf = flare.stray_light(clear, pupil, surfaces={"lens": {"b0": b0, "l": width, "s": s}}, **camera)
    found = bright_pixels(psf, LINE, shape=(size, size), pixel_pitch=PITCH)
    pixels = [30, 300, 3000, 10000, 30000]
    np.testing.assert_allclose(between(found, pixels), ranked(expected, pixels), rtol=0.02)
    assert ranked(expected, [30000]) > 2 * ranked(airy, [30000])  # most of the light there is scattered

    for most in (1000, 20000):
        photons = 1e4 / ranked(expected, [most])[0]  # so that this number of pixels holds 1e4 electrons
        picture = dazzle(
            torch.zeros(1, size, size), [photons * psf.intensity], shape=(size, size), full_well=1e4,
            quantum_efficiency=1.0, read_noise=0.0,
        )  # fmt: skip
        assert float(picture.saturated) == pytest.approx(most, rel=0.02)


def test_the_mean_over_a_feature_is_ranked_beside_the_pixels():
    light = torch.zeros(1, 40, 40)
    light[0, 20, 20] = 1.0
    found = bright_pixels(Psf(light, torch.ones(1)), LINE, shape=(40, 40), pixel_pitch=PITCH, feature=4)
    assert found.level[0] == 1
    assert (found.level[found.pixels > 1] == 0).all()
    assert found.smooth[0] == pytest.approx(1 / 16)
    assert (found.smooth[found.pixels <= 16] == found.smooth[0]).all()
    assert (found.smooth[found.pixels > 16] == 0).all()


def test_the_rim_says_whether_the_window_holds_the_pixels():
    at = torch.arange(-20.0, 21.0)
    light = (1 + at[:, None].square() + at.square()).pow(-1)[None]
    psf = Psf(light, torch.ones(1))
    whole = bright_pixels(psf, LINE, shape=(41, 41), pixel_pitch=PITCH)
    part = bright_pixels(psf, LINE, shape=(81, 41), pixel_pitch=PITCH)
    assert (whole.rim == 0).all()
    assert part.level.equal(whole.level)
    reached = part.level <= 1 / 400  # the middle of the upper and of the lower side
    assert (part.rim[~reached] == 0).all()
    assert (part.rim[reached] > 0).all()
    assert part.rim[-1] == 1


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_the_light_of_bands_and_samples_is_summed_in_double_precision(dtype):
    """In single precision the roundings of the sum split pixels that are alike, so that their rank is by chance."""
    at = torch.arange(-20.0, 22.0)
    light = (1 + at[:, None].square() + at.square()).pow(-1).to(dtype)
    three = Bands(*(torch.tensor(x, dtype=torch.float64) for x in ([5e-7, 5.3e-7, 6e-7], [1e-9] * 3, [0.2, 0.5, 0.3])))
    fine = {"shape": (50, 14), "pixel_pitch": PITCH, "sample_pitch": PITCH / 3}
    single, double = (
        bright_pixels(Psf(torch.stack([x, x / 3, x * 0.7]), torch.ones(3)), three, **fine)
        for x in (light, light.double())
    )
    near = bright_pixels(Psf(torch.stack([light, light / 3, light * 0.7]).double(), torch.ones(3)), three, **fine)
    assert all(one.equal(other) for one, other in zip(single, near, strict=True))
    torch.testing.assert_close(single.level, double.level, rtol=2 * float(torch.finfo(dtype).eps), atol=0.0)


def test_a_psf_that_is_narrower_than_a_pixel_is_refused():
    with pytest.raises(ValueError, match="a PSF of 2 x 9 samples holds no pixel, which is 3 samples wide"):
        bright_pixels(
            Psf(torch.ones(1, 2, 9), torch.ones(1)), LINE, shape=(3, 3), pixel_pitch=PITCH, sample_pitch=PITCH / 3
        )


def test_a_sample_pitch_that_is_no_fraction_of_the_pixel_is_refused_with_one_that_is():
    with pytest.raises(ParameterError, match=r"give a whole fraction of the pixel, such as 1\.45 um"):
        bright_pixels.hooks.preflight(pixel_pitch=2.9e-6, sample_pitch=1.3e-6)
