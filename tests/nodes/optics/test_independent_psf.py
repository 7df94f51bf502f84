"""The reference PSF against closed forms, and against 50 digits: it holds before anything is
compared with it.
"""

import mpmath
import numpy as np
import pytest
from scipy.special import j0, j1, jn_zeros

from tests.nodes.optics.independent_psf import point_spread, round_stop, window

EPS = float(np.finfo(np.longdouble).eps)
LENS = {"wavelength": 532e-9, "pitch": 8e-6, "focal_length": 0.05, "pixel_pitch": 3.45e-6}
INDEX = 0.46
# powers of two, so that waves, pixels and angles are exact; a period of the pattern has 64 pixels
EXACT = {
    "wavelength": 2.0**-21,
    "pitch": 2.0**-17,
    "focal_length": 2.0**-4,
    "pixel_pitch": 2.0**-14,
}
# of a clear pupil of 16 x 16 samples there: (pitch pixel_pitch / (wavelength f))^2 16^2
PEAK = 16.0**2 / 64**2
POINTS = [(0, 0), (1, 0), (0, -1), (2.25, -7.5), (-13, 11)]


def flat(n):
    return np.zeros((n, n), np.float32)


def bumps(n, size=1e-6, seed=0):
    """Draw heights (m) with no symmetry at all."""
    return (size * np.random.default_rng(seed).random((n, n))).astype(np.float32)


def close(got, expected, to):
    """Compare with the largest of the expected values as the scale."""
    assert got.shape == expected.shape
    assert np.max(np.abs(got - expected)) <= to * np.max(np.abs(expected))


# --- against 50 digits ----------------------------------------------------------------------------


def digits(height, path, aperture, point, angle, index, lens):
    """Write the definition once more, term by term, in 50 decimal digits."""
    wavelength, pitch, f, q = (
        mpmath.mpf(lens[k]) for k in ("wavelength", "pitch", "focal_length", "pixel_pitch")
    )
    y, x = (mpmath.mpf(i) * q - f * mpmath.mpf(a) for i, a in zip(point, angle, strict=True))
    n, u, clear = len(height), mpmath.mpc(0), mpmath.mpf(0)
    for k in range(n):
        for j in range(n):
            vk, uj = ((mpmath.mpf(m) - mpmath.mpf(n - 1) / 2) * pitch for m in (k, j))
            length = mpmath.mpf(index) * mpmath.mpf(float(height[k, j])) + mpmath.mpf(
                float(path[k, j])
            )
            a = mpmath.mpf(float(aperture[k, j]))
            u += a * mpmath.expjpi(2 * (length / wavelength - (x * uj + y * vk) / (wavelength * f)))
            clear += a**2
    return abs(u) ** 2 * (pitch * q / (wavelength * f)) ** 2 / clear


@pytest.mark.parametrize(("thickness", "angle"), [(0.0, (0, 0)), (0.01, (0.31, -0.17))])
def test_fifty_digits(thickness, angle):
    n = 8
    height = bumps(n, 2e-6).astype(float) + thickness
    path = np.random.default_rng(1).normal(size=(n, n)) * 1e-6
    aperture = np.random.default_rng(2).random((n, n)) * round_stop(
        n, LENS["pitch"], n * LENS["pitch"]
    )
    on_spot = [LENS["focal_length"] * a / LENS["pixel_pitch"] for a in angle]
    points = [*POINTS, (on_spot[0] + 40.5, on_spot[1] - 90), (3000, -2000)]
    got = point_spread(height, path, aperture, INDEX, **LENS, points=points, angle=angle)
    with mpmath.workdps(50):
        exact = [digits(height, path, aperture, p, angle, INDEX, LENS) for p in points]
        peak = digits(flat(n), flat(n), aperture, (0, 0), (0, 0), INDEX, LENS)
        off = [
            abs(mpmath.mpf(int(g * 2**200)) / 2**200 - e) for g, e in zip(got, exact, strict=True)
        ]
        # a phase of T turns is rounded by about T eps / 2; 10 mm are 8600 turns
        assert max(off) < (2 if thickness == 0 else 3000) * EPS * peak
        seen = window(height, path, aperture, INDEX, **LENS, shape=(5, 4), angle=angle)
        for i, j in np.ndindex(seen.shape):
            at = digits(height, path, aperture, (i - 2, j - 2), angle, INDEX, LENS)
            assert abs(mpmath.mpf(seen[i, j]) - at) < 1e-14 * peak


def test_window_is_the_points_of_the_window():
    n = 540
    height, path, angle = bumps(n, 1.5e-6), 2e-7 * bumps(n, 1, seed=1), (0.003, -0.002)
    aperture = round_stop(n, LENS["pitch"], n * LENS["pitch"])
    seen = window(height, path, aperture, INDEX, **LENS, shape=(64, 63), angle=angle)
    pixels = [(0, 0), (32, 31), (63, 62), (5, 50), (50, 5)]
    points = [(y - 32, x - 31) for y, x in pixels]
    close(
        np.array([seen[p] for p in pixels]),
        point_spread(height, path, aperture, INDEX, **LENS, points=points, angle=angle),
        1e-13,
    )


# --- the pattern of a clear pupil -----------------------------------------------------------------


def airy(v):
    """Give the Airy pattern, 1 at the axis, at v = pi D r / (wavelength f)."""
    v = np.where(v == 0, 1e-9, v)
    return (2 * j1(v) / v) ** 2


def clear_round(n, per_ring, shape):
    """Compute the window of a round clear pupil, with ``per_ring`` pixels to wavelength f / D;
    give it and v.
    """
    diameter = n * LENS["pitch"]
    fine = LENS | {"pixel_pitch": LENS["wavelength"] * LENS["focal_length"] / diameter / per_ring}
    seen = window(flat(n), flat(n), round_stop(n, LENS["pitch"], diameter), 0, **fine, shape=shape)
    y, x = (np.arange(m) - m // 2 for m in shape)
    return seen, np.pi * np.hypot(y[:, None], x[None, :]) / per_ring


def test_airy_pattern():
    seen, v = clear_round(540, 16, (129, 128))
    assert np.unravel_index(seen.argmax(), seen.shape) == (64, 64)
    # the area of the pupil is known in wholes of a sample: the peak is pi D^2 / 4 pixel_pitch^2 /
    # (wavelength f)^2
    assert seen.max() == pytest.approx(np.pi / 4 / 16**2, rel=1e-4)
    assert np.max(np.abs(seen / seen.max() - airy(v))) < 1e-4


def test_dark_rings():
    seen, v = clear_round(540, 400, (1, 3000))
    row, v = seen[0, 1500:], v[0, 1500:]
    dark = 1 + np.flatnonzero((row[1:-1] < row[:-2]) & (row[1:-1] < row[2:]))
    # 1.220, 2.233 and 3.238 wavelength f / D: the zeros of J1
    np.testing.assert_allclose(v[dark], jn_zeros(1, 3), atol=np.pi / 400)
    assert row[dark].max() < 1e-5 * row[0]


def test_encircled_energy():
    seen, v = clear_round(540, 16, (129, 129))
    # Born & Wolf, 8.5.2
    for ring, published in zip(jn_zeros(1, 3), (0.838, 0.910, 0.938), strict=True):
        inside = seen[v < ring].sum()
        assert inside == pytest.approx(published, abs=1e-3)
        assert inside == pytest.approx(1 - j0(ring) ** 2 - j1(ring) ** 2, abs=3e-4)


def test_square_pupil():
    n = 24
    points = [(0.3, 0.7), (2, -1), (-4.5, 8), (60, 31)]
    got = point_spread(flat(n), flat(n), np.ones((n, n)), INDEX, **LENS, points=points)
    with mpmath.workdps(50):
        wavelength, pitch, f, q = (mpmath.mpf(LENS[k]) for k in LENS)
        exact, smooth = [], []
        for point in points:
            # turns from sample to sample
            t = [mpmath.mpf(i) * q * pitch / (wavelength * f) for i in point]
            peak = (n * pitch * q / (wavelength * f)) ** 2
            sinc = [mpmath.sincpi(n * s) / mpmath.sincpi(s) for s in t]
            exact.append(np.longdouble(str(peak * (sinc[0] * sinc[1]) ** 2)))
            smooth.append(float(peak * (mpmath.sincpi(n * t[0]) * mpmath.sincpi(n * t[1])) ** 2))
        peak = float(peak)
    # a sum of equal steps is the sinc of the side over the sinc of a sample
    assert np.max(np.abs(got - np.array(exact))) < 20 * EPS * peak
    # sinc^2 where a sample is small
    assert np.max(np.abs(got - np.array(smooth))[:3]) < 1e-3 * peak


@pytest.mark.parametrize("waves", [0.25, 0.5, 1.0, 1.75])
def test_defocus_on_the_axis(waves):
    n = 540
    r = np.hypot(*np.meshgrid(*[np.arange(n) - (n - 1) / 2] * 2)) / (n / 2)
    aperture = round_stop(n, LENS["pitch"], n * LENS["pitch"])
    path = waves * LENS["wavelength"] * r**2
    dull, sharp = (
        point_spread(flat(n), p, aperture, INDEX, **LENS, points=[(0, 0)]) for p in (path, flat(n))
    )
    assert float(dull[0] / sharp[0]) == pytest.approx(np.sinc(waves) ** 2, abs=1e-4)


# --- what moves the pattern, and what leaves it ---------------------------------------------------


def test_source_moves_the_pattern():
    n, (dy, dx) = 16, (5, -9)
    pupil = (
        bumps(n),
        1e-7 * bumps(n, 1, seed=3),
        round_stop(n, EXACT["pitch"], n * EXACT["pitch"]),
        INDEX,
    )
    angle = [d * EXACT["pixel_pitch"] / EXACT["focal_length"] for d in (dy, dx)]
    still = point_spread(*pupil, **EXACT, points=POINTS)
    moved = point_spread(*pupil, **EXACT, points=[(y + dy, x + dx) for y, x in POINTS], angle=angle)
    assert np.array_equal(still, moved)
    still = window(*pupil, **EXACT, shape=(32, 33))
    moved = window(*pupil, **EXACT, shape=(32, 33), angle=angle)
    close(moved[5:, :-9], still[:-5, 9:], 1e-14)


def test_spot_is_at_focal_length_times_angle():
    pupil = flat(16), flat(16), np.ones((16, 16)), INDEX
    angle = (
        7 * EXACT["pixel_pitch"] / EXACT["focal_length"],
        -3 * EXACT["pixel_pitch"] / EXACT["focal_length"],
    )
    seen = window(*pupil, **EXACT, shape=(40, 31), angle=angle)
    assert np.unravel_index(seen.argmax(), seen.shape) == (20 + 7, 15 - 3)
    assert seen.max() == pytest.approx(PEAK, rel=1e-14)


@pytest.mark.parametrize("of", ["height", "path"])
def test_ramp_moves_the_spot(of):
    n, (dy, dx) = 16, (6, -4)
    x = np.arange(n) * EXACT["pitch"]
    slope = [d * EXACT["pixel_pitch"] / EXACT["focal_length"] for d in (dy, dx)]
    # m of path: moves the spot by f times its slope
    ramp = slope[0] * x[:, None] + slope[1] * x[None, :]
    aperture = round_stop(n, EXACT["pitch"], n * EXACT["pitch"])
    pupil = ((2 * ramp).astype(np.float32), flat(n)) if of == "height" else (flat(n), ramp)
    moved = point_spread(
        *pupil, aperture, 0.5, **EXACT, points=[(y + dy, x + dx) for y, x in POINTS]
    )
    close(moved, point_spread(flat(n), flat(n), aperture, 0.5, **EXACT, points=POINTS), 20 * EPS)
    seen = window(*pupil, aperture, 0.5, **EXACT, shape=(24, 24))
    assert np.unravel_index(seen.argmax(), seen.shape) == (12 + dy, 12 + dx)


def test_plate_changes_nothing():
    n = 16
    path, aperture = 1e-6 * bumps(n, 1), round_stop(n, LENS["pitch"], n * LENS["pitch"])
    plate = np.full((n, n), 0.01, np.float32)
    without = point_spread(flat(n), path, aperture, INDEX, **LENS, points=POINTS)
    close(point_spread(plate, path, aperture, INDEX, **LENS, points=POINTS), without, 20 * EPS)
    without = window(flat(n), path, aperture, INDEX, **LENS, shape=(16, 16))
    close(window(plate, path, aperture, INDEX, **LENS, shape=(16, 16)), without, 1e-14)


def test_whole_waves_change_nothing():
    n = 16
    waves = np.random.default_rng(4).integers(-9, 9, (n, n))
    whole = (waves * EXACT["wavelength"] / 0.5).astype(np.float32)
    rest = np.ones((n, n)), 0.5
    path = 1e-6 * bumps(n, 1)
    got, expected = (point_spread(h, path, *rest, **EXACT, points=POINTS) for h in (whole, flat(n)))
    assert np.array_equal(got, expected)
    got, expected = (window(h, path, *rest, **EXACT, shape=(9, 9)) for h in (whole, flat(n)))
    assert np.array_equal(got, expected)


def test_checkerboard_of_half_a_wave():
    n = 16
    board = (np.indices((n, n)).sum(0) % 2 * EXACT["wavelength"] / 2 / 0.5).astype(np.float32)
    # half a period: the first orders lie on the diagonals
    points = [(0, 0), (32, 32), (-32, 32), (0, 32)]
    got = point_spread(board, flat(n), np.ones((n, n)), 0.5, **EXACT, points=points)
    np.testing.assert_allclose(got.astype(float), [0, PEAK, PEAK, 0], rtol=1e-15, atol=1e-30)


# --- the light ------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [64, 63, 16])
def test_whole_period_has_all_the_light(n):
    rng = np.random.default_rng(n)
    aperture = rng.random((n, n)) * round_stop(n, EXACT["pitch"], n * EXACT["pitch"])
    seen = window(
        bumps(n),
        1e-6 * rng.normal(size=(n, n)),
        aperture,
        INDEX,
        **EXACT,
        shape=(64, 64),
        angle=(0.2, 0.01),
    )
    assert seen.sum() == pytest.approx(1, abs=1e-13)


def test_round_stop():
    assert round_stop(4, 1e-6, 4e-6).tolist() == [
        [0, 1, 1, 0],
        [1, 1, 1, 1],
        [1, 1, 1, 1],
        [0, 1, 1, 0],
    ]
    stop = round_stop(11, 1e-7, 1e-6)  # a sample on the edge is inside: 3, 4, 5
    assert stop[5 + 3, 5 + 4] == stop[5, 10] == 1
    assert stop[5 + 4, 5 + 4] == 0
    assert round_stop(540, 8e-6, 540 * 8e-6).sum() == pytest.approx(np.pi / 4 * 540**2, rel=1e-4)
