"""The likelihood of the levels of a real camera, with drift and unequal pixels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.calibrate._emva_fit import Share, without_histograms
from neusee.nodes.calibrate._sensor_likelihood import ROUNDED, Likelihood, without_details
from neusee.nodes.sensor._digitization import Rounding
from neusee.nodes.units import Efficiency, Electrons, Exposure, Gain, Real
from neusee.nodes.values import Levels

Scattered = Annotated[float, Field(ge=0, le=100)]  #: a standard deviation; 0 for none
_ITERATIONS = 40  #: of the inverse of a response that bends by less than a half
_QUIET = 0.24  #: DN2, least variance that EMVA 1288 accepts for a signal
#: DN, standard deviation below which levels keep a histogram although no number is cut off
_COARSE = 0.8


class _Camera(NamedTuple):
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


#: the parameter of `camera` for each field of `_Camera`
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
    slope: Tensor  #: DN per electron at that signal
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
    fitted, top, first = _used(levels, share)
    dark = (dark_signal, temporal_dark_noise, dark_current)
    parameters = (gain, quantum_efficiency, *dark, scatter, lamp, drift, bend, twist)
    sensor = _Camera(*(torch.as_tensor(x, dtype=torch.float64)[..., None] for x in parameters))
    sensor = sensor._replace(current=sensor.current / dark_exposure)
    residuals = _residuals(
        without_histograms(levels, fitted), top, sensor, first, ROUNDED[rounding][1]
    )
    squared = residuals.variance[0].square() + residuals.mean[0].square()
    log = -0.5 * squared - residuals.variance[1] - residuals.mean[1]
    total = log.where(residuals.possible, -torch.inf).sum(-1)
    if not told:
        return without_details(total)
    deviance = squared.new_zeros(*squared.shape[:-1], len(levels.mean)).index_copy(
        -1, fitted, squared
    )
    freedom = torch.zeros_like(levels.mean).index_fill(0, fitted, 2.0)
    # squared derivatives of a residual and of its log width sum, on average, to the Fisher
    # information
    mean = levels.mean.expand(*squared.shape[:-1], -1)
    # for the levels used
    variance = torch.zeros_like(mean).index_copy(-1, fitted, residuals.expected)
    return Likelihood(
        total,
        deviance,
        freedom,
        torch.cat([*residuals.variance, *residuals.mean], -1),
        mean,
        variance,
    )


@camera.check
def _(result: Likelihood, levels: Levels, **params: Any) -> list[Check]:
    if not len(result.degrees_of_freedom):
        return []
    off, fitted = float(result.deviance.sum()), result.degrees_of_freedom > 0
    count, coarse = int(fitted.sum()), int((levels.variance[fitted] < _QUIET).sum())
    checks = [
        Check(
            f"deviance {off:.4g} for {2 * count} means and variances, from {count} of {len(fitted)}"
            " levels"
        )
    ]
    dark = levels.photons == 0
    first, shortest = levels.exposure[fitted & dark].min(), levels.exposure[dark].min()
    if first > shortest:
        text = (
            f"the dark frames of {float(shortest):.4g} s pile up at an end: dark signal and dark"
            " noise are those of"
        )
        checks.append(Check(f"{text} {float(first):.4g} s", False))
    if coarse:
        text = (
            f"{coarse} levels with a variance below {_QUIET} DN2, where rounding is not independent"
            " noise"
        )
        checks.append(Check(text, False))
    return checks


def expected_levels(levels: Levels, params: Mapping[str, Any]) -> Levels:
    """Return measured levels with the means and variances that a camera with given parameters
    should have.

    ``params`` are the parameters of `camera`, and all numbers. Levels that `camera` leaves out stay
    as they are.

    Shapes: levels (level,) -> levels (level,), without histograms.
    Units:  those of `Levels`.
    Error:  1e-12 of the inverse of the response, which is iterated.
    Raises: ValueError as `camera`.
    Source: the model of `camera`.
    """
    fitted, top, first = _used(levels, params["share"])
    fitted_levels = without_histograms(levels, fitted)
    numbers = {
        name: torch.as_tensor(params[name], dtype=torch.float64) for name in CAMERA_PARAMETERS
    }
    sensor = _Camera(*numbers.values())
    current = sensor.current / params["dark_exposure"]
    electrons = sensor.efficiency * fitted_levels.photons + current * (
        fitted_levels.exposure - first
    )
    signal = sensor.gain * electrons
    for _ in range(_ITERATIONS):
        x = signal / top
        signal = sensor.gain * electrons * (1.0 + sensor.bend * x + sensor.twist * x.square())
    slope = _signal(signal, top, sensor).slope
    variance = slope.square() * (sensor.noise.square() + electrons) + ROUNDED[params["rounding"]][1]
    every_level = without_histograms(levels, torch.arange(len(levels.mean)))
    return every_level._replace(
        mean=every_level.mean.index_copy(0, fitted, signal + sensor.signal),
        variance=every_level.variance.index_copy(0, fitted, variance),
    )


def _residuals(
    levels: Levels, top: float, camera: _Camera, first: float, quantization: float
) -> _Residuals:
    signal = _signal(levels.mean - camera.signal, top, camera)
    variance = signal.slope.square() * (camera.noise.square() + signal.electrons) + quantization
    possible = signal.possible & (variance > quantization)
    variance = variance.where(possible, 1.0)
    width = (2.0 / levels.degrees_of_freedom + camera.scatter.square()).sqrt()
    # the mean log variance is below the log of the mean variance by one over the degrees of freedom
    off = (levels.variance.log() - variance.log() + 1.0 / levels.degrees_of_freedom) / width
    light = camera.efficiency * levels.photons
    expected = light + camera.current * (levels.exposure - first)
    error = (
        levels.variance / levels.pixels
        + camera.drift.square()
        + (camera.lamp * light * signal.slope).square()
    )
    away = (signal.electrons - expected) * signal.slope / error.sqrt()
    parts = (off, width.log(), away, 0.5 * error.log(), possible, variance)
    parts = torch.broadcast_tensors(*parts)  # type: ignore[no-untyped-call]
    return _Residuals(parts[:2], parts[2:4], *parts[4:])


def _signal(signal: Tensor, top: float, camera: _Camera) -> _Signal:
    """Convert measured signals, DN above the dark level, to electrons by the inverse of the
    camera's response.
    """
    x = signal / top
    curve = 1.0 + camera.bend * x + camera.twist * x.square()
    straight = 1.0 - camera.twist * x.square()  # curve - x dcurve/dx
    possible = (curve > 0) & (straight > 0)
    curve, straight = curve.where(possible, 1.0), straight.where(possible, 1.0)
    return _Signal(
        signal / (camera.gain * curve), camera.gain * curve.square() / straight, possible
    )


def _used(levels: Levels, share: float) -> tuple[Tensor, float, float]:
    """Return the indices of the light levels to fit, their largest signal in DN, and the
    shortest dark exposure.
    """
    dark, unclipped = levels.photons == 0, ~_piled(levels)
    if not bool((dark & unclipped).any()):
        raise ValueError(
            "no dark level is free of clipped numbers, so the offset of the camera is unknown: "
            "give frames without light"
        )
    shortest = torch.where(dark & unclipped, levels.exposure, torch.inf).argmin()
    signal = levels.mean - levels.mean[shortest]
    lit = ~dark
    if not bool(lit.any()):
        raise ValueError("there are no lit levels: give two or more different light levels")
    full = float(signal[lit][levels.variance[lit].argmax()])
    fitted = unclipped & (dark | (signal <= share * full))
    if len(set(levels.photons[fitted & lit].tolist())) < 2:
        raise ValueError(
            f"{int((fitted & lit).sum())} lit level(s) below {share:.0%} of saturation ({full:.4g}"
            " DN above the dark level): give two or more different light levels there"
        )
    top = float(signal[fitted].max())
    if top <= 0:
        raise ValueError(
            f"the brightest level is {top:.4g} DN above the dark level, which must be positive:"
            " check `photons` of each level"
        )
    if bool((levels.variance[fitted] <= 0).any()):
        wrong_level = int(fitted.nonzero().squeeze(1)[(levels.variance[fitted] <= 0).nonzero()[0]])
        raise ValueError(
            f"level {wrong_level}, of {float(levels.mean[wrong_level]):.4g} DN, has no variance:"
            " give frames whose noise exceeds rounding"
        )
    return fitted.nonzero().squeeze(1), top, float(levels.exposure[shortest])


def _piled(levels: Levels) -> Tensor:
    """Return a mask of the light levels with a histogram because numbers pile up at an end of
    the range.
    """
    counted, at_zero = (torch.zeros_like(levels.mean, dtype=torch.bool) for _ in range(2))
    counted[levels.cell_level] = True
    at_zero[levels.cell_level[levels.cell_value == 0]] = True
    return counted & (at_zero | (levels.variance >= _COARSE**2))
