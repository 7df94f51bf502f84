"""The most likely values of all lasers and lamps of a frame at once, by steps of Gauss and Newton."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.restore._lasers._components import Lamp, Laser
from neusee.nodes.restore._lasers._whitening import Filter, Weights

Parts = tuple[Laser | Lamp, ...]
_DAMPED = (0.0, 1e-3, 1e-1, 10.0)  #: factors of the diagonal, tried in this order until a step lowers the misfit


_ENOUGH = 0.02  #: log likelihood, a smaller gain of which ends the steps


class Fit(NamedTuple):
    """Lasers and lamps, and how well they explain a frame."""

    parts: Parts
    misfit: float  #: half the sum of squares of the white residual and of the errors of responses
    normal: Tensor  #: (value, value), matrix of second derivatives of the misfit
    columns: Tensor  #: (value, number), slopes of the white residual
    rest: Tensor  #: (number,), the white residual


def fitted(electrons: Tensor, parts: Sequence[Laser | Lamp], use: Filter, weights: Weights, steps: int) -> Fit:
    """Return the parts after at most ``steps`` steps, each of which lowers the misfit."""
    now = tuple(parts)
    rest, misfit = _misfit(electrons, now, use, weights)
    for number in range(steps + 1):
        columns = torch.cat([weights(use(part.columns())).flatten(1) for part in now])
        prior = torch.cat([part.precision for part in now])
        normal = (columns @ columns.T + prior.diag()).double()
        if number == steps:
            break
        slope = columns @ rest - prior * torch.cat([part.values * (part.precision > 0) for part in now])
        better = _step(electrons, now, use, weights, normal, slope, misfit)
        if better is None:
            break
        now, new, rest = better
        misfit, gained = new, misfit - new
        if gained < _ENOUGH:
            columns = torch.cat([weights(use(part.columns())).flatten(1) for part in now])
            normal = (columns @ columns.T + prior.diag()).double()
            break
    return Fit(now, misfit, normal, columns, rest)


def _step(
    electrons: Tensor, now: Parts, use: Filter, weights: Weights, normal: Tensor, slope: Tensor, misfit: float
) -> tuple[Parts, float, Tensor] | None:
    """Return the parts after one step, their misfit and residual; None if no step lowers the misfit."""
    sizes = [len(part.values) for part in now]
    for damping in _DAMPED:
        step = solved(normal + damping * normal.diagonal().diag(), slope).to(slope)
        moved = tuple(part.moved(own) for part, own in zip(now, torch.split(step, sizes), strict=True))
        rest, new = _misfit(electrons, moved, use, weights)
        if new < misfit:
            return moved, new, rest
    return None


def solved(normal: Tensor, right: Tensor) -> Tensor:
    """Solve a normal system, whose values have any scale, in spite of values that nothing tells."""
    scale = normal.diagonal().clamp_min(1e-30).rsqrt()
    even = scale[:, None] * normal * scale
    even = even + 1e-12 * torch.eye(len(even)).to(even)
    each = scale if right.ndim == 1 else scale[:, None]
    answer: Tensor = each * torch.linalg.solve(even, each * right.to(even))
    return answer


def _misfit(electrons: Tensor, parts: Parts, use: Filter, weights: Weights) -> tuple[Tensor, float]:
    light = torch.zeros_like(electrons)
    for part in parts:
        light = light + part.electrons()
    rest = weights(use(electrons - light)).flatten()
    prior = sum(float((part.precision * part.values.square()).sum()) for part in parts)
    return rest, 0.5 * (float(rest.square().sum()) + prior)
