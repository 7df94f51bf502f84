"""Sensitivity of a posterior to its prior, by reweighting of draws to a prior that is twice as wide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.studies.calibration.independent_draws import FloatArray

ENOUGH = 0.5  #: least effective sample fraction; a parameter that only its prior constrains has a quarter or less
_TAIL = 0.05  #: probability beyond a limit


@dataclass(frozen=True)
class ParameterSensitivity:
    """The estimate of one parameter, and its estimates after the prior of each parameter is made twice as wide."""

    name: str
    kind: str  #: one of `identifiability.KINDS`; for `upper` and `lower` the value is a limit of 95 %
    value: float
    sd: float
    doubled: Mapping[str, float | None]  #: by the prior that is twice as wide; None where reweighting is unreliable


@dataclass(frozen=True)
class Sensitivity:
    """The sensitivity of the estimates of all parameters to the width of each prior."""

    findings: Sequence[ParameterSensitivity]
    left: Mapping[str, float]  #: effective sample fraction with each prior twice as wide


def sensitivity(problem: SensorPosterior, samples: FloatArray, kinds: Mapping[str, str]) -> Sensitivity:
    """Return the sensitivity of each parameter to each prior, from draws ``samples`` (draw, free parameter)."""
    values = {name: x.numpy() for name, x in problem.parameters(samples).items()}
    z = problem.whitened(samples)
    weights = {name: _weights(z[:, i]) for i, name in enumerate(problem.names)}
    left = {name: float(1.0 / (w @ w) / len(w)) for name, w in weights.items()}
    even = np.full(len(samples), 1.0 / len(samples))

    def of(name: str) -> ParameterSensitivity:
        x, kind = values[name], kinds[name]
        again = {by: _value(x, w, kind) if left[by] >= ENOUGH else None for by, w in weights.items()}
        return ParameterSensitivity(name, kind, _value(x, even, kind), float(x.std(ddof=1)), again)

    return Sensitivity([of(name) for name in problem.names], left)


def _weights(z: FloatArray) -> FloatArray:
    """Return normalised importance weights of draws ``z`` for a normal prior of standard deviation 2 instead of 1."""
    log = 0.5 * (1.0 - 0.25) * z**2
    ratios = np.exp(log - log.max())
    weights: FloatArray = ratios / ratios.sum()
    return weights


def _value(x: FloatArray, weights: FloatArray, kind: str) -> float:
    """Return the weighted mean of the draws ``x``, or their 95 % limit if the frames only limit the parameter."""
    if kind not in ("upper", "lower"):
        return float(weights @ x)
    order = np.argsort(x)
    share = 1.0 - _TAIL if kind == "upper" else _TAIL
    at = int(np.searchsorted(np.cumsum(weights[order]), share))
    return float(x[order[min(at, len(x) - 1)]])
