"""The judge of `bench_mask_design.py`: PSFs by NumPy, and the error of the filtered picture by
`metrics`.

Nothing here is used by the loss that the masks were designed with. The camera is the lens of the
paper (8.08 mm, f = 110 mm) on 96 x 96 samples of the pupil, with pixels of 2.9 um and a window of
192 x 192 pixels. What is not known is drawn from laws: defocus normal with a standard deviation of
0.25 waves, wavelength uniform from 530 to 570 nm, and direction uniform within a pixel. The peak of
the laser is that of the worst draw, and the error is the mean over all.
"""

import math
from functools import cache

import numpy as np
import torch
from scipy.stats import norm, qmc

from neusee.nodes import metrics
from neusee.nodes.doe import index_curve
from neusee.nodes.values import Bands, Psf

SAMPLES, WINDOW, READ = 96, 192, 10.5
DIAMETER, FOCAL, PIXEL, CENTRE = 8.08e-3, 0.11, 2.9e-6, 550e-9
#: waves, standard deviation; m, half the width of the law of the wavelength
DEFOCUS, SPAN = 0.25, 20e-9
STATES = 16
WIDTHS = 61  #: stops that are tried between the narrowest and the open lens
_RADII = (np.arange(SAMPLES) - (SAMPLES - 1) / 2) / (SAMPLES / 2)
_ONE = torch.ones(1, dtype=torch.float64)


@cache
def index(wavelength):
    """Refractive index of fused silica minus 1."""
    at, value = (x.numpy() for x in index_curve("fused silica", 4000))
    return float(np.interp(wavelength, at, value)) - 1


def opening(width):
    """The amplitude of a round stop, with the share of each sample of the pupil that lies inside
    it.
    """
    fine = (np.arange(8 * SAMPLES) - (8 * SAMPLES - 1) / 2) / (4 * SAMPLES)
    inside = (fine[:, None] ** 2 + fine**2 <= width**2).astype(float)
    return inside.reshape(SAMPLES, 8, SAMPLES, 8).mean((1, 3))


CLEAR = opening(1.0)


def draws():
    """Rows of defocus in waves, wavelength in m, and direction in pixels on both axes: the
    nominal one, and others.
    """
    share = qmc.Sobol(4, seed=2026).random(STATES)[1:] * (1 - 2e-6) + 1e-6
    defocus, wavelength = DEFOCUS * norm.ppf(share[:, 0]), CENTRE + SPAN * (2 * share[:, 1] - 1)
    others = np.column_stack([defocus, wavelength, share[:, 2:] - 0.5])
    return np.concatenate([[[0, CENTRE, 0, 0]], others])


def intensity(amplitude, turns, state):
    """The share of the clear lens's light in each pixel, and in the brightest pixel of the clear
    lens.
    """
    defocus, wavelength, *shift = state
    path = turns * CENTRE * index(wavelength) / index(CENTRE) + defocus * CENTRE * (
        _RADII[:, None] ** 2 + _RADII**2
    )
    field = amplitude * np.exp(2j * math.pi * path / wavelength)
    scale = DIAMETER / SAMPLES * PIXEL / (wavelength * FOCAL)
    pixels = np.arange(WINDOW) - WINDOW // 2
    left, right = (
        np.exp(-2j * math.pi * scale * SAMPLES / 2 * np.outer(pixels - s, _RADII)) for s in shift
    )
    light = (np.abs(left @ field @ right.T) * scale) ** 2
    return light / (CENTRE_LIGHT := (CLEAR**2).sum()), scale**2 * CLEAR.sum() ** 2 / CENTRE_LIGHT


class Judged:
    """A front (mask and stop) in all states: its worst LSR, and its error at any light behind
    any grey filter.
    """

    def __init__(self, amplitude, turns):
        states = draws()
        found = [intensity(amplitude, turns, state) for state in states]
        self.lsr = max(float(light.max() / clear) for light, clear in found)
        self.psfs = [Psf(torch.from_numpy(light)[None], clear * _ONE) for light, clear in found]
        self.bands = [Bands(state[1] * _ONE, 1e-9 * _ONE, _ONE) for state in states]

    def error(self, light, filtered):
        """The mean error variance after the filter over the variance of the scene."""
        each = []
        for psf, bands in zip(self.psfs, self.bands, strict=True):
            seen = Psf(filtered * psf.intensity, psf.clear_peak)
            found = metrics.filtered_picture(
                seen, _ONE, _ONE[None], bands, electrons=light, read_noise=READ
            )
            each.append(float(found.error[0]))
        return sum(each) / len(each)

    def behind(self, limit, light):
        """The error behind the grey filter that holds the worst peak at the limit, and the
        filter.
        """
        filtered = min(1.0, limit / self.lsr)
        return self.error(light, filtered), filtered


@cache
def stops(limit):
    """Round stops from the one that needs no filter to the open lens."""
    least = 0.98 * limit**0.25
    flat = np.zeros((SAMPLES, SAMPLES))
    return [(width, Judged(opening(width), flat)) for width in np.linspace(least, 1.0, WIDTHS)]


@cache
def rival(limit, light):
    """The least error of a round stop with a filter, its diameter and the transmittance of its
    filter.
    """
    return min(
        (error, float(width), filtered)
        for width, front in stops(limit)
        for error, filtered in [front.behind(limit, light)]
    )
