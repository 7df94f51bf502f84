"""Quantities of the linear camera model of EMVA 1288, from photon transfer to dark current."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from neusee.nodes.values import Levels

# --- quantity -------------------------------------------------------------------------------------

# A quantity of the EMVA 1288 sheet: a value, a limit, or the reason why there is neither.


Bound = Literal["", "<", ">"]
_WHOLE_RANGE = (1e3, 1e7)  #: values that are shown as whole numbers


@dataclass(frozen=True)
class Quantity:
    """A quantity of an EMVA 1288 data sheet, with its name, symbol and unit; ``value`` is None if
    the frames do not determine it.

    With a ``bound`` the frames give a limit only: the quantity is below (``<``) or above (``>``)
    the value. ``reason`` says why there is no value, or only a limit.
    """

    key: str
    symbol: str
    name: str
    unit: str = ""
    value: float | None = None
    bound: Bound = ""
    reason: str = ""

    @property
    def text(self) -> str:
        """Value and unit with four digits or as a whole number, such as ``< 1.4 e-``, or ``not
        measured``.
        """
        if self.value is None:
            return "not measured"
        number = (
            f"{self.value:.0f}"
            if _WHOLE_RANGE[0] <= abs(self.value) < _WHOLE_RANGE[1]
            else f"{self.value:.4g}"
        )
        return f"{self.bound} {number} {self.unit}".strip()

    def told(self, value: float, bound: Bound = "", reason: str = "") -> Quantity:
        """Return a copy of the quantity with a value; a value that is not finite becomes None, with
        ``reason`` as the reason.
        """
        if not math.isfinite(value):
            return self.untold(reason or "no finite value follows from these frames")
        return replace(self, value=float(value), bound=bound, reason=reason)

    def untold(self, reason: str) -> Quantity:
        """Return a copy of the quantity without a value, with the reason why it has none."""
        return replace(self, value=None, bound="", reason=reason)


# --- photon transfer ------------------------------------------------------------------------------

# The photon transfer of EMVA 1288: lit levels with their darks, the saturation point, and the
# ranges of fits.


FloatArray = NDArray[np.float64]
FITTED_SHARE = 0.7  #: share of saturation up to which gain and responsivity are fitted
#: shares of saturation between which the response is compared with a line
LINEAR_RANGE = (0.05, 0.95)
#: a local maximum of the variance below this share of the greatest variance is noise of saturated
#: levels
_PEAK_SHARE = 0.5


@dataclass(frozen=True)
class PhotonTransfer:
    """A photon-transfer measurement: lit levels (level,) in rising order of light, the dark level
    subtracted from each, and all dark levels (dark,) in rising order of exposure.
    """

    photons: FloatArray  #: mu_p, per pixel and exposure
    exposure: FloatArray  #: s
    mean: FloatArray  #: mu_y, DN
    variance: FloatArray  #: sigma_y^2, DN2
    mean_dark: FloatArray  #: mu_y.dark of the dark level of the nearest exposure, DN
    variance_dark: FloatArray  #: DN2
    dark_exposure: FloatArray  #: s
    dark_mean: FloatArray  #: DN
    dark_variance: FloatArray  #: DN2
    saturation: int  #: index of the lit level at saturation
    #: False if the variance rises up to the brightest level, which then only bounds saturation
    saturated: bool

    @property
    def signal(self) -> FloatArray:
        """mu_y - mu_y.dark of each lit level, DN."""
        return np.asarray(self.mean - self.mean_dark)

    @property
    def excess(self) -> FloatArray:
        """sigma_y^2 - sigma_y.dark^2 of each lit level, DN2."""
        return np.asarray(self.variance - self.variance_dark)

    @property
    def fitted(self) -> NDArray[np.bool_]:
        """True for the lit levels from 0 to 70 % of saturation."""
        return np.asarray(self.signal <= FITTED_SHARE * self.signal[self.saturation])

    @property
    def linear(self) -> NDArray[np.bool_]:
        """True for the lit levels from 5 to 95 % of saturation."""
        low, high = (share * self.signal[self.saturation] for share in LINEAR_RANGE)
        return np.asarray((self.signal >= low) & (self.signal <= high))


def photon_transfer(levels: Levels) -> PhotonTransfer:
    """Return the photon-transfer measurement, which pairs each lit level with the dark level of the
    nearest exposure.

    Shapes: levels (level,).
    Units:  as in `PhotonTransfer`.
    Raises: ValueError without a dark level or without two lit levels.
    Source: EMVA Standard 1288, release 4.0 Linear.
    """
    photons, exposure, mean, variance = (
        np.asarray(x, dtype=np.float64)
        for x in (levels.photons, levels.exposure, levels.mean, levels.variance)
    )
    dark = np.flatnonzero(photons == 0)
    dark = dark[np.argsort(exposure[dark], kind="stable")]
    lit = lit_order(photons, exposure)
    if not len(dark):
        raise ValueError("a sheet of EMVA 1288 needs dark frames: give a level without light")
    if len(lit) < 2:
        raise ValueError(
            f"a sheet of EMVA 1288 needs lit levels, and there is {len(lit)}: give two or more"
        )
    dark_of_lit = dark[np.abs(exposure[lit, None] - exposure[dark]).argmin(1)]
    saturation = saturation_point(variance[lit])
    # in the order of its fields: lit levels, the dark of each, all darks
    return PhotonTransfer(
        photons[lit],
        exposure[lit],
        mean[lit],
        variance[lit],
        mean[dark_of_lit],
        variance[dark_of_lit],
        exposure[dark],
        mean[dark],
        variance[dark],
        saturation,
        saturation < len(lit) - 1,
    )


def saturation_point(variance: FloatArray) -> int:
    """Return the index of the level at saturation: coming down from the brightest level, the first
    local maximum of the variance, which exceeds the variances of the next two darker levels.

    A maximum below half of the greatest variance is noise of saturated levels, and is skipped.
    """
    peak = len(variance) - 1
    for i in range(len(variance) - 2, -1, -1):
        # down from the brightest level, until both variances below the peak are less than it
        if variance[i] >= variance[peak]:
            peak = i
        elif i == 0 or variance[i - 1] < variance[peak]:
            break
    return peak if variance[peak] >= _PEAK_SHARE * variance.max() else int(variance.argmax())


def lit_order(photons: FloatArray, exposure: FloatArray) -> NDArray[np.int64]:
    """Return the indices of the lit levels, sorted by light and then by exposure."""
    lit = np.flatnonzero(photons > 0)
    order: NDArray[np.int64] = lit[np.lexsort((exposure[lit], photons[lit]))]
    return order


def slope_through_origin(x: FloatArray, y: FloatArray) -> float:
    """Return the slope of the least-squares line through the origin and the points (x, y), all of
    equal weight.
    """
    return float(x @ y / (x @ x))


def line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return slope and intercept (value at x = 0) of the least-squares line through the points (x,
    y).
    """
    centred_x = x - x.mean()
    slope = float(centred_x @ y / (centred_x @ centred_x))
    return slope, float(y.mean() - slope * x.mean())


def relative_line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return slope and intercept of the line that minimises the squared relative deviations
    from y.
    """
    # slope x + intercept = y, divided by y: a linear least-squares problem with the right side 1
    design = np.stack([x / y, 1 / y], axis=1)
    # columns scaled to unit length, so that the problem is well conditioned
    scaled_parameters: Any = np.linalg.lstsq(
        design / np.linalg.norm(design, axis=0), np.ones_like(y), rcond=None
    )[0]
    slope, value_at_0 = scaled_parameters / np.linalg.norm(design, axis=0)
    return float(slope), float(value_at_0)


# --- sensitivity ----------------------------------------------------------------------------------

# Sensitivity, noise, saturation, linearity and dark current of the EMVA 1288 sheet.


QUANTIZATION = 1.0 / 12.0  #: sigma_q^2, DN2
#: DN2, least temporal dark variance that rounding leaves measurable; its root is 0.49 DN
LEAST_DARK_VARIANCE = 0.24
_LINE_EXPOSURES = 2  #: a slope needs more exposures than this
_SLOPE_SIGMA = 2.0  #: a slope of fewer standard errors than this is not stated
#: why a quantity in electrons has no value
NO_GAIN = "K is not told, so that no value in electrons is"
_NO_LIGHT = "the photons of the levels are not told"


@dataclass(frozen=True)
class Linearity:
    """The line fitted to the response by its relative deviations, and the deviation of each level
    from it in percent.
    """

    slope: float  #: DN per photon
    start: float  #: DN, at no light
    deviation: FloatArray  #: %, of each level from 5 to 95 % of saturation


def gain(transfer: PhotonTransfer) -> Quantity:
    """Return the overall system gain K in DN/e-, fitted to the levels up to 70 % of saturation."""
    blank = Quantity("K", "K", "overall system gain", "DN/e-")
    fitted = transfer.fitted
    if fitted.sum() < 2:
        return blank.untold(
            f"{int(fitted.sum())} lit levels lie below 70 % of saturation, and a line needs two"
        )
    slope = slope_through_origin(transfer.signal[fitted], transfer.excess[fitted])
    return (
        blank.told(slope)
        if slope > 0
        else blank.untold("the variance does not rise with the signal")
    )


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
    thresholds = _thresholds(transfer, k, eta, noise, coarse)
    return [
        eta,
        k,
        _inverse(k),
        response,
        *_dark_noise_and_signal(transfer, k, noise, coarse),
        *thresholds,
        *_saturation_and_range(transfer, k, eta, thresholds),
    ]


def dark_noise(transfer: PhotonTransfer) -> tuple[float, bool]:
    """Return the temporal dark noise sigma_y.dark in DN at exposure 0, and True if rounding hides
    it: then the value, 0.49 DN, is only an upper limit.
    """
    if len(np.unique(transfer.dark_exposure)) > _LINE_EXPOSURES:
        _, variance = line(transfer.dark_exposure, transfer.dark_variance)
    else:
        variance = float(transfer.dark_variance[0])
    return math.sqrt(max(variance, LEAST_DARK_VARIANCE)), variance < LEAST_DARK_VARIANCE


def linearity(transfer: PhotonTransfer) -> Linearity | None:
    """Return the deviation of the response from a line, or None for fewer than three levels from 5
    to 95 % of saturation.
    """
    linear = transfer.linear
    if linear.sum() < 3 or len(np.unique(transfer.photons[linear])) < 3:
        return None
    x, y = transfer.photons[linear], transfer.signal[linear]
    slope, start = relative_line(x, y)
    fitted = slope * x + start
    return Linearity(slope, start, 100 * (y - fitted) / fitted)


def linearity_errors(transfer: PhotonTransfer) -> list[Quantity]:
    """Return the linearity errors LE_min and LE_max: the least and the greatest relative deviation
    from the line, in percent.
    """
    extremes = (("LE_min", "LE.min", "least"), ("LE_max", "LE.max", "greatest"))
    blanks = [
        Quantity(key, symbol, f"linearity error, {name} deviation", "%")
        for key, symbol, name in extremes
    ]
    line = linearity(transfer)
    if line is None:
        count = int(transfer.linear.sum())
        return [
            b.untold(f"{count} levels lie from 5 to 95 % of saturation, and three are needed")
            for b in blanks
        ]
    values = (float(line.deviation.min()), float(line.deviation.max()))
    return [blank.told(value) for blank, value in zip(blanks, values, strict=True)]


def dark_current(transfer: PhotonTransfer) -> list[Quantity]:
    """Return the dark current mu_I in e-/s, once from the means and once from the variances of dark
    frames.

    Source: EMVA Standard 1288, release 4.0 Linear.
    """
    of_mean = Quantity("mu_I_mean", "μ_I.mean", "dark current, from the means", "e-/s")
    of_variance = Quantity("mu_I_var", "μ_I.var", "dark current, from the variances", "e-/s")
    gain_value, exposures = gain(transfer).value, transfer.dark_exposure
    count = len(np.unique(exposures))
    reason = "" if gain_value else NO_GAIN
    if count <= _LINE_EXPOSURES:
        reason = f"dark frames at {count} exposure{'s' * (count > 1)}: three or more are needed"
    if reason or not gain_value:
        return [of_mean.untold(reason), of_variance.untold(reason)]
    from_means = _slope_over_exposure(of_mean, exposures, transfer.dark_mean, gain_value)
    _, is_coarse = dark_noise(transfer)
    if is_coarse:
        return [from_means, of_variance.untold("rounding hides the variance of the dark")]
    return [
        from_means,
        _slope_over_exposure(of_variance, exposures, transfer.dark_variance, gain_value**2),
    ]


def _slope_over_exposure(
    blank: Quantity, times: FloatArray, values: FloatArray, scale: float
) -> Quantity:
    """Return the slope of ``values`` over exposure time, divided by ``scale``; no value if the
    slope is below twice its standard error.
    """
    slope, value_at_0 = line(times, values)
    residuals = values - value_at_0 - slope * times
    slope_error = math.sqrt(
        float(residuals @ residuals) / (len(times) - 2) / float(((times - times.mean()) ** 2).sum())
    )
    if slope > 0 and slope >= _SLOPE_SIGMA * slope_error:
        return blank.told(slope / scale)
    return blank.untold(
        f"no rise with the exposure: {slope / scale:.3g} {blank.unit}, with a standard error of"
        f" {slope_error / scale:.2g}"
    )


def _responsivity(transfer: PhotonTransfer, k: Quantity, photons_told: bool) -> Quantity:
    """Return the responsivity in DN per photon from the levels up to 70 % of saturation."""
    blank = Quantity("R", "R", "responsivity", "DN/photon")
    fitted = transfer.fitted
    if not photons_told:
        return blank.untold(_NO_LIGHT)
    if fitted.sum() < 2:
        return blank.untold(k.reason)
    return blank.told(slope_through_origin(transfer.photons[fitted], transfer.signal[fitted]))


def _efficiency(response: Quantity, k: Quantity, photons_told: bool) -> Quantity:
    """Return the quantum efficiency in %, which is responsivity over gain."""
    blank = Quantity("eta", "η", "quantum efficiency", "%")
    if not photons_told:
        return blank.untold(_NO_LIGHT)
    if response.value is None or k.value is None:
        return blank.untold(NO_GAIN)
    return blank.told(100 * response.value / k.value)


def _inverse(k: Quantity) -> Quantity:
    """Return the inverse of the gain in e-/DN."""
    blank = Quantity("inverse_K", "1/K", "inverse of the overall system gain", "e-/DN")
    return blank.untold(k.reason) if k.value is None else blank.told(1 / k.value)


def _dark_noise_and_signal(
    transfer: PhotonTransfer, k: Quantity, noise: float, coarse: bool
) -> list[Quantity]:
    """Return temporal dark noise and dark signal, each in DN and in electrons."""
    rounding_reason = (
        f"the dark noise is below the {math.sqrt(LEAST_DARK_VARIANCE):.2f} DN that the standard"
        " sets, because rounding hides it"
    )
    bound: Bound = "<" if coarse else ""
    in_numbers = Quantity("sigma_y_dark", "σ_y.dark", "temporal dark noise", "DN").told(
        noise, bound, rounding_reason * coarse
    )
    blank = Quantity("sigma_d", "σ_d", "temporal dark noise", "e-")
    signal = Quantity("mu_d", "μ_d", "dark signal, with the offset of the converter", "e-")
    mean = Quantity("mu_y_dark", "μ_y.dark", "dark signal", "DN").told(float(transfer.dark_mean[0]))
    if k.value is None:
        return [in_numbers, blank.untold(NO_GAIN), mean, signal.untold(NO_GAIN)]
    electrons = math.sqrt(noise**2 - QUANTIZATION) / k.value
    return [
        in_numbers,
        blank.told(electrons, bound, rounding_reason * coarse),
        mean,
        signal.told(float(transfer.dark_mean[0]) / k.value),
    ]


def _thresholds(
    transfer: PhotonTransfer, k: Quantity, eta: Quantity, noise: float, coarse: bool
) -> list[Quantity]:
    """Return the absolute sensitivity threshold, the light whose signal equals its noise, in
    photons and in electrons.

    ``k`` is the gain, ``eta`` the quantum efficiency in %, ``noise`` the dark noise in DN. If
    ``coarse``, rounding hides the dark noise, and ``noise`` is only its upper limit.
    """
    photons = Quantity("mu_p_min", "μ_p.min", "absolute sensitivity threshold", "photons")
    electrons = Quantity("mu_e_min", "μ_e.min", "absolute sensitivity threshold", "e-")
    if k.value is None:
        return [photons.untold(NO_GAIN), electrons.untold(NO_GAIN)]
    # EMVA 1288: sigma_y.dark / K + 1/2
    threshold_electrons, bound_sign = noise / k.value + 0.5, "<" if coarse else ""
    reason = "a limit, as the dark noise is" if coarse else ""
    bound: Bound = "<" if bound_sign else ""
    of_electrons = electrons.told(threshold_electrons, bound, reason)
    if eta.value is None:
        return [photons.untold(eta.reason), of_electrons]
    return [photons.told(100 * threshold_electrons / eta.value, bound, reason), of_electrons]


def _saturation_and_range(
    transfer: PhotonTransfer, k: Quantity, eta: Quantity, thresholds: list[Quantity]
) -> list[Quantity]:
    """Return saturation in photons and in electrons, the greatest SNR, and the dynamic range.

    ``thresholds`` are the absolute sensitivity thresholds in photons and in electrons.
    """
    saturation = transfer.saturation
    bound: Bound = "" if transfer.saturated else ">"
    reason = (
        ""
        if transfer.saturated
        else "the variance rises up to the brightest level: saturation was not reached"
    )
    in_photons = Quantity("mu_p_sat", "μ_p.sat", "saturation capacity", "photons")
    in_electrons = Quantity("mu_e_sat", "μ_e.sat", "saturation capacity", "e-")
    photons = in_photons.untold(eta.reason)
    if eta.value is not None:
        photons = in_photons.told(float(transfer.photons[saturation]), bound, reason)
    if k.value is None:
        electrons = in_electrons.untold(NO_GAIN)
    elif eta.value is not None:
        # EMVA 1288: mu_e.sat = eta mu_p.sat
        electrons = in_electrons.told(
            eta.value / 100 * float(transfer.photons[saturation]), bound, reason
        )
    else:
        electrons = in_electrons.told(float(transfer.signal[saturation]) / k.value, bound, reason)
    return [photons, electrons, *_ratios(electrons, thresholds)]


def _ratios(electrons: Quantity, thresholds: list[Quantity]) -> list[Quantity]:
    """Return the maximum signal-to-noise ratio and the dynamic range, each as a ratio, in dB and in
    bits.
    """
    # in electrons
    threshold = thresholds[1]
    greatest_snr = Quantity("SNR_max", "SNR.max", "maximum signal-to-noise ratio", "")
    if electrons.value is None:
        greatest_snr = greatest_snr.untold(electrons.reason)
    else:
        # shot noise alone: sqrt(electrons)
        greatest_snr = greatest_snr.told(
            math.sqrt(electrons.value), electrons.bound, electrons.reason
        )
    dynamic_range = Quantity("DR", "DR", "dynamic range", "")
    reason = "; ".join(dict.fromkeys(q.reason for q in (electrons, threshold) if q.reason))
    if electrons.value is None or threshold.value is None:
        dynamic_range = dynamic_range.untold(reason)
    else:
        bound: Bound = ">" if electrons.bound or threshold.bound else ""
        dynamic_range = dynamic_range.told(electrons.value / threshold.value, bound, reason)
    return [*_on_three_scales(greatest_snr), *_on_three_scales(dynamic_range)]


def _on_three_scales(ratio: Quantity) -> list[Quantity]:
    """Return a quantity as a plain ratio, in dB and in bits."""
    in_decibels = replace(ratio, key=f"{ratio.key}_dB", unit="dB")
    in_bits = replace(ratio, key=f"{ratio.key}_bit", unit="bit")
    if ratio.value is not None:
        in_decibels = replace(in_decibels, value=_decibel(ratio.value))
        in_bits = replace(in_bits, value=math.log2(ratio.value))
    return [ratio, in_decibels, in_bits]


def _decibel(ratio: float) -> float:
    return 20 * math.log10(ratio)
