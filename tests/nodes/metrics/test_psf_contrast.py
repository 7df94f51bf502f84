"""Contrast of a PSF against the autocorrelation of a disc, and energy within a radius."""

import math

import pytest
import torch

from neusee.nodes.metrics import encircled, encircled_curve, mtf, over_clear_peak
from neusee.nodes.values import Psf

DIAMETER, FOCAL, WAVE, PITCH = 8.0784e-3, 0.11, 550e-9, 2.9e-6


def lens(turns=None, window=512, samples=432):
    """PSF of a disc by the plain Fourier sum; ``turns`` gives the phase at (u, v) in units of
    the radius.
    """
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
    ring, axicon = (
        mtf(lens(turns)) for turns in (half_ring(20), lambda v, u: 20 * torch.hypot(v, u))
    )
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
    assert float(encircled(lens(), pixel_pitch=PITCH, radius=first_zero)) == pytest.approx(
        0.838, abs=0.03
    )
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


def test_each_band_is_over_the_peak_of_its_own_clear_lens():
    flat = Psf(
        torch.full((2, 3, 3), 0.2, dtype=torch.float64),
        torch.tensor([0.5, 0.8], dtype=torch.float64),
    )
    assert float(over_clear_peak(flat, 0)[0, 0]) == pytest.approx(0.4)
    assert float(over_clear_peak(flat, 1)[2, 1]) == pytest.approx(0.25)


def test_what_a_run_says_of_contrast_and_light_is_the_mean_and_the_range_of_the_bands():
    found = mtf(two_pixels(0.6))
    line = found._replace(rms=torch.tensor([0.2, 0.4, 0.9]), median=torch.tensor([0.1, 0.3, 0.5]))
    assert mtf.hooks.check(line)[0].text.endswith("rms 0.5, median 0.3")
    assert "20.0% to 90.0%" in encircled.hooks.check(torch.tensor([0.4, 0.2, 0.9]))[0].text


def test_only_the_root_mean_square_has_a_gradient():
    psf = two_pixels(0.6)
    found = mtf(psf._replace(intensity=psf.intensity.requires_grad_()))
    assert [x.requires_grad for x in found] == [True, False, False]


# --- borders --------------------------------------------------------------------------------------


def two_pixels(ratio, size=8, clear=0.5):
    """Return a PSF of two neighbours, whose contrast along x is that of two slits: |cos(pi f) +
    ...|.
    """
    kernel = torch.zeros(1, size, size, dtype=torch.float64)
    kernel[0, size // 2, size // 2], kernel[0, size // 2, size // 2 + 1] = 1.0, ratio
    return Psf(kernel, torch.tensor([clear], dtype=torch.float64))


def contrasts(ratio, size, cut):
    """Return the sorted contrasts of two pixels at all frequencies of the half plane up to
    ``cut``, in closed form.
    """
    found = []
    for i in range(size):
        for j in range(size // 2 + 1):
            fy, fx = (i if i < size / 2 else i - size) / size, j / size
            if math.hypot(fy, fx) <= cut + 1e-12:
                found.append(
                    math.sqrt(1 + ratio**2 + 2 * ratio * math.cos(2 * math.pi * fx)) / (1 + ratio)
                )
    return sorted(found)


@pytest.mark.parametrize("cut", [0.25, 0.3, 0.5])
@pytest.mark.parametrize("size", [8, 24])
def test_statistics_of_two_pixels_are_those_of_their_closed_form(size, cut):
    """The cut-off itself counts; the median of an even number is the lower one; 1 of 100 is
    below `low`.
    """
    psf = two_pixels(0.6, size)._replace(cut_off=torch.tensor([cut], dtype=torch.float64))
    found = mtf(psf)
    exact = contrasts(0.6, size, cut)
    assert float(found.rms) == pytest.approx(
        math.sqrt(sum(x**2 for x in exact) / len(exact)), rel=1e-9
    )
    assert float(found.median) == pytest.approx(exact[(len(exact) - 1) // 2], rel=1e-9)
    assert float(found.low) == pytest.approx(exact[math.floor(0.01 * (len(exact) - 1))], rel=1e-9)


def test_a_contrast_is_at_most_one_and_light_below_the_darkest_has_none():
    kernel = torch.zeros(3, 8, 8, dtype=torch.float64)
    # an error that is negative: 1.5 times the light at high frequencies
    kernel[0, 4, 4], kernel[0, 4, 5] = 1.0, -0.5
    kernel[1, 4, 4], kernel[2, 4, 4] = 0.9e-30, 1.1e-30
    found = mtf(Psf(kernel, torch.full((3,), 0.5, dtype=torch.float64)))
    assert float(found.median[0]) == 1.0
    assert [float(x) for x in found.rms[1:]] == pytest.approx([0.0, 1.0])
    assert mtf.hooks.check(found)[0].ok
    assert not mtf.hooks.check(found._replace(rms=found.rms + 0.1))[0].ok


@pytest.mark.parametrize(
    ("radius", "count"), [(0.999, 1), (1.0, 5), (1.414, 5), (1.4143, 9), (2.0, 13)]
)
def test_a_pixel_counts_whose_centre_is_within_the_radius_or_on_it(radius, count):
    flat = Psf(torch.ones(1, 7, 6, dtype=torch.float64), torch.ones(1, dtype=torch.float64))
    assert float(encircled(flat, pixel_pitch=2.0, radius=2.0 * radius)) == count


def test_the_curve_counts_a_pixel_from_the_next_whole_radius_on():
    curve = encircled_curve(torch.ones(7, 7, dtype=torch.float64))
    assert curve[:4].tolist() == [1.0, 5.0, 13.0, 29.0]
    assert len(curve) == 6  # the corner is 4.24 pixels away


@pytest.mark.parametrize(("share", "ok"), [(1.0099, True), (1.0101, False)])
def test_more_than_all_of_the_light_is_noticed(share, ok):
    assert encircled.hooks.check(torch.tensor([share], dtype=torch.float64))[0].ok == ok
