"""The exact probability of each digital number of a converter, for a Gaussian signal limited by a full well.

Numbers are not treated as continuous, and no quantization variance is added.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.special import log_ndtr

from neusee.nodes.sensor._digitization import Rounding

_LEAST = 1e-300  #: probability below which a probability counts as 0


def log_cell(value: Tensor, mean: Tensor, sd: Tensor, well: Tensor, rounding: Rounding, top: int) -> Tensor:
    """Return the logarithm of the probability of each digital number, minus infinity for an impossible number.

    Shapes: all broadcast.
    Units:  DN; ``well`` is the signal of a full pixel, the largest signal; ``top`` the largest number of the converter.
    Error:  `nearest` and `truncation` 1e-13 of the logarithm; `dithered_floor` 1e-15 sd**2 of the probability.
    Source: s = round(x), floor(x), or floor(x + U(-1/2, 1/2)); NeuSee, Eq. (SensorImage).
    """
    if rounding == "nearest":
        low = torch.where(value <= 0, -math.inf, value - 0.5)
        high = torch.where((value >= top) | (value + 0.5 >= well), math.inf, value + 0.5)
        return torch.where(low < well, _between(low, high, mean, sd), -math.inf)
    if rounding == "truncation":
        low = torch.where(value <= 0, -math.inf, value)
        high = torch.where((value >= top) | (value + 1.0 > well), math.inf, value + 1.0)
        return torch.where(low <= well, _between(low, high, mean, sd), -math.inf)
    probability = _dithered(value, mean, sd, well, top)
    return torch.where(probability > _LEAST, probability.clamp_min(_LEAST).log(), -math.inf)


def _between(low: Tensor, high: Tensor, mean: Tensor, sd: Tensor) -> Tensor:
    """Return log P(low < x < high) for a Gaussian x, computed in the tail where no digits cancel."""
    a, b = (low - mean) / sd, (high - mean) / sd
    above = a + b > 0
    a, b = torch.where(above, -b, a), torch.where(above, -a, b)
    far, near = log_ndtr(a), log_ndtr(b)
    log_probability: Tensor = near + torch.log(-torch.expm1((far - near).clamp_max(-_LEAST)))
    return log_probability


def _dithered(value: Tensor, mean: Tensor, sd: Tensor, well: Tensor, top: int) -> Tensor:
    """Return P(floor(x + U(-1/2, 1/2)) = k): the density of x, weighted by a triangle from k - 1/2 to k + 3/2.

    Integration by parts uses the integral G of the distribution function: G'' is the density, and the triangle has
    three corners. No x lies beyond the well; the probability beyond the well is concentrated at the well. Above the
    mean the asymptote x - mean is subtracted from G, so that no digits cancel far from the mean; the asymptotes and the
    triangle at the well add up to 0.
    """
    middle = value + 0.5
    start, end = middle - 1.0, torch.minimum(torch.maximum(well, middle - 1.0), middle + 1.0)
    inner = torch.minimum(middle, end)
    above = middle > mean
    g0, g1, g2 = (_integral(x, mean, sd, above) for x in (start, inner, end))
    at_well = torch.where(above, 0.0, (1.0 - (end - middle).abs()))
    within = at_well + g0 - 2.0 * g1 + g2
    lowest = torch.where(above, 1.0, middle + 1.0 - torch.maximum(end, middle)) + g2 - g1
    highest = torch.where(above, 0.0, inner - start) + g0 - g1
    return torch.where(value <= 0, lowest, torch.where(value >= top, highest, within)).clamp_min(0.0)


def _integral(x: Tensor, mean: Tensor, sd: Tensor, above: Tensor) -> Tensor:
    """Return the integral of the Gaussian distribution function up to x, minus (x - mean) if ``above`` is True."""
    z = (x - mean) / sd
    density = torch.exp(-0.5 * z.square()) / math.sqrt(2.0 * math.pi)
    side = torch.where(above, z, -z)
    tail = 0.5 * torch.special.erfc(side / math.sqrt(2.0))  # `ndtr` loses all digits below -8
    integral: Tensor = sd * (density - side * tail)
    return integral
