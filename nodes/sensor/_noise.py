"""Noise of the sensor: photon noise, dark current and read noise."""

import functools
import math
from collections.abc import Callable
from itertools import pairwise
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Generator, Tensor

from neusee.nodes import Check, ErrorBound, ParameterError, TensorStats, node
from neusee.nodes._half_precision import single
from neusee.nodes.sensor._draw_limits import SURE, amplitude_error, amplitude_error_drawn, chi_square_limit, poisson_rms
from neusee.nodes.sensor._room_for_light import refuse_without_room
from neusee.nodes.sensor._saturation import Efficiency, Well
from neusee.nodes.torch_func import transformed
from neusee.nodes.units import DarkCurrent, Electrons, ElectronsPerSecond, Exposure, Fraction

Distribution = Literal["gaussian", "poisson"]
_PART = 1 << 15  #: elements; torch splits larger arrays among threads, which is slow on a busy machine
_DARK = 1e-30  #: e-; smaller numbers count as 0, because the gradient of the square root is unbounded near 0
_MOST = 5.0  #: largest ratio of a sampled mean of the dark current to the given mean, 8 standard deviations above
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

    With the mean count n in the unit in which the noise is drawn, `additive` gives n + N(c1 n, c2 sqrt(n)), and
    `literal` gives N(c1 n, c2 sqrt(n)), as the paper prints, with c1 = mean_shift and c2 = spread. `poisson` draws the
    fluctuation from the Poisson distribution. If the noise is drawn in photons and then multiplied by the efficiency,
    the noise is too small by a factor of sqrt(efficiency).

    Shapes: photons (..., y, x) -> (..., y, x).
    Units:  photons per exposure; result e-.
    Error:  the result is clipped at 0, which raises the Gaussian mean by at most 0.1 e-, near 0.4 e-, and by less
            than 1e-3 e- above 10 e-. Negative photons (round-off of a convolution) count as 0.
    Source: NeuSee, section Sensor Image; EMVA Standard 1288, release 4.0 (variance = mean, in electrons).
    """
    kept = mean_shift if mean == "literal" else 1.0 + mean_shift

    def detected(part: Tensor) -> Tensor:
        counts = part.clamp_min(0) * (quantum_efficiency if drawn_in == "electrons" else 1.0)
        fluctuation = _poisson(counts, rng) if distribution == "poisson" else _gaussian(counts, rng)
        drawn = (kept * counts).add_(spread * fluctuation).clamp_min(0)
        return drawn if drawn_in == "electrons" else drawn * quantum_efficiency

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
    """Return the error bound of the electrons: the error of the mean plus the error of the noise amplitude.

    The noise amplitude is the square root of the mean: |sqrt(a) - sqrt(b)| <= sqrt|a - b| and <= |a - b| / sqrt(a).
    Poisson numbers are drawn anew for another mean, so their error has no bound.
    """
    return _electrons_error(photons, amplitude_error, **params)


@photon_noise.propagate_draw
def _(photons: ErrorBound, *, result: TensorStats, **params: Any) -> float:
    """Return the error bound of the electrons of one draw, which one of 10 000 draws exceeds."""
    pixels = max(1, math.prod(result.shape))
    return _electrons_error(photons, functools.partial(amplitude_error_drawn, pixels=pixels), **params)


def _electrons_error(
    photons: ErrorBound,
    amplitude: Callable[[float, float], float],
    *,
    quantum_efficiency: float,
    spread: float = 1.0,
    **params: Any,
) -> float:
    if params["distribution"] == "poisson" and photons.rms > 0:
        return math.inf
    drawn = photons.rms * (quantum_efficiency if params["drawn_in"] == "electrons" else 1.0)
    kept = params["mean_shift"] + (params["mean"] == "additive")
    electrons: float = 1.0 if params["drawn_in"] == "electrons" else quantum_efficiency
    darkest = photons.stats.min * drawn / photons.rms if photons.stats and photons.rms > 0 else 0.0
    total: float = electrons * (abs(kept) * drawn + spread * amplitude(drawn, darkest))
    return total


def _gaussian(counts: Tensor, rng: Generator) -> Tensor:
    lit = ~(counts <= _DARK)  # True for NaN, so that NaN reaches the result
    if not (counts.requires_grad or transformed()):
        return normal(counts, rng).mul_(counts.where(lit, 0.0).sqrt_())
    sigma = counts.where(lit, 1.0).sqrt().where(lit, 0.0)  # at 0, the square root has no finite gradient
    return sigma * normal(counts, rng)


def _poisson(counts: Tensor, rng: Generator) -> Tensor:
    still = counts.detach()
    return torch.poisson(still.to(rng.device), generator=rng).to(counts) - still


def _by_parts(compute: Callable[[Tensor], Tensor], whole: Tensor, rng: Generator) -> Tensor:
    """Apply ``compute`` to parts of a tensor that fit into the CPU cache, with the same result as for the whole.

    The random numbers must not depend on the parts. Torch draws fewer than 16 normal numbers by another method, so no
    part is that short.
    """
    count = whole.numel()
    if torch.is_grad_enabled() or {whole.device.type, rng.device.type} != {"cpu"} or count < 2 * _PART:
        return compute(whole)
    result, flat = torch.empty(whole.shape, dtype=whole.dtype), whole.reshape(-1)
    ends = [*range(_PART, count - _PART, _PART), count]
    for first, last in pairwise([0, *ends]):
        result.view(-1)[first:last] = compute(flat[first:last])
    return result


def normal(like: Tensor, rng: Generator) -> Tensor:
    """Sample standard normal numbers in the shape of ``like``, with equal numbers in every precision."""
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

    The mean of the distribution is ``mean``, for ``mean_of`` sensor. For ``mean_of`` exposure the mean is sampled once
    for each exposure from a normal distribution with mean ``mean`` and half of it as standard deviation, as the paper
    prints of the training; a negative sample counts as 0.

    ``full_well`` is used only to decide if the dark current is small enough to leave out: the electrons are compared
    with the signal up to the well, because a later step cuts off the signal of a laser above the well.

    Shapes: electrons (..., y, x) -> (..., y, x).
    Units:  e-; mean e- per exposure, or e-/s; exposure s.
    Error:  one mean for all pixels: hot pixels are left out.
    Raises: ParameterError before the run for a mean in e-/s without an exposure.
    Source: NeuSee, section Sensor Image; EMVA Standard 1288, release 4.0 (dark current).
    """

    total = dark_electrons(mean, exposure)
    expected = total if mean_of == "sensor" else _sampled_mean(total, rng)

    def with_dark_current(part: Tensor) -> Tensor:
        rate = torch.full(part.shape, expected, dtype=part.dtype, device=rng.device)
        return part + torch.poisson(rate, generator=rng).to(part)

    return _by_parts(with_dark_current, single(electrons), rng)


def dark_electrons(mean: float | ElectronsPerSecond, exposure: float | None) -> float:
    """Return the mean dark electrons of one exposure, from electrons of an exposure or electrons per second.

    Raises ParameterError for electrons per second without an exposure.
    """
    if not isinstance(mean, ElectronsPerSecond):
        return mean
    if exposure is None:
        raise ParameterError("mean", f"{mean.rate:g} e-/s needs the exposure: give `exposure` to the step, or use e-")
    return mean.rate * exposure


@dark_current.preflight
def _(
    *, mean: float | ElectronsPerSecond, exposure: float | None, full_well: float | None = None, **params: object
) -> list[str]:
    refuse_without_room(math.inf if full_well is None else full_well, dark=dark_electrons(mean, exposure))
    return []


def _sampled_mean(mean: float, rng: Generator) -> float:
    drawn = torch.randn((), generator=rng, device=rng.device, dtype=torch.float64)
    return mean * max(0.0, min(_MOST, 1.0 + 0.5 * float(drawn)))


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
    most = total if mean_of == "sensor" else _MOST * total
    return _share(most, math.sqrt(most), electrons, full_well)


@dark_current.skip_draw
def _(
    electrons: TensorStats,
    *,
    mean: float | ElectronsPerSecond,
    exposure: float | None = None,
    mean_of: str = "sensor",
    **params: Any,
) -> float:
    total = dark_electrons(mean, exposure)
    most = total if mean_of == "sensor" else _MOST * total
    usual = math.sqrt(most + most**2)
    return poisson_rms(most, max(1, math.prod(electrons.shape))) / usual if usual > 0 else 1.0


@node()
def read_noise(
    electrons: Tensor, *, offset: Electrons, read_noise: Electrons, full_well: Well | None = None, rng: Generator
) -> Tensor:
    """Add the offset and the Gaussian noise of the sensor amplifier to the electrons of each pixel.

    The temporal dark noise of EMVA 1288 includes read noise and dark current:
    sigma_d**2 = read_noise**2 + mean of the dark current. The dark signal mu_d of EMVA 1288 is offset + mean of the
    dark current. ``full_well`` has the same meaning as in `sensor.dark_current`.

    Shapes: electrons (..., y, x) -> (..., y, x).
    Units:  e-; offset e-, the paper's "mean read noise"; read_noise e- rms.
    Error:  white: row noise and telegraph noise are left out.
    Source: NeuSee, section Sensor Image; EMVA Standard 1288, release 4.0; Janesick, Photon Transfer, SPIE
            PM170 (2007).
    """

    def with_read_noise(part: Tensor) -> Tensor:
        return part + normal(part, rng).mul_(read_noise).add_(offset)

    return _by_parts(with_read_noise, single(electrons), rng)


@read_noise.preflight
def _(*, offset: float, read_noise: float, full_well: float | None = None, **params: object) -> list[str]:
    refuse_without_room(math.inf if full_well is None else full_well, offset=offset, read_noise=read_noise)
    return []


@read_noise.skip_bound
def _(electrons: TensorStats, *, offset: float, read_noise: float, full_well: float | None) -> float:
    return _share(offset, read_noise, electrons, full_well)


@read_noise.skip_draw
def _(electrons: TensorStats, *, offset: float, read_noise: float, **params: Any) -> float:
    pixels, variance = max(1, math.prod(electrons.shape)), read_noise**2
    sure = SURE + math.log(2.0)  # half of the probability is for the mean of the noise, half for its square
    mean = abs(offset) * read_noise * math.sqrt(2.0 * sure / pixels)
    square = chi_square_limit(pixels * variance, variance, sure) / pixels
    usual = math.hypot(offset, read_noise)
    return math.sqrt(offset**2 + 2.0 * mean + square) / usual if usual > 0 else 1.0


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


def _share(shift: float, spread: float, electrons: TensorStats, full_well: float | None) -> float:
    """Return the rms of the added electrons, divided by the largest signal or the full well, whichever is smaller.

    The largest signal is that of the brightest pixel, or that of the darkest pixel if the counts are below 0. The well
    alone is not enough, because a dark frame is only noise. The bound is exact for one mean and spread everywhere.
    """
    added = math.hypot(shift, spread)
    if added == 0:
        return 0.0
    largest = max(math.hypot(electrons.max + shift, spread), math.hypot(electrons.min + shift, spread))
    weighed = largest if full_well is None else min(largest, full_well)
    return added / weighed if weighed > 0 else math.inf
