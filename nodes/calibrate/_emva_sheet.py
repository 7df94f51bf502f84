"""The EMVA 1288 data sheet, the least-squares fit of the linear camera model, and the general
model, which does not assume a linear response.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.calibrate._emva_quantities import (
    LEAST_DARK_VARIANCE,
    QUANTIZATION,
    Bound,
    FloatArray,
    Linearity,
    PhotonTransfer,
    Quantity,
    dark_current,
    gain,
    linearity,
    linearity_errors,
    photon_transfer,
    sensitivity,
)
from neusee.nodes.calibrate._nonuniformity import Nonuniformity, nonuniformity
from neusee.nodes.values import Levels

# --- least-squares fit ----------------------------------------------------------------------------

# A fit of the linear camera model, as EMVA 1288 prescribes; slower fits start from this estimate.


Share = Annotated[float, Field(gt=0, le=1)]


class LeastSquares(NamedTuple):
    """Results of the least-squares fit to a photon-transfer measurement, float64 scalars; errors
    are standard errors from noise alone.
    """

    gain: Tensor  #: K, DN/e-
    efficiency: Tensor  #: electrons per photon
    temporal_dark_noise: Tensor  #: sigma_d, e-
    dark_signal: Tensor  #: mean of the dark level of the shortest exposure, DN
    dark_current: Tensor  #: e-/s; NaN where all dark levels have the same exposure
    saturation: Tensor  #: electrons above the dark in the level of the largest variance
    gain_error: Tensor
    efficiency_error: Tensor
    temporal_dark_noise_error: Tensor
    fitted: Tensor  #: number of lit levels used in both line fits


@node(rtol=1e-9)
def least_squares(levels: Levels, *, share: Share = 0.7) -> LeastSquares:
    """Fit gain and quantum efficiency by lines through the origin, and estimate temporal dark noise
    and dark current.

    The slope of mean over photons is the responsivity, and the slope of variance over mean is the
    gain, after subtraction of the dark level of the nearest exposure. The level of the greatest
    variance marks saturation; only levels up to ``share`` of saturation are fitted.

    Shapes: levels (level,) -> ten scalars.
    Units:  K DN/e-; temporal dark noise, saturation e-; dark current e-/s.
    Error:  valid as far as the camera is linear and the light is Poisson. Every level has the same
            weight, as in the standard, so that the brightest levels dominate. Rounding in the
            converter is assumed to add 1/12 DN2; dithered rounding adds up to 1/6. The errors omit
            the scatter of means in x, drift and non-linearity, which are larger in real cameras.
    Raises: ValueError without a dark level, without two lit levels of different light below
            saturation, and for a camera without response.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 6.6 to 6.8.
    """
    is_dark = levels.photons == 0
    _refuse_too_few(is_dark)
    # for each lit level, the dark level of the most similar exposure
    nearest_dark = (levels.exposure[~is_dark, None] - levels.exposure[is_dark]).abs().argmin(1)
    lit_levels = without_histograms(levels, ~is_dark)
    darks_of_lit = without_histograms(levels, is_dark.nonzero().squeeze(1)[nearest_dark])
    mean, variance = (
        lit_levels.mean - darks_of_lit.mean,
        lit_levels.variance - darks_of_lit.variance,
    )
    saturation_signal = mean[lit_levels.variance.argmax()]
    fitted_index = (mean <= share * saturation_signal).nonzero().squeeze(1)
    if len(set(lit_levels.photons[fitted_index].tolist())) < 2:
        raise ValueError(
            f"{len(fitted_index)} lit level(s) below {share:.0%} of saturation"
            f" ({float(saturation_signal):.4g} DN above the dark level) cannot define a line: give"
            " two or more different light levels there"
        )
    gain = _slope(mean[fitted_index], variance[fitted_index])
    responsivity = _slope(lit_levels.photons[fitted_index], mean[fitted_index])
    _refuse_falling(gain, responsivity)
    # variance of a measured variance s^2 of nu degrees of freedom: 2 s^4 / nu
    lit_variance, dark_variance = (
        (2 * x.variance.square() / x.degrees_of_freedom)[fitted_index]
        for x in (lit_levels, darks_of_lit)
    )
    gain_error = (
        _slope_error(mean[fitted_index], lit_variance, dark_variance, nearest_dark[fitted_index])
        / gain
    )
    # variance of a mean over all pixels
    lit_variance, dark_variance = (
        (x.variance / x.pixels)[fitted_index] for x in (lit_levels, darks_of_lit)
    )
    responsivity_error = (
        _slope_error(
            lit_levels.photons[fitted_index],
            lit_variance,
            dark_variance,
            nearest_dark[fitted_index],
        )
        / responsivity
    )
    noise_in_numbers, noise_error_in_numbers = _dark_noise(levels, is_dark)
    efficiency = responsivity / gain
    return LeastSquares(
        gain=gain,
        efficiency=efficiency,
        temporal_dark_noise=noise_in_numbers / gain,
        dark_signal=levels.mean[_shortest_dark(levels, is_dark)],
        dark_current=_dark_current(levels, is_dark) / gain,
        saturation=saturation_signal / gain,
        gain_error=gain_error * gain,
        efficiency_error=efficiency * torch.hypot(gain_error, responsivity_error),
        temporal_dark_noise_error=torch.hypot(noise_error_in_numbers, gain_error * noise_in_numbers)
        / gain,
        fitted=torch.tensor(float(len(fitted_index)), dtype=torch.float64),
    )


def _refuse_too_few(dark: Tensor) -> None:
    """Raise ValueError for fewer than one dark or two lit levels; ``dark`` (level,) is True for a
    dark level.
    """
    if not bool(dark.any()):
        raise ValueError(
            "the offset of the camera is unknown without dark frames: give frames without light"
        )
    lit = int((~dark).sum())
    if lit < 2:
        raise ValueError(
            f"{lit} lit level(s) cannot define a line: give two or more different light levels"
        )


def _refuse_falling(gain: Tensor, response: Tensor) -> None:
    """Raise ValueError unless both fitted slopes, gain and responsivity, are positive."""
    if not (float(gain) > 0 and float(response) > 0):
        raise ValueError(
            f"slopes {float(gain):.3g} DN/e- and {float(response):.3g} DN/photon are not positive:"
            " more light must raise mean and variance; check `photons` of each level"
        )


@least_squares.check
def _(result: LeastSquares, levels: Levels, **params: float) -> list[Check]:
    text = (
        f"K {float(result.gain):.4g} DN/e-, QE {float(result.efficiency):.3g}, temporal dark noise"
        f" {float(result.temporal_dark_noise):.4g} e-, from {int(result.fitted)} of"
        f" {len(levels.mean)} levels"
    )
    return [Check(text, 0.0 < float(result.efficiency) <= 1.0)]


def without_histograms(levels: Levels, which: Tensor) -> Levels:
    """Return the light levels selected by an index tensor or a mask, without their histograms."""
    return Levels._make([*(x[which] for x in levels[:6]), *(x[:0] for x in levels[6:])])


def _slope(x: Tensor, y: Tensor) -> Tensor:
    """Return the slope of the least-squares line through the origin and the points (x, y)."""
    return (x @ y) / (x @ x)


def _slope_error(x: Tensor, own: Tensor, dark: Tensor, which: Tensor) -> Tensor:
    """Return the standard error of the slope sum(x y) / sum(x x) of a line through the origin.

    ``own`` is the variance of each lit value, ``dark`` that of the dark value subtracted from it,
    and ``which`` the index of that dark level. Points with the same dark level share its error.
    """
    dark_errors = torch.zeros(int(which.max()) + 1, dtype=x.dtype, device=x.device).index_add_(
        0, which, x * dark.sqrt()
    )
    return (x.square() @ own + dark_errors.square().sum()).sqrt() / (x @ x)


def _shortest_dark(levels: Levels, dark: Tensor) -> Tensor:
    """Return the index of the dark level of the shortest exposure."""
    return torch.where(dark, levels.exposure, math.inf).argmin()


def _dark_noise(levels: Levels, dark: Tensor) -> tuple[Tensor, Tensor]:
    """Return the temporal dark noise in DN, with rounding noise subtracted, and its standard error
    in DN (infinite for a noise of 0).
    """
    variance, freedom = (
        x[_shortest_dark(levels, dark)] for x in (levels.variance, levels.degrees_of_freedom)
    )
    noise = (variance - QUANTIZATION).clamp_min(0.0).sqrt()
    # d(sqrt(v)) = dv / (2 sqrt(v)), with the relative error sqrt(2 / nu) of v
    return noise, torch.where(noise > 0, variance / (2 * freedom).sqrt() / noise, math.inf)


def _dark_current(levels: Levels, dark: Tensor) -> Tensor:
    """Return the slope of the dark signal over exposure time in DN/s, or NaN if all dark levels
    have the same exposure.
    """
    time, signal = levels.exposure[dark], levels.mean[dark]
    centred_time = time - time.mean()
    return torch.where(
        time.max() > time.min(), (centred_time @ signal) / (centred_time @ centred_time), math.nan
    )


# --- general model --------------------------------------------------------------------------------

# The general model of EMVA 1288 does not assume a linear response: the local slope of the response
# converts noise in DN to noise in photons.


_LOCAL_LEVELS = 5  #: least number of levels of a local fit
_LOCAL_SHARE = 0.25  #: share of all levels that a local fit uses
_KNOWN_SLOPE_ERROR = 0.03  #: a slope with a larger relative standard error is not used


class GeneralModel(NamedTuple):
    """Local slope and input-referred signal-to-noise ratio of the lit levels up to saturation, in
    rising order of light.
    """

    photons: FloatArray  #: (level,) per pixel and exposure
    slope: FloatArray  #: (1 + level,) DN per photon, local; the first is the slope without light
    #: (1 + level,) relative standard error of the slope, from the scatter about the local fits
    error: FloatArray
    #: (level,) signal-to-noise ratio of the light: photons over the input-referred temporal noise
    #: in photons
    ratio: FloatArray


def general_model(transfer: PhotonTransfer) -> GeneralModel | None:
    """Return the local slope of the response and the signal-to-noise ratio of the light at each
    level up to saturation; None for fewer than 3 levels.

    The slope is that of a parabola fitted to five or more neighbouring levels; the dark counts as a
    level. The light is assumed to scatter from level to level by the same relative amount, which is
    estimated from the residuals of the parabolas and gives the errors.

    Source: EMVA Standard 1288, release 4.0 General (characteristic curve, and noise referred to the
            input).
    """
    up_to_saturation = slice(0, transfer.saturation + 1)
    light = np.concatenate([[0.0], transfer.photons[up_to_saturation]])
    signal = np.concatenate([[0.0], transfer.signal[up_to_saturation]])
    if len(np.unique(light)) < 4 or len(np.unique(light)) < len(light):
        return None
    slope, error = _local_slopes(light, signal)
    # slope x light over the temporal noise in DN
    ratio = (
        light[1:]
        * slope[1:]
        / np.sqrt(transfer.variance[up_to_saturation].clip(np.finfo(float).tiny))
    )
    return GeneralModel(light[1:], slope, error, np.asarray(ratio))


def general_quantities(transfer: PhotonTransfer, photons_told: bool = True) -> list[Quantity]:
    """Return sensitivity threshold, maximum signal-to-noise ratio and dynamic range of the general
    model.

    The threshold is the light whose signal equals the noise; between the dark and the first lit
    level the variance is interpolated linearly in the light.

    Units:  photons; a number; dB.
    Source: EMVA Standard 1288, release 4.0 General.
    """
    threshold_blank = Quantity(
        "mu_p_min_general", "μ_p.min", "absolute sensitivity threshold, no linear model", "photons"
    )
    greatest_snr = Quantity(
        "SNR_max_general", "SNR.max", "maximum SNR of the light, no linear model", "dB"
    )
    dynamic_range = Quantity("DR_general", "DR", "dynamic range, no linear model", "dB")
    model = general_model(transfer)
    if model is None or not (model.slope > 0).all():
        lacking_reason = (
            "three or more levels of different light up to saturation, all brighter than those"
            " below, are needed"
        )
        return [
            blank.untold(lacking_reason) for blank in (threshold_blank, greatest_snr, dynamic_range)
        ]
    error_at_dark, error_at_greatest = (
        float(model.error[0]),
        float(model.error[1 + int(model.ratio.argmax())]),
    )
    bound, reason = _bound_of_brightest(transfer)
    told_snr = greatest_snr.untold(_SCATTER_REASON.format(error_at_greatest))
    if error_at_greatest <= _KNOWN_SLOPE_ERROR:
        told_snr = greatest_snr.told(20 * math.log10(float(model.ratio.max())), bound, reason)
    if error_at_dark > _KNOWN_SLOPE_ERROR:
        lacking_reason = _SCATTER_REASON.format(error_at_dark)
        return [
            threshold_blank.untold(lacking_reason),
            told_snr,
            dynamic_range.untold(lacking_reason),
        ]
    threshold = _threshold(transfer, model)
    decibels = 20 * math.log10(float(model.photons[-1]) / threshold)
    if float(transfer.dark_variance[0]) < LEAST_DARK_VARIANCE:
        rounding_reason = "rounding hides the dark noise"
        told_threshold, told_range = (
            threshold_blank.told(threshold, "<", rounding_reason),
            dynamic_range.told(decibels, ">", rounding_reason),
        )
    else:
        told_threshold, told_range = (
            threshold_blank.told(threshold),
            dynamic_range.told(decibels, bound, reason),
        )
    return [
        told_threshold if photons_told else threshold_blank.untold("the photons are not told"),
        told_snr,
        told_range,
    ]


#: why a quantity of the general model is not stated
_SCATTER_REASON = (
    "the light scatters from level to level, so that the slope is known to {:.0%} only"
)


def _bound_of_brightest(transfer: PhotonTransfer) -> tuple[Bound, str]:
    """Return the bound of quantities that depend on saturation, and its reason: lower limits if
    saturation was not reached.
    """
    return ("", "") if transfer.saturated else (">", "saturation was not reached")


def _local_slopes(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the local slope at each point, from a parabola fitted to the nearest points, and the
    relative standard error of each slope.

    The points are assumed to scatter by the same relative amount everywhere, which is estimated
    from their residuals.
    """
    # an odd number of points: at least `_LOCAL_LEVELS`, and about `_LOCAL_SHARE` of all
    window_length = min(len(x), max(_LOCAL_LEVELS, 2 * round(_LOCAL_SHARE * len(x) / 2) + 1))
    slopes, error_weights, relative_residuals = [], [], []
    for index in range(len(x)):
        first = min(max(0, index - window_length // 2), len(x) - window_length)
        neighbours = slice(first, first + window_length)
        x_range = float(np.ptp(x[neighbours]))
        # rows: weights of the values for the parabola's value, slope and bend at the point
        parabola_weights = np.linalg.pinv(
            np.vander((x[neighbours] - x[index]) / x_range, 3, increasing=True)
        )
        slopes.append(float(parabola_weights[1] @ y[neighbours]) / x_range)
        error_weights.append(float(np.linalg.norm(parabola_weights[1] * y[neighbours])) / x_range)
        residual_weights = -parabola_weights[0]
        # residual of the point: its value less the value of the parabola there
        residual_weights[index - first] += 1
        if residual_size := float(np.linalg.norm(residual_weights * y[neighbours])):
            relative_residuals.append(float(residual_weights @ y[neighbours]) / residual_size)
    error = (
        math.sqrt(float(np.mean(np.square(relative_residuals))))
        * np.array(error_weights)
        / np.abs(slopes)
    )
    return np.array(slopes), np.asarray(error)


def _threshold(transfer: PhotonTransfer, model: GeneralModel) -> float:
    """Return the light in photons whose signal equals its temporal noise."""
    dark_variance = max(float(transfer.variance_dark[0]), LEAST_DARK_VARIANCE)
    variance_per_photon = max(0.0, float(transfer.excess[0]) / float(model.photons[0]))
    slope = float(model.slope[0])
    # (slope x)^2 = dark variance + variance per photon * x
    threshold = (
        variance_per_photon + math.sqrt(variance_per_photon**2 + 4 * dark_variance * slope**2)
    ) / (2 * slope**2)
    # the linear variance holds up to the first level only; beyond it, find where the ratio is 1
    if threshold <= model.photons[0] or not (model.ratio < 1).any():
        return threshold
    brightest_below = int(np.flatnonzero(model.ratio < 1).max())
    if brightest_below + 1 == len(model.ratio):
        return float(model.photons[brightest_below])
    neighbours = slice(brightest_below, brightest_below + 2)
    return float(
        # interpolated between two levels, in logarithms of ratio and light
        np.exp(
            np.interp(
                0.0, np.log(model.ratio[neighbours].clip(1e-300)), np.log(model.photons[neighbours])
            )
        )
    )


# --- sheet ----------------------------------------------------------------------------------------

# The EMVA 1288 data sheet: all quantities, each with a value or the reason why it has none.


@dataclass(frozen=True)
class EmvaSheet:
    """The EMVA 1288 data sheet of a camera at one operating point."""

    transfer: PhotonTransfer
    linearity: Linearity | None
    spatial: Nonuniformity
    quantities: tuple[Quantity, ...]  #: in the order of the standard

    def __getitem__(self, key: str) -> Quantity:
        return next(quantity for quantity in self.quantities if quantity.key == key)


def emva_sheet(
    levels: Levels, spatial: Nonuniformity | None = None, *, photons_told: bool = True
) -> EmvaSheet:
    """Compute every quantity of the EMVA 1288 data sheet from light levels and from series of
    frames.

    ``levels`` are the levels of the photon-transfer measurement, with temporal variances;
    ``spatial`` has the averaged frames. If ``photons_told`` is False, the light is known only up to
    a factor, and no quantity in photons is stated.

    Shapes: levels (level,); frames (y, x).
    Units:  with each quantity.
    Raises: ValueError without a dark level or without two lit levels.
    Source: EMVA Standard 1288, release 4.0 Linear.
    """
    transfer, patterns = photon_transfer(levels), spatial or Nonuniformity(None, None)
    quantities = [
        *sensitivity(transfer, photons_told),
        *general_quantities(transfer, photons_told),
        *linearity_errors(transfer),
        *dark_current(transfer),
        *nonuniformity(patterns, gain(transfer).value),
    ]
    return EmvaSheet(transfer, linearity(transfer), patterns, tuple(quantities))
