"""Heat of the hottest point of a spot, against closed forms and sums over sampled spots."""

import math

import numpy as np
import pytest
import torch

from neusee.nodes.laser import beam, density_in_spot, heated_in_spot, spot_heat

AIRY = 16 / (3 * math.pi)  # integral of (2 J1(v) / v)^2 over v


def heat_of(fill, waves):
    return float(spot_heat(torch.tensor(fill), torch.tensor(waves)))


def summed_heat(fill, waves, samples=1024, pad=16.0):
    """The largest sum of E dA / (2 pi r) near the middle of a spot by FFT, over that of the
    even, focused pupil.
    """
    step = 2 * pad / samples
    x = (np.arange(samples) - samples / 2 + 0.5) * step
    square = x**2 + x[:, None] ** 2
    # cells that the rim cuts count by their share
    lit = np.clip((1 - np.sqrt(square)) / step + 0.5, 0, 1)
    pupil = lit * np.exp((-fill + 2j * np.pi * waves) * square)
    light = np.abs(np.fft.fftshift(np.fft.fft2(pupil))) ** 2 * (step**2 / np.pi) ** 2
    dv = math.pi / pad
    v = (np.arange(samples) - samples // 2) * dv
    # the spot is even: rows above the middle stand for those below, and the last one is dark
    light = light[samples // 2 :]
    light[1:] *= 2
    found = []
    for place in v[(v >= 0) & (v < 5)][::3]:
        apart = np.hypot(v - place, v[samples // 2 :, None])
        inverse = 1 / np.where(apart > 0, apart, np.inf)
        # mean over a square cell around the point
        inverse[apart == 0] = 4 * math.log(1 + math.sqrt(2)) / dv
        found.append((light * inverse).sum() * dv**2 / (2 * np.pi))
    return max(found) / AIRY


@pytest.mark.slow
def test_an_even_beam_in_focus_has_the_heat_of_the_airy_spot():
    assert heat_of(0.0, 0.0) == pytest.approx(1, rel=1e-5)


@pytest.mark.parametrize("fill", [10.0, 40.0, 1e4])
@pytest.mark.parametrize("waves", [0.0, 0.7, 30.0])
def test_a_narrow_beam_has_the_heat_of_a_gaussian_spot(fill, waves):
    size = math.hypot(fill, 2 * math.pi * waves)
    gaussian = math.sqrt(math.pi / (2 * fill)) / size
    assert gaussian * 0.999 < heat_of(fill, waves) * AIRY < gaussian * 1.01


@pytest.mark.parametrize("fill", [0.0, 0.3, 2.0])
def test_far_out_of_focus_the_heat_is_that_of_straight_rays(fill):
    rho = (np.arange(2000) + 0.5) / 2000
    rays = 2 / math.hypot(fill, 2 * math.pi * 500) * np.exp(-2 * fill * rho**2).mean()
    assert rays * 0.9999 < heat_of(fill, 500.0) * AIRY < rays * 1.003


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fill", "waves"),
    [(0.0, 0.3), (0.0, 1.0), (0.0, 1.35), (0.2, 1.0), (0.5, 2.5), (1.0, 0.0), (1.4, 0.01), (3.0, 4.2), (0.0, 6.0)],
)  # fmt: skip
def test_the_heat_is_that_of_the_sampled_spot(fill, waves):
    assert heat_of(fill, waves) == pytest.approx(summed_heat(fill, waves), rel=0.012)


@pytest.mark.slow
@pytest.mark.parametrize(("fill", "waves"), [(0.0, 9.0), (0.0, 12.0), (2.0, 9.0)])
def test_beyond_the_table_the_heat_is_an_upper_bound_that_is_near(fill, waves):
    found = summed_heat(fill, waves, samples=4096)
    assert found * 0.998 < heat_of(fill, waves) < found * 1.025


@pytest.mark.parametrize("fill", [0.0, 1.0, 7.9, 8.1])
def test_the_heat_falls_with_defocus_without_a_step(fill):
    waves = torch.linspace(0, 20, 4001)
    heat = spot_heat(torch.tensor(fill), waves)
    assert (heat[1:] < heat[:-1] * 1.005).all()
    assert (heat[1:] > heat[:-1] * 0.97).all()


def test_a_peak_stated_too_high_has_the_same_heat():
    laser = beam(532e-9, power=1.0, waist=1e-3, divergence=1e-3)
    given = [torch.tensor(x, dtype=torch.float64) for x in (30.0, 8e-3, 50e-3, 2.3)]
    peak = density_in_spot(laser, *given)
    width = heated_in_spot(laser, *given, peak)
    assert float(heated_in_spot(laser, *given, 2 * peak) * 2) == pytest.approx(float(width))
    assert 5 * 532e-9 * 50 / 8 < float(width) < 20 * 532e-9 * 50 / 8
