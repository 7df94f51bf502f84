"""A run with `reading=as_printed`, against the formulas of the paper, written here apart in NumPy.

The reflectance of the scene, the height map and the tabulated curves (daylight and the CIE
observer) are those of the run; everything that the paper prints as a formula is computed here from
the printed numbers.
"""

from dataclasses import replace

import numpy as np
import pytest

import neusee
from neusee.workflows import Store, load

N_PUPIL, N_SCENE, N_SENSOR, N_PSF = 64, 48, 40, 40
PITCH_U, PITCH_X, FOCAL, DIAMETER = 8.078e-3 / N_PUPIL, 2.9e-6, 0.11, 11e-3
WELL, EFFICIENCY, EXPOSURE, GAIN, READ, OFFSET = 25500.0, 0.56, 0.1, 0.37, 10.5, 390.0
STRENGTH, BACKGROUND, C1, C2 = 1e3, 0.7, 0.2, 1.0
PLANCK, LIGHT = 6.63e-34, 3e8  # as printed; they cancel
ANGLE = (-0.1e-3, 0.12e-3)
SMALL = [
    "reading=as_printed", f"optics.samples={N_PUPIL}", f"optics.pitch={PITCH_U * 1e6} um", "optics.border=zero",
    f"optics.window=[{N_PSF}, {N_PSF}]", f"scene.shape=[{N_SCENE}, {N_SCENE}]",
    f"sensor.shape=[{N_SENSOR}, {N_SENSOR}]", f"lasers.green.angle=[{ANGLE[0] * 1e3} mrad, {ANGLE[1] * 1e3} mrad]",
    "doe=half_ring", "doe.waves=[3]",
    "outputs=[cube, illuminant, responses, laser_responses, fabricated, photons, charge, dark, "
    "read, well, digital, "
    "raw, signal]",
]  # fmt: skip

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("printed")
    return neusee.run(replace(load("first_light", SMALL), exact=True), store=Store(folder))


def data(run, name):
    return run[name].double().numpy()


def fused_silica(wavelength):
    """n - 1 by Malitson's formula, in which wavelengths are in um."""
    s = (wavelength * 1e6) ** 2
    terms = ((0.6961663, 0.0684043), (0.4079426, 0.1162414), (0.8974794, 9.896161))
    return np.sqrt(1 + sum(b * s / (s - c**2) for b, c in terms)) - 1


def psf(height, wavelengths, size, angle=(0.0, 0.0)):
    """|U|^2 of the printed integral over an 11 mm disc on the grid, as the share of the disc's
    light in each pixel.
    """
    u = (np.arange(N_PUPIL) - (N_PUPIL - 1) / 2) * PITCH_U
    aperture = (np.hypot(u[:, None], u) <= DIAMETER / 2).astype(float)
    x = (np.arange(size) - size // 2) * PITCH_X
    found = []
    for wavelength in wavelengths:
        field = aperture * np.exp(2j * np.pi / wavelength * fused_silica(wavelength) * height)
        rows, columns = (
            np.exp(-2j * np.pi * np.outer(x - FOCAL * a, u) / (wavelength * FOCAL)) for a in angle
        )
        amplitude = rows @ field @ columns.T * PITCH_U * PITCH_X / (wavelength * FOCAL)
        found.append(np.abs(amplitude) ** 2 / aperture.sum())
    return np.array(found)


def blurred(scene, kernel):
    """Linear convolution, darkness beyond the scene, cropped to the scene."""
    size = N_SCENE + N_PSF
    whole = np.fft.ifft2(np.fft.fft2(scene, (size, size)) * np.fft.fft2(kernel, (size, size))).real
    first = N_PSF // 2
    return whole[..., first : first + N_SCENE, first : first + N_SCENE]


def saturation(wavelengths):
    return WELL * PLANCK * LIGHT / (wavelengths * EXPOSURE * PITCH_X**2 * EFFICIENCY)


def photons(irradiance, wavelengths, responses):
    counts = wavelengths * EXPOSURE * PITCH_X**2 / (PLANCK * LIGHT)
    return np.einsum("cb,b,byx->cyx", responses, counts, irradiance)


def printed_photons(run, height):
    """Photons of scene and laser: daylight twice, every band scaled to alpha_b, the line at
    points of a 10 nm grid.
    """
    bands = np.linspace(400e-9, 700e-9, 31)
    radiance = data(run, "cube") * (data(run, "illuminant") ** 2)[:, None, None]
    plain = blurred(radiance, psf(np.zeros_like(height), bands, N_PSF)).max((1, 2))
    scale = BACKGROUND * saturation(bands) / plain
    scene = blurred(radiance, psf(height, bands, N_PSF)) * scale[:, None, None]
    line = np.array([510e-9, 520e-9, 530e-9, 540e-9, 550e-9])
    profile = np.exp(-4 * np.log(2) * ((line - 532e-9) / 10e-9) ** 2) + 1e-3
    peaks = psf(np.zeros_like(height), line, N_PSF).max((1, 2))
    power = STRENGTH * profile / (profile * peaks / saturation(line)).sum()
    spot = psf(height, line, N_SCENE, ANGLE) * power[:, None, None]
    laser = photons(spot, line, data(run, "laser_responses[green]"))
    return photons(scene, bands, data(run, "responses")) + laser


@pytest.mark.parametrize("arm", ["plain", "mask"])
def test_the_light_is_that_of_the_printed_formulas(run, arm):
    height = data(run, "fabricated") if arm == "mask" else np.zeros((N_PUPIL, N_PUPIL))
    expected, found = printed_photons(run, height), data(run, f"photons[{arm}]")
    assert np.abs(found - expected).max() < 1e-4 * expected.max()
    assert np.median(np.abs(found / expected - 1)) < 1e-4


@pytest.mark.parametrize("arm", ["plain", "mask"])
def test_the_noise_is_that_of_the_printed_formulas(run, arm):
    p, charge = data(run, f"photons[{arm}]"), data(run, f"charge[{arm}]")
    lit = p > 1000  # c1 p is more than six standard deviations above 0
    assert lit.mean() > 0.5
    z = ((charge - EFFICIENCY * C1 * p) / (EFFICIENCY * C2 * np.sqrt(p)))[lit]
    assert abs(z.mean()) < 5 / np.sqrt(z.size)
    assert abs(z.std() - 1) < 5 / np.sqrt(2 * z.size)
    read = data(run, f"read[{arm}]") - data(run, f"dark[{arm}]") - OFFSET
    assert abs(read.mean()) < 5 * READ / np.sqrt(read.size)
    assert abs(read.std() / READ - 1) < 5 / np.sqrt(2 * read.size)


@pytest.mark.parametrize("arm", ["plain", "mask"])
def test_the_digital_numbers_are_those_of_the_printed_formulas(run, arm):
    electrons = np.minimum(WELL, data(run, f"read[{arm}]"))
    np.testing.assert_allclose(data(run, f"well[{arm}]"), electrons, rtol=1e-6)
    added = data(run, f"digital[{arm}]") - GAIN * electrons  # floor(x + U(-1/2, 1/2)) - x
    assert added.min() > -1.51
    assert added.max() <= 0.51
    assert abs(added.mean() + 0.5) < 5 * np.sqrt(1 / 6 / added.size)
    assert data(run, f"digital[{arm}]").max() <= np.floor(GAIN * WELL + 0.5)  # 9435 of 65 535
    np.testing.assert_allclose(
        data(run, f"signal[{arm}]"), data(run, f"raw[{arm}]") / GAIN, rtol=1e-6
    )


def test_without_a_share_of_the_mean_no_light_is_left(tmp_path):
    words = [*SMALL[:-1], "outputs=[photons, charge]", "sensor.c1=0", "lasers.green.strength=0"]
    run = neusee.run(replace(load("first_light", words), exact=True), store=Store(tmp_path))
    p, charge = data(run, "photons[plain]"), data(run, "charge[plain]")
    # the positive half of N(0, sqrt(p)) in photons: its mean is sqrt(p / 2 pi)
    expected = EFFICIENCY * np.sqrt(p / (2 * np.pi))
    assert charge.mean() == pytest.approx(expected.mean(), rel=0.05)
    assert charge.mean() < 0.02 * (EFFICIENCY * p).mean()
