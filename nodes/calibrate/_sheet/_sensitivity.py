"""Sensitivity, noise, saturation, linearity and dark current of the EMVA 1288 sheet."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from neusee.nodes.calibrate._sheet._photon_transfer import (
    FloatArray,
    PhotonTransfer,
    line,
    relative_line,
    slope_through_origin,
)
from neusee.nodes.calibrate._sheet._quantity import Bound, Quantity

QUANTIZATION = 1.0 / 12.0  #: sigma_q^2, DN2
COARSE = 0.24  #: DN2, least temporal dark variance that rounding leaves measurable; its root is 0.49 DN
_LINE = 2  #: exposures that a slope needs more than
_SURE = 2.0  #: standard errors of a slope below which no slope is told
_NO_GAIN = "K is not told, so that no value in electrons is"
_NO_LIGHT = "the photons of the levels are not told"


@dataclass(frozen=True)
class Linearity:
    """The line of least relative deviation through the response, and the deviation from it in percent (level,)."""

    slope: float  #: DN per photon
    start: float  #: DN, at no light
    deviation: FloatArray  #: %, of each level from 5 to 95 % of saturation


def gain(transfer: PhotonTransfer) -> Quantity:
    """Return K, DN/e-, from the levels up to 70 % of saturation."""
    blank = Quantity("K", "K", "overall system gain", "DN/e-")
    used = transfer.fitted
    if used.sum() < 2:
        return blank.untold(f"{int(used.sum())} lit levels lie below 70 % of saturation, and a line needs two")
    slope = slope_through_origin(transfer.signal[used], transfer.excess[used])
    return blank.told(slope) if slope > 0 else blank.untold("the variance does not rise with the signal")


def sensitivity(transfer: PhotonTransfer, photons_told: bool = True) -> list[Quantity]:
    """Return gain, responsivity, efficiency, noise, thresholds, saturation, SNR and dynamic range.

    Shapes: scalars.
    Units:  as in each `Quantity`.
    Source: EMVA Standard 1288, release 4.0 Linear.
    """
    k = gain(transfer)
    response = _responsivity(transfer, k, photons_told)
    eta = _efficiency(response, k, photons_told)
    noise, coarse = dark_noise(transfer)
    least = _least(transfer, k, eta, noise, coarse)
    return [
        eta,
        k,
        _inverse(k),
        response,
        *_dark(transfer, k, noise, coarse),
        *least,
        *_greatest(transfer, k, eta, least),
    ]


def dark_noise(transfer: PhotonTransfer) -> tuple[float, bool]:
    """Return sigma_y.dark in DN at exposure 0, and True if rounding hides it, so that 0.49 DN is only a limit."""
    if len(np.unique(transfer.dark_exposure)) > _LINE:
        variance = line(transfer.dark_exposure, transfer.dark_variance)[1]
    else:
        variance = float(transfer.dark_variance[0])
    return math.sqrt(max(variance, COARSE)), variance < COARSE


def linearity(transfer: PhotonTransfer) -> Linearity | None:
    """Return the deviation of the response from a line, or None with fewer than three levels in the range."""
    used = transfer.linear
    if used.sum() < 3 or len(np.unique(transfer.photons[used])) < 3:
        return None
    x, y = transfer.photons[used], transfer.signal[used]
    slope, start = relative_line(x, y)
    fitted = slope * x + start
    return Linearity(slope, start, 100 * (y - fitted) / fitted)


def linearity_errors(transfer: PhotonTransfer) -> list[Quantity]:
    """Return LE_min and LE_max, the extreme relative deviations in percent."""
    ends = (("LE_min", "LE.min", "least"), ("LE_max", "LE.max", "greatest"))
    blanks = [Quantity(key, symbol, f"linearity error, {name} deviation", "%") for key, symbol, name in ends]
    found = linearity(transfer)
    if found is None:
        count = int(transfer.linear.sum())
        return [b.untold(f"{count} levels lie from 5 to 95 % of saturation, and three are needed") for b in blanks]
    values = (float(found.deviation.min()), float(found.deviation.max()))
    return [blank.told(value) for blank, value in zip(blanks, values, strict=True)]


def dark_current(transfer: PhotonTransfer) -> list[Quantity]:
    """Return mu_I from the means and from the variances of dark frames, e-/s.

    Source: EMVA Standard 1288, release 4.0 Linear.
    """
    of_mean = Quantity("mu_I_mean", "μ_I.mean", "dark current, from the means", "e-/s")
    of_variance = Quantity("mu_I_var", "μ_I.var", "dark current, from the variances", "e-/s")
    k, times = gain(transfer).value, transfer.dark_exposure
    count = len(np.unique(times))
    why = "" if k else _NO_GAIN
    if count <= _LINE:
        why = f"dark frames at {count} exposure{'s' * (count > 1)}: three or more are needed"
    if why or not k:
        return [of_mean.untold(why), of_variance.untold(why)]
    found = _slope(of_mean, times, transfer.dark_mean, k)
    if dark_noise(transfer)[1]:
        return [found, of_variance.untold("rounding hides the variance of the dark")]
    return [found, _slope(of_variance, times, transfer.dark_variance, k**2)]


def _slope(blank: Quantity, times: FloatArray, values: FloatArray, scale: float) -> Quantity:
    """Return the slope of values over exposures in units of ``scale``, if it is at least twice its standard error."""
    slope, start = line(times, values)
    left = values - start - slope * times
    error = math.sqrt(float(left @ left) / (len(times) - 2) / float(((times - times.mean()) ** 2).sum()))
    if slope > 0 and slope >= _SURE * error:
        return blank.told(slope / scale)
    return blank.untold(
        f"no rise with the exposure: {slope / scale:.3g} {blank.unit}, with a standard error of {error / scale:.2g}"
    )


def _responsivity(transfer: PhotonTransfer, k: Quantity, told: bool) -> Quantity:
    blank = Quantity("R", "R", "responsivity", "DN/photon")
    used = transfer.fitted
    if not told or used.sum() < 2:
        return blank.untold(k.reason if told else _NO_LIGHT)
    return blank.told(slope_through_origin(transfer.photons[used], transfer.signal[used]))


def _efficiency(response: Quantity, k: Quantity, told: bool) -> Quantity:
    blank = Quantity("eta", "η", "quantum efficiency", "%")
    if response.value is None or k.value is None:
        return blank.untold(_NO_GAIN if told else _NO_LIGHT)
    return blank.told(100 * response.value / k.value)


def _inverse(k: Quantity) -> Quantity:
    blank = Quantity("inverse_K", "1/K", "inverse of the overall system gain", "e-/DN")
    return blank.untold(k.reason) if k.value is None else blank.told(1 / k.value)


def _dark(transfer: PhotonTransfer, k: Quantity, noise: float, coarse: bool) -> list[Quantity]:
    """Return temporal dark noise and dark signal in DN and in electrons."""
    why = f"the dark noise is below the {math.sqrt(COARSE):.2f} DN that the standard sets, because rounding hides it"
    bound: Bound = "<" if coarse else ""
    in_numbers = Quantity("sigma_y_dark", "σ_y.dark", "temporal dark noise", "DN").told(noise, bound, why * coarse)
    blank = Quantity("sigma_d", "σ_d", "temporal dark noise", "e-")
    signal = Quantity("mu_d", "μ_d", "dark signal, with the offset of the converter", "e-")
    mean = Quantity("mu_y_dark", "μ_y.dark", "dark signal", "DN").told(float(transfer.dark_mean[0]))
    if k.value is None:
        return [in_numbers, blank.untold(_NO_GAIN), mean, signal.untold(_NO_GAIN)]
    electrons = math.sqrt(noise**2 - QUANTIZATION) / k.value
    return [
        in_numbers,
        blank.told(electrons, bound, why * coarse),
        mean,
        signal.told(float(transfer.dark_mean[0]) / k.value),
    ]


def _least(transfer: PhotonTransfer, k: Quantity, eta: Quantity, noise: float, coarse: bool) -> list[Quantity]:
    """Return the absolute sensitivity threshold in photons and in electrons."""
    photons = Quantity("mu_p_min", "μ_p.min", "absolute sensitivity threshold", "photons")
    electrons = Quantity("mu_e_min", "μ_e.min", "absolute sensitivity threshold", "e-")
    if k.value is None:
        return [photons.untold(_NO_GAIN), electrons.untold(_NO_GAIN)]
    value, bound = noise / k.value + 0.5, "<" if coarse else ""
    why = "a limit, as the dark noise is" if coarse else ""
    limit: Bound = "<" if bound else ""
    found = electrons.told(value, limit, why)
    if eta.value is None:
        return [photons.untold(eta.reason), found]
    return [photons.told(100 * value / eta.value, limit, why), found]


def _greatest(transfer: PhotonTransfer, k: Quantity, eta: Quantity, least: list[Quantity]) -> list[Quantity]:
    """Return saturation in photons and in electrons, the greatest SNR, and the dynamic range."""
    at = transfer.saturation
    bound: Bound = "" if transfer.saturated else ">"
    why = "" if transfer.saturated else "the variance rises up to the brightest level: saturation was not reached"
    in_photons = Quantity("mu_p_sat", "μ_p.sat", "saturation capacity", "photons")
    in_electrons = Quantity("mu_e_sat", "μ_e.sat", "saturation capacity", "e-")
    photons = in_photons.untold(eta.reason)
    if eta.value is not None:
        photons = in_photons.told(float(transfer.photons[at]), bound, why)
    if k.value is None:
        electrons = in_electrons.untold(_NO_GAIN)
    elif eta.value is not None:
        electrons = in_electrons.told(eta.value / 100 * float(transfer.photons[at]), bound, why)
    else:
        electrons = in_electrons.told(float(transfer.signal[at]) / k.value, bound, why)
    return [photons, electrons, *_ratios(electrons, least)]


def _ratios(electrons: Quantity, least: list[Quantity]) -> list[Quantity]:
    """Return SNR_max and the dynamic range, each as a number, in dB and in bits."""
    found = []
    threshold = least[1]
    best = None if electrons.value is None else math.sqrt(electrons.value)
    span = None if electrons.value is None or threshold.value is None else electrons.value / threshold.value
    limited: Bound = ">" if electrons.bound or threshold.bound else ""
    why = "; ".join(dict.fromkeys(q.reason for q in (electrons, threshold) if q.reason))
    for key, symbol, name, value, bound, reason in (
        ("SNR_max", "SNR.max", "maximum signal-to-noise ratio", best, electrons.bound, electrons.reason),
        ("DR", "DR", "dynamic range", span, limited, why),
    ):
        for suffix, unit, scaled in (("", "", lambda x: x), ("_dB", "dB", _decibel), ("_bit", "bit", math.log2)):
            blank = Quantity(key + suffix, symbol, name, unit)
            found.append(blank.untold(reason) if value is None else blank.told(scaled(value), bound, reason))
    return found


def _decibel(ratio: float) -> float:
    return 20 * math.log10(ratio)
