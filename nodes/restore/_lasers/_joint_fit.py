"""The most likely values of all lasers and lamps of a frame at once, by steps of Gauss and Newton."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.restore._lasers._censored import Censored
from neusee.nodes.restore._lasers._components import Lamp, Laser
from neusee.nodes.restore._lasers._whitening import Filter, Weights

Parts = tuple[Laser | Lamp, ...]
_DAMPED = (0.0, 1e-3, 1e-1, 10.0)  #: factors of the diagonal, tried in this order until a step lowers the misfit
_PIECE = 1 << 16  #: numbers at a time whose float64 copies fit in the cache
_ENOUGH = 0.02  #: log likelihood, a smaller gain of which ends the steps


class Data(NamedTuple):
    """What is fitted: a frame, and what its pixels count."""

    electrons: Tensor  #: (channel, y, x)
    use: Filter
    weights: Weights
    clipped: Censored | None = None  #: None leaves the clipped pixels out


class Fit(NamedTuple):
    """Lasers and lamps, and how well they explain a frame."""

    parts: Parts
    misfit: float  #: half the sum of squares of the white residual and of the errors of responses
    normal: Tensor  #: (value, value), matrix of second derivatives of the misfit
    columns: Tensor  #: (value, number), slopes of the white residual, and of the misfits of clipped pixels after it
    rest: Tensor  #: (number,), the white residual, and the misfits of clipped pixels after it


def fitted(data: Data, parts: Sequence[Laser | Lamp], steps: int) -> Fit:
    """Return the parts after at most ``steps`` steps, each of which lowers the misfit, with the slopes at the end."""
    now, left, rest, misfit = _walked(data, tuple(parts), steps)
    columns = _columns(data, now, left)
    return Fit(now, misfit, _normal(now, columns), columns, rest)


def misfit_of(data: Data, parts: Sequence[Laser | Lamp], steps: int) -> tuple[Parts, float]:
    """Return the parts after at most ``steps`` steps, and their misfit."""
    now, _, _, misfit = _walked(data, tuple(parts), steps)
    return now, misfit


def _walked(data: Data, now: Parts, steps: int) -> tuple[Parts, Tensor, Tensor, float]:
    """Return parts after steps, the frame less their light, the white residual and the misfit."""
    left, rest, misfit = _misfit(data, now)
    for _ in range(steps):
        better = _step(data, now, left, rest, misfit)
        if better is None:
            break
        gained = misfit - better[3]
        now, left, rest, misfit = better
        if gained < _ENOUGH:
            break
    return now, left, rest, misfit


def _step(
    data: Data, now: Parts, left: Tensor, rest: Tensor, misfit: float
) -> tuple[Parts, Tensor, Tensor, float] | None:
    """Return the parts after one step, and what `_misfit` says of them; None if no step lowers the misfit."""
    columns = _columns(data, now, left)
    normal = _normal(now, columns)
    pulled = torch.cat([part.values * part.precision for part in now])
    slope = columns @ rest - pulled
    sizes = [len(part.values) for part in now]
    for damping in _DAMPED:
        step = solved(normal + damping * normal.diagonal().diag(), slope).to(slope)
        moved = tuple(part.moved(own) for part, own in zip(now, torch.split(step, sizes), strict=True))
        after, white, new = _misfit(data, moved)
        if new < misfit:
            return moved, after, white, new
    return None


def _columns(data: Data, parts: Parts, left: Tensor) -> Tensor:
    """Return the slopes of what `_misfit` squares: (value, number)."""
    white = torch.cat([data.weights(part.columns(data.use.__call__)).flatten(1) for part in parts])
    if data.clipped is None:
        return white
    lit = torch.cat([data.clipped.of(part.columns(data.clipped.lit)) for part in parts])
    return torch.cat([white, data.clipped.slopes(left, lit)], 1)


def _normal(parts: Parts, columns: Tensor) -> Tensor:
    return products(columns) + torch.cat([part.precision for part in parts]).double().diag()


def products(columns: Tensor) -> Tensor:
    """Return the products (value, value) of columns (value, number), summed in float64, a piece at a time.

    Of a million numbers float32 loses 1e-4 of a product, and what tells strength from responses is smaller than that.
    """
    total = torch.zeros(len(columns), len(columns), dtype=torch.float64, device=columns.device)
    for first in range(0, columns.shape[1], _PIECE):
        piece = columns[:, first : first + _PIECE].double()
        total += piece @ piece.T
    return total


def solved(normal: Tensor, right: Tensor) -> Tensor:
    """Solve a normal system, whose values have any scale, in spite of values that nothing tells."""
    scale = normal.diagonal().clamp_min(1e-30).rsqrt()
    even = scale[:, None] * normal * scale
    even = even + 1e-12 * torch.eye(len(even)).to(even)
    each = scale if right.ndim == 1 else scale[:, None]
    answer: Tensor = each * torch.linalg.solve(even, each * right.to(even))
    return answer


def _misfit(data: Data, parts: Parts) -> tuple[Tensor, Tensor, float]:
    """Return the frame less the light of the parts, the numbers that are squared, and the misfit."""
    left = data.electrons
    for part in parts:
        left = left - part.electrons()
    rest = data.weights(data.use(left)).flatten()
    if data.clipped is not None:
        rest = torch.cat([rest, data.clipped.misfits(left)])
    prior = sum(float((part.precision * part.values.square()).sum()) for part in parts)
    return left, rest, 0.5 * (float(rest.double().square().sum()) + prior)
