"""What would have been found, had one parameter been known half as well beforehand: the same draws, weighed anew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from neusee.workflows.calibration.log_posterior import SensorPosterior

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import Places

ENOUGH = 0.5  #: share of the draws that must be left; of a parameter that only its prior tells it is a quarter or less
_TAIL = 0.05  #: beyond a limit


@dataclass(frozen=True)
class Finding:
    """What the draws say of a parameter, in its unit."""

    name: str
    kind: str  #: of `_posterior_weak.KINDS`; of `upper` and `lower` the value is a limit of 95 %
    value: float
    sd: float
    doubled: Mapping[str, float | None]  #: by the prior that is made twice as wide; None where reweighing cannot tell


@dataclass(frozen=True)
class Sensitivity:
    """Of all parameters, by the width of each one's prior."""

    findings: Sequence[Finding]
    left: Mapping[str, float]  #: share of the draws that is left by weighing for that prior, as independent ones


def sensitivity(problem: SensorPosterior, places: Places, kinds: Mapping[str, str]) -> Sensitivity:
    """Of draws (draw, free) that hardly depend on each other."""
    values = {name: x.numpy() for name, x in problem.parameters(places).items()}
    z = problem.whitened(places)
    weights = {name: _weights(z[:, i]) for i, name in enumerate(problem.names)}
    left = {name: float(1.0 / (w @ w) / len(w)) for name, w in weights.items()}
    even = np.full(len(places), 1.0 / len(places))

    def found(name: str) -> Finding:
        x, kind = values[name], kinds[name]
        again = {by: _value(x, w, kind) if left[by] >= ENOUGH else None for by, w in weights.items()}
        return Finding(name, kind, _value(x, even, kind), float(x.std(ddof=1)), again)

    return Sensitivity([found(name) for name in problem.names], left)


def _weights(z: Places) -> Places:
    """Of a normal law of twice the width by one of the width, at z standard deviations; they add up to one."""
    log = 0.5 * (1.0 - 0.25) * z**2
    weights = np.exp(log - log.max())
    found: Places = weights / weights.sum()
    return found


def _value(x: Places, weights: Places, kind: str) -> float:
    """The mean; of what is only limited, the limit."""
    if kind not in ("upper", "lower"):
        return float(weights @ x)
    order = np.argsort(x)
    share = 1.0 - _TAIL if kind == "upper" else _TAIL
    at = int(np.searchsorted(np.cumsum(weights[order]), share))
    return float(x[order[min(at, len(x) - 1)]])
