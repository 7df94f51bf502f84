"""The distribution of a linear sensor's numbers under flat light, and the likelihood of the measured levels."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.special import log_ndtr, ndtr

from neusee.nodes.calibrate._likelihood._quantised_gaussian import Rounding, log_cell
from neusee.nodes.calibrate._likelihood._sufficient_statistics import Sufficient

#: for each kind of rounding, the shift of the mean, DN, and the added variance, DN2
ROUNDED: dict[str, tuple[float, float]] = {"nearest": (0.0, 1.0 / 12.0), "dithered_floor": (-0.5, 1.0 / 6.0)}
_FEW = 8.0  #: electrons; up to this mean, coarse levels sum over the number of electrons
_GRAIN = 1e-3  #: share of the variance above which the discreteness of electrons matters
_MOST = 40  #: electrons; with a mean of _FEW, only 1e-15 of all pixels hold more


class Sensor(NamedTuple):
    """A linear sensor in units of digital numbers; all (..., 1) float64."""

    gain: Tensor  #: K, DN/e-
    response: Tensor  #: DN per photon
    noise: Tensor  #: DN2, variance added per photon
    offset: Tensor  #: DN, before rounding
    read: Tensor  #: DN rms
    dark: Tensor  #: DN/s
    well: Tensor  #: DN, signal of a full pixel
    counted: bool  #: whether photons give whole electrons with a Poisson distribution


class Likelihood(NamedTuple):
    """The likelihood of the levels; leading dimensions are those of the sensors."""

    log: Tensor  #: (...)
    deviance: Tensor  #: (..., level) twice the log-likelihood below that of a separate fit of each level
    degrees_of_freedom: Tensor  #: (level,) of each deviance; 0 for a level without deviance
    scaled: Tensor  #: (..., row) expected values in standard deviations: J^T J of these rows is the Fisher information
    mean: Tensor  #: (..., level) DN, of all numbers of a level, without clipping by well and converter
    variance: Tensor  #: (..., level) DN2, as `mean`


class _Law(NamedTuple):
    mean: Tensor  #: (..., level) DN, before rounding
    variance: Tensor  #: (..., level) DN2, before rounding


def likelihood(levels: Sufficient, sensor: Sensor, rounding: Rounding, bits: int, told: bool) -> Likelihood:
    """Compute the likelihood: from moments where numbers count as continuous, exact in the quantiser for histograms.

    Without ``told`` only the logarithm is computed, which is all that a sampler needs.
    """
    law, (shift, spread), top = _law(levels, sensor), ROUNDED[rounding], 2**bits - 1
    mean, variance = law.mean + shift, law.variance + spread
    off = levels.pixels * (levels.mean - mean).square() / variance
    log = -0.5 * (
        (levels.degrees_of_freedom + 1) * variance.log() + levels.degrees_of_freedom * levels.variance / variance + off
    )
    celled, measured = _cells_in(levels), levels.pixels > 0
    below = levels.pixels * log_ndtr((sensor.well - law.mean) / law.variance.sqrt())
    cells = _log_cells(levels, law, sensor, rounding, top)
    total = (log + below.where(~celled, 0.0)).where(measured, 0.0).sum(-1) + (levels.cell_count * cells).sum(-1)
    if not told:
        none = torch.zeros(0, dtype=torch.float64)
        return Likelihood(total, none, none, none, none, none)
    ratio = levels.variance.where(measured, 1.0) / variance
    deviance, freedom = _deviance(
        levels, levels.degrees_of_freedom * (ratio - 1 - ratio.log()) + off, cells, measured & ~celled
    )
    rows = [_scaled(levels, mean, variance).where(measured.repeat(2), 0.0)]
    rows.append(2.0 * (_of_level(levels)[levels.cell_level] * cells.exp()).sqrt())
    if rounding == "nearest":  # the well lies anywhere within one number, 1 DN wide
        rows.append(math.sqrt(12.0) * sensor.well * _cut_off(levels, law, sensor, top))
    return Likelihood(total, deviance, freedom, torch.cat(rows, -1), mean, variance)


def _cut_off(levels: Sufficient, law: _Law, sensor: Sensor, top: int) -> Tensor:
    """Return True, (..., 1), where the well cuts off numbers that the converter could still give."""
    over = _of_level(levels) * ndtr((law.mean - sensor.well) / law.variance.sqrt())
    found: Tensor = (over.sum(-1, keepdim=True) > 1.0) & (sensor.well < top - 0.5)
    return found


def _scaled(levels: Sufficient, mean: Tensor, variance: Tensor) -> Tensor:
    """Return the mean and the log variance of each level in standard deviations of the measured values."""
    known = levels.variance.where(levels.pixels > 0, 1.0)
    return torch.cat(
        [(levels.pixels / known).sqrt() * mean, ((levels.degrees_of_freedom + 1) / 2).sqrt() * variance.log()], -1
    )


def _law(levels: Sufficient, sensor: Sensor) -> _Law:
    dark = sensor.dark * levels.exposure
    mean = sensor.offset + dark + sensor.response * levels.photons
    return _Law(mean, sensor.read.square() + sensor.gain * dark + sensor.noise * levels.photons)


def _cells_in(levels: Sufficient) -> Tensor:
    """Mark the levels that have cells."""
    return torch.zeros_like(levels.pixels, dtype=torch.bool).index_fill_(0, levels.cell_level, True)


def _of_level(levels: Sufficient) -> Tensor:
    """Count the pixels of each level, inside and outside of cells."""
    return levels.pixels.index_add(0, levels.cell_level, levels.cell_count)


def _log_cells(levels: Sufficient, law: _Law, sensor: Sensor, rounding: Rounding, top: int) -> Tensor:
    """Return the logarithm of the probability of each cell, (..., cell)."""
    at = levels.cell_level
    mean, variance = law.mean.index_select(-1, at), law.variance.index_select(-1, at)
    found = log_cell(levels.cell_value, mean, variance.sqrt(), sensor.well, rounding, top)
    coarse = (levels.pixels == 0)[at]
    electrons = (mean - sensor.offset if sensor.counted else sensor.dark * levels.exposure[at]) / sensor.gain
    few = coarse & (electrons <= _FEW) & (sensor.gain.square() * electrons > _GRAIN * variance)
    if not bool(few.any()):
        return found
    return torch.where(few, _counted_out(levels, law, sensor, rounding, top, electrons.expand_as(found)), found)


def _counted_out(
    levels: Sufficient, law: _Law, sensor: Sensor, rounding: Rounding, top: int, electrons: Tensor
) -> Tensor:
    """Sum over the number of electrons, each with the remaining noise, where few electrons make no Gaussian."""
    at = levels.cell_level
    count = torch.arange(_MOST + 1, dtype=torch.float64).view(-1, *(1 for _ in electrons.shape))
    expected = electrons.clamp_min(1e-300)
    weight = count * expected.log() - expected - torch.lgamma(count + 1)
    mean = law.mean[..., at] + sensor.gain * (count - electrons)
    rest = (law.variance[..., at] - sensor.gain.square() * electrons).clamp_min(0.0) + 1e-300
    each = log_cell(levels.cell_value, mean, rest.sqrt(), sensor.well, rounding, top)
    return torch.logsumexp(weight + each, 0)


def _deviance(levels: Sufficient, moments: Tensor, cells: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
    """Return the deviance of each level from its moments or from its cells, and 0 for a partly clipped level."""
    whole = levels.pixels == 0
    count, total = levels.cell_count, _of_level(levels)[levels.cell_level]
    each = 2.0 * count * ((count / total).log() - cells)
    summed = torch.zeros_like(moments).index_add(-1, levels.cell_level, each.expand(*moments.shape[:-1], -1))
    distinct = torch.zeros_like(levels.pixels).index_add(0, levels.cell_level, torch.ones_like(count))
    freedom = torch.where(measured, 2.0, torch.where(whole, (distinct - 1).clamp_min(0.0), 0.0))
    found = torch.where(measured, moments, torch.where(whole, summed, 0.0))
    return torch.where(freedom > 0, found, 0.0), freedom
