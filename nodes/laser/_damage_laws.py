"""Laws of damage: the irradiance or the fluence at which a laser damages a sensor, with a bracket or a spread.

A published threshold is a figure or a bracket such as "tens of kW/cm2": it gives ratios and no probability. A law with
``factor`` is lognormal and stands on data of devices: its median is the threshold of the median device, ``factor`` is
one geometric standard deviation from device to device, and ``median_factor`` is one geometric standard deviation of the
median itself, which is known from few devices. A probability is the share of devices that are damaged; its interval
comes from the median.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

Number = float | Tensor
Kind = Literal["point", "line", "cross", "destruction", "frame"]
Quantity = Literal["irradiance", "fluence"]

KINDS: tuple[Kind, ...] = ("point", "line", "cross", "destruction", "frame")
DIFFUSIVITY = 9e-5  #: m2/s, of silicon at room temperature: 148 W/(m K) / (2330 kg/m3 x 710 J/(kg K))
LEVEL = 0.9  #: probability of every interval of this module
_QUANTILE = 1.6448536269514722  #: of the standard normal distribution at 0.95: both ends of `LEVEL`


class DamageLaw(NamedTuple):
    """The threshold of one kind of damage to one class of sensors, with the range where it was measured."""

    device: str  #: class of the sensor, such as CMOS
    damage: Kind  #: what the damage looks like
    quantity: Quantity  #: irradiance of continuous light, or fluence of one pulse
    median: float  #: W/m2 or J/m2, threshold of the median device, peak of the spot
    factor: float | None  #: geometric standard deviation from device to device, above 1; None where it is not known
    median_factor: float | None  #: geometric standard deviation of the median, above 1; None where it is not known
    wavelengths: tuple[float, float]  #: m
    durations: tuple[float, float]  #: s, dwell time of continuous light or duration of a pulse
    spot: float | None  #: m, 1/e2 diameter of the spot with which the threshold was measured; None where not known
    source: str
    low: float | None = None  #: W/m2 or J/m2, lower end of a published bracket; None for a single figure
    high: float | None = None  #: W/m2 or J/m2, upper end of a published bracket

    @property
    def has_spread(self) -> bool:
        """Return True if the law states the spread of devices and of its median, which a probability needs."""
        return self.factor is not None and self.median_factor is not None

    @property
    def unit(self) -> str:
        """Return the unit in which laser damage is usually stated: W/cm2 or J/cm2; 1 of it is 1e4 of the SI unit."""
        return "W/cm2" if self.quantity == "irradiance" else "J/cm2"


class Damage(NamedTuple):
    """How near a laser is to damage: the ratio to the threshold and, where the spread is known, a probability."""

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
    """Return the laws that hold for a class of sensors, a wavelength in m and a duration in s."""
    return tuple(
        law
        for law in laws
        if law.quantity == quantity
        and law.device.casefold() == device.casefold()
        and law.wavelengths[0] <= wavelength <= law.wavelengths[1]
        and law.durations[0] <= duration <= law.durations[1]
    )


def spot_reach(diameter: Number, duration: Number) -> Tensor:
    """Return the length in m that is proportional to the heat at the centre of a Gaussian spot, per peak irradiance.

    The surface of a half-space at the centre of a spot of radius w warms by A E w / (k sqrt(2 pi)) times
    arctan(sqrt(8 kappa t) / w) after a time t. The result is w arctan(sqrt(8 kappa t) / w): proportional to w for small
    steady spots, and independent of w for short pulses.

    Source: Carslaw, Jaeger, Conduction of Heat in Solids, 2nd ed., ch. 10, integrated over a Gaussian spot.
    """
    radius = double(diameter) / 2
    return radius * torch.atan(torch.sqrt(8 * DIFFUSIVITY * double(duration)) / radius)


def spot_factor(published: float, spot: Number, duration: Number, small_spot_exponent: Number = 0.0) -> Tensor:
    """Return the factor on a threshold of continuous light for a spot of another diameter than the published one.

    A wider spot warms more at equal irradiance, and its threshold falls by equal heat at the centre: published / spot
    in the steady state. A narrower spot gets no bonus: two published laws contradict the factor 1 / diameter 40 times.
    ``small_spot_exponent`` above 0 asks for the bonus (published / spot) to the power of the exponent.
    """
    diameter = double(spot)
    bonus = (published / diameter) ** double(small_spot_exponent)
    wider = spot_reach(published, duration) / spot_reach(diameter, duration)
    return torch.where(diameter <= published, bonus, wider)


def damage_threshold(
    law: DamageLaw, spot: float | None = None, duration: float | None = None, small_spot_exponent: float = 0.0
) -> float:
    """Return the threshold of the median device in W/m2 or J/m2 for a spot of another 1/e2 diameter than the law's.

    The irradiance of continuous light is multiplied by `spot_factor`. A fluence is not scaled, because heat travels
    about 2 um in 10 ns. Without a spot, or for a law whose own spot is not known, the result is the published median.
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
    """Return how near an exposure in W/m2 or J/m2, at the peak of a spot, is to the damage that a law describes.

    The probability is that of a device drawn from all devices, Phi(ln ratio / ln factor). Its 90 % interval has the
    median moved by 1.645 of its own standard deviations. A law without ``factor`` or ``median_factor`` has no
    probability. Neither the exposure time of a frame nor gain, full well or quantum efficiency enters.
    """
    ratio = exposure / damage_threshold(law, spot, duration, small_spot_exponent)
    if law.factor is None or law.median_factor is None:
        return Damage(ratio, None, None, None)
    away = math.log(ratio) / math.log(law.factor) if ratio > 0 else -math.inf
    moved = _QUANTILE * math.log(law.median_factor) / math.log(law.factor)
    return Damage(ratio, _normal(away), _normal(away - moved), _normal(away + moved))


def _normal(x: float) -> float:
    """Return the standard normal distribution function, accurate in its lower tail."""
    return math.erfc(-x / math.sqrt(2)) / 2
