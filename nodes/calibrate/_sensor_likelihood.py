"""The likelihood of light levels of a linear sensor, and the statistics it needs."""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.special import log_ndtr, ndtr

from neusee.nodes import Check, node
from neusee.nodes.calibrate._emva_fit import Share
from neusee.nodes.sensor._digitization import Bits, Rounding
from neusee.nodes.sensor._noise import Distribution, Spread
from neusee.nodes.sensor._saturation import Well
from neusee.nodes.units import Efficiency, Electrons, Exposure, Fraction, Gain
from neusee.nodes.values import Levels

# --- sufficient statistics ------------------------------------------------------------------------

# Sufficient statistics of the frames of each light level, for a sensor whose pixels are alike.


_EDGE = 4  #: DN from either end that keep a histogram: a full well affects two or three numbers
_COARSE = 0.8  #: DN, standard deviation below which mean and variance are not sufficient


class Sufficient(NamedTuple):
    """The mean and variance of most pixels of each light level, and a histogram of the remaining
    pixels.
    """

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
    """Replace the middle of each light level's histogram by mean and variance, and keep the counts
    near both ends.

    Between the ends numbers count as continuous, and mean and variance are sufficient; at a full
    well every single number carries information. A level keeps its whole histogram if its numbers,
    or its numbers between the ends, have a standard deviation below 0.8 DN. ``share`` leaves out
    the levels above this share of saturation, which is taken at the lit level of the greatest
    variance. Give 0.7 for a sensor whose well ends the electrons before the read noise is added:
    `density` ends the sum of both, as the paper prints, and cannot describe its saturated levels.

    Shapes: levels (level,), cells (cell,) -> the same, with at most ten cells for a level that is
            not coarse.
    Units:  those of `Levels`.
    Error:  1e-12 of the moments. The pixels of a histogram are assumed alike.
    Raises: ValueError for a ``share`` without a lit level.
    Source: Fisher, Phil. Trans. R. Soc. A 222, 309 (1922), sufficiency.
    """
    levels = levels if share is None else _below(levels, share)
    moments = torch.stack(
        [levels.pixels, levels.mean, levels.variance, levels.degrees_of_freedom], 1
    )
    outer = torch.ones(len(levels.cell_level), dtype=torch.bool)
    for level in sorted(set(levels.cell_level.tolist())):
        cells_of_level = levels.cell_level == level
        sd = math.sqrt(float(levels.variance[level]))
        inner, moments[level] = _inner(
            levels.cell_value[cells_of_level], levels.cell_count[cells_of_level], sd
        )
        outer[cells_of_level] = ~inner
    cells = (x[outer] for x in (levels.cell_level, levels.cell_value, levels.cell_count))
    return Sufficient(levels.photons, levels.exposure, *moments.T.contiguous(), *cells)


@sufficient.check
def _(result: Sufficient, *inputs: Levels, **params: Any) -> list[Check]:
    counted = len(set(result.cell_level.tolist()))
    return [
        Check(
            f"{len(result.mean)} light levels, {counted} with a histogram, {len(result.cell_level)}"
            " histogram bins"
        )
    ]


@sufficient.reference
def _(levels: Levels, *, share: float | None = None) -> Sufficient:
    levels = levels if share is None else _below(levels, share)
    cells = list(
        zip(
            levels.cell_level.tolist(),
            levels.cell_value.tolist(),
            levels.cell_count.tolist(),
            strict=True,
        )
    )
    rows = torch.stack(
        [levels.pixels, levels.mean, levels.variance, levels.degrees_of_freedom], 1
    ).tolist()
    left = []
    for level in range(len(rows)):
        own = [(v, n) for cell_level, v, n in cells if cell_level == level]
        if own:
            rows[level], inside = _reference_inner(own, rows[level][2])
            left += [(level, v, n) for v, n in own if (v, n) not in inside]
    cell = torch.tensor(left, dtype=torch.float64).reshape(-1, 3).unbind(1)
    numbers, mean, variance, freedom = torch.tensor(rows, dtype=torch.float64).unbind(1)
    return Sufficient(
        levels.photons, levels.exposure, numbers, mean, variance, freedom, cell[0].long(), *cell[1:]
    )


def _reference_inner(
    own: list[tuple[float, float]], variance: float
) -> tuple[list[float], list[tuple[float, float]]]:
    """Return number, mean, variance and degrees of freedom of the middle of a histogram of numbers
    and counts, and this middle; zeros and nothing if the middle is too narrow.
    """
    low, high = own[0][0] + _EDGE, own[-1][0] - _EDGE
    if not variance**0.5 >= _COARSE:  # or not a number
        return [0.0, 0.0, 0.0, 0.0], []
    inside = [(v, n) for v, n in own if low < v < high]
    count = math.fsum(n for _, n in inside)
    if count < 2:
        return [0.0, 0.0, 0.0, 0.0], []
    mean = math.fsum(v * n for v, n in inside) / count
    square = math.fsum((v - mean) ** 2 * n for v, n in inside)
    if square < _COARSE**2 * (count - 1):
        return [0.0, 0.0, 0.0, 0.0], []
    return [count, mean, square / (count - 1), count - 1], inside


def _below(levels: Levels, share: float) -> Levels:
    """Return the dark levels, and the lit levels up to a share of saturation."""
    lit = levels.photons > 0
    if not bool(lit.any()):
        raise ValueError(
            "there are no lit levels, so saturation is unknown: leave out share, or give lit levels"
        )
    dark = float(levels.mean[~lit].min()) if bool((~lit).any()) else 0.0
    full = float(levels.mean[lit][levels.variance[lit].argmax()]) - dark
    used_levels = ~lit | (levels.mean - dark <= share * full)
    number, cells = used_levels.cumsum(0) - 1, used_levels[levels.cell_level]
    columns = [x[used_levels] for x in levels[:6]]
    counts = (number[levels.cell_level[cells]], levels.cell_value[cells], levels.cell_count[cells])
    return Levels._make([*columns, *counts])


def _inner(value: Tensor, count: Tensor, sd: float) -> tuple[Tensor, Tensor]:
    """Return a mask of the digital numbers away from both ends of the range, and the statistics
    of these numbers.
    """
    inner = (value > value[0] + _EDGE) & (value < value[-1] - _EDGE)
    total = float(count[inner].sum())
    mean = (value[inner] * count[inner]).sum() / max(total, 1.0)
    variance = ((value[inner] - mean).square() * count[inner]).sum() / max(total - 1, 1.0)
    if min(sd, math.sqrt(float(variance))) < _COARSE:
        return torch.zeros_like(inner), torch.zeros(4, dtype=torch.float64)
    return inner, torch.stack(
        [torch.tensor(total, dtype=torch.float64), mean, variance, torch.tensor(total - 1.0)]
    )


# --- quantised gaussian ---------------------------------------------------------------------------

# The exact probability of each digital number of a converter, for a Gaussian signal limited by a
# full well.
#
# Numbers are not treated as continuous, and no quantization variance is added.


_LEAST = 1e-300  #: probability below which a probability counts as 0


def log_cell(
    value: Tensor, mean: Tensor, sd: Tensor, well: Tensor, rounding: Rounding, top: int
) -> Tensor:
    """Return the logarithm of the probability of each digital number, minus infinity for an
    impossible number.

    Shapes: all broadcast.
    Units:  DN; ``well`` is the signal of a full pixel, the largest signal; ``top`` the largest
            number of the converter.
    Error:  `nearest` and `truncation` 1e-13 of the logarithm; `dithered_floor` 1e-15 sd**2 of the
            probability.
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
    """Return log P(low < x < high) for a Gaussian x, computed in the tail where no digits
    cancel.
    """
    a, b = (low - mean) / sd, (high - mean) / sd
    above = a + b > 0
    a, b = torch.where(above, -b, a), torch.where(above, -a, b)
    far, near = log_ndtr(a), log_ndtr(b)
    log_probability: Tensor = near + torch.log(-torch.expm1((far - near).clamp_max(-_LEAST)))
    return log_probability


def _dithered(value: Tensor, mean: Tensor, sd: Tensor, well: Tensor, top: int) -> Tensor:
    """Return P(floor(x + U(-1/2, 1/2)) = k): the density of x, weighted by a triangle from k - 1/2
    to k + 3/2.

    Integration by parts uses the integral G of the distribution function: G'' is the density, and
    the triangle has three corners. No x lies beyond the well; the probability beyond the well is
    concentrated at the well. Above the mean the asymptote x - mean is subtracted from G, so that no
    digits cancel far from the mean; the asymptotes and the triangle at the well add up to 0.
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
    return torch.where(value <= 0, lowest, torch.where(value >= top, highest, within)).clamp_min(
        0.0
    )


def _integral(x: Tensor, mean: Tensor, sd: Tensor, above: Tensor) -> Tensor:
    """Return the integral of the Gaussian distribution function up to x, minus (x - mean) if
    ``above`` is True.
    """
    z = (x - mean) / sd
    density = torch.exp(-0.5 * z.square()) / math.sqrt(2.0 * math.pi)
    side = torch.where(above, z, -z)
    tail = 0.5 * torch.special.erfc(side / math.sqrt(2.0))  # `ndtr` loses all digits below -8
    integral: Tensor = sd * (density - side * tail)
    return integral


# --- linear sensor --------------------------------------------------------------------------------

# The distribution of a linear sensor's digital numbers under flat light, and the likelihood of
# light levels.


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
    """The parameters of a linear sensor in units of digital numbers; each tensor is (..., 1)
    float64.
    """

    gain: Tensor  #: K, DN/e-
    response: Tensor  #: DN per photon
    noise: Tensor  #: DN2, variance added per photon
    offset: Tensor  #: DN, before rounding
    read: Tensor  #: DN rms
    dark: Tensor  #: DN/s
    well: Tensor  #: DN, signal of a full pixel
    counted: bool  #: True if photons give whole electrons with a Poisson distribution


class Likelihood(NamedTuple):
    """The likelihood of the light levels; the leading dimensions of each tensor are those of the
    sensor parameters.
    """

    log: Tensor  #: (...)
    #: (..., level) twice the log-likelihood below that of a separate fit of each level
    deviance: Tensor
    degrees_of_freedom: Tensor  #: (level,) of each deviance; 0 for a level without deviance
    #: (..., row) expected values in standard deviations: J^T J of these rows is the Fisher
    #: information
    scaled: Tensor
    #: (..., level) DN, of all numbers of a level, without clipping by well and converter
    mean: Tensor
    variance: Tensor  #: (..., level) DN2, as `mean`


class _Expected(NamedTuple):
    mean: Tensor  #: (..., level) DN, before rounding
    variance: Tensor  #: (..., level) DN2, before rounding


def likelihood(
    levels: Sufficient, sensor: Sensor, rounding: Rounding, bits: int, with_details: bool
) -> Likelihood:
    """Compute the likelihood of light levels from means, variances, and exact probabilities of
    histogram bins.

    Without ``with_details`` only the logarithm is computed, because a sampler needs no other field.
    """
    signal, (shift, spread), top = _expected(levels, sensor), ROUNDED[rounding], 2**bits - 1
    mean, variance = signal.mean + shift, signal.variance + spread
    off = levels.pixels * (levels.mean - mean).square() / variance
    log = -0.5 * (
        (levels.degrees_of_freedom + 1) * variance.log()
        + levels.degrees_of_freedom * levels.variance / variance
        + off
    )
    counted, measured = _has_cells(levels), levels.pixels > 0
    below = levels.pixels * log_ndtr((sensor.well - signal.mean) / signal.variance.sqrt())
    cells = _log_cells(levels, signal, sensor, rounding, top)
    total = (log + below.where(~counted, 0.0)).where(measured, 0.0).sum(-1) + (
        levels.cell_count * cells
    ).sum(-1)
    if not with_details:
        return without_details(total)
    ratio = levels.variance.where(measured, 1.0) / variance
    deviance, freedom = _deviance(
        levels,
        levels.degrees_of_freedom * (ratio - 1 - ratio.log()) + off,
        cells,
        measured & ~counted,
    )
    rows = [_scaled(levels, mean, variance).where(measured.repeat(2), 0.0)]
    rows.append(2.0 * (_pixels(levels)[levels.cell_level] * cells.exp()).sqrt())
    if rounding != "dithered_floor":  # the well lies anywhere within one number, 1 DN wide
        rows.append(math.sqrt(12.0) * sensor.well * _cut_off(levels, signal, sensor, top))
    return Likelihood(total, deviance, freedom, torch.cat(rows, -1), mean, variance)


def _cut_off(levels: Sufficient, signal: _Expected, sensor: Sensor, top: int) -> Tensor:
    """Return a mask (..., 1) of the sensors whose full well clips numbers that the converter
    could still give.
    """
    over = _pixels(levels) * ndtr((signal.mean - sensor.well) / signal.variance.sqrt())
    clips: Tensor = (over.sum(-1, keepdim=True) > 1.0) & (sensor.well < top - 0.5)
    return clips


def without_details(total: Tensor) -> Likelihood:
    """Return a log likelihood whose other fields are empty."""
    return Likelihood(total, *(torch.zeros(0, dtype=torch.float64) for _ in Likelihood._fields[1:]))


def _scaled(levels: Sufficient, mean: Tensor, variance: Tensor) -> Tensor:
    """Return expected mean and log variance of each light level, in standard deviations of the
    measured values.
    """
    measured = levels.variance.where(levels.pixels > 0, 1.0)
    return torch.cat(
        [
            (levels.pixels / measured).sqrt() * mean,
            ((levels.degrees_of_freedom + 1) / 2).sqrt() * variance.log(),
        ],
        -1,
    )


def _expected(levels: Sufficient, sensor: Sensor) -> _Expected:
    dark = sensor.dark * levels.exposure
    mean = sensor.offset + dark + sensor.response * levels.photons
    return _Expected(
        mean, sensor.read.square() + sensor.gain * dark + sensor.noise * levels.photons
    )


def _has_cells(levels: Sufficient) -> Tensor:
    return torch.zeros_like(levels.pixels, dtype=torch.bool).index_fill_(0, levels.cell_level, True)


def _pixels(levels: Sufficient) -> Tensor:
    """Return the number of pixels of each light level, counted in mean and variance and in
    histogram bins.
    """
    return levels.pixels.index_add(0, levels.cell_level, levels.cell_count)


def _log_cells(
    levels: Sufficient, signal: _Expected, sensor: Sensor, rounding: Rounding, top: int
) -> Tensor:
    """Return the logarithm of the probability of each histogram bin (..., bin)."""
    cell_level = levels.cell_level
    mean, variance = (
        signal.mean.index_select(-1, cell_level),
        signal.variance.index_select(-1, cell_level),
    )
    continuous = log_cell(levels.cell_value, mean, variance.sqrt(), sensor.well, rounding, top)
    coarse = (levels.pixels == 0)[cell_level]
    electrons = (
        mean - sensor.offset if sensor.counted else sensor.dark * levels.exposure[cell_level]
    ) / sensor.gain
    few = coarse & (electrons <= _FEW) & (sensor.gain.square() * electrons > _GRAIN * variance)
    if not bool(few.any()):
        return continuous
    return torch.where(
        few,
        _counted_out(levels, signal, sensor, rounding, top, electrons.expand_as(continuous)),
        continuous,
    )


def _counted_out(
    levels: Sufficient,
    signal: _Expected,
    sensor: Sensor,
    rounding: Rounding,
    top: int,
    electrons: Tensor,
) -> Tensor:
    """Return log probabilities of histogram bins, summed over Poisson-distributed numbers of
    electrons.
    """
    cell_level = levels.cell_level
    count = torch.arange(_MOST + 1, dtype=torch.float64).view(-1, *(1 for _ in electrons.shape))
    expected = electrons.clamp_min(1e-300)
    weight = count * expected.log() - expected - torch.lgamma(count + 1)
    mean = signal.mean[..., cell_level] + sensor.gain * (count - electrons)
    other_variance = (
        signal.variance[..., cell_level] - sensor.gain.square() * electrons
    ).clamp_min(0.0) + 1e-300
    log_probability = log_cell(
        levels.cell_value, mean, other_variance.sqrt(), sensor.well, rounding, top
    )
    return torch.logsumexp(weight + log_probability, 0)


def _deviance(
    levels: Sufficient, moments: Tensor, cells: Tensor, measured: Tensor
) -> tuple[Tensor, Tensor]:
    """Return deviance and degrees of freedom of each light level; both are 0 for a partly
    clipped level.
    """
    by_cells = levels.pixels == 0
    count, total = levels.cell_count, _pixels(levels)[levels.cell_level]
    of_cell = 2.0 * count * ((count / total).log() - cells)
    summed = torch.zeros_like(moments).index_add(
        -1, levels.cell_level, of_cell.expand(*moments.shape[:-1], -1)
    )
    distinct = torch.zeros_like(levels.pixels).index_add(
        0, levels.cell_level, torch.ones_like(count)
    )
    freedom = torch.where(measured, 2.0, torch.where(by_cells, (distinct - 1).clamp_min(0.0), 0.0))
    deviance = torch.where(measured, moments, torch.where(by_cells, summed, 0.0))
    return torch.where(freedom > 0, deviance, 0.0), freedom


# --- likelihood node ------------------------------------------------------------------------------

# The node of the likelihood of calibration frames, given the parameters of a sensor.


@node()
def density(
    levels: Sufficient,
    *,
    gain: Gain,
    quantum_efficiency: Efficiency,
    offset: Electrons,
    read_noise: Electrons,
    dark_current: Electrons,
    dark_exposure: Exposure,
    full_well: Well,
    arrivals: Distribution = "gaussian",
    mean_shift: Fraction = 0.0,
    spread: Spread = 1.0,
    mean: Literal["additive", "literal"] = "additive",
    drawn_in: Literal["electrons", "photons"] = "electrons",
    rounding: Rounding = "nearest",
    bits: Bits = 16,
    told: bool = True,
) -> Likelihood:
    """Compute the likelihood of measured light levels from the probability distributions of the
    nodes in `sensor`.

    Where numbers count as continuous, mean and variance are sufficient statistics of a level, so
    that the cost does not depend on the number of pixels. Numbers near the well and coarse numbers
    have the exact probabilities of the quantiser. Any of the seven numbers of the sensor may be a
    tensor (walker,), and all walkers are computed at once. ``told`` adds deviances and the rows of
    the Fisher information, which a sampler does not need.

    Shapes: levels -> log (walker,), deviance (walker, level), scaled (walker, row).
    Units:  gain K, DN/e-; dark_current e- in ``dark_exposure``; log in nats, for numbers of 1 DN.
    Error:  the signal is taken as Gaussian, except in coarse levels of up to 8 electrons: relative
            1e-3 at 3 standard deviations of 100 Poisson electrons. All pixels are assumed alike;
            crosstalk of neighbours, lag and drift of the lamp, which real frames show, are
            neglected (see `camera`).
    Source: NeuSee, section Sensor Image; EMVA Standard 1288, release 4.0 Linear, section 3.
    """
    parameters = (
        gain,
        quantum_efficiency,
        offset,
        read_noise,
        dark_current,
        full_well,
        mean_shift,
        spread,
    )
    columns = [torch.as_tensor(x, dtype=torch.float64)[..., None] for x in parameters]
    alike = torch.broadcast_tensors(*columns)  # type: ignore[no-untyped-call]
    k, efficiency, bias, read, dark, well, shift, c2 = alike
    mean_factor = shift + (mean == "additive")
    variance = c2.square() * (efficiency if drawn_in == "electrons" else efficiency.square())
    poisson = arrivals == "poisson" and (mean, drawn_in) == ("additive", "electrons")
    sensor = Sensor(
        gain=k,
        response=k * efficiency * mean_factor,
        noise=k.square() * variance,
        offset=k * bias,
        read=k * read,
        dark=k * dark / dark_exposure,
        well=k * well,
        counted=poisson and bool(((c2 == 1) & (shift == 0)).all()),
    )
    return likelihood(levels, sensor, rounding, bits, told)


@density.check
def _(result: Likelihood, *inputs: Sufficient, **params: Any) -> list[Check]:
    if not len(result.degrees_of_freedom):
        return []
    off, freedom = float(result.deviance.sum()), float(result.degrees_of_freedom.sum())
    return [Check(f"deviance {off:.4g} for {freedom:.0f} degrees of freedom")]
