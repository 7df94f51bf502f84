"""Sensitivity to the prior: the same draws, reweighted as if one prior had been twice as wide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from neusee.workflows.calibration.log_posterior import SensorPosterior

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import FloatArray

ENOUGH = 0.5  #: least effective sample fraction; a parameter that only its prior constrains has a quarter or less
_TAIL = 0.05  #: beyond a limit


@dataclass(frozen=True)
class ParameterSensitivity:
    """The value of a parameter, in its unit, and its value under wider priors."""

    name: str
    kind: str  #: of `identifiability.KINDS`; of `upper` and `lower` the value is a limit of 95 %
    value: float
    sd: float
    doubled: Mapping[str, float | None]  #: by the prior that is made twice as wide; None where reweighing cannot tell


@dataclass(frozen=True)
class Sensitivity:
    """The sensitivity of all parameters to the width of each prior."""

    findings: Sequence[ParameterSensitivity]
    left: Mapping[str, float]  #: effective sample fraction after reweighting for each prior


def sensitivity(problem: SensorPosterior, samples: FloatArray, kinds: Mapping[str, str]) -> Sensitivity:
    """Return the sensitivity from nearly independent draws (draw, free)."""
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
    """Return weights that sum to one: a normal distribution of twice the width over one of the width, at z."""
    log = 0.5 * (1.0 - 0.25) * z**2
    weights = np.exp(log - log.max())
    found: FloatArray = weights / weights.sum()
    return found


def _value(x: FloatArray, weights: FloatArray, kind: str) -> float:
    """Return the mean; for a parameter that is only limited, the limit."""
    if kind not in ("upper", "lower"):
        return float(weights @ x)
    order = np.argsort(x)
    share = 1.0 - _TAIL if kind == "upper" else _TAIL
    at = int(np.searchsorted(np.cumsum(weights[order]), share))
    return float(x[order[min(at, len(x) - 1)]])
