"""How the light of scenes varies over a coarse grid: spectra that a scene may have, and what frames share."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.restore._shading._frame_cells import Cells

EXPONENTS = (1.0, 1.5, 2.0, 2.5, 3.0)  #: b of a power spectrum 1 / f^b
STRETCHES = (0.5, 1.0, 2.0)  #: of frequencies along y: a horizon has more power there
HABIT = 0.12  #: share of the power of the modes of a horizon and of a bright centre that scenes have in common
CHANCE = 0.01  #: the same of all other modes; the mean log-frame of 200 photographs (BSDS500) has 0.08 and 0.005
_FREE = 1e6  #: variance of the unknown level of a frame, relative to that of its scene


class Likelihood(NamedTuple):
    """The law of a scene for each spectrum that it may have, but for its strength."""

    precision: Tensor  #: (spectrum, cell, cell) float64; 0 for a cell that is not seen, and for a constant
    log_root: Tensor  #: (spectrum,) float64: half the logarithm of the determinant of the precision


def cosines(grid: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Return orthonormal cosines (cell, mode), and the half-periods of each mode along y and x."""
    bases = []
    for n in grid:
        number, place = torch.arange(n, dtype=torch.float64), torch.arange(n, dtype=torch.float64)
        base = torch.cos(math.pi * number * (place[:, None] + 0.5) / n)
        bases.append(base / base.norm(dim=0))
    longest = max(grid)
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) * longest / n for n in grid), indexing="ij")
    return torch.kron(bases[0], bases[1]), y.flatten(), x.flatten()


def likelihoods(frame: Cells, grid: tuple[int, int]) -> Likelihood:
    """Return the law of the log-scene of a frame whose level is unknown, for each exponent and stretch."""
    base, y, x = cosines(grid)
    seen = frame.seen
    precisions, roots = [], []
    for exponent, stretch in itertools.product(EXPONENTS, STRETCHES):
        power = ((stretch * y).square() + x.square()).clamp_min(1e-9).pow(-exponent / 2)
        power[0] = 0.0
        power = power / power.sum()
        power[0] = _FREE
        rows = base[seen]
        lower = torch.linalg.cholesky((rows * power) @ rows.mT)
        inverse = torch.cholesky_inverse(lower)
        level = inverse.sum(0)
        inverse = inverse - torch.outer(level, level) / level.sum()
        full = torch.zeros(len(seen), len(seen), dtype=torch.float64)
        full[seen.nonzero(), seen.nonzero().mT] = inverse
        precisions.append(full)
        roots.append(-lower.diagonal().log().sum() - 0.5 * level.sum().log())
    return Likelihood(torch.stack(precisions), torch.stack(roots))


def shared_detail(logs: Sequence[Tensor], seen: Sequence[Tensor], grid: tuple[int, int]) -> float:
    """Return the correlation of the details of two frames, which are too fine to be dirt."""
    base, y, x = cosines(grid)
    fine = torch.hypot(y, x) >= max(grid) / 2
    details = []
    for log, known in zip(logs, seen, strict=True):
        flat = torch.where(known, log - log[known].mean(), 0.0)
        detail = base[:, fine].mT @ flat
        details.append(detail / detail.norm().clamp_min(1e-300))
    total, count = torch.stack(details).sum(0), len(details)
    if count < 2:
        return 0.0
    found = (float(total.square().sum()) - count) / (count * (count - 1))
    return min(1.0, max(0.0, found))


def habits(precision: Tensor, frames: float, grid: tuple[int, int]) -> Tensor:
    """Return the covariance (cell, cell) of what scenes have in common, from the summed precision of the frames.

    Photographs are brighter at the centre and above: their mean does not go to a constant.
    """
    base, y, x = cosines(grid)
    power = frames / (base * (precision @ base)).sum(0).clamp_min(1e-12)
    rows, columns = (y > 0).double() * y, (x > 0).double() * x
    step_y, step_x = max(grid) / grid[0], max(grid) / grid[1]
    upright = (columns == 0) & (rows <= 2.5 * step_y)
    level = (rows == 0) & (((columns / step_x).round() == 2) | ((columns / step_x).round() == 4))
    share = torch.where(upright | level, HABIT, CHANCE)
    share[0] = 0.0
    return (base * (share * power)) @ base.mT
