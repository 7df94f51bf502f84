"""Sufficient statistics of the frames of each light level, for a sensor whose pixels are alike."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.calibrate._emva_fit import Share
from neusee.nodes.values import Levels

_EDGE = 4  #: DN from either end that keep a histogram: a full well affects two or three numbers
_COARSE = 0.8  #: DN, standard deviation below which mean and variance are not sufficient


class Sufficient(NamedTuple):
    """The mean and variance of most pixels of each light level, and a histogram of the remaining pixels."""

    photons: Tensor  #: (level,) float64, per pixel and exposure
    exposure: Tensor  #: (level,) float64, s
    pixels: Tensor  #: (level,) float64, count of the pixels of `mean` and `variance`
    mean: Tensor  #: (level,) float64, DN
    variance: Tensor  #: (level,) float64, DN2
    degrees_of_freedom: Tensor  #: (level,) float64, of the variance
    cell_level: Tensor  #: (cell,) int64, rising
    cell_value: Tensor  #: (cell,) float64, DN
    cell_count: Tensor  #: (cell,) float64


@node(rtol=1e-9)
def sufficient(levels: Levels, *, share: Share | None = None) -> Sufficient:
    """Replace the middle of each light level's histogram by mean and variance, and keep the counts near both ends.

    Between the ends numbers count as continuous, and mean and variance are sufficient; at a full well every single
    number carries information. A level keeps its whole histogram if its numbers, or its numbers between the ends, have
    a standard deviation below 0.8 DN. ``share`` leaves out the levels above this share of saturation, which is taken at
    the lit level of the greatest variance. Give 0.7 for a sensor whose well ends the electrons before the read noise is
    added: `density` ends the sum of both, as the paper prints, and cannot describe its saturated levels.

    Shapes: levels (level,), cells (cell,) -> the same, with at most ten cells for a level that is not coarse.
    Units:  those of `Levels`.
    Error:  1e-12 of the moments. The pixels of a histogram are assumed alike.
    Raises: ValueError for a ``share`` without a lit level.
    Source: Fisher, Phil. Trans. R. Soc. A 222, 309 (1922), sufficiency.
    """
    levels = levels if share is None else _below(levels, share)
    moments = torch.stack([levels.pixels, levels.mean, levels.variance, levels.degrees_of_freedom], 1)
    kept = torch.ones(len(levels.cell_level), dtype=torch.bool)
    for level in sorted(set(levels.cell_level.tolist())):
        at = levels.cell_level == level
        sd = math.sqrt(float(levels.variance[level]))
        inner, moments[level] = _inner(levels.cell_value[at], levels.cell_count[at], sd)
        kept[at] = ~inner
    cells = (x[kept] for x in (levels.cell_level, levels.cell_value, levels.cell_count))
    return Sufficient(levels.photons, levels.exposure, *moments.T.contiguous(), *cells)


@sufficient.check
def _(result: Sufficient, *inputs: Levels, **params: Any) -> list[Check]:
    counted = len(set(result.cell_level.tolist()))
    return [
        Check(f"{len(result.mean)} light levels, {counted} with a histogram, {len(result.cell_level)} histogram bins")
    ]


@sufficient.reference
def _(levels: Levels, *, share: float | None = None) -> Sufficient:
    levels = levels if share is None else _below(levels, share)
    cells = list(zip(levels.cell_level.tolist(), levels.cell_value.tolist(), levels.cell_count.tolist(), strict=True))
    rows = torch.stack([levels.pixels, levels.mean, levels.variance, levels.degrees_of_freedom], 1).tolist()
    left = []
    for level in range(len(rows)):
        own = [(v, n) for at, v, n in cells if at == level]
        if not own:
            continue
        low, high = own[0][0] + _EDGE, own[-1][0] - _EDGE
        inside = [(v, n) for v, n in own if low < v < high and rows[level][2] ** 0.5 >= _COARSE]
        count: float = math.fsum(n for _, n in inside)
        middle: float = math.fsum(v * n for v, n in inside) / count if count else 0.0
        square = math.fsum((v - middle) ** 2 * n for v, n in inside)
        if count < 2 or square < _COARSE**2 * (count - 1):
            inside, count, middle, square = [], 0.0, 0.0, 0.0
        rows[level] = [count, middle, square / (count - 1) if count else 0.0, count - 1 if count else 0.0]
        left += [(level, v, n) for v, n in own if (v, n) not in inside]
    cell = torch.tensor(left, dtype=torch.float64).reshape(-1, 3).unbind(1)
    numbers, mean, variance, freedom = torch.tensor(rows, dtype=torch.float64).unbind(1)
    return Sufficient(levels.photons, levels.exposure, numbers, mean, variance, freedom, cell[0].long(), *cell[1:])


def _below(levels: Levels, share: float) -> Levels:
    """Return the dark levels, and the lit levels up to a share of saturation."""
    lit = levels.photons > 0
    if not bool(lit.any()):
        raise ValueError("there are no lit levels, so saturation is unknown: leave out share, or give lit levels")
    dark = float(levels.mean[~lit].min()) if bool((~lit).any()) else 0.0
    full = float(levels.mean[lit][levels.variance[lit].argmax()]) - dark
    kept = ~lit | (levels.mean - dark <= share * full)
    number, cells = kept.cumsum(0) - 1, kept[levels.cell_level]
    each = [x[kept] for x in levels[:6]]
    counts = (number[levels.cell_level[cells]], levels.cell_value[cells], levels.cell_count[cells])
    return Levels._make([*each, *counts])


def _inner(value: Tensor, count: Tensor, sd: float) -> tuple[Tensor, Tensor]:
    """Return a mask of the digital numbers away from both ends of the range, and the statistics of these numbers."""
    inner = (value > value[0] + _EDGE) & (value < value[-1] - _EDGE)
    total = float(count[inner].sum())
    mean = (value[inner] * count[inner]).sum() / max(total, 1.0)
    variance = ((value[inner] - mean).square() * count[inner]).sum() / max(total - 1, 1.0)
    if min(sd, math.sqrt(float(variance))) < _COARSE:
        return torch.zeros_like(inner), torch.zeros(4, dtype=torch.float64)
    return inner, torch.stack([torch.tensor(total, dtype=torch.float64), mean, variance, torch.tensor(total - 1.0)])
