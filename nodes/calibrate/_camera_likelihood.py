"""The likelihood of the light levels of a real camera, whose lamp drifts and whose pixels
differ.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.calibrate._emva_quantities import LEAST_DARK_VARIANCE
from neusee.nodes.calibrate._emva_sheet import Share, without_histograms
from neusee.nodes.calibrate._light_levels import COARSE_DEVIATION
from neusee.nodes.calibrate._sensor_likelihood import ROUNDED, Likelihood, without_details
from neusee.nodes.sensor._digitization import Rounding
from neusee.nodes.units import Efficiency, Electrons, Exposure, Gain, Real
from neusee.nodes.values import Levels

Scattered = Annotated[float, Field(ge=0, le=100)]  #: a standard deviation; 0 for none
_ITERATIONS = 40  #: fixed-point iterations that invert a response that bends by less than a half


class CameraValues(NamedTuple):
    """The parameters of a camera; each tensor is (..., 1) float64."""

    gain: Tensor  #: K at no signal, DN/e-
    efficiency: Tensor
    signal: Tensor  #: DN in the dark
    noise: Tensor  #: e- in the dark
    current: Tensor  #: e-/s
    scatter: Tensor
    lamp: Tensor
    drift: Tensor  #: DN
    bend: Tensor
    twist: Tensor


#: the parameter of `camera` for each field of `CameraValues`
CAMERA_PARAMETERS = (
    "gain",
    "quantum_efficiency",
    "dark_signal",
    "temporal_dark_noise",
    "dark_current",
    "scatter",
    "lamp",
    "drift",
    "bend",
    "twist",
)


class _Signal(NamedTuple):
    """The measured means, converted to electrons by the response of a camera; each tensor is
    (..., level).
    """

    electrons: Tensor  #: electrons above the shortest dark level
    slope: Tensor  #: derivative of the response at that signal, DN per electron
    possible: Tensor  #: True if the response rises


class _Residuals(NamedTuple):
    """The residuals of the measured levels in standard deviations; each tensor is (..., level)."""

    #: the residual of the log variance, and its log standard deviation
    variance: tuple[Tensor, Tensor]
    mean: tuple[Tensor, Tensor]  #: the residual of the mean, and its log standard deviation
    possible: Tensor
    expected: Tensor  #: the expected variance, DN2


@node()
def camera(
    levels: Levels,
    *,
    gain: Gain,
    quantum_efficiency: Efficiency,
    dark_signal: Real,
    temporal_dark_noise: Electrons,
    dark_current: Electrons = 0.0,
    dark_exposure: Exposure = 1.0,
    scatter: Scattered = 0.003,
    lamp: Scattered = 0.01,
    drift: Scattered = 0.0,
    bend: Real = 0.0,
    twist: Real = 0.0,
    rounding: Rounding = "nearest",
    share: Share = 0.7,
    told: bool = True,
) -> Likelihood:
    """Compute the likelihood of the means and variances that a real camera measures under a
    drifting lamp.

    A mean of y DN above the dark stands for e electrons, y = K e (1 + bend x + twist x**2), where x
    is y over the y of the brightest level used. Then ln(variance) is normal about ln((dy/de)**2
    (temporal_dark_noise**2 + e) + rounding), however the lamp drifts, and e is normal about
    quantum_efficiency * photons + dark_current * (exposure - shortest dark). A dark level is a
    level without photons. Three standard deviations are not measured within a level: ``scatter`` of
    every variance beyond chance (relative), ``lamp`` of the light (relative), and ``drift`` of the
    dark signal (DN). Each is the width of one normal distribution over all levels, and may be held
    or free like any parameter. Levels brighter than ``share`` of saturation are excluded, where
    saturation is the level of the greatest variance, and so are levels whose numbers pile up at an
    end. Any number may be a tensor (walker,). ``told`` adds deviances and the rows of the Fisher
    information, which a sampler does not need.

    Shapes: levels -> log (walker,), deviance (walker, level), scaled (walker, row).
    Units:  gain K, DN/e-, at no signal; dark_signal DN and temporal_dark_noise e- of the shortest
            dark; dark_current e- in ``dark_exposure``; log in nats, for means in DN and logarithms
            of variances.
    Error:  levels count as independent, and photons as exact except for ``lamp``: a common error of
            all photons becomes an error of the efficiency. The variance must be temporal, without
            flicker of the lamp within a pair (`steady`). Pixels that differ by 1 % then shift the
            gain by 1e-4. A response that is not a parabola is left to `spread` of the posterior.
            Below 0.24 DN2 rounding is not independent noise: a temporal dark noise of 0.2 DN is
            estimated wrongly.
    Raises: ValueError without a dark level, without two levels of different light below saturation,
            for a level without variance, and where more light does not raise the signal.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 2 and 6.6 (photon transfer); Janesick,
            Photon Transfer.
    """
    fitted_index, largest_signal, shortest_dark = levels_to_fit(levels, share)
    dark = (dark_signal, temporal_dark_noise, dark_current)
    parameters = (gain, quantum_efficiency, *dark, scatter, lamp, drift, bend, twist)
    sensor = CameraValues(*(torch.as_tensor(x, dtype=torch.float64)[..., None] for x in parameters))
    sensor = sensor._replace(current=sensor.current / dark_exposure)
    # index 1 of `ROUNDED` is the variance that rounding adds, DN2
    residuals = _residuals(
        without_histograms(levels, fitted_index),
        largest_signal,
        sensor,
        shortest_dark,
        ROUNDED[rounding][1],
    )
    squared_residuals = residuals.variance[0].square() + residuals.mean[0].square()
    # two normal densities a level: of its log variance and of its mean
    log_of_level = -0.5 * squared_residuals - residuals.variance[1] - residuals.mean[1]
    log_likelihood = log_of_level.where(residuals.possible, -torch.inf).sum(-1)
    if not told:
        return without_details(log_likelihood)
    deviance = squared_residuals.new_zeros(
        *squared_residuals.shape[:-1], len(levels.mean)
    ).index_copy(-1, fitted_index, squared_residuals)
    # two observations in each level used: its mean and its variance
    degrees_of_freedom = torch.zeros_like(levels.mean).index_fill(0, fitted_index, 2.0)
    # the expected Fisher information is the sum of squared derivatives of each residual and of its
    # log width
    mean = levels.mean.expand(*squared_residuals.shape[:-1], -1)
    # expected variances of the fitted levels; 0 for the others
    variance = torch.zeros_like(mean).index_copy(-1, fitted_index, residuals.expected)
    return Likelihood(
        log_likelihood,
        deviance,
        degrees_of_freedom,
        torch.cat([*residuals.variance, *residuals.mean], -1),
        mean,
        variance,
    )


@camera.check
def _(result: Likelihood, levels: Levels, **params: Any) -> list[Check]:
    if not len(result.degrees_of_freedom):
        return []
    deviance, fitted = float(result.deviance.sum()), result.degrees_of_freedom > 0
    count, coarse_count = (
        int(fitted.sum()),
        int((levels.variance[fitted] < LEAST_DARK_VARIANCE).sum()),
    )
    checks = [
        Check(
            f"deviance {deviance:.4g} for {2 * count} means and variances, from {count} of"
            f" {len(fitted)} levels"
        )
    ]
    dark = levels.photons == 0
    shortest_fitted, shortest = levels.exposure[fitted & dark].min(), levels.exposure[dark].min()
    if shortest_fitted > shortest:
        text = (
            f"the dark frames of {float(shortest):.4g} s pile up at an end: dark signal and dark"
            " noise are those of"
        )
        checks.append(Check(f"{text} {float(shortest_fitted):.4g} s", False))
    if coarse_count:
        text = (
            f"{coarse_count} levels with a variance below {LEAST_DARK_VARIANCE} DN2, where rounding"
            " is not independent noise"
        )
        checks.append(Check(text, False))
    return checks


def expected_levels(levels: Levels, params: Mapping[str, Any]) -> Levels:
    """Return the measured levels with their means and variances replaced by those that the camera
    model expects.

    ``params`` are the parameters of `camera`, each a number. Levels that `camera` excludes from the
    fit keep their measured values.

    Shapes: levels (level,) -> levels (level,), without histograms.
    Units:  those of `Levels`.
    Error:  1e-12 of the inverse of the response, which is iterated.
    Raises: ValueError as `camera`.
    Source: the model of `camera`.
    """
    fitted_index, largest_signal, shortest_dark = levels_to_fit(levels, params["share"])
    fitted_levels = without_histograms(levels, fitted_index)
    parameters = {
        name: torch.as_tensor(params[name], dtype=torch.float64) for name in CAMERA_PARAMETERS
    }
    sensor = CameraValues(*parameters.values())
    current = sensor.current / params["dark_exposure"]
    electrons = sensor.efficiency * fitted_levels.photons + current * (
        fitted_levels.exposure - shortest_dark
    )
    signal = sensor.gain * electrons
    # fixed point of the response y = K e (1 + bend x + twist x^2), where x depends on y
    for _ in range(_ITERATIONS):
        share_of_largest = signal / largest_signal
        signal = (
            sensor.gain
            * electrons
            * (1.0 + sensor.bend * share_of_largest + sensor.twist * share_of_largest.square())
        )
    slope = camera_signal(signal, largest_signal, sensor).slope
    variance = slope.square() * (sensor.noise.square() + electrons) + ROUNDED[params["rounding"]][1]
    all_levels = without_histograms(levels, torch.arange(len(levels.mean)))
    return all_levels._replace(
        mean=all_levels.mean.index_copy(0, fitted_index, signal + sensor.signal),
        variance=all_levels.variance.index_copy(0, fitted_index, variance),
    )


def _residuals(
    levels: Levels, top: float, camera: CameraValues, first: float, quantization: float
) -> _Residuals:
    """Return the residuals of the measured log variances and means in standard deviations, with
    the logarithms of these standard deviations.

    ``top`` is the largest signal used and ``quantization`` the variance of rounding (DN, DN2),
    ``first`` the shortest dark exposure in s.
    """
    signal = camera_signal(levels.mean - camera.signal, top, camera)
    variance = signal.slope.square() * (camera.noise.square() + signal.electrons) + quantization
    possible = signal.possible & (variance > quantization)
    variance = variance.where(possible, 1.0)
    # a variance of nu degrees of freedom has the relative variance 2 / nu
    log_variance_width = (2.0 / levels.degrees_of_freedom + camera.scatter.square()).sqrt()
    # the expectation of a log sample variance is ln(variance) - 1 / nu, to first order in 1 / nu
    variance_residual = (
        levels.variance.log() - variance.log() + 1.0 / levels.degrees_of_freedom
    ) / log_variance_width
    expected_light = camera.efficiency * levels.photons
    expected_electrons = expected_light + camera.current * (levels.exposure - first)
    variance_of_mean = (
        levels.variance / levels.pixels
        + camera.drift.square()
        + (camera.lamp * expected_light * signal.slope).square()
    )
    mean_residual = (signal.electrons - expected_electrons) * signal.slope / variance_of_mean.sqrt()
    # two fields of pairs, then two single fields of `_Residuals`
    columns = (
        variance_residual,
        log_variance_width.log(),
        mean_residual,
        0.5 * variance_of_mean.log(),
        possible,
        variance,
    )
    columns = torch.broadcast_tensors(*columns)  # type: ignore[no-untyped-call]
    return _Residuals(columns[:2], columns[2:4], *columns[4:])


def camera_signal(signal: Tensor, top: float, camera: CameraValues) -> _Signal:
    """Convert measured signals, DN above the dark level, to electrons by the inverse of the
    camera's response.
    """
    share_of_top = signal / top
    response = 1.0 + camera.bend * share_of_top + camera.twist * share_of_top.square()
    slope_term = 1.0 - camera.twist * share_of_top.square()  # response - x dresponse/dx
    possible = (response > 0) & (slope_term > 0)
    response, slope_term = response.where(possible, 1.0), slope_term.where(possible, 1.0)
    return _Signal(
        # with y = K e c(x): e = y / (K c), dy/de = K c^2 / (c - x dc/dx)
        signal / (camera.gain * response),
        camera.gain * response.square() / slope_term,
        possible,
    )


def levels_to_fit(levels: Levels, share: float) -> tuple[Tensor, float, float]:
    """Return the indices of the levels to fit, the largest signal above the dark among them in DN,
    and the shortest dark exposure in s.
    """
    is_dark, unclipped = levels.photons == 0, ~_piles_up(levels)
    if not bool((is_dark & unclipped).any()):
        raise ValueError(
            "no dark level is free of clipped numbers, so the offset of the camera is unknown: "
            "give frames without light"
        )
    shortest = torch.where(is_dark & unclipped, levels.exposure, torch.inf).argmin()
    signal = levels.mean - levels.mean[shortest]
    is_lit = ~is_dark
    if not bool(is_lit.any()):
        raise ValueError("there are no lit levels: give two or more different light levels")
    # saturation: the signal of the lit level of the greatest variance
    saturation_signal = float(signal[is_lit][levels.variance[is_lit].argmax()])
    fitted = unclipped & (is_dark | (signal <= share * saturation_signal))
    if len(set(levels.photons[fitted & is_lit].tolist())) < 2:
        raise ValueError(
            f"{int((fitted & is_lit).sum())} lit level(s) below {share:.0%} of saturation"
            f" ({saturation_signal:.4g} DN above the dark level): give two or more different light"
            " levels there"
        )
    largest_signal = float(signal[fitted].max())
    if largest_signal <= 0:
        raise ValueError(
            f"the brightest level is {largest_signal:.4g} DN above the dark level, which must be"
            " positive: check `photons` of each level"
        )
    if bool((levels.variance[fitted] <= 0).any()):
        wrong_level = int(fitted.nonzero().squeeze(1)[(levels.variance[fitted] <= 0).nonzero()[0]])
        raise ValueError(
            f"level {wrong_level}, of {float(levels.mean[wrong_level]):.4g} DN, has no variance:"
            " give frames whose noise exceeds rounding"
        )
    return fitted.nonzero().squeeze(1), largest_signal, float(levels.exposure[shortest])


def _piles_up(levels: Levels) -> Tensor:
    """Return a mask (level,) of the levels in which digital numbers pile up at an end of the range
    (clipping).

    Such a level has a histogram. A level without the number 0 and with a small variance has a
    histogram only because its numbers are coarse; it is not clipped.
    """
    has_histogram, has_zero = (torch.zeros_like(levels.mean, dtype=torch.bool) for _ in range(2))
    has_histogram[levels.cell_level] = True
    has_zero[levels.cell_level[levels.cell_value == 0]] = True
    return has_histogram & (has_zero | (levels.variance >= COARSE_DEVIATION**2))
