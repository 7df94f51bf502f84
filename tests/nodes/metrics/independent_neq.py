"""NEQ and error of a filtered picture behind masks and stops, in plain NumPy: no line is shared
with the nodes.
"""

import numpy as np

SAMPLES, PITCH, FOCAL, PIXEL, WAVE, WINDOW = 540, 14.96e-6, 0.11, 2.9e-6, 550e-9, 512
_side = (np.arange(SAMPLES) - (SAMPLES - 1) / 2) / (SAMPLES / 2)
V, U = np.meshgrid(_side, _side, indexing="ij")
R = np.hypot(V, U)
_f = np.fft.fftfreq(WINDOW)
NU = np.hypot(_f[:, None], _f)
LOW = (NU > 0) & (NU <= 0.12)
POWER = np.where(NU > 0, NU, np.inf) ** -2.0
POWER *= 0.1 / POWER.mean()


def _half_rings(waves):
    annulus = np.minimum((R**2 * len(waves)).astype(int), len(waves) - 1)
    return (
        2 * np.pi * np.array([w * (-1) ** i for i, w in enumerate(waves)])[annulus] * R * np.sign(U)
    )


def phases():
    """The phase of each mask of the table in rad, by the name of the mask."""
    return {
        "half-ring, 8": _half_rings([8]),
        "half-ring, 20": _half_rings([20]),
        "five half-rings": _half_rings([12, 18, 24, 30, 36]),
        "axicon, 5": 2 * np.pi * 5 * R,
        "vortex, 4": 4 * np.arctan2(V, U),
        "cubic, 20": 2 * np.pi * 20 * (U**3 + V**3),
    }


def psf(opening, phase=0.0):
    """Light in each pixel, as a share of the light of the clear pupil: a padded FFT has not this
    pitch, so two sums.
    """
    turns = (
        PITCH
        * PIXEL
        / (WAVE * FOCAL)
        * np.outer(np.arange(WINDOW) - WINDOW // 2, np.arange(SAMPLES) - (SAMPLES - 1) / 2)
    )
    waves = np.exp(-2j * np.pi * turns)
    field = waves @ (opening * np.exp(1j * phase) * (R <= 1)) @ waves.T
    return np.abs(field) ** 2 * (PITCH * PIXEL / (WAVE * FOCAL)) ** 2 / (R <= 1).sum()


def stops(diameters):
    """Spectrum and peak, relative to the clear lens, of the clear lens in each smaller stop."""
    peak = psf(R <= 1).max()
    return [(np.fft.fft2(one), one.max() / peak) for one in (psf(d >= R) for d in diameters)], peak


def gains(spectrum, lsr, rivals, light, read_noise):
    """(mean log NEQ, filtered error) of a mask and of the best stop-and-filter of its peak, in
    dB, at one light.
    """

    def measure(otf):
        neq = (light * np.abs(otf)) ** 2 / (light * otf[0, 0].real + read_noise**2)
        left = (POWER / (1 + neq * POWER)).sum() / POWER.sum()
        return np.array([10 * np.log10(np.maximum(neq[LOW], 1e-30)).mean(), -10 * np.log10(left)])

    each = np.stack([measure(otf * lsr / peak) for otf, peak in rivals if peak > lsr * 0.98])
    return measure(spectrum), each.max(0)
