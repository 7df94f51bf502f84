"""Noise of the sensor: photon noise, dark current, read noise, and probable limits of one draw."""

import functools
import math
from collections.abc import Callable
from itertools import pairwise
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Generator, Tensor

from neusee.nodes import Check, ErrorBound, ParameterError, TensorStats, node
from neusee.nodes.precision import single, transformed
from neusee.nodes.sensor._saturation import Well, refuse_without_room
from neusee.nodes.units import (
    DarkCurrent,
    Efficiency,
    Electrons,
    ElectronsPerSecond,
    Exposure,
    Fraction,
)

# --- draw limits ----------------------------------------------------------------------------------

# Limits that noise exceeds in at most one of 10 000 draws: for counts of rare events, and for sums
# of squares of noise.


RARITY = math.log(1e4)  #: negative logarithm of the probability that a draw exceeds its limit


def rare_events(mean: float, sure: float = RARITY) -> int:
    """Return the smallest count that a Poisson number of this mean exceeds with a probability of at
    most exp(-``sure``).

    It is also a limit for a sum of independent events of unequal probabilities, if the count is at
    least the mean + 1.

    Source: quantile of the Poisson distribution, whose sum of probabilities is the incomplete gamma
            function; sums of unequal events: Anderson and Samuels, Proc. 5th Berkeley Symp. 1, 1
            (1967).
    """
    low, high = -1, max(8, math.ceil(mean + sure + 2.0 * math.sqrt(mean * sure)))
    # bisection: `low` is exceeded too often, `high` is not
    while high - low > 1:
        middle = (low + high) // 2
        # probability of more than `middle` events: incomplete gamma function P(middle + 1, mean)
        exceeding = torch.special.gammainc(
            torch.tensor(middle + 1.0, dtype=torch.float64), torch.tensor(mean, dtype=torch.float64)
        )
        low, high = (middle, high) if float(exceeding) > math.exp(-sure) else (low, middle)
    return high


def poisson_rms(mean: float, pixels: int) -> float:
    """Return a limit that the rms of Poisson numbers in ``pixels`` exceeds in at most one of 10 000
    draws.

    Half of the probability is for a pixel above ``rare_number``, half for the sum of squares of the
    others, whose variance is at most the fourth moment of the distribution.

    Source: Bernstein's inequality: Boucheron, Lugosi and Massart, Concentration Inequalities,
            section 2.8 (2013).
    """
    if mean == 0:
        return 0.0
    sure = RARITY + math.log(2.0)
    rare_number = rare_events(mean, sure + math.log(pixels))
    # fourth moment of a Poisson number of mean m: m + 7 m^2 + 6 m^3 + m^4
    fourth_moment = mean + 7 * mean**2 + 6 * mean**3 + mean**4
    # Bernstein: excess t of a sum of bounded terms solves t^2 / (2 (V + c t / 3)) = sure
    linear_term = rare_number**2 * sure / 3
    sum_excess = linear_term + math.sqrt(linear_term**2 + 2 * pixels * fourth_moment * sure)
    return min(float(rare_number), math.sqrt((pixels * (mean + mean**2) + sum_excess) / pixels))


def chi_square_limit(weights: float, largest: float, sure: float = RARITY) -> float:
    """Return the limit that a weighted sum of squared normal numbers exceeds with a probability of
    exp(-``sure``).

    ``weights`` is the sum of the weights, ``largest`` the largest weight.

    Source: Laurent and Massart, Ann. Stat. 28, 1302 (2000), lemma 1, with the sum of squared
            weights at most
    ``weights`` x ``largest``.
    """
    return weights + 2.0 * math.sqrt(weights * largest * sure) + 2.0 * largest * sure


def amplitude_error_drawn(drawn: float, darkest: float, pixels: int) -> float:
    """Return a bound of the rms change of one draw of photon noise, if the mean counts change by
    the rms ``drawn``.

    The change of a pixel is a normal number times the square root of a weight. For a change e of
    the mean, the weight is at most e, and at most e**2 / ``darkest``. The weights are summed for
    the worst distribution of the error over the pixels.
    """
    sum_of_squares = pixels * drawn**2
    # largest weight: the whole error in one pixel; largest sum: equal errors in all pixels
    largest_weight = math.sqrt(sum_of_squares)
    sum_of_weights = math.sqrt(pixels) * largest_weight
    if darkest > 0:
        largest_weight, sum_of_weights = (
            min(largest_weight, sum_of_squares / darkest),
            min(sum_of_weights, sum_of_squares / darkest),
        )
    return math.sqrt(chi_square_limit(sum_of_weights, largest_weight) / pixels)


def amplitude_error(drawn: float, darkest: float) -> float:
    """Return a bound of the rms change of photon noise over all draws, if the mean counts change by
    the rms ``drawn``.
    """
    return math.sqrt(drawn) if darkest <= drawn else drawn / math.sqrt(darkest)


# --- noise ----------------------------------------------------------------------------------------

# Noise of the sensor: photon noise, dark current and read noise.


Distribution = Literal["gaussian", "poisson"]
#: elements per part; torch splits larger arrays among threads, which is slow on a busy machine
_PART_ELEMENTS = 1 << 15
#: e-; smaller values count as 0, because the gradient of the square root is unbounded near 0
_DARK_ELECTRONS = 1e-30
#: largest ratio of a sampled mean of the dark current to ``mean``: 8 standard deviations above it
_LARGEST_DRAWN_MEAN = 5.0
Spread = Annotated[float, Field(ge=0, le=100)]


@node()
def photon_noise(
    photons: Tensor,
    *,
    quantum_efficiency: Efficiency,
    distribution: Distribution = "gaussian",
    mean_shift: Fraction = 0.0,
    spread: Spread = 1.0,
    mean: Literal["additive", "literal"] = "additive",
    drawn_in: Literal["electrons", "photons"] = "electrons",
    rng: Generator,
) -> Tensor:
    """Convert photons to electrons and add photon noise.

    With the mean count n in the unit in which the noise is drawn, `additive` gives n + N(c1 n, c2
    sqrt(n)), and `literal` gives N(c1 n, c2 sqrt(n)), as the paper prints, with c1 = mean_shift and
    c2 = spread. `poisson` draws the fluctuation from the Poisson distribution. If the noise is
    drawn in photons and then multiplied by the efficiency, the noise is too small by a factor of
    sqrt(efficiency).

    Shapes: photons (..., y, x) -> (..., y, x).
    Units:  photons per exposure; result e-.
    Error:  the result is clipped at 0, which raises the Gaussian mean by at most 0.1 e-, near 0.4
            e-, and by less than 1e-3 e- above 10 e-. Negative photons (round-off of a convolution)
            count as 0.
    Source: NeuSee, section Sensor Image; EMVA Standard 1288, release 4.0 (variance = mean, in
            electrons).
    """
    mean_factor = mean_shift if mean == "literal" else 1.0 + mean_shift

    def detected(piece: Tensor) -> Tensor:
        counts = piece.clamp_min(0) * (quantum_efficiency if drawn_in == "electrons" else 1.0)
        fluctuation = (
            _poisson_deviation(counts, rng)
            if distribution == "poisson"
            else _gaussian_noise(counts, rng)
        )
        noisy_counts = (mean_factor * counts).add_(spread * fluctuation).clamp_min(0)
        return noisy_counts if drawn_in == "electrons" else noisy_counts * quantum_efficiency

    return _by_parts(detected, single(photons), rng)


@photon_noise.preflight
def _(*, mean: str = "additive", mean_shift: float = 0.0, **params: object) -> list[str]:
    if mean == "literal" and mean_shift < 1:
        return [f"photon noise as the paper prints: the mean is {mean_shift:.0%} of the light"]
    return []


@photon_noise.check
def _(result: Tensor, photons: Tensor, **params: Any) -> list[Check]:
    low, high = float(photons.min()), float(photons.max())
    mean = float(result.sum(-1).sum(dtype=torch.float64)) / max(1, result.numel())
    return [Check(f"the mean signal is {mean:.4g} e- per pixel", low >= -1e-4 * max(high, 1.0))]


@photon_noise.propagate_error
def _(photons: ErrorBound, *, result: TensorStats, **params: Any) -> float:
    """Return the error bound of the electrons: the error of the mean plus the error of the noise
    amplitude.

    The noise amplitude is the square root of the mean: |sqrt(a) - sqrt(b)| <= sqrt|a - b| and <= |a
    - b| / sqrt(a). Poisson numbers are drawn anew for another mean, so their error has no bound.
    """
    return _electrons_error(photons, amplitude_error, **params)


@photon_noise.propagate_draw
def _(photons: ErrorBound, *, result: TensorStats, **params: Any) -> float:
    """Return an error bound of the electrons of one draw, which at most one of 10 000 draws
    exceeds.
    """
    pixels = max(1, math.prod(result.shape))
    return _electrons_error(
        photons, functools.partial(amplitude_error_drawn, pixels=pixels), **params
    )


def _electrons_error(
    photons: ErrorBound,
    amplitude: Callable[[float, float], float],
    *,
    quantum_efficiency: float,
    spread: float = 1.0,
    **params: Any,
) -> float:
    """Return the error bound of the electrons: error of the mean plus error of the noise amplitude.

    ``amplitude`` computes the latter from the error of the mean and the darkest mean count.
    """
    if params["distribution"] == "poisson" and photons.rms > 0:
        return math.inf
    # counts: electrons or photons, the unit in which the noise is drawn
    count_error = photons.rms * (quantum_efficiency if params["drawn_in"] == "electrons" else 1.0)
    mean_factor = params["mean_shift"] + (params["mean"] == "additive")
    electrons_per_count: float = 1.0 if params["drawn_in"] == "electrons" else quantum_efficiency
    darkest_count = (
        photons.stats.min * count_error / photons.rms if photons.stats and photons.rms > 0 else 0.0
    )
    electrons_error: float = electrons_per_count * (
        abs(mean_factor) * count_error + spread * amplitude(count_error, darkest_count)
    )
    return electrons_error


def _gaussian_noise(counts: Tensor, rng: Generator) -> Tensor:
    """Return normal noise of the standard deviation sqrt(counts), 0 where there is no light."""
    has_light = ~(counts <= _DARK_ELECTRONS)  # True for NaN, so that NaN reaches the result
    if not (counts.requires_grad or transformed()):
        return standard_normal(counts, rng).mul_(counts.where(has_light, 0.0).sqrt_())
    # at 0, the square root has no finite gradient
    sigma = counts.where(has_light, 1.0).sqrt().where(has_light, 0.0)
    return sigma * standard_normal(counts, rng)


def _poisson_deviation(counts: Tensor, rng: Generator) -> Tensor:
    """Return the deviation from their means of Poisson numbers with the means ``counts``; it has
    no gradient.
    """
    means = counts.detach()
    return torch.poisson(means.to(rng.device), generator=rng).to(counts) - means


def _by_parts(compute: Callable[[Tensor], Tensor], numbers: Tensor, rng: Generator) -> Tensor:
    """Apply ``compute`` to parts of a tensor that fit into the CPU cache, with the same result as
    for the whole.

    The random numbers must not depend on the parts. Torch draws fewer than 16 normal numbers by
    another method, so no part is that short.
    """
    element_count = numbers.numel()
    if (
        torch.is_grad_enabled()
        or {numbers.device.type, rng.device.type} != {"cpu"}
        or element_count < 2 * _PART_ELEMENTS
    ):
        return compute(numbers)
    result, flat_numbers = torch.empty(numbers.shape, dtype=numbers.dtype), numbers.reshape(-1)
    # the last part includes the remainder, so that none is shorter than `_PART_ELEMENTS`
    part_ends = [
        *range(_PART_ELEMENTS, element_count - _PART_ELEMENTS, _PART_ELEMENTS),
        element_count,
    ]
    for start, end in pairwise([0, *part_ends]):
        result.view(-1)[start:end] = compute(flat_numbers[start:end])
    return result


def standard_normal(like: Tensor, rng: Generator) -> Tensor:
    """Sample standard normal numbers in the shape of ``like``, with equal numbers in every
    precision.
    """
    return torch.randn(like.shape, generator=rng, device=rng.device, dtype=torch.float32).to(like)


@node()
def dark_current(
    electrons: Tensor,
    *,
    mean: DarkCurrent,
    exposure: Exposure | None = None,
    full_well: Well | None = None,
    mean_of: Literal["sensor", "exposure"] = "sensor",
    rng: Generator,
) -> Tensor:
    """Add the thermal electrons of one exposure, sampled from a Poisson distribution.

    A mean in e-/s is multiplied by ``exposure``.

    The mean of the distribution is ``mean``, for ``mean_of`` sensor. For ``mean_of`` exposure the
    mean is sampled once for each exposure from a normal distribution with mean ``mean`` and half of
    it as standard deviation, as the paper prints of the training; a negative sample counts as 0.

    ``full_well`` is used only to decide if the dark current is small enough to leave out: the
    electrons are compared with the signal up to the well, because a later step cuts off the signal
    of a laser above the well.

    Shapes: electrons (..., y, x) -> (..., y, x).
    Units:  e-; mean e- per exposure, or e-/s; exposure s.
    Error:  one mean for all pixels: hot pixels are left out.
    Raises: ParameterError before the run for a mean in e-/s without an exposure.
    Source: NeuSee, section Sensor Image; EMVA Standard 1288, release 4.0 (dark current).
    """

    mean_electrons = dark_electrons(mean, exposure)
    exposure_mean = mean_electrons if mean_of == "sensor" else _sampled_mean(mean_electrons, rng)

    def with_dark_current(piece: Tensor) -> Tensor:
        rate = torch.full(piece.shape, exposure_mean, dtype=piece.dtype, device=rng.device)
        return piece + torch.poisson(rate, generator=rng).to(piece)

    return _by_parts(with_dark_current, single(electrons), rng)


def dark_electrons(mean: float | ElectronsPerSecond, exposure: float | None) -> float:
    """Return the mean dark electrons of one exposure, from electrons of an exposure or electrons
    per second.

    Raises ParameterError for electrons per second without an exposure.
    """
    if not isinstance(mean, ElectronsPerSecond):
        return mean
    if exposure is None:
        raise ParameterError(
            "mean", f"{mean.rate:g} e-/s needs the exposure: give `exposure` to the step, or use e-"
        )
    return mean.rate * exposure


@dark_current.preflight
def _(
    *,
    mean: float | ElectronsPerSecond,
    exposure: float | None,
    full_well: float | None = None,
    **params: object,
) -> list[str]:
    well = math.inf if full_well is None else full_well
    refuse_without_room(well, dark=dark_electrons(mean, exposure))
    return []


def _sampled_mean(mean: float, rng: Generator) -> float:
    """Return the mean dark electrons of one exposure, drawn with a standard deviation of half the
    mean and limited to 0 and `_LARGEST_DRAWN_MEAN` times the mean.
    """
    normal_number = torch.randn((), generator=rng, device=rng.device, dtype=torch.float64)
    return mean * max(0.0, min(_LARGEST_DRAWN_MEAN, 1.0 + 0.5 * float(normal_number)))


@dark_current.skip_bound
def _(
    electrons: TensorStats,
    *,
    mean: float | ElectronsPerSecond,
    full_well: float | None,
    exposure: float | None = None,
    mean_of: str = "sensor",
) -> float:
    total = dark_electrons(mean, exposure)
    largest_mean = total if mean_of == "sensor" else _LARGEST_DRAWN_MEAN * total
    return _relative_rms(largest_mean, math.sqrt(largest_mean), electrons, full_well)


@dark_current.skip_draw
def _(
    electrons: TensorStats,
    *,
    mean: float | ElectronsPerSecond,
    exposure: float | None = None,
    mean_of: str = "sensor",
    **params: Any,
) -> float:
    mean_electrons = dark_electrons(mean, exposure)
    largest_mean = mean_electrons if mean_of == "sensor" else _LARGEST_DRAWN_MEAN * mean_electrons
    usual_rms = math.sqrt(largest_mean + largest_mean**2)
    return (
        poisson_rms(largest_mean, max(1, math.prod(electrons.shape))) / usual_rms
        if usual_rms > 0
        else 1.0
    )


@node()
def read_noise(
    electrons: Tensor,
    *,
    offset: Electrons,
    read_noise: Electrons,
    full_well: Well | None = None,
    rng: Generator,
) -> Tensor:
    """Add the offset and the Gaussian noise of the sensor amplifier to the electrons of each pixel.

    The temporal dark noise of EMVA 1288 includes read noise and dark current:
    sigma_d**2 = read_noise**2 + mean of the dark current. The dark signal mu_d of EMVA 1288 is
    offset + mean of the dark current. ``full_well`` has the same meaning as in
    `sensor.dark_current`.

    Shapes: electrons (..., y, x) -> (..., y, x).
    Units:  e-; offset e-, the paper's "mean read noise"; read_noise e- rms.
    Error:  white: row noise and telegraph noise are left out.
    Source: NeuSee, section Sensor Image; EMVA Standard 1288, release 4.0; Janesick, Photon
            Transfer, SPIE PM170 (2007).
    """

    def with_read_noise(piece: Tensor) -> Tensor:
        return piece + standard_normal(piece, rng).mul_(read_noise).add_(offset)

    return _by_parts(with_read_noise, single(electrons), rng)


@read_noise.preflight
def _(
    *, offset: float, read_noise: float, full_well: float | None = None, **params: object
) -> list[str]:
    well = math.inf if full_well is None else full_well
    refuse_without_room(well, offset=offset, read_noise=read_noise)
    return []


@read_noise.skip_bound
def _(
    electrons: TensorStats, *, offset: float, read_noise: float, full_well: float | None
) -> float:
    return _relative_rms(offset, read_noise, electrons, full_well)


@read_noise.skip_draw
def _(electrons: TensorStats, *, offset: float, read_noise: float, **params: Any) -> float:
    pixels, variance = max(1, math.prod(electrons.shape)), read_noise**2
    # half of the probability is for the mean of the noise, half for its square
    sure = RARITY + math.log(2.0)
    mean_term = abs(offset) * read_noise * math.sqrt(2.0 * sure / pixels)
    square_limit = chi_square_limit(pixels * variance, variance, sure) / pixels
    usual_rms = math.hypot(offset, read_noise)
    # limit of the rms of offset + noise, relative to the usual rms
    return (
        math.sqrt(offset**2 + 2.0 * mean_term + square_limit) / usual_rms if usual_rms > 0 else 1.0
    )


@dark_current.skip_scale
@read_noise.skip_scale
def _(electrons: TensorStats, *, full_well: float | None, **params: Any) -> float:
    """Return the largest absolute number of electrons in a pixel, limited to the full well."""
    largest = max(abs(electrons.max), abs(electrons.min))
    return largest if full_well is None else min(largest, full_well)


@dark_current.propagate_error
@read_noise.propagate_error
def _(electrons: ErrorBound, **params: Any) -> float:
    return electrons.rms


def _relative_rms(
    shift: float, spread: float, electrons: TensorStats, full_well: float | None
) -> float:
    """Return the rms of the added electrons, divided by the largest signal or the full well,
    whichever is smaller.

    The largest signal is that of the brightest pixel, or that of the darkest pixel if the counts
    are below 0. The well alone is not enough, because a dark frame is only noise. The bound is
    exact for one mean and spread everywhere.
    """
    rms_added = math.hypot(shift, spread)
    if rms_added == 0:
        return 0.0
    largest_rms = max(
        math.hypot(electrons.max + shift, spread), math.hypot(electrons.min + shift, spread)
    )
    reference_signal = largest_rms if full_well is None else min(largest_rms, full_well)
    return rms_added / reference_signal if reference_signal > 0 else math.inf
