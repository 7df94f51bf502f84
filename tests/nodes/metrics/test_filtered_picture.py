"""NEQ, error and information of a filtered picture: against the reference, NumPy, closed forms
and first figures.
"""

import math

import numpy as np
import pytest
import torch

from neusee.nodes import doe, metrics, optics
from neusee.nodes.metrics import (
    channel_psf,
    information_bits,
    mean_log_neq,
    noise_variance,
    picture_spectrum,
    remaining_error,
)
from neusee.nodes.spectra import bands
from neusee.nodes.values import Psf
from tests.nodes.metrics import independent_neq as numpy_code

GREEN = bands(start=500e-9, stop=600e-9, count=1)
ONE = torch.ones(1, dtype=torch.float64)
STOP = optics.stop(samples=540, pitch=14.96e-6, diameter=8.0784e-3)
LENS = {"focal_length": 0.11, "pixel_pitch": 2.9e-6, "shape": (512, 512)}
SIGMA = 10.5
LIGHTS = (10, 30, 100, 300, 1e3, 1e4)
#: mean log NEQ to 0.12 cycles a pixel, less that of the best stop-and-filter of the same peak, in
#: dB, by scene light
TABLE = {
    "half-ring, 8": (2.6e-2, 4.0, 3.5, 2.1, 0.2, -2.0, -4.2),
    "half-ring, 20": (1.0e-2, 8.2, 7.5, 5.9, 3.5, 0.4, -3.4),
    "five half-rings": (1.5e-3, 10.6, 10.0, 8.2, 5.4, 1.3, -5.9),
    "axicon, 5": (8.8e-3, 9.5, 8.8, 7.2, 4.7, 1.6, -2.6),
    "vortex, 4": (7.2e-2, 2.1, 1.7, 0.6, -0.9, -2.3, -3.2),
    "cubic, 20": (4.7e-3, 3.1, 2.5, 0.8, -2.0, -5.7, -11.2),
}
MASKS = {
    "half-ring, 8": lambda: doe.half_rings(STOP, waves=(8.0,)),
    "half-ring, 20": lambda: doe.half_rings(STOP, waves=(20.0,)),
    "five half-rings": lambda: doe.half_rings(STOP, waves=(12.0, 18.0, 24.0, 30.0, 36.0)),
    "axicon, 5": lambda: doe.axicon(STOP, waves=5.0),
    "vortex, 4": lambda: doe.vortex(STOP, charge=4),
    "cubic, 20": lambda: doe.cubic(STOP, waves=20.0),
}


def psf_of(height=None, **given):
    height = torch.zeros(540, 540) if height is None else height
    return optics.psf(
        optics.pupil(height, doe.material(GREEN), GREEN, STOP, shade=doe.shade(STOP, **given)),
        **LENS,
    )


def spectrum_of(one, known=None):
    channels, known_channels = (
        channel_psf(psf, ONE, ONE[None], GREEN) for psf in (one, known or one)
    )
    return picture_spectrum(channels, known_channels)


def measured(spectrum, amplitude, light_passed):
    noise = noise_variance(light_passed * spectrum.light, 0.0, SIGMA)[None]
    error = float(remaining_error(spectrum, amplitude, noise))
    return np.array(
        [
            10 / math.log(10) * float(mean_log_neq(spectrum, amplitude, noise)),
            -10 * math.log10(error),
        ]
    )


def compared(names, diameters):
    """Gains of nodes and of NumPy: (mask, light, mean log NEQ | error), in dB, and the LSR of
    each mask.
    """
    rivals = [psf_of(diameter=d) for d in diameters]
    fronts = [(spectrum_of(one), float(metrics.lsr(one))) for one in rivals]
    theirs, peak = numpy_code.stops(diameters)
    found, other, ratios = [], [], []
    for name in names:
        one = psf_of(MASKS[name]())
        mask, lsr = spectrum_of(one), float(metrics.lsr(one))
        reach = [(front, lsr / own) for front, own in fronts if own > lsr * 0.98]
        best = [np.max([measured(f, n * t, n * t) for f, t in reach], axis=0) for n in LIGHTS]
        found.append([measured(mask, n, n) - b for n, b in zip(LIGHTS, best, strict=True)])
        light = numpy_code.psf(1, numpy_code.phases()[name])
        pairs = [
            numpy_code.gains(np.fft.fft2(light), light.max() / peak, theirs, n, SIGMA)
            for n in LIGHTS
        ]
        other.append([a - b for a, b in pairs])
        ratios.append(lsr)
    return np.array(found), np.array(other), ratios


def test_a_mask_against_stops_and_filters_agrees_with_numpy_and_with_the_table():
    found, other, (lsr,) = compared(["axicon, 5"], (0.35, 0.45, 0.55, 0.7, 0.85, 1.0))
    assert found == pytest.approx(other, abs=0.02)
    assert lsr == pytest.approx(TABLE["axicon, 5"][0], rel=0.02)
    # six stops alone: a weaker rival
    assert found[0, :, 0] == pytest.approx(TABLE["axicon, 5"][1:], abs=0.35)


@pytest.mark.slow
def test_the_table_of_six_masks_is_found_by_both_codes():
    found, other, ratios = compared(list(TABLE), np.linspace(0.2, 1, 31).tolist())
    assert found == pytest.approx(other, abs=0.02)
    assert ratios == pytest.approx([row[0] for row in TABLE.values()], rel=0.03)
    wanted = np.array([row[1:] for row in TABLE.values()])
    assert np.abs(found[:5, :, 0] - wanted[:5]).max() < 0.2
    assert np.abs(found[5, :, 0] - wanted[5]).max() < 0.35
    # the error of the filtered picture, of five half-rings and of the axicon, at 30 and 300 e- a
    # pixel
    assert found[2, [1, 3], 1] == pytest.approx([1.6 - 1.1, 2.8 - 3.0], abs=0.1)
    assert found[3, 1, 1] == pytest.approx(2.8 - 1.85, abs=0.1)


def some_psf(count=3, side=24, seed=1):
    light = (
        torch.rand(
            count, side, side, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
        )
        ** 8
    )
    light = light * torch.exp(-0.1 * torch.arange(side)) / light.sum((-2, -1), keepdim=True)
    return Psf(light, 0.1 + torch.rand(count, dtype=torch.float64))


def test_the_node_agrees_with_its_reference():
    three = bands(start=450e-9, stop=650e-9, count=3)
    inputs = some_psf(), torch.rand(3).double(), torch.rand(2, 3).double(), three
    given = {
        "electrons": 40.0,
        "read_noise": 3.0,
        "glare": 12.0,
        "prnu": 0.02,
        "residual_glare": 0.1,
        "up_to": 0.3,
    }
    fast, slow = (
        f(*inputs, **given)
        for f in (metrics.filtered_picture, metrics.filtered_picture.hooks.reference)
    )
    for one, other in zip(fast, slow, strict=True):
        assert one == pytest.approx(other, rel=1e-10)


def test_the_histogram_agrees_with_the_node_with_and_without_a_filter():
    three = bands(start=450e-9, stop=650e-9, count=3)
    rest = torch.rand(3).double(), torch.rand(2, 3).double(), three
    one = some_psf(side=64)
    channels = channel_psf(one, *rest)
    spectrum = picture_spectrum(channels, channels)
    for grey in (1.0, 0.03):
        dim = one._replace(intensity=one.intensity * grey)
        exact = metrics.filtered_picture(dim, *rest, electrons=200.0, read_noise=3.0, glare=5.0)
        noise = noise_variance(200.0 * grey * spectrum.light, 5.0, 3.0)[None]
        assert remaining_error(spectrum, 200.0 * grey, noise)[0] == pytest.approx(
            exact.error, rel=2e-4
        )
        assert information_bits(spectrum, 200.0 * grey, noise)[0] == pytest.approx(
            exact.information, rel=2e-4
        )
        assert mean_log_neq(spectrum, 200.0 * grey, noise)[0] == pytest.approx(
            exact.log_neq, abs=1e-9
        )


def test_a_filter_that_takes_the_wrong_psf_for_the_true_one_errs_as_a_sum_over_frequencies_says():
    true, known = some_psf(1, 48, 1), some_psf(1, 48, 2)
    spectrum = spectrum_of(true, known)
    h, k = (np.fft.fft2(one.intensity[0].numpy()) for one in (true, known))
    f = np.fft.fftfreq(48)
    square = f[:, None] ** 2 + f**2
    s = np.divide(1, square, where=square > 0, out=0 * square)
    s *= 0.1 / s.mean()
    for light, noise in ((30.0, 60.0), (900.0, 1000.0)):
        w = light * s * k.conj() / (light**2 * s * abs(k) ** 2 + noise)
        wanted = (s * abs(1 - light * w * h) ** 2 + abs(w) ** 2 * noise).sum() / s.sum()
        found = float(remaining_error(spectrum, light, torch.tensor([[noise]])))
        assert found == pytest.approx(wanted, rel=1e-3)
        assert found > float(remaining_error(spectrum_of(true), light, torch.tensor([[noise]])))


def test_without_noise_a_lens_that_passes_all_frequencies_restores_the_scene():
    point = torch.zeros(1, 32, 32, dtype=torch.float64)
    point[0, 16, 16] = 1.0
    found = metrics.filtered_picture(
        Psf(point, ONE), ONE, ONE[None], GREEN, electrons=1e9, read_noise=0.0
    )
    assert float(found.error) < 1e-7
    flat = metrics.filtered_picture(
        Psf(point, ONE), ONE, ONE[None], GREEN, electrons=50.0, read_noise=7.0
    )
    assert float(flat.log_neq) == pytest.approx(math.log(50**2 / (50 + 49)))


def test_the_noise_of_a_pixel_is_the_sum_of_its_parts():
    assert noise_variance(100.0, 20.0, 3.0, 0.01, 0.05) == pytest.approx(120 + 9 + 1.2**2 + 1)
