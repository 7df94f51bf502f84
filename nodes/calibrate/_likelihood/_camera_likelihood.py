"""Likelihood of the levels of a real camera, with a drifting lamp, unequal pixels and a slight non-linearity."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.calibrate._emva_fit import Share
from neusee.nodes.calibrate._likelihood._linear_sensor import ROUNDED, Likelihood
from neusee.nodes.sensor._digitization import Rounding
from neusee.nodes.sensor._saturation import Efficiency
from neusee.nodes.units import Electrons, Gain, Real, Time
from neusee.nodes.values import Levels

Scattered = Annotated[float, Field(ge=0, allow_inf_nan=False)]  #: a standard deviation; 0 for none
_QUIET = 0.24  #: DN2, least variance that EMVA 1288 accepts for a signal
_COARSE = 0.8  #: DN, standard deviation below which levels keep a histogram although no number is cut off


class _Camera(NamedTuple):
    """The parameters of a camera; all (..., 1) float64."""

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


class _Seen(NamedTuple):
    """The electrons that the measured means stand for in one camera; all (..., level)."""

    electrons: Tensor  #: electrons above the shortest dark level
    slope: Tensor  #: DN per electron at that signal
    possible: Tensor  #: whether the response rises


class _Told(NamedTuple):
    """Pairs (..., level): measured minus expected value in standard deviations, and the log standard deviation."""

    variance: tuple[Tensor, Tensor]
    mean: tuple[Tensor, Tensor]
    possible: Tensor
    law: Tensor  #: the expected variance, DN2


@node()
def camera(
    levels: Levels,
    *,
    gain: Gain,
    quantum_efficiency: Efficiency,
    dark_signal: Real,
    temporal_dark_noise: Electrons,
    dark_current: Electrons = 0.0,
    dark_exposure: Time = 1.0,
    scatter: Scattered = 0.003,
    lamp: Scattered = 0.01,
    drift: Scattered = 0.0,
    bend: Real = 0.0,
    twist: Real = 0.0,
    rounding: Rounding = "nearest",
    share: Share = 0.7,
    told: bool = True,
) -> Likelihood:
    """Compute the likelihood of a real camera's levels: variances given the means, and means given a drifting lamp.

    A mean of y DN above the dark stands for e electrons, y = K e (1 + bend x + twist x**2), where x is y over the y of
    the brightest level used. Then ln(variance) is normal about ln((dy/de)**2 (temporal_dark_noise**2 + e) + rounding),
    however the lamp drifts, and e is normal about quantum_efficiency * photons + dark_current * (exposure - shortest
    dark). A dark level is a level without photons. Three standard deviations are not measured within a level:
    ``scatter`` of every variance beyond chance (relative), ``lamp`` of the light (relative), and ``drift`` of the dark
    signal (DN). Each stands for one normal distribution over all levels, and may be held or free like any parameter.
    Two kinds of levels are excluded: levels brighter than ``share`` of saturation, where saturation is the level of the
    greatest variance, and levels whose numbers pile up at an end. Any number may be a tensor (walker,).

    Shapes: levels -> log (walker,), deviance (walker, level), scaled (walker, row).
    Units:  gain K, DN/e-, at no signal; dark_signal DN and temporal_dark_noise e- of the shortest dark; dark_current
            e- in ``dark_exposure``; log in nats, for means in DN and logarithms of variances.
    Error:  levels count as independent, and photons as exact except for ``lamp``: a common error of all photons becomes
            an error of the efficiency. The variance must be temporal, without flicker of the lamp within a pair
            (`steady`). Pixels that differ by 1 % then shift the gain by 1e-4. A response that is not a parabola is left
            to `spread` of the posterior. Below 0.24 DN2 rounding is not independent noise: a temporal dark noise of
            0.2 DN is estimated wrongly.
    Raises: ValueError without a dark level, without two levels of different light below saturation, for a level
            without variance, and where more light does not raise the signal.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 2 and 6.6 (photon transfer); Janesick, Photon Transfer.
    """
    seen, top, first = _used(levels, share)
    dark = (dark_signal, temporal_dark_noise, dark_current)
    given = (gain, quantum_efficiency, *dark, scatter, lamp, drift, bend, twist)
    columns = [torch.as_tensor(x, dtype=torch.float64)[..., None] for x in given]
    made = _Camera(*columns)
    made = made._replace(current=made.current / dark_exposure)
    found = _told(_only(levels, seen), top, made, first, ROUNDED[rounding][1])
    each = found.variance[0].square() + found.mean[0].square()
    log = -0.5 * each - found.variance[1] - found.mean[1]
    total = log.where(found.possible, -torch.inf).sum(-1)
    if not told:
        return Likelihood(total, *(torch.zeros(0, dtype=torch.float64) for _ in range(5)))
    deviance = each.new_zeros(*each.shape[:-1], len(levels.mean)).index_copy(-1, seen, each)
    freedom = torch.zeros_like(levels.mean).index_fill(0, seen, 2.0)
    # squared derivatives of a residual and of its log width sum, on average, to the Fisher information
    mean = levels.mean.expand(*each.shape[:-1], -1)
    variance = torch.zeros_like(mean).index_copy(-1, seen, found.law)  # for the levels used
    return Likelihood(total, deviance, freedom, torch.cat([*found.variance, *found.mean], -1), mean, variance)


@camera.check
def _(result: Likelihood, levels: Levels, **params: Any) -> list[Check]:
    if not len(result.degrees_of_freedom):
        return []
    off, used = float(result.deviance.sum()), result.degrees_of_freedom > 0
    count, coarse = int(used.sum()), int((levels.variance[used] < _QUIET).sum())
    said = [Check(f"deviance {off:.4g} of {2 * count} means and variances, {count} of {len(used)} levels")]
    if coarse:
        said.append(Check(f"{coarse} levels of less than {_QUIET} DN2, where rounding is not independent noise", False))
    return said


def _told(levels: Levels, top: float, camera: _Camera, first: float, quantization: float) -> _Told:
    seen = _seen(levels.mean - camera.signal, top, camera)
    law = seen.slope.square() * (camera.noise.square() + seen.electrons) + quantization
    possible = seen.possible & (law > quantization)
    law = law.where(possible, 1.0)
    width = (2.0 / levels.degrees_of_freedom + camera.scatter.square()).sqrt()
    # the mean log variance is below the log of the mean variance by one over the degrees of freedom
    off = (levels.variance.log() - law.log() + 1.0 / levels.degrees_of_freedom) / width
    light = camera.efficiency * levels.photons
    expected = light + camera.current * (levels.exposure - first)
    error = levels.variance / levels.pixels + camera.drift.square() + (camera.lamp * light * seen.slope).square()
    away = (seen.electrons - expected) * seen.slope / error.sqrt()
    parts = (off, width.log(), away, 0.5 * error.log(), possible, law)
    told = torch.broadcast_tensors(*parts)  # type: ignore[no-untyped-call]
    return _Told((told[0], told[1]), (told[2], told[3]), told[4], told[5])


def _seen(signal: Tensor, top: float, camera: _Camera) -> _Seen:
    """Solve the response for electrons; with x from the measured signal no iteration is needed."""
    x = signal / top
    curve = 1.0 + camera.bend * x + camera.twist * x.square()
    straight = 1.0 - camera.twist * x.square()  # curve - x dcurve/dx
    possible = (curve > 0) & (straight > 0)
    curve, straight = curve.where(possible, 1.0), straight.where(possible, 1.0)
    return _Seen(signal / (camera.gain * curve), camera.gain * curve.square() / straight, possible)


def _used(levels: Levels, share: float) -> tuple[Tensor, float, float]:
    """Return the levels used, the signal of the brightest level used, DN, and the exposure of the shortest dark."""
    dark, whole = levels.photons == 0, ~_piled(levels)
    if not bool((dark & whole).any()):
        raise ValueError("no dark level without clipped numbers, so that the offset of the camera is not known: "
                         "give frames without light")  # fmt: skip
    shortest = torch.where(dark & whole, levels.exposure, torch.inf).argmin()
    signal = levels.mean - levels.mean[shortest]
    lit = ~dark
    if not bool(lit.any()):
        raise ValueError("0 lit levels: give two or more of different light")
    full = float(signal[lit][levels.variance[lit].argmax()])
    used = whole & (dark | (signal <= share * full))
    if len(set(levels.photons[used & lit].tolist())) < 2:
        raise ValueError(f"{int((used & lit).sum())} lit level(s) below {share:.0%} of saturation, {full:.4g} DN above "
                         "the dark: give two or more of different light there")  # fmt: skip
    top = float(signal[used].max())
    if top <= 0:
        raise ValueError(f"the brightest level is {top:.4g} DN above the dark: check that the light belongs "
                         "to the levels")  # fmt: skip
    if bool((levels.variance[used] <= 0).any()):
        at = int(used.nonzero().squeeze(1)[(levels.variance[used] <= 0).nonzero()[0]])
        raise ValueError(f"level {at}, of {float(levels.mean[at]):.4g} DN, has no variance: give frames whose noise "
                         "exceeds rounding")  # fmt: skip
    return used.nonzero().squeeze(1), top, float(levels.exposure[shortest])


def _piled(levels: Levels) -> Tensor:
    """Mark the levels whose histogram is kept because numbers pile up at an end, not because numbers are coarse."""
    counted, at_zero = (torch.zeros_like(levels.mean, dtype=torch.bool) for _ in range(2))
    counted[levels.cell_level] = True
    at_zero[levels.cell_level[levels.cell_value == 0]] = True
    return counted & (at_zero | (levels.variance >= _COARSE**2))


def _only(levels: Levels, which: Tensor) -> Levels:
    return Levels._make([*(x[which] for x in levels[:6]), *(x[:0] for x in levels[6:])])
