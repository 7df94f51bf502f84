"""Laws of laser damage by irradiance or fluence, published thresholds, absorption of silicon."""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

# --- damage laws ----------------------------------------------------------------------------------

# A law of damage is the threshold, an irradiance or a fluence, at which a laser damages a sensor,
# with a bracket or a spread.
#
# A published threshold is a single value or a bracket such as "tens of kW/cm2": it gives ratios and
# no probability. A law with ``factor`` is lognormal and rests on measurements of devices: its
# median is the threshold of the median device, ``factor`` is the geometric standard deviation from
# device to device, and ``median_factor`` is the geometric standard deviation of the median, which
# was estimated from few devices. A probability is the share of devices that are damaged; its
# interval comes from the uncertainty of the median.


Number = float | Tensor
Kind = Literal["point", "line", "cross", "destruction", "frame"]
Quantity = Literal["irradiance", "fluence"]

KINDS: tuple[Kind, ...] = ("point", "line", "cross", "destruction", "frame")
#: m2/s, of silicon at room temperature: 148 W/(m K) / (2330 kg/m3 x 710 J/(kg K))
DIFFUSIVITY = 9e-5
LEVEL = 0.9  #: probability of every interval of this module
#: quantile of the standard normal distribution at 0.95, for a two-sided interval of `LEVEL`
NORMAL_QUANTILE = 1.6448536269514722


class DamageLaw(NamedTuple):
    """The threshold of one kind of damage to one class of sensors, with the ranges of wavelength
    and duration for which it holds.
    """

    device: str  #: class of the sensor, such as CMOS
    damage: Kind  #: kind of damage, by its appearance
    quantity: Quantity  #: irradiance of continuous light, or fluence of one pulse
    median: float  #: W/m2 or J/m2, threshold of the median device, peak of the spot
    #: geometric standard deviation from device to device, above 1; None where it is not known
    factor: float | None
    #: geometric standard deviation of the median, above 1; None where it is not known
    median_factor: float | None
    wavelengths: tuple[float, float]  #: m
    durations: tuple[float, float]  #: s, dwell time of continuous light or duration of a pulse
    #: m, 1/e2 diameter of the spot with which the threshold was measured; None where not known
    spot: float | None
    source: str
    #: W/m2 or J/m2, lower end of a published bracket; None for a single figure
    low: float | None = None
    high: float | None = None  #: W/m2 or J/m2, upper end of a published bracket

    @property
    def has_spread(self) -> bool:
        """Return True if the law states both `factor` and `median_factor`, which a probability
        needs.
        """
        return self.factor is not None and self.median_factor is not None

    @property
    def unit(self) -> str:
        """Return the unit in which laser damage is usually stated, W/cm2 or J/cm2, which is 1e4 SI
        units.
        """
        return "W/cm2" if self.quantity == "irradiance" else "J/cm2"


class Damage(NamedTuple):
    """Exposure relative to a damage threshold and, where the spread is known, the probability of
    damage.
    """

    ratio: float  #: exposure over the threshold of the median device
    probability: float | None  #: share of devices that are damaged; None for a law without spread
    low: float | None  #: lower end of the 90 % interval of the probability
    high: float | None  #: upper end


def double(value: Number) -> Tensor:
    """Return a number or a tensor as a tensor in double precision."""
    return torch.as_tensor(value, dtype=torch.float64)


def matching_laws(
    laws: Iterable[DamageLaw], device: str, wavelength: float, duration: float, quantity: Quantity
) -> tuple[DamageLaw, ...]:
    """Return the laws of a quantity that hold for a class of sensors, a wavelength in m and a
    duration in s.
    """
    device_laws = [law for law in laws if law.device.casefold() == device.casefold()]
    quantity_laws = [law for law in device_laws if law.quantity == quantity]
    return tuple(law for law in quantity_laws if _holds(law, wavelength, duration))


def _holds(law: DamageLaw, wavelength: float, duration: float) -> bool:
    """Return True if a law holds at a wavelength in m and for a duration in s."""
    in_wavelengths = law.wavelengths[0] <= wavelength <= law.wavelengths[1]
    return in_wavelengths and law.durations[0] <= duration <= law.durations[1]


def spot_reach(diameter: Number, duration: Number) -> Tensor:
    """Return a length in m proportional to the temperature rise at the centre of a Gaussian spot
    per peak irradiance.

    The surface of a half-space at the centre of a spot of radius w warms by A E w / (k sqrt(2 pi))
    times arctan(sqrt(8 kappa t) / w) after a time t. The result is w arctan(sqrt(8 kappa t) / w):
    proportional to w for small steady spots, and independent of w for short pulses.

    Source: Carslaw, Jaeger, Conduction of Heat in Solids, 2nd ed., ch. 10, integrated over a
            Gaussian spot.
    """
    radius = double(diameter) / 2
    return radius * torch.atan(torch.sqrt(8 * DIFFUSIVITY * double(duration)) / radius)


def spot_factor(
    published: float, spot: Number, duration: Number, small_spot_exponent: Number = 0.0
) -> Tensor:
    """Return the factor on a published threshold of continuous light for a spot of another
    diameter, both 1/e2 in m.

    A wider spot warms more at equal irradiance; its threshold is lowered to give equal heat at the
    centre, by the factor published / spot in the steady state. The threshold of a narrower spot is
    not raised by default: two published laws contradict the factor 1 / diameter by 40 times. With
    ``small_spot_exponent`` above 0 it is raised by (published / spot) to the power of the exponent.
    """
    diameter = double(spot)
    narrower_factor = (published / diameter) ** double(small_spot_exponent)
    wider_factor = spot_reach(published, duration) / spot_reach(diameter, duration)
    return torch.where(diameter <= published, narrower_factor, wider_factor)


def damage_threshold(
    law: DamageLaw,
    spot: float | None = None,
    duration: float | None = None,
    small_spot_exponent: float = 0.0,
) -> float:
    """Return the threshold of the median device in W/m2 or J/m2, for a spot of the 1/e2 diameter
    ``spot``.

    The irradiance of continuous light is multiplied by `spot_factor`. A fluence is not scaled,
    because heat travels about 2 um in 10 ns. Without a spot, or for a law whose own spot is not
    known, the result is the published median.
    """
    if law.quantity == "fluence" or spot is None or law.spot is None:
        return law.median
    dwell = law.durations[0] if duration is None else duration
    return law.median * float(spot_factor(law.spot, spot, dwell, small_spot_exponent))


def damage_at(
    law: DamageLaw,
    exposure: float,
    spot: float | None = None,
    duration: float | None = None,
    small_spot_exponent: float = 0.0,
) -> Damage:
    """Return ratio and probability of damage by a law, for an exposure in W/m2 or J/m2 at the peak
    of a spot.

    The probability is that of a random device, Phi(ln ratio / ln factor). Its 90 % interval follows
    from the median shifted by +-1.645 of its standard deviations. A law without ``factor`` or
    ``median_factor`` gives no probability. Exposure time of a frame, gain, full well and quantum
    efficiency have no effect.
    """
    ratio = exposure / damage_threshold(law, spot, duration, small_spot_exponent)
    if law.factor is None or law.median_factor is None:
        return Damage(ratio, None, None, None)
    # distance of the exposure above the median threshold, in standard deviations of ln threshold
    deviations = math.log(ratio) / math.log(law.factor) if ratio > 0 else -math.inf
    median_shift = NORMAL_QUANTILE * math.log(law.median_factor) / math.log(law.factor)
    return Damage(
        ratio,
        _normal_distribution(deviations),
        _normal_distribution(deviations - median_shift),
        _normal_distribution(deviations + median_shift),
    )


def _normal_distribution(x: float) -> float:
    """Return the standard normal distribution function, accurate in its lower tail."""
    return math.erfc(-x / math.sqrt(2)) / 2


# --- damage curve ---------------------------------------------------------------------------------

# Threshold of the first damage as a function of the duration of the light, from nanosecond pulses
# to continuous light.
#
# The curve connects two published thresholds: a fluence for pulses of 10 ns and an irradiance for
# continuous light. Between 10 ns and 10 us the fluence is interpolated log-log; beyond, the
# irradiance of the continuous law is used. The threshold fluence never falls with duration, and the
# threshold irradiance never rises.


PULSE_END = 10e-9  #: s, duration of the published fluence
CONTINUOUS_FROM = 10e-6  #: s, duration from which the continuous law counts
SHORTEST = 1e-9  #: s; for shorter pulses no lower end of the threshold is known
#: factor from the curve to each end of its bracket: by equal heat the two published thresholds
#: differ 40 times
SPREAD = math.sqrt(40.0)


@dataclass(frozen=True)
class Bracket:
    """A threshold and the ends of its bracket, in J/m2 or W/m2, as tensors that broadcast."""

    low: Tensor  #: 0 where no lower end is known
    middle: Tensor  #: the threshold to which ratios refer
    high: Tensor

    def times(self, factor: Number | tuple[float, float]) -> Bracket:
        """Return the bracket multiplied by a factor, or with its low and high ends multiplied by a
        pair of factors.
        """
        if isinstance(factor, tuple):
            return Bracket(self.low * factor[0], self.middle, self.high * factor[1])
        return Bracket(self.low * factor, self.middle * factor, self.high * factor)


@dataclass(frozen=True)
class CurveEnds:
    """The two published thresholds that define the curve of a class of sensors."""

    pulse: DamageLaw  #: fluence of the first damage by pulses of 10 ns
    #: irradiance of the first damage by continuous light, with its bracket and its spot
    continuous: DamageLaw


def first_damage(
    ends: CurveEnds, duration: Number, spot: Number | None = None, small_spot_exponent: Number = 0.0
) -> Bracket:
    """Return the threshold fluence in J/m2 of the first damage, for light of a duration in s on a
    spot of a 1/e2 diameter in m.

    From 1 to 10 ns the fluence is that of 10 ns, because heat stays within the depth in which
    silicon absorbs. Below 1 ns the lower end is 0: pulses of picoseconds are reported to damage at
    less fluence than those of nanoseconds, and no figure was found; the upper end still holds. The
    upper and the lower end are `SPREAD` away from the curve up to `CONTINUOUS_FROM`, and those of
    the continuous law where these are higher.

    Shapes: duration and spot broadcast.
    Units:  s, m -> J/m2.
    Error:  an interpolation between two published figures, which nobody measured.
    Source: the sources of both laws.
    """
    time = double(duration)
    spot_factors = _steady_spot_factor(ends.continuous, time, spot, small_spot_exponent)
    join_time = torch.full_like(time, CONTINUOUS_FROM)
    fluence_at_join = (
        _steady_spot_factor(ends.continuous, join_time, spot, small_spot_exponent)
        * ends.continuous.median
        * CONTINUOUS_FROM
    )
    # the threshold fluence must not fall with duration
    pulse_fluence = fluence_at_join.clamp_max(ends.pulse.median)
    decades = math.log10(CONTINUOUS_FROM / PULSE_END)
    # log-log slope of fluence over duration
    slope = torch.log10(fluence_at_join / pulse_fluence) / decades
    interpolated = pulse_fluence * (time.clamp(PULSE_END, CONTINUOUS_FROM) / PULSE_END) ** slope
    # a law without a bracket: the median for both ends
    low_irradiance, high_irradiance = (
        end or ends.continuous.median for end in (ends.continuous.low, ends.continuous.high)
    )
    middle = torch.maximum(interpolated, spot_factors * ends.continuous.median * time)
    lower = torch.maximum(interpolated / SPREAD, spot_factors * low_irradiance * time)
    return Bracket(
        low=torch.where(time < SHORTEST, 0.0, lower),
        middle=middle,
        high=torch.maximum(interpolated * SPREAD, spot_factors * high_irradiance * time),
    )


def _steady_spot_factor(
    law: DamageLaw, duration: Tensor, spot: Number | None, small_spot_exponent: Number
) -> Tensor:
    """Return the factor of the spot size on the continuous law; 1 if a spot is not known."""
    if spot is None or law.spot is None:
        return torch.ones_like(duration)
    return spot_factor(law.spot, spot, duration, small_spot_exponent)


# --- damage published -----------------------------------------------------------------------------

# Published thresholds of damage: brackets and single values, each with its source.
#
# Only abstracts and summaries of the sources were read, not full tables, so that no law has a
# spread of devices or a probability. A bracket such as "tens of kW/cm2" is taken as 10 to 100
# kW/cm2 around its geometric mean. The ranges of wavelengths, around the laser of the experiment,
# and of durations are our choice.


_SCHWARZ = (
    "Schwarz et al., Opt. Eng. 56, 034108 (2017), as summarised in Laser Focus World, July 2018:"
    " 532 nm, spot 25.7 um continuous, 28.2 um for pulses of 10 ns"
)
_TENS_OF_KILOWATTS = f"{_SCHWARZ}; a bracket, tens of kW/cm2, read as 10 to 100 kW/cm2"
_FRONT_SIDE = (
    "Photonics 12, 790 (2025), abstract: front-side illuminated CMOS, 532 nm, nanosecond pulses; "
    "one figure without spread"
)
GREEN = (500e-9, 560e-9)  #: m, around 532 nm
_CONTINUOUS = (1e-3, 100.0)  #: s, long enough for a spot of 28 um to be in its steady state
NANOSECONDS = (1e-9, 100e-9)  #: s
_PER_CM2 = 1e4


def _single(device: str, damage: Kind, joules: float, spot: float | None, source: str) -> DamageLaw:
    """Return a law from a published threshold in J/cm2 for nanosecond pulses, without spread."""
    return DamageLaw(
        device=device,
        damage=damage,
        quantity="fluence",
        median=joules * _PER_CM2,
        factor=None,
        median_factor=None,
        wavelengths=GREEN,
        durations=NANOSECONDS,
        spot=spot,
        source=source,
    )


def _bracket(device: str) -> DamageLaw:
    """Return the law of continuous green light that damages at tens of kW/cm2."""
    return DamageLaw(
        device=device,
        damage="point",
        quantity="irradiance",
        median=math.sqrt(10e3 * 100e3) * _PER_CM2,
        factor=None,
        median_factor=None,
        wavelengths=GREEN,
        durations=_CONTINUOUS,
        spot=25.7e-6,
        source=_TENS_OF_KILOWATTS,
        low=10e3 * _PER_CM2,
        high=100e3 * _PER_CM2,
    )


PUBLISHED_DAMAGE: tuple[DamageLaw, ...] = (
    _bracket("CMOS"),
    _bracket("CCD"),
    _single("CMOS", "point", 0.1, 28.2e-6, f"{_SCHWARZ}; first traces"),
    _single(
        "CCD", "point", 0.1, 28.2e-6, f"{_SCHWARZ}; first traces, sometimes drawn out along columns"
    ),
    _single("CMOS", "destruction", 100.0, 28.2e-6, f"{_SCHWARZ}; lasting destruction"),
    _single("CMOS", "point", 78.9e-3, None, f"{_FRONT_SIDE}; white bright spot"),
    _single("CMOS", "cross", 241.9e-3, None, f"{_FRONT_SIDE}; horizontal and vertical black lines"),
    _single("CMOS", "frame", 2005.4e-3, None, f"{_FRONT_SIDE}; no valid picture any more"),
)


# --- silicon absorption ---------------------------------------------------------------------------

# Absorption of light in silicon, used to extrapolate damage thresholds to other wavelengths.


SILICON_RANGE = (400e-9, 1100e-9)  #: m, wavelengths of the table below
DEPTH = 3e-6  #: m, depth of silicon in which absorbed light is taken to warm a pixel
ABSORPTION_SOURCE = (
    "extinction of silicon at 300 K: Green, Sol. Energ. Mat. Sol. Cells 92, 1305 (2008), as"
    " tabulated in the refractiveindex.info database (CC0)"
)
_TABLE_STEP = 10e-9  #: m, between two entries of the table
#: extinction coefficient k of silicon from 400 to 1100 nm
_EXTINCTION = (
    2.9600e-1, 2.2700e-1, 1.7600e-1, 1.3800e-1, 1.0700e-1, 8.6302e-2, 7.1381e-2, 6.2086e-2,
    5.5004e-2, 4.9131e-2, 4.4165e-2, 3.9367e-2, 3.6415e-2, 3.3108e-2, 3.0295e-2, 2.7968e-2,
    2.5758e-2, 2.4131e-2, 2.2524e-2, 2.1081e-2, 1.9934e-2, 1.8446e-2, 1.7367e-2, 1.6444e-2,
    1.5432e-2, 1.4431e-2, 1.3498e-2, 1.2743e-2, 1.1905e-2, 1.1201e-2, 1.0528e-2, 1.0057e-2,
    9.6257e-3, 8.9461e-3, 8.3620e-3, 7.8185e-3, 7.1970e-3, 6.7402e-3, 6.3933e-3, 5.8340e-3,
    5.4113e-3, 4.9955e-3, 4.6134e-3, 4.2734e-3, 3.9439e-3, 3.6120e-3, 3.2781e-3, 2.9839e-3,
    2.6821e-3, 2.4293e-3, 2.1701e-3, 1.9625e-3, 1.7571e-3, 1.5467e-3, 1.3689e-3, 1.1793e-3,
    1.0237e-3, 8.7225e-4, 7.4866e-4, 6.2238e-4, 5.0930e-4, 4.1071e-4, 3.2386e-4, 2.4753e-4,
    1.8704e-4, 1.3620e-4, 9.3631e-5, 6.8118e-5, 5.3285e-5, 4.0768e-5, 3.0637e-5,
)  # fmt: skip


def silicon_absorption(wavelength: float) -> float:
    """Return the absorption coefficient 4 pi k / wavelength of silicon at 300 K in 1/m, from 400 to
    1100 nm.

    The logarithm of k is interpolated between entries of the table that are 10 nm apart. Raises
    ValueError for another wavelength. Source: Green, Sol. Energ. Mat. Sol. Cells 92, 1305 (2008),
    band-to-band absorption.
    """
    first, last = SILICON_RANGE
    if not first <= wavelength <= last:
        raise ValueError(
            f"no absorption of silicon at {wavelength * 1e9:.5g} nm: the table has 400 to 1100 nm"
        )
    entries = [first + _TABLE_STEP * index for index in range(len(_EXTINCTION))]
    # index of the interval that contains the wavelength
    index = min(max(bisect.bisect(entries, wavelength) - 1, 0), len(_EXTINCTION) - 2)
    share = (wavelength - entries[index]) / _TABLE_STEP
    log_extinction = (1 - share) * math.log(_EXTINCTION[index]) + share * math.log(
        _EXTINCTION[index + 1]
    )
    return 4 * math.pi * math.exp(log_extinction) / wavelength


def absorbed_share(wavelength: float, depth: float = DEPTH) -> float:
    """Return the share of light entering silicon that is absorbed within a depth in m: 1 -
    exp(-alpha depth).
    """
    return -math.expm1(-silicon_absorption(wavelength) * depth)


def absorption_bracket(wavelength: float, measured: float) -> tuple[float, float]:
    """Return the least and the largest factor that converts a threshold measured at the wavelength
    ``measured`` to another wavelength, both in m.

    One end is the factor 1: the sensor absorbs as much as at the measured wavelength, because
    metal, filters and microlenses absorb too. The other end is that of absorption in 3 um of
    silicon alone. Both are extrapolations: the true factor lies between them, or outside if another
    mechanism causes the damage.
    """
    # less absorption at the wavelength raises the threshold
    silicon_factor = absorbed_share(measured) / absorbed_share(wavelength)
    return min(1.0, silicon_factor), max(1.0, silicon_factor)
