"""The general model of EMVA 1288, which needs no line: the local slope of the response refers noise to the light."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from neusee.nodes.calibrate._sheet._photon_transfer import FloatArray, PhotonTransfer
from neusee.nodes.calibrate._sheet._quantity import Bound, Quantity
from neusee.nodes.calibrate._sheet._sensitivity import COARSE

_WINDOW, _SHARE = 5, 0.25  #: least number of levels of a local fit, and the share of all levels that a fit takes
_KNOWN = 0.03  #: relative standard error of a slope above which nothing follows from it


class GeneralModel(NamedTuple):
    """The response at the lit levels up to saturation, in rising order of light."""

    photons: FloatArray  #: (level,) per pixel and exposure
    slope: FloatArray  #: (1 + level,) DN per photon, local; the first is that of the dark
    error: FloatArray  #: (1 + level,) relative standard error of the slope, from the scatter about the local fits
    ratio: FloatArray  #: (level,) light over the standard deviation of the light that the noise in time stands for


def general_model(transfer: PhotonTransfer) -> GeneralModel | None:
    """Return local slope and signal-to-noise ratio of the light at each level up to saturation; None below 3 levels.

    The slope is that of a parabola through five or more neighbouring levels, the dark among them. The light scatters
    from level to level, by the same share at all levels; its scatter about the parabolas gives the errors.

    Source: EMVA Standard 1288, release 4.0 General (characteristic curve, and noise referred to the input).
    """
    below = slice(0, transfer.saturation + 1)
    light = np.concatenate([[0.0], transfer.photons[below]])
    signal = np.concatenate([[0.0], transfer.signal[below]])
    if len(np.unique(light)) < 4 or len(np.unique(light)) < len(light):
        return None
    slope, error = _slopes(light, signal)
    ratio = light[1:] * slope[1:] / np.sqrt(transfer.variance[below].clip(np.finfo(float).tiny))
    return GeneralModel(light[1:], slope, error, np.asarray(ratio))


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
    top: Bound = "" if transfer.saturated else ">"
    cut = "" if transfer.saturated else "saturation was not reached"
    rounded = "rounding hides the dark noise" if coarse else ""
    scatters = "the light scatters from level to level, so that the slope is known to {:.0%} only"
    at_dark, at_best = float(found.error[0]), float(found.error[1 + int(found.ratio.argmax())])
    first = best.untold(scatters.format(at_best))
    if at_best <= _KNOWN:
        first = best.told(20 * math.log10(float(found.ratio.max())), top, cut)
    if at_dark > _KNOWN:
        why = scatters.format(at_dark)
        return [least.untold(why), first, span.untold(why)]
    threshold = _threshold(transfer, found)
    bottom: Bound = "<" if coarse else ""
    last = span.told(20 * math.log10(float(found.photons[-1]) / threshold), ">" if coarse else top, rounded or cut)
    low = least.told(threshold, bottom, rounded) if photons_told else least.untold("the photons are not told")
    return [low, first, last]


def _slopes(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the slope at each point of a parabola through the nearest points, and its relative standard error."""
    count = min(len(x), max(_WINDOW, 2 * round(_SHARE * len(x) / 2) + 1))
    slopes, spreads, scatter = [], [], []
    for at in range(len(x)):
        first = min(max(0, at - count // 2), len(x) - count)
        near = slice(first, first + count)
        scale = float(np.ptp(x[near]))
        fit = np.linalg.pinv(np.vander((x[near] - x[at]) / scale, 3, increasing=True))
        slopes.append(float(fit[1] @ y[near]) / scale)
        spreads.append(float(np.linalg.norm(fit[1] * y[near])) / scale)
        left = -fit[0]
        left[at - first] += 1
        if weight := float(np.linalg.norm(left * y[near])):
            scatter.append(float(left @ y[near]) / weight)
    error = math.sqrt(float(np.mean(np.square(scatter)))) * np.array(spreads) / np.abs(slopes)
    return np.array(slopes), np.asarray(error)


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
