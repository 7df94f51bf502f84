"""Exposure limits of a sensor at its lens, and the intervals of distance at which a laser exceeds a limit."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

_SAMPLES = 400  #: distances at which a margin is looked at first
_ROUNDS = 60  #: halvings of an interval, to the last bit of a distance
_GOLDEN = (math.sqrt(5) - 1) / 2


def sensor_gain(
    wavelength: float,
    focal_length: float,
    diameter: float,
    lens_transmittance: float = 1.0,
    peak_ratio: float = 1.0,
) -> float:
    """Return the peak irradiance on the sensor over the irradiance at the lens: tau (pi D^2 / (4 lambda f))^2 x ratio.

    ``peak_ratio`` is the peak of the PSF over that of the clear, focused lens, such as the laser suppression ratio of
    a mask. The beam overfills the aperture. The same ratio holds for fluences.
    """
    area = math.pi * diameter**2 / 4
    return lens_transmittance * (area / (wavelength * focal_length)) ** 2 * peak_ratio


def exposure_limit(threshold: float, gain: float) -> float:
    """Return the exposure at the lens, in the unit of the threshold, that gives the threshold on the sensor.

    With the damage threshold the result is the maximum permissible exposure of the sensor, MPE_S; with `sensor_gain`
    it is for a beam that overfills the aperture. Our derivation of the quantity that Ritt (Sensors 19, 3765, 2019,
    with the correction of 2021) defines, not his formula.
    """
    return threshold / gain


def airy_diameter(wavelength: float, f_number: float) -> float:
    """Return the 1/e2 diameter of the Gaussian spot that heats as an Airy spot of equal peak: 1.725 lambda N.

    The steady heat at the centre is the integral of the irradiance along a radius: w sqrt(pi / 8) for a Gaussian spot,
    16 lambda N / (3 pi^2) for an Airy spot.
    """
    return 2 * 16 / (3 * math.pi**2) / math.sqrt(math.pi / 8) * wavelength * f_number


def defocus_of_source(distance: float, diameter: float, wavelength: float, focused_at: float = math.inf) -> float:
    """Return the defocus in waves at the rim of the pupil, D^2 / (8 lambda) (1 / R - 1 / R0), of a source at R.

    ``distance`` is the radius of the wavefront at the lens, which for a distant laser is the distance.
    """
    return diameter**2 / (8 * wavelength) * (1 / distance - 1 / focused_at)


def distance_intervals(
    margin: Callable[[float], float], near: float, far: float, samples: int = _SAMPLES
) -> list[tuple[float, float]]:
    """Return the intervals of distance in m between ``near`` and ``far`` at which a margin is above 0, in rising order.

    ``margin(distance)`` is above 0 where a limit is exceeded, such as ln(exposure / limit); -inf and inf are allowed.
    It need not be monotone: a near source is out of focus, so that a zone may begin away from the laser. The margin is
    sampled at equal ratios of distance, each local extremum that stays on one side is refined, and each end is found
    by bisection. A zone whose margin has several extrema within one step of the samples may be missed. The first end
    is ``near``, or the last end ``far``, where the margin is still above 0 there.

    Raises ValueError unless 0 < near < far, and for a margin that is not a number.
    """
    if not 0 < near < far < math.inf:
        raise ValueError(f"distances from {near:g} m to {far:g} m: give 0 < near < far, both finite")

    def value(distance: float) -> float:
        found = float(margin(distance))
        if math.isnan(found):
            raise ValueError(f"the margin at {distance:g} m is not a number")
        return found

    at = [near * (far / near) ** (i / (samples - 1)) for i in range(samples - 1)] + [far]
    points = _with_extrema(value, at, [value(distance) for distance in at])
    ends: list[float] = [near] if points[0][1] > 0 else []
    for (a, first), (b, last) in itertools.pairwise(points):
        if (first > 0) != (last > 0):
            ends.append(_crossing(value, a, b, first > 0))
    if len(ends) % 2:
        ends.append(far)
    return list(zip(ends[::2], ends[1::2], strict=True))


def _with_extrema(value: Callable[[float], float], at: list[float], found: list[float]) -> list[tuple[float, float]]:
    """Return the samples with one more for each local extremum that may cross 0 between the samples."""
    points = list(zip(at, found, strict=True))
    more = []
    for i in range(1, len(at) - 1):
        sign = 1.0 if found[i] <= 0 else -1.0  # a hidden zone is a maximum below 0, a hidden gap a minimum above 0
        one, here, other = (sign * x for x in found[i - 1 : i + 2])
        if here >= max(one, other) and here > min(one, other):
            more.append(_extremum(value, at[i - 1], at[i + 1], sign))
    return sorted({*points, *more})


def _extremum(value: Callable[[float], float], a: float, b: float, sign: float) -> tuple[float, float]:
    """Return the place and the value of the largest ``sign`` x margin between two distances, by golden section."""
    low, high = math.log(a), math.log(b)
    for _ in range(_ROUNDS):
        one, other = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        if sign * value(math.exp(one)) > sign * value(math.exp(other)):
            high = other
        else:
            low = one
    place = math.exp((low + high) / 2)
    return place, value(place)


def _crossing(value: Callable[[float], float], a: float, b: float, above: bool) -> float:
    """Return the distance between two others at which a margin passes 0; ``above`` says that it is above 0 at a."""
    for _ in range(_ROUNDS):
        middle = math.sqrt(a * b)
        a, b = (middle, b) if (value(middle) > 0) == above else (a, middle)
    return math.sqrt(a * b)
