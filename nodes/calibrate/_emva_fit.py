"""A least-squares fit of the linear camera model, as EMVA 1288 prescribes; slower fits start
from this estimate.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.values import Levels

Share = Annotated[float, Field(gt=0, le=1)]
_QUANTIZATION = 1.0 / 12.0  #: DN2, of rounding to the nearest number


class LeastSquares(NamedTuple):
    """The results of a photon-transfer measurement, float64 scalars; errors are standard errors
    from noise alone.
    """

    gain: Tensor  #: K, DN/e-
    efficiency: Tensor  #: electrons per photon
    temporal_dark_noise: Tensor  #: sigma_d, e-
    dark_signal: Tensor  #: dark signal of the shortest exposure, DN
    dark_current: Tensor  #: e-/s; NaN where all dark levels have the same exposure
    saturation: Tensor  #: electrons in the level of the largest variance, without the dark signal
    gain_error: Tensor
    efficiency_error: Tensor
    temporal_dark_noise_error: Tensor
    fitted: Tensor  #: number of lit levels in both fits


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
        _error(mean[fitted_index], lit_variance, dark_variance, nearest_dark[fitted_index]) / gain
    )
    # variance of a mean over all pixels
    lit_variance, dark_variance = (
        (x.variance / x.pixels)[fitted_index] for x in (lit_levels, darks_of_lit)
    )
    responsivity_error = (
        _error(
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
    """Raise ValueError unless one level is ``dark``, (level,) bool, and two are lit."""
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
    """Raise ValueError unless both slopes of a camera are positive."""
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
    """Return the light levels that an index or a mask selects, without their histograms."""
    return Levels._make([*(x[which] for x in levels[:6]), *(x[:0] for x in levels[6:])])


def _slope(x: Tensor, y: Tensor) -> Tensor:
    """Return the slope of the line through the origin that fits the points (x, y) best."""
    return (x @ y) / (x @ x)


def _error(x: Tensor, own: Tensor, dark: Tensor, which: Tensor) -> Tensor:
    """Return the standard error of the slope (x y) / (x x) of a line through the origin.

    ``own`` is the variance of each lit value, ``dark`` that of the dark value subtracted from it.
    ``which`` is the number of this dark level: points with the same one share its error.
    """
    dark_errors = torch.zeros(int(which.max()) + 1, dtype=x.dtype, device=x.device).index_add_(
        0, which, x * dark.sqrt()
    )
    return (x.square() @ own + dark_errors.square().sum()).sqrt() / (x @ x)


def _shortest_dark(levels: Levels, dark: Tensor) -> Tensor:
    """Return the index of the dark level of the shortest exposure."""
    return torch.where(dark, levels.exposure, math.inf).argmin()


def _dark_noise(levels: Levels, dark: Tensor) -> tuple[Tensor, Tensor]:
    """Return the temporal dark noise without rounding noise and its standard error (infinite for
    0 noise), in DN.
    """
    variance, freedom = (
        x[_shortest_dark(levels, dark)] for x in (levels.variance, levels.degrees_of_freedom)
    )
    noise = (variance - _QUANTIZATION).clamp_min(0.0).sqrt()
    # d(sqrt(v)) = dv / (2 sqrt(v)), with the relative error sqrt(2 / nu) of v
    return noise, torch.where(noise > 0, variance / (2 * freedom).sqrt() / noise, math.inf)


def _dark_current(levels: Levels, dark: Tensor) -> Tensor:
    """Return the slope of the dark signal over exposure, DN/s, or NaN if all dark levels have
    the same exposure.
    """
    time, signal = levels.exposure[dark], levels.mean[dark]
    centred_time = time - time.mean()
    return torch.where(
        time.max() > time.min(), (centred_time @ signal) / (centred_time @ centred_time), math.nan
    )
