"""The distribution of a linear sensor's digital numbers under flat light, and the likelihood of light levels."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.special import log_ndtr, ndtr

from neusee.nodes.calibrate._likelihood._quantised_gaussian import log_cell
from neusee.nodes.calibrate._likelihood._sufficient_statistics import Sufficient
from neusee.nodes.sensor._digitization import Rounding

#: for each kind of rounding, the shift of the mean, DN, and the added variance, DN2
ROUNDED: dict[str, tuple[float, float]] = {
    "nearest": (0.0, 1.0 / 12.0),
    "truncation": (-0.5, 1.0 / 12.0),
    "dithered_floor": (-0.5, 1.0 / 6.0),
}
_FEW = 8.0  #: electrons; up to this mean, coarse levels sum over the number of electrons
_GRAIN = 1e-3  #: share of the variance above which the discreteness of electrons matters
_MOST = 40  #: electrons; with a mean of _FEW, only 1e-15 of all pixels hold more


class Sensor(NamedTuple):
    """The parameters of a linear sensor in units of digital numbers; each tensor is (..., 1) float64."""

    gain: Tensor  #: K, DN/e-
    response: Tensor  #: DN per photon
    noise: Tensor  #: DN2, variance added per photon
    offset: Tensor  #: DN, before rounding
    read: Tensor  #: DN rms
    dark: Tensor  #: DN/s
    well: Tensor  #: DN, signal of a full pixel
    counted: bool  #: True if photons give whole electrons with a Poisson distribution


class Likelihood(NamedTuple):
    """The likelihood of the light levels; the leading dimensions of each tensor are those of the sensor parameters."""

    log: Tensor  #: (...)
    deviance: Tensor  #: (..., level) twice the log-likelihood below that of a separate fit of each level
    degrees_of_freedom: Tensor  #: (level,) of each deviance; 0 for a level without deviance
    scaled: Tensor  #: (..., row) expected values in standard deviations: J^T J of these rows is the Fisher information
    mean: Tensor  #: (..., level) DN, of all numbers of a level, without clipping by well and converter
    variance: Tensor  #: (..., level) DN2, as `mean`


class _Expected(NamedTuple):
    mean: Tensor  #: (..., level) DN, before rounding
    variance: Tensor  #: (..., level) DN2, before rounding


def likelihood(levels: Sufficient, sensor: Sensor, rounding: Rounding, bits: int, told: bool) -> Likelihood:
    """Compute the likelihood of light levels from means, variances, and exact probabilities of histogram bins.

    Without ``told`` only the logarithm is computed, because a sampler needs no other field.
    """
    signal, (shift, spread), top = _expected(levels, sensor), ROUNDED[rounding], 2**bits - 1
    mean, variance = signal.mean + shift, signal.variance + spread
    off = levels.pixels * (levels.mean - mean).square() / variance
    log = -0.5 * (
        (levels.degrees_of_freedom + 1) * variance.log() + levels.degrees_of_freedom * levels.variance / variance + off
    )
    counted, measured = _has_cells(levels), levels.pixels > 0
    below = levels.pixels * log_ndtr((sensor.well - signal.mean) / signal.variance.sqrt())
    cells = _log_cells(levels, signal, sensor, rounding, top)
    total = (log + below.where(~counted, 0.0)).where(measured, 0.0).sum(-1) + (levels.cell_count * cells).sum(-1)
    if not told:
        none = torch.zeros(0, dtype=torch.float64)
        return Likelihood(total, none, none, none, none, none)
    ratio = levels.variance.where(measured, 1.0) / variance
    deviance, freedom = _deviance(
        levels, levels.degrees_of_freedom * (ratio - 1 - ratio.log()) + off, cells, measured & ~counted
    )
    rows = [_scaled(levels, mean, variance).where(measured.repeat(2), 0.0)]
    rows.append(2.0 * (_pixels(levels)[levels.cell_level] * cells.exp()).sqrt())
    if rounding != "dithered_floor":  # the well lies anywhere within one number, 1 DN wide
        rows.append(math.sqrt(12.0) * sensor.well * _cut_off(levels, signal, sensor, top))
    return Likelihood(total, deviance, freedom, torch.cat(rows, -1), mean, variance)


def _cut_off(levels: Sufficient, signal: _Expected, sensor: Sensor, top: int) -> Tensor:
    """Return a mask (..., 1) of the sensors whose full well clips numbers that the converter could still give."""
    over = _pixels(levels) * ndtr((signal.mean - sensor.well) / signal.variance.sqrt())
    clips: Tensor = (over.sum(-1, keepdim=True) > 1.0) & (sensor.well < top - 0.5)
    return clips


def _scaled(levels: Sufficient, mean: Tensor, variance: Tensor) -> Tensor:
    """Return expected mean and log variance of each light level, in standard deviations of the measured values."""
    known = levels.variance.where(levels.pixels > 0, 1.0)
    return torch.cat(
        [(levels.pixels / known).sqrt() * mean, ((levels.degrees_of_freedom + 1) / 2).sqrt() * variance.log()], -1
    )


def _expected(levels: Sufficient, sensor: Sensor) -> _Expected:
    dark = sensor.dark * levels.exposure
    mean = sensor.offset + dark + sensor.response * levels.photons
    return _Expected(mean, sensor.read.square() + sensor.gain * dark + sensor.noise * levels.photons)


def _has_cells(levels: Sufficient) -> Tensor:
    return torch.zeros_like(levels.pixels, dtype=torch.bool).index_fill_(0, levels.cell_level, True)


def _pixels(levels: Sufficient) -> Tensor:
    """Return the number of pixels of each light level, counted in mean and variance and in histogram bins."""
    return levels.pixels.index_add(0, levels.cell_level, levels.cell_count)


def _log_cells(levels: Sufficient, signal: _Expected, sensor: Sensor, rounding: Rounding, top: int) -> Tensor:
    """Return the logarithm of the probability of each histogram bin (..., bin)."""
    at = levels.cell_level
    mean, variance = signal.mean.index_select(-1, at), signal.variance.index_select(-1, at)
    continuous = log_cell(levels.cell_value, mean, variance.sqrt(), sensor.well, rounding, top)
    coarse = (levels.pixels == 0)[at]
    electrons = (mean - sensor.offset if sensor.counted else sensor.dark * levels.exposure[at]) / sensor.gain
    few = coarse & (electrons <= _FEW) & (sensor.gain.square() * electrons > _GRAIN * variance)
    if not bool(few.any()):
        return continuous
    return torch.where(
        few, _counted_out(levels, signal, sensor, rounding, top, electrons.expand_as(continuous)), continuous
    )


def _counted_out(
    levels: Sufficient, signal: _Expected, sensor: Sensor, rounding: Rounding, top: int, electrons: Tensor
) -> Tensor:
    """Return log probabilities of histogram bins, summed over Poisson-distributed numbers of electrons."""
    at = levels.cell_level
    count = torch.arange(_MOST + 1, dtype=torch.float64).view(-1, *(1 for _ in electrons.shape))
    expected = electrons.clamp_min(1e-300)
    weight = count * expected.log() - expected - torch.lgamma(count + 1)
    mean = signal.mean[..., at] + sensor.gain * (count - electrons)
    rest = (signal.variance[..., at] - sensor.gain.square() * electrons).clamp_min(0.0) + 1e-300
    each = log_cell(levels.cell_value, mean, rest.sqrt(), sensor.well, rounding, top)
    return torch.logsumexp(weight + each, 0)


def _deviance(levels: Sufficient, moments: Tensor, cells: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
    """Return deviance and degrees of freedom of each light level; both are 0 for a partly clipped level."""
    whole = levels.pixels == 0
    count, total = levels.cell_count, _pixels(levels)[levels.cell_level]
    each = 2.0 * count * ((count / total).log() - cells)
    summed = torch.zeros_like(moments).index_add(-1, levels.cell_level, each.expand(*moments.shape[:-1], -1))
    distinct = torch.zeros_like(levels.pixels).index_add(0, levels.cell_level, torch.ones_like(count))
    freedom = torch.where(measured, 2.0, torch.where(whole, (distinct - 1).clamp_min(0.0), 0.0))
    deviance = torch.where(measured, moments, torch.where(whole, summed, 0.0))
    return torch.where(freedom > 0, deviance, 0.0), freedom
