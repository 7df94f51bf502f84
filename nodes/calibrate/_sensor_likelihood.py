"""The likelihood of the light levels of a linear sensor, and its sufficient statistics."""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.special import log_ndtr, ndtr

from neusee.nodes import Check, node
from neusee.nodes.calibrate._emva_sheet import Share
from neusee.nodes.calibrate._light_levels import COARSE_DEVIATION
from neusee.nodes.sensor._digitization import Bits, Rounding
from neusee.nodes.sensor._noise import Distribution, Spread
from neusee.nodes.sensor._saturation import Well
from neusee.nodes.units import Efficiency, Electrons, Exposure, Fraction, Gain
from neusee.nodes.values import Levels

# --- sufficient statistics ------------------------------------------------------------------------

# Sufficient statistics of the frames of each light level, for a sensor whose pixels are alike.


#: DN; within this distance of either end the histogram is kept, since a full well affects two or
#: three values
_EDGE_NUMBERS = 4


class Sufficient(NamedTuple):
    """Sufficient statistics of the light levels: mean and variance of most pixels of each level,
    and a histogram of the remaining pixels.
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
    levels = levels if share is None else _levels_below(levels, share)
    moments = torch.stack(
        [levels.pixels, levels.mean, levels.variance, levels.degrees_of_freedom], 1
    )
    keeps_cell = torch.ones(len(levels.cell_level), dtype=torch.bool)
    for level in sorted(set(levels.cell_level.tolist())):
        cells_of_level = levels.cell_level == level
        deviation = math.sqrt(float(levels.variance[level]))
        # the middle is replaced by mean and variance; the cells near both ends are kept
        is_inner, moments[level] = _histogram_middle(
            levels.cell_value[cells_of_level], levels.cell_count[cells_of_level], deviation
        )
        keeps_cell[cells_of_level] = ~is_inner
    cells = (x[keeps_cell] for x in (levels.cell_level, levels.cell_value, levels.cell_count))
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
    levels = levels if share is None else _levels_below(levels, share)
    cells = list(
        zip(
            levels.cell_level.tolist(),
            levels.cell_value.tolist(),
            levels.cell_count.tolist(),
            strict=True,
        )
    )
    moments = torch.stack(
        [levels.pixels, levels.mean, levels.variance, levels.degrees_of_freedom], 1
    ).tolist()
    outer_cells = []
    for level in range(len(moments)):
        cells_of_level = [(v, n) for cell_level, v, n in cells if cell_level == level]
        if cells_of_level:
            moments[level], inside = _reference_middle(cells_of_level, moments[level][2])
            outer_cells += [(level, v, n) for v, n in cells_of_level if (v, n) not in inside]
    columns = torch.tensor(outer_cells, dtype=torch.float64).reshape(-1, 3).unbind(1)
    numbers, mean, variance, freedom = torch.tensor(moments, dtype=torch.float64).unbind(1)
    return Sufficient(
        levels.photons,
        levels.exposure,
        numbers,
        mean,
        variance,
        freedom,
        columns[0].long(),
        *columns[1:],
    )


def _reference_middle(
    own: list[tuple[float, float]], variance: float
) -> tuple[list[float], list[tuple[float, float]]]:
    """Return count, mean, variance and degrees of freedom of the middle of a histogram of (value,
    count), and the cells of the middle; zeros and no cells if the middle is too narrow.
    """
    lower_edge, upper_edge = own[0][0] + _EDGE_NUMBERS, own[-1][0] - _EDGE_NUMBERS
    if not variance**0.5 >= COARSE_DEVIATION:  # also true for NaN
        return [0.0, 0.0, 0.0, 0.0], []
    middle_cells = [(v, n) for v, n in own if lower_edge < v < upper_edge]
    count = math.fsum(n for _, n in middle_cells)
    if count < 2:
        return [0.0, 0.0, 0.0, 0.0], []
    mean = math.fsum(v * n for v, n in middle_cells) / count
    sum_of_squares = math.fsum((v - mean) ** 2 * n for v, n in middle_cells)
    if sum_of_squares < COARSE_DEVIATION**2 * (count - 1):
        return [0.0, 0.0, 0.0, 0.0], []
    return [count, mean, sum_of_squares / (count - 1), count - 1], middle_cells


def _levels_below(levels: Levels, share: float) -> Levels:
    """Return the dark levels, and the lit levels up to a share of the saturation signal."""
    is_lit = levels.photons > 0
    if not bool(is_lit.any()):
        raise ValueError(
            "there are no lit levels, so saturation is unknown: leave out share, or give lit levels"
        )
    darkest = float(levels.mean[~is_lit].min()) if bool((~is_lit).any()) else 0.0
    saturation_signal = float(levels.mean[is_lit][levels.variance[is_lit].argmax()]) - darkest
    used_levels = ~is_lit | (levels.mean - darkest <= share * saturation_signal)
    # new indices of the levels that are kept
    new_number, kept_cells = used_levels.cumsum(0) - 1, used_levels[levels.cell_level]
    # the first six fields have one value per level, the others one per histogram cell
    columns = [x[used_levels] for x in levels[:6]]
    cell_columns = (
        new_number[levels.cell_level[kept_cells]],
        levels.cell_value[kept_cells],
        levels.cell_count[kept_cells],
    )
    return Levels._make([*columns, *cell_columns])


def _histogram_middle(value: Tensor, count: Tensor, sd: float) -> tuple[Tensor, Tensor]:
    """Return a mask of the middle of a histogram, away from both ends, and (count, mean, variance,
    degrees of freedom) of its pixels; an empty mask and zeros if the values are too coarse.
    """
    is_inner = (value > value[0] + _EDGE_NUMBERS) & (value < value[-1] - _EDGE_NUMBERS)
    pixel_count = float(count[is_inner].sum())
    mean = (value[is_inner] * count[is_inner]).sum() / max(pixel_count, 1.0)
    variance = ((value[is_inner] - mean).square() * count[is_inner]).sum() / max(
        pixel_count - 1, 1.0
    )
    if min(sd, math.sqrt(float(variance))) < COARSE_DEVIATION:
        return torch.zeros_like(is_inner), torch.zeros(4, dtype=torch.float64)
    return is_inner, torch.stack(
        [
            torch.tensor(pixel_count, dtype=torch.float64),
            mean,
            variance,
            torch.tensor(pixel_count - 1.0),
        ]
    )


# --- quantised gaussian ---------------------------------------------------------------------------

# The exact probability of each digital number, for a Gaussian signal clipped at the full well.
#
# Digital numbers are treated as discrete, so that no quantisation variance is added.


_LEAST_PROBABILITY = 1e-300  #: a smaller probability counts as 0


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
        # the numbers 0 and `top` include all signals below and above; the full well clips the
        # signal
        lower_edge = torch.where(value <= 0, -math.inf, value - 0.5)
        upper_edge = torch.where((value >= top) | (value + 0.5 >= well), math.inf, value + 0.5)
        return torch.where(
            lower_edge < well, _log_between(lower_edge, upper_edge, mean, sd), -math.inf
        )
    if rounding == "truncation":
        lower_edge = torch.where(value <= 0, -math.inf, value)
        upper_edge = torch.where((value >= top) | (value + 1.0 > well), math.inf, value + 1.0)
        return torch.where(
            lower_edge <= well, _log_between(lower_edge, upper_edge, mean, sd), -math.inf
        )
    probability = _dithered_probability(value, mean, sd, well, top)
    return torch.where(
        probability > _LEAST_PROBABILITY, probability.clamp_min(_LEAST_PROBABILITY).log(), -math.inf
    )


def _log_between(low: Tensor, high: Tensor, mean: Tensor, sd: Tensor) -> Tensor:
    """Return log P(low < x < high) for a Gaussian x, without cancellation in the tails."""
    lower_z, upper_z = (low - mean) / sd, (high - mean) / sd
    is_above = lower_z + upper_z > 0
    # mirror an interval above the mean into the lower tail
    lower_z, upper_z = (
        torch.where(is_above, -upper_z, lower_z),
        torch.where(is_above, -lower_z, upper_z),
    )
    log_far, log_near = log_ndtr(lower_z), log_ndtr(upper_z)
    # log(exp(near) - exp(far)) without cancellation
    log_probability: Tensor = log_near + torch.log(
        -torch.expm1((log_far - log_near).clamp_max(-_LEAST_PROBABILITY))
    )
    return log_probability


def _dithered_probability(
    value: Tensor, mean: Tensor, sd: Tensor, well: Tensor, top: int
) -> Tensor:
    """Return P(floor(x + U(-1/2, 1/2)) = k), the integral of the density of x times a triangle from
    k - 1/2 to k + 3/2.

    Integrated by parts, with G the integral of the distribution function (G'' is the density) at
    the three corners of the triangle. The signal is clipped at the well, so that all probability
    beyond it is at the well. Above the mean the asymptote x - mean is subtracted from G to avoid
    cancellation far from the mean; the asymptotes and the term at the well add up to 0.
    """
    middle = value + 0.5
    first_corner, last_corner = (
        middle - 1.0,
        torch.minimum(torch.maximum(well, middle - 1.0), middle + 1.0),
    )
    # the well may cut the triangle off before its middle or its last corner
    middle_corner = torch.minimum(middle, last_corner)
    is_above = middle > mean
    integral_first, integral_middle, integral_last = (
        _integrated_distribution(x, mean, sd, is_above)
        for x in (first_corner, middle_corner, last_corner)
    )
    # height of the triangle where the well cuts it off
    at_well = torch.where(is_above, 0.0, (1.0 - (last_corner - middle).abs()))
    inner_probability = at_well + integral_first - 2.0 * integral_middle + integral_last
    lowest_probability = (
        torch.where(is_above, 1.0, middle + 1.0 - torch.maximum(last_corner, middle))
        + integral_last
        - integral_middle
    )
    highest_probability = (
        torch.where(is_above, 0.0, middle_corner - first_corner) + integral_first - integral_middle
    )
    return torch.where(
        value <= 0,
        lowest_probability,
        torch.where(value >= top, highest_probability, inner_probability),
    ).clamp_min(0.0)


def _integrated_distribution(x: Tensor, mean: Tensor, sd: Tensor, above: Tensor) -> Tensor:
    """Return the integral of the Gaussian distribution function up to x, less (x - mean) where
    ``above``.
    """
    z = (x - mean) / sd
    density = torch.exp(-0.5 * z.square()) / math.sqrt(2.0 * math.pi)
    mirrored_z = torch.where(above, z, -z)
    tail = 0.5 * torch.special.erfc(mirrored_z / math.sqrt(2.0))  # `ndtr` is inaccurate below -8
    integral: Tensor = sd * (density - mirrored_z * tail)
    return integral


# --- linear sensor --------------------------------------------------------------------------------

# The distribution of a linear sensor's digital numbers in uniform light, and the likelihood of
# light levels.


#: for each kind of rounding, the shift of the mean, DN, and the added variance, DN2
ROUNDED: dict[str, tuple[float, float]] = {
    "nearest": (0.0, 1.0 / 12.0),
    "truncation": (-0.5, 1.0 / 12.0),
    "dithered_floor": (-0.5, 1.0 / 6.0),
}
#: electrons; up to this mean, coarse levels use a Poisson sum over numbers of electrons
_FEW_ELECTRONS = 8.0
#: share of the electrons' shot noise in the variance above which they are treated as discrete
_GRAIN_SHARE = 1e-3
#: electrons; with a mean of `_FEW_ELECTRONS`, only 1e-15 of all pixels hold more
_MOST_ELECTRONS = 40


class Sensor(NamedTuple):
    """The parameters of a linear sensor in units of DN; each tensor is (..., 1) float64."""

    gain: Tensor  #: K, DN/e-
    response: Tensor  #: DN per photon
    noise: Tensor  #: DN2, variance added per photon
    offset: Tensor  #: DN, before rounding
    read: Tensor  #: DN rms
    dark: Tensor  #: DN/s
    well: Tensor  #: DN, signal of a full pixel
    counted: bool  #: True if photons give whole electrons with a Poisson distribution


class Likelihood(NamedTuple):
    """The likelihood of light levels; the leading dimensions (...) are those of the sensor
    parameters.
    """

    log: Tensor  #: (...)
    #: (..., level) twice the deficit of the log likelihood against a separate fit of each level
    deviance: Tensor
    degrees_of_freedom: Tensor  #: (level,) of each deviance; 0 for a level without deviance
    #: (..., row) rows scaled to unit standard deviation: with J their Jacobian, J^T J is the Fisher
    #: information
    scaled: Tensor
    #: (..., level) DN, expected mean of a level, before clipping by full well and converter
    mean: Tensor
    variance: Tensor  #: (..., level) DN2, as `mean`


class _ExpectedSignal(NamedTuple):
    mean: Tensor  #: (..., level) DN, before rounding
    variance: Tensor  #: (..., level) DN2, before rounding


def likelihood(
    levels: Sufficient, sensor: Sensor, rounding: Rounding, bits: int, with_details: bool
) -> Likelihood:
    """Compute the likelihood of light levels from means and variances, and from the exact
    probabilities of histogram bins.

    Without ``with_details`` only the log likelihood is computed, which is all that a sampler needs.
    """
    expected, (rounding_shift, rounding_variance), largest_number = (
        _expected_signal(levels, sensor),
        ROUNDED[rounding],
        2**bits - 1,
    )
    mean, variance = expected.mean + rounding_shift, expected.variance + rounding_variance
    mean_term = levels.pixels * (levels.mean - mean).square() / variance
    # Gaussian likelihood of mean and variance of a level
    log_of_moments = -0.5 * (
        (levels.degrees_of_freedom + 1) * variance.log()
        + levels.degrees_of_freedom * levels.variance / variance
        + mean_term
    )
    has_cells, has_moments = _has_cells(levels), levels.pixels > 0
    # a level without a histogram has no clipped pixel: probability that all lie below the full well
    log_below_well = levels.pixels * log_ndtr(
        (sensor.well - expected.mean) / expected.variance.sqrt()
    )
    log_cells = _log_cells(levels, expected, sensor, rounding, largest_number)
    log_likelihood = (log_of_moments + log_below_well.where(~has_cells, 0.0)).where(
        has_moments, 0.0
    ).sum(-1) + (levels.cell_count * log_cells).sum(-1)
    if not with_details:
        return without_details(log_likelihood)
    variance_ratio = levels.variance.where(has_moments, 1.0) / variance
    deviance, freedom = _deviance(
        levels,
        levels.degrees_of_freedom * (variance_ratio - 1 - variance_ratio.log()) + mean_term,
        log_cells,
        has_moments & ~has_cells,
    )
    rows = [_scaled(levels, mean, variance).where(has_moments.repeat(2), 0.0)]
    # 2 sqrt(count) of a Poisson count has the standard deviation 1
    rows.append(2.0 * (_pixel_counts(levels)[levels.cell_level] * log_cells.exp()).sqrt())
    if rounding != "dithered_floor":  # rounded values determine the full well only to within 1 DN
        # standard deviation of a uniform distribution 1 DN wide: 1 / sqrt(12)
        rows.append(
            math.sqrt(12.0) * sensor.well * _cut_off(levels, expected, sensor, largest_number)
        )
    return Likelihood(log_likelihood, deviance, freedom, torch.cat(rows, -1), mean, variance)


def _cut_off(levels: Sufficient, signal: _ExpectedSignal, sensor: Sensor, top: int) -> Tensor:
    """Return a mask (..., 1) of the sensors whose full well clips pixels below the range of the
    converter.
    """
    pixels_above = _pixel_counts(levels) * ndtr(
        (signal.mean - sensor.well) / signal.variance.sqrt()
    )
    is_clipping: Tensor = (pixels_above.sum(-1, keepdim=True) > 1.0) & (sensor.well < top - 0.5)
    return is_clipping


def without_details(total: Tensor) -> Likelihood:
    """Return a `Likelihood` with a log likelihood only; its other fields are empty."""
    return Likelihood(total, *(torch.zeros(0, dtype=torch.float64) for _ in Likelihood._fields[1:]))


def _scaled(levels: Sufficient, mean: Tensor, variance: Tensor) -> Tensor:
    """Return the expected mean and log variance of each light level, divided by the standard
    deviations of the measured values.
    """
    measured = levels.variance.where(levels.pixels > 0, 1.0)
    return torch.cat(
        [
            (levels.pixels / measured).sqrt() * mean,
            ((levels.degrees_of_freedom + 1) / 2).sqrt() * variance.log(),
        ],
        -1,
    )


def _expected_signal(levels: Sufficient, sensor: Sensor) -> _ExpectedSignal:
    """Return mean and variance (..., level) of the signal before rounding: offset, dark signal and
    light, with read noise and the shot noise of dark signal and light.
    """
    dark = sensor.dark * levels.exposure
    mean = sensor.offset + dark + sensor.response * levels.photons
    return _ExpectedSignal(
        mean, sensor.read.square() + sensor.gain * dark + sensor.noise * levels.photons
    )


def _has_cells(levels: Sufficient) -> Tensor:
    """Return a mask of the levels that have a histogram."""
    return torch.zeros_like(levels.pixels, dtype=torch.bool).index_fill_(0, levels.cell_level, True)


def _pixel_counts(levels: Sufficient) -> Tensor:
    """Return the number of pixels of each light level, those of its mean and variance plus those in
    histogram bins.
    """
    return levels.pixels.index_add(0, levels.cell_level, levels.cell_count)


def _log_cells(
    levels: Sufficient, signal: _ExpectedSignal, sensor: Sensor, rounding: Rounding, top: int
) -> Tensor:
    """Return the logarithm of the probability of each histogram bin (..., bin).

    For coarse levels of few electrons, where a Gaussian is too inaccurate, it is summed over the
    Poisson distribution of the number of electrons.
    """
    cell_level = levels.cell_level
    mean, variance = (
        signal.mean.index_select(-1, cell_level),
        signal.variance.index_select(-1, cell_level),
    )
    gaussian = log_cell(levels.cell_value, mean, variance.sqrt(), sensor.well, rounding, top)
    is_coarse = (levels.pixels == 0)[cell_level]
    electrons = (
        mean - sensor.offset if sensor.counted else sensor.dark * levels.exposure[cell_level]
    ) / sensor.gain
    has_few = (
        is_coarse
        & (electrons <= _FEW_ELECTRONS)
        & (sensor.gain.square() * electrons > _GRAIN_SHARE * variance)
    )
    if not bool(has_few.any()):
        return gaussian
    return torch.where(
        has_few,
        _log_cells_by_electrons(
            levels, signal, sensor, rounding, top, electrons.expand_as(gaussian)
        ),
        gaussian,
    )


def _log_cells_by_electrons(
    levels: Sufficient,
    signal: _ExpectedSignal,
    sensor: Sensor,
    rounding: Rounding,
    top: int,
    electrons: Tensor,
) -> Tensor:
    """Return log probabilities of histogram bins, summed over Poisson-distributed numbers of
    electrons.
    """
    cell_level = levels.cell_level
    electron_count = torch.arange(_MOST_ELECTRONS + 1, dtype=torch.float64).view(
        -1, *(1 for _ in electrons.shape)
    )
    mean_electrons = electrons.clamp_min(1e-300)
    log_poisson = (
        electron_count * mean_electrons.log() - mean_electrons - torch.lgamma(electron_count + 1)
    )
    mean = signal.mean[..., cell_level] + sensor.gain * (electron_count - electrons)
    # variance without the shot noise of the electrons that are summed over
    other_variance = (
        signal.variance[..., cell_level] - sensor.gain.square() * electrons
    ).clamp_min(0.0) + 1e-300
    log_probability = log_cell(
        levels.cell_value, mean, other_variance.sqrt(), sensor.well, rounding, top
    )
    return torch.logsumexp(log_poisson + log_probability, 0)


def _deviance(
    levels: Sufficient, moments: Tensor, cells: Tensor, measured: Tensor
) -> tuple[Tensor, Tensor]:
    """Return deviance (..., level) and degrees of freedom (level,); both are 0 for a partly clipped
    level.

    Levels marked in ``measured`` have the deviance ``moments`` of mean and variance. Levels with a
    histogram only have that of its bins, whose log probabilities are ``cells``.
    """
    by_cells = levels.pixels == 0
    count, pixels_of_level = levels.cell_count, _pixel_counts(levels)[levels.cell_level]
    # twice the deficit of the log likelihood against that of the measured frequencies
    cell_deviance = 2.0 * count * ((count / pixels_of_level).log() - cells)
    level_deviance = torch.zeros_like(moments).index_add(
        -1, levels.cell_level, cell_deviance.expand(*moments.shape[:-1], -1)
    )
    bin_count = torch.zeros_like(levels.pixels).index_add(
        0, levels.cell_level, torch.ones_like(count)
    )
    # degrees of freedom: two for mean and variance, number of bins - 1 for a histogram
    freedom = torch.where(measured, 2.0, torch.where(by_cells, (bin_count - 1).clamp_min(0.0), 0.0))
    deviance = torch.where(measured, moments, torch.where(by_cells, level_deviance, 0.0))
    return torch.where(freedom > 0, deviance, 0.0), freedom


# --- likelihood node ------------------------------------------------------------------------------

# The node that computes the likelihood of calibration frames from the parameters of a sensor.


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
    broadcast = torch.broadcast_tensors(*columns)  # type: ignore[no-untyped-call]
    (
        gain_k,
        efficiency,
        offset_electrons,
        read_electrons,
        dark_electrons,
        well_electrons,
        mean_change,
        noise_factor,
    ) = broadcast
    mean_factor = mean_change + (mean == "additive")
    # e-^2 per photon; noise drawn in photons is multiplied by the quantum efficiency afterwards
    variance_per_photon = noise_factor.square() * (
        efficiency if drawn_in == "electrons" else efficiency.square()
    )
    is_poisson = arrivals == "poisson" and (mean, drawn_in) == ("additive", "electrons")
    sensor = Sensor(
        gain=gain_k,
        response=gain_k * efficiency * mean_factor,
        noise=gain_k.square() * variance_per_photon,
        offset=gain_k * offset_electrons,
        read=gain_k * read_electrons,
        dark=gain_k * dark_electrons / dark_exposure,
        well=gain_k * well_electrons,
        counted=is_poisson and bool(((noise_factor == 1) & (mean_change == 0)).all()),
    )
    return likelihood(levels, sensor, rounding, bits, told)


@density.check
def _(result: Likelihood, *inputs: Sufficient, **params: Any) -> list[Check]:
    if not len(result.degrees_of_freedom):
        return []
    deviance, freedom = float(result.deviance.sum()), float(result.degrees_of_freedom.sum())
    return [Check(f"deviance {deviance:.4g} for {freedom:.0f} degrees of freedom")]
