"""Pixels ranked by the light of a laser, against Hankel integrals, Airy's pattern and Harvey and
Shack's scatter.
"""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import dblquad
from scipy.special import j0, j1

from neusee.nodes import ParameterError, doe, flare, optics
from neusee.nodes.laser import bright_pixels, dazzle, hidden_light, round_pixels, with_frame
from neusee.nodes.values import Bands, Psf

DIAMETER, PITCH, WAVELENGTH = 8.08e-3, 2.9e-6, 550e-9
LINE = Bands(*(torch.tensor([x], dtype=torch.float64) for x in (WAVELENGTH, 1e-9, 1.0)))


def lens(spread, samples=540, mask=doe.flat):
    stop = optics.stop(samples=samples, pitch=DIAMETER / samples, diameter=DIAMETER)
    return (
        optics.pupil(mask(stop), doe.material(LINE), LINE, stop),
        spread * DIAMETER * PITCH / WAVELENGTH,
    )


def places(half, points):
    """Distances from the axis, in pixels, of points x points samples in each pixel of a window."""
    inside = (np.arange(points) - (points - 1) / 2) / points
    at = (np.arange(-half, half + 1)[:, None] + inside).ravel()
    return np.hypot(at[:, None], at[None, :])


def averaged(image, points):
    pixels = len(image) // points
    return image.reshape(pixels, points, pixels, points).mean((1, 3))


def between(found, pixels, light="light"):
    """The light of the faintest of a number of pixels; a group is as bright from its first to
    its last.
    """
    column = getattr(found, light)
    order = column.argsort(descending=True)
    count = found.pixels[order].cumsum(0).clamp_min(1e-9)
    ends = (
        torch.stack([(count - found.pixels[order] + 1).minimum(count), count], 1)
        .flatten()
        .log()
        .numpy()
    )
    return np.exp(
        np.interp(
            np.log(pixels), ends, column[order].clamp_min(1e-300).log().repeat_interleave(2).numpy()
        )
    )


def above(found, level):
    return float(found.pixels[found.light >= level].sum())


def ranked(image, pixels):
    return np.sort(image.ravel())[::-1][np.array(pixels) - 1]


def test_pixels_behind_an_axicon_have_the_light_of_its_hankel_integral():
    """The field of exp(2 pi i 5 r) by Gauss-Legendre and SciPy's J0, averaged over 5 x 5 points
    of each pixel.
    """
    spread, half, points = 1.3, 70, 5
    at, weights = np.polynomial.legendre.leggauss(400)
    radius = (at + 1) / 2
    distance, where = np.unique(np.round(places(half, points), 6), return_inverse=True)
    rows = np.concatenate(
        [
            j0(np.outer(np.pi / spread * part, radius))
            @ (radius * weights * np.exp(2j * np.pi * 5 * radius))
            for part in np.array_split(distance, 40)
        ]
    )
    expected = averaged((np.abs(rows) ** 2)[where].reshape((2 * half + 1) * points, -1), points)
    pupil, focal = lens(spread, mask=lambda s: doe.axicon(s, waves=5, wavelength=WAVELENGTH))
    size, fine = 2 * half + 1, {"focal_length": focal, "pixel_pitch": PITCH / 3}
    psf = optics.psf(pupil, **fine, shape=(3 * size, 3 * size))
    found = bright_pixels(psf, LINE, shape=(size, size), pixel_pitch=PITCH, sample_pitch=PITCH / 3)
    expected *= np.pi / (4 * spread**2)  # of the light, in a pixel at the peak of the clear lens
    pixels = [30, 100, 300, 3000, 10000]
    np.testing.assert_allclose(between(found, pixels), ranked(expected, pixels), rtol=0.02)
    for level in ranked(expected, [1000, 3000, 10000]):  # at 1000 pixels the light falls steeply
        assert above(found, level) == pytest.approx((expected >= level).sum(), rel=0.02, abs=1)


def test_the_light_that_a_lens_scatters_lies_beside_the_spot_and_counts_as_dazzle():
    """Airy's pattern from SciPy, less what is scattered, and Harvey and Shack's law at the
    middle of each pixel.
    """
    spread, half, (b0, width, s) = 2.58, 100, (1e4, 5e-4, -2.2)
    pupil, focal = lens(spread)
    scattered = (
        2 * np.pi * b0 * ((width**2 + 1) ** ((s + 2) / 2) - width ** (s + 2)) / (width**s * (s + 2))
    )
    away = places(half, 1)
    v = np.where(away > 0, away, 1) * np.pi / spread
    airy = np.where(away > 0, (2 * j1(v) / v) ** 2, 1.0) * np.pi / (4 * spread**2)
    veil = b0 * (1 + (away * PITCH / (focal * width)) ** 2) ** (s / 2) * (PITCH / focal) ** 2
    expected = (1 - scattered) * airy + veil
    size = 2 * half + 1
    clear = optics.psf(pupil, focal_length=focal, pixel_pitch=PITCH, shape=(size, size))
    camera = {"focal_length": focal, "pixel_pitch": PITCH, "diameter": DIAMETER}
    psf = flare.stray_light(
        clear, pupil, surfaces={"lens": {"b0": b0, "l": width, "s": s}}, **camera
    )
    found = bright_pixels(psf, LINE, shape=(size, size), pixel_pitch=PITCH)
    pixels = [30, 300, 3000, 10000, 30000]
    np.testing.assert_allclose(between(found, pixels), ranked(expected, pixels), rtol=0.02)
    # most of the light there is scattered
    assert ranked(expected, [30000]) > 2 * ranked(airy, [30000])

    for most in (1000, 20000):
        # so that this number of pixels holds 1e4 electrons
        photons = 1e4 / ranked(expected, [most])[0]
        picture = dazzle(
            torch.zeros(1, size, size),
            [photons * psf.intensity],
            shape=(size, size),
            full_well=1e4,
            quantum_efficiency=1.0,
            read_noise=0.0,
        )
        assert float(picture.saturated) == pytest.approx(most, rel=0.02)


def test_the_mean_over_a_feature_stands_beside_the_pixels():
    light = torch.zeros(1, 40, 40)
    light[0, 20, 20] = 1.0
    found = bright_pixels(
        Psf(light, torch.ones(1)), LINE, shape=(40, 40), pixel_pitch=PITCH, feature=4
    )
    assert found.pixels.sum() == pytest.approx(1600)
    assert between(found, 1) == pytest.approx(1, rel=0.01)
    assert float(found.pixels[found.light > 0].sum()) == pytest.approx(1)
    assert found.smooth.max() == pytest.approx(1 / 16, rel=0.01)
    assert float(found.pixels[found.smooth > 0].sum()) == pytest.approx(16, rel=0.1)


def test_pixels_beyond_the_window_have_a_radial_law_and_the_rim_says_so():
    at = torch.arange(-20.0, 21.0)
    light = (1 + at[:, None].square() + at.square()).pow(-1.5)[None]
    psf = Psf(light, torch.ones(1))
    whole = bright_pixels(psf, LINE, shape=(41, 41), pixel_pitch=PITCH)
    assert whole.rim.tolist() == [0.0, 0.0, pytest.approx(float(light.sum()))]
    assert hidden_light(whole) == 0
    assert with_frame(whole, (41, 41)) is whole
    part = with_frame(bright_pixels(psf, LINE, shape=(81, 81), pixel_pitch=PITCH), (81, 81))
    assert part.rim[0] == 20
    assert part.pixels.sum() == pytest.approx(81**2)
    wide = torch.arange(-40.0, 41.0)
    expected = (1 + wide[:, None].square() + wide.square()).pow(-1.5).numpy()
    np.testing.assert_allclose(
        between(part, [50, 500, 1500]), ranked(expected, [50, 500, 1500]), rtol=0.05
    )
    assert between(part, [5000]) == pytest.approx(ranked(expected, [5000]), rel=0.05)


def test_light_beyond_the_window_is_hidden_unless_the_radial_law_accounts_for_it():
    """The plane has 2 pi of the law a / (a^2 + r^2)^(3/2); a third of another spot goes to a
    ring outside.
    """
    at = torch.arange(-50.0, 51.0)
    light = 3 / (9 + at[:, None].square() + at.square()).pow(1.5)[None] / (2 * math.pi)
    smooth = bright_pixels(Psf(light, torch.ones(1)), LINE, shape=(301, 301), pixel_pitch=PITCH)
    assert light.sum() < 0.97
    assert hidden_light(smooth) == 0
    # half as much again as the law has counts as known
    expected = 1 / 3 - 0.5 * 2 / 3 * (1 - float(light.sum()))
    ringed = bright_pixels(
        Psf(light * 2 / 3, torch.ones(1)), LINE, shape=(301, 301), pixel_pitch=PITCH
    )
    assert hidden_light(ringed) == pytest.approx(expected, rel=2e-3)
    wider = bright_pixels(
        Psf(light * 2 / 3, torch.ones(1)), LINE, shape=(80, 301), pixel_pitch=PITCH
    )
    assert hidden_light(wider) == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize(("spread", "half", "points"), [(0.35, (40, 60), 21), (0.64, (50, 70), 15), (1.3, (80, 90), 7),
                                                        (2.58, (90, 120), 5), (5.0, (100, 140), 3)])  # fmt: skip
def test_a_clear_lens_has_the_pixels_of_the_airy_pattern_on_the_whole_sensor(spread, half, points):
    """SciPy's J1 at points x points places of every pixel of a frame, sorted."""
    inside = (np.arange(points) - (points - 1) / 2) / points
    y, x = ((np.arange(-h, h + 1)[:, None] + inside).ravel() for h in half)
    v = np.hypot(y[:, None], x) * np.pi / spread
    v[v == 0] = 1e-9
    shape = (2 * half[0] + 1, 2 * half[1] + 1)
    image = (
        ((2 * j1(v) / v) ** 2).reshape(shape[0], points, shape[1], points).mean((1, 3))
        * np.pi
        / (4 * spread**2)
    )
    found = round_pixels(0.0, 0.0, spread, shape)
    assert found.pixels.sum() == pytest.approx(image.size)
    assert float((found.pixels * found.light).sum()) == pytest.approx(image.sum(), rel=2e-4)
    pixels = [1, 9, 21, 300, 1000, 3000, 6000]
    np.testing.assert_allclose(between(found, pixels), ranked(image, pixels), rtol=0.025)


@pytest.mark.parametrize(
    ("fill", "waves", "spread"), [(1.0, 3.0, 1.5), (8.0, 5.0, 1.0), (0.2, 9.0, 0.8)]
)
def test_a_narrow_beam_out_of_focus_has_the_pixels_of_its_own_integral(fill, waves, spread):
    """A direct sum over the pupil with SciPy's J0 at 5 x 5 places of every pixel."""
    half, points = 45, 5
    distance, where = np.unique(np.round(places(half, points), 6), return_inverse=True)
    at, weights = np.polynomial.legendre.leggauss(300)
    radius = (at + 1) / 2
    pupil = radius * weights * np.exp((-fill + 2j * np.pi * waves) * radius**2)
    field = np.concatenate(
        [
            j0(np.outer(np.pi / spread * part, radius)) @ pupil
            for part in np.array_split(distance, 40)
        ]
    )
    share = -np.expm1(-2 * fill) / (2 * fill)
    size = 2 * half + 1
    image = (
        averaged((np.abs(field) ** 2)[where].reshape(size * points, -1), points)
        * np.pi
        / (4 * spread**2)
        / share
    )
    pixels = [9, 100, 300, 1000, 3000, 6000]
    np.testing.assert_allclose(
        between(round_pixels(fill, waves, spread, (size, size)), pixels),
        ranked(image, pixels),
        rtol=0.035,
    )


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_the_light_of_bands_and_samples_is_summed_in_double_precision(dtype):
    """In single precision the roundings of the sum split pixels that are alike, so that their
    rank is by chance.
    """
    at = torch.arange(-20.0, 22.0)
    light = (1 + at[:, None].square() + at.square()).pow(-1).to(dtype)
    three = Bands(
        *(
            torch.tensor(x, dtype=torch.float64)
            for x in ([5e-7, 5.3e-7, 6e-7], [1e-9] * 3, [0.2, 0.5, 0.3])
        )
    )
    fine = {"shape": (50, 14), "pixel_pitch": PITCH, "sample_pitch": PITCH / 3}
    single, double = (
        bright_pixels(Psf(torch.stack([x, x / 3, x * 0.7]), torch.ones(3)), three, **fine)
        for x in (light, light.double())
    )
    near = bright_pixels(
        Psf(torch.stack([light, light / 3, light * 0.7]).double(), torch.ones(3)), three, **fine
    )
    assert all(one.equal(other) for one, other in zip(single, near, strict=True))
    torch.testing.assert_close(
        single.light, double.light, rtol=2 * float(torch.finfo(dtype).eps), atol=0.0
    )


def test_a_psf_that_is_narrower_than_a_pixel_is_refused():
    with pytest.raises(
        ValueError, match="a PSF of 2 x 9 samples holds no pixel, which is 3 samples wide"
    ):
        bright_pixels(
            Psf(torch.ones(1, 2, 9), torch.ones(1)),
            LINE,
            shape=(3, 3),
            pixel_pitch=PITCH,
            sample_pitch=PITCH / 3,
        )


def test_a_sample_pitch_that_is_no_fraction_of_the_pixel_is_refused_with_one_that_is():
    with pytest.raises(
        ParameterError, match=r"give a whole fraction of the pixel, such as 1\.45 um"
    ):
        bright_pixels.hooks.preflight(pixel_pitch=2.9e-6, sample_pitch=1.3e-6)


def test_the_rim_is_the_mean_of_the_sides_where_the_sensor_goes_on_brought_to_one_distance():
    """A window of 21 x 41 with light on its rim alone: rows have 1, columns 2; each pixel counts
    by its cube.
    """
    light = torch.zeros(1, 21, 41)
    light[0, [0, -1], :] = 1.0
    light[0, :, [0, -1]] = 2.0
    y, x = np.arange(-10, 11.0), np.arange(-20, 21.0)
    rows = np.where(np.abs(x) == 20, 2.0, 1.0) * np.hypot(10, x) ** 3
    columns = 2.0 * np.hypot(y, 20) ** 3
    for shape, cubes, distance in (((61, 41), rows, 10), ((21, 81), columns, 20),
                                   ((61, 81), np.concatenate([rows, rows, columns, columns]), 10)):  # fmt: skip
        rim = bright_pixels(Psf(light, torch.ones(1)), LINE, shape=shape, pixel_pitch=PITCH).rim
        assert float(rim[0]) == distance
        assert float(rim[1]) == pytest.approx(cubes.mean() / distance**3, rel=1e-6)
        outside = dblquad(
            lambda v, u: (v * v + u * u) ** -1.5,
            20.5,
            np.inf,
            lambda u: 0,
            lambda u: 10.5 / 20.5 * u,
        )[0]
        above = dblquad(
            lambda v, u: (v * v + u * u) ** -1.5,
            10.5,
            np.inf,
            lambda u: 0,
            lambda u: 20.5 / 10.5 * u,
        )[0]
        law = 4 * (outside + above) * cubes.mean()
        assert float(rim[2]) == pytest.approx(float(light.sum()) + 1.5 * law, rel=1e-5)


def test_the_frame_around_a_window_has_every_pixel_of_the_sensor_at_its_distance():
    """The sensor is off square: the second moment of all pixels, and the light of a cube, by
    sums.
    """
    at = torch.ones(1, 15, 15)
    whole = with_frame(
        bright_pixels(Psf(at, torch.ones(1)), LINE, shape=(61, 91), pixel_pitch=PITCH), (61, 91)
    )
    away = np.hypot((np.arange(61) - 30)[:, None], np.arange(91) - 45)
    outside = (np.abs(np.arange(61) - 30)[:, None] > 7) | (np.abs(np.arange(91) - 45) > 7)
    assert float(whole.pixels.sum()) == pytest.approx(61 * 91)
    added = whole.pixels[whole.radius > away[~outside].max()]
    assert float((whole.pixels * whole.radius.square()).sum()) == pytest.approx(
        (away**2).sum(), rel=0.02
    )
    for distance in (20, 35, 50):
        expected = (away <= distance).sum()
        assert float(whole.pixels[whole.radius <= distance].sum()) == pytest.approx(
            expected, rel=0.03
        )
    assert len(added) > 100
    low, high = whole.light[whole.radius > 40], whole.light[whole.radius > 50]
    rim = whole.rim.tolist()
    assert float(low.max()) == pytest.approx(rim[1] * (rim[0] / 40) ** 3, rel=0.01)
    assert float(high.max()) == pytest.approx(rim[1] * (rim[0] / 50) ** 3, rel=0.01)


@pytest.mark.parametrize("shape", [(31, 31), (31, 61), (160, 130)])
def test_every_pixel_of_a_frame_counts_once_at_its_distance(shape):
    found = round_pixels(0.0, 0.0, 1.0, shape)
    y, x = (np.arange(n) - (n - 1) / 2 for n in shape)
    away = np.hypot(y[:, None], x)
    assert float(found.pixels.sum()) == pytest.approx(away.size)
    assert float((found.pixels * found.radius.square()).sum()) == pytest.approx(
        (away**2).sum(), rel=0.02
    )


@pytest.mark.parametrize("feature", [4.0, 25.0])
def test_a_feature_around_the_spot_has_the_light_that_it_encloses(feature):
    """The encircled energy of Airy's pattern, 1 - J0^2 - J1^2, within the radius of a disc of as
    many pixels.
    """
    spread = 1.0
    found = round_pixels(0.0, 0.0, spread, (201, 201), feature)
    v = np.pi / spread * feature / math.sqrt(math.pi)
    enclosed = 1 - j0(v) ** 2 - j1(v) ** 2
    assert float(found.smooth.max()) == pytest.approx(enclosed / feature**2, rel=0.02)
    far = found.radius > 60
    ratio = (found.smooth / found.light.clamp_min(1e-300))[far]
    assert float((found.pixels * found.smooth)[far].sum()) == pytest.approx(
        float((found.pixels * found.light)[far].sum()), rel=0.1
    )
    assert ratio.numel() > 10
