"""The general model of EMVA 1288, which needs no line: the local slope of the response refers noise to the light."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from neusee.nodes.calibrate._sheet._photon_transfer import FloatArray, PhotonTransfer
from neusee.nodes.calibrate._sheet._quantity import Bound, Quantity
from neusee.nodes.calibrate._sheet._sensitivity import COARSE

_WINDOW = 5  #: levels of a local fit


class GeneralModel(NamedTuple):
    """The response at the lit levels up to saturation, in rising order of light."""

    photons: FloatArray  #: (level,) per pixel and exposure
    slope: FloatArray  #: (1 + level,) DN per photon, local; the first is that of the dark
    ratio: FloatArray  #: (level,) light over the standard deviation of the light that the noise in time stands for


def general_model(transfer: PhotonTransfer) -> GeneralModel | None:
    """Return local slope and signal-to-noise ratio of the light at each level up to saturation; None below 3 levels.

    The slope is that of a parabola through five neighbouring levels, the dark among them. At saturation and beyond it
    the response is cut, and has no slope.

    Source: EMVA Standard 1288, release 4.0 General (characteristic curve, and noise referred to the input).
    """
    below = slice(0, transfer.saturation + 1)
    light = np.concatenate([[0.0], transfer.photons[below]])
    signal = np.concatenate([[0.0], transfer.signal[below]])
    if len(np.unique(light)) < 4 or len(np.unique(light)) < len(light):
        return None
    slope = np.array([_local_slope(light, signal, i) for i in range(len(light))])
    ratio = light[1:] * slope[1:] / np.sqrt(transfer.variance[below].clip(np.finfo(float).tiny))
    return GeneralModel(light[1:], slope, np.asarray(ratio))


def general_quantities(transfer: PhotonTransfer, photons_told: bool = True) -> list[Quantity]:
    """Return threshold, greatest signal-to-noise ratio and dynamic range without a linear model.

    The threshold is the light whose signal equals the noise; from dark to the first level the variance is taken as a
    line over the light.

    Units:  photons; a number; dB.
    Source: EMVA Standard 1288, release 4.0 General.
    """
    least = Quantity("mu_p_min_general", "μ_p.min", "absolute sensitivity threshold, no linear model", "photons")
    best = Quantity("SNR_max_general", "SNR.max", "maximum SNR of the light, no linear model", "dB")
    span = Quantity("DR_general", "DR", "dynamic range, no linear model", "dB")
    found = general_model(transfer)
    if found is None or not (found.slope > 0).all():
        why = "three or more levels of different light up to saturation, all brighter than those below, are needed"
        return [blank.untold(why) for blank in (least, best, span)]
    coarse = float(transfer.dark_variance[0]) < COARSE
    threshold = _threshold(transfer, found)
    top: Bound = "" if transfer.saturated else ">"
    cut = "" if transfer.saturated else "saturation was not reached"
    rounded = "rounding hides the dark noise" if coarse else ""
    limits: tuple[Bound, Bound] = ("<" if coarse else "", ">" if coarse else top)
    return [
        least.told(threshold, limits[0], rounded) if photons_told else least.untold("the photons are not told"),
        best.told(20 * math.log10(float(found.ratio.max())), top, cut),
        span.told(20 * math.log10(float(found.photons[-1]) / threshold), limits[1], rounded or cut),
    ]


def _local_slope(x: FloatArray, y: FloatArray, at: int) -> float:
    """Return the slope at a point of the parabola that fits the nearest points best."""
    count = min(_WINDOW, len(x))
    first = min(max(0, at - count // 2), len(x) - count)
    near = slice(first, first + count)
    scale = float(np.ptp(x[near]))
    return float(np.polyfit((x[near] - x[at]) / scale, y[near], 2)[1]) / scale


def _threshold(transfer: PhotonTransfer, found: GeneralModel) -> float:
    """Return the light whose signal equals its noise in time, in photons."""
    dark = max(float(transfer.variance_dark[0]), COARSE)
    rise = max(0.0, float(transfer.excess[0]) / float(found.photons[0]))
    slope = float(found.slope[0])
    near = (rise + math.sqrt(rise**2 + 4 * dark * slope**2)) / (2 * slope**2)
    if near <= found.photons[0] or not (found.ratio < 1).any():
        return near
    last = int(np.flatnonzero(found.ratio < 1).max())  # the brightest level below the threshold
    if last + 1 == len(found.ratio):
        return float(found.photons[last])
    ends = slice(last, last + 2)
    return float(np.exp(np.interp(0.0, np.log(found.ratio[ends].clip(1e-300)), np.log(found.photons[ends]))))
