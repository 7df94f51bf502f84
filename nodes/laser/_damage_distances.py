"""Exposure limits of a sensor, distances at which they are exceeded, size and heating of the
spot.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor

from neusee.nodes.laser._beam import Beam, beam_radius, even_density, underfilled
from neusee.nodes.laser._round_spot import bilinear, legendre

# --- damage distances -----------------------------------------------------------------------------

# Exposure limits at the lens of a sensor, and the intervals of distance in which a laser exceeds
# them.


_SAMPLED_DISTANCES = 400  #: number of distances at which a margin is sampled
_HALVINGS = 60  #: halvings of an interval, to the last bit of a distance
_GOLDEN = (math.sqrt(5) - 1) / 2


def sensor_gain(
    wavelength: float,
    focal_length: float,
    diameter: float,
    lens_transmittance: float = 1.0,
    peak_ratio: float = 1.0,
) -> float:
    """Return the ratio of peak irradiance on the sensor to irradiance at the lens: tau (pi D^2 / (4
    lambda f))^2 x ``peak_ratio``.

    ``peak_ratio`` is the peak of the PSF over that of the clear, focused lens, such as the laser
    suppression ratio of a mask. The beam overfills the aperture. The same ratio holds for fluences.
    """
    area = math.pi * diameter**2 / 4
    return lens_transmittance * (area / (wavelength * focal_length)) ** 2 * peak_ratio


def exposure_limit(threshold: float, gain: float) -> float:
    """Return the exposure at the lens, in the unit of the threshold, at which the sensor reaches
    the threshold.

    With the damage threshold the result is the maximum permissible exposure of the sensor, MPE_S;
    with `sensor_gain` it is for a beam that overfills the aperture. Our derivation of the quantity
    that Ritt (Sensors 19, 3765, 2019, with the correction of 2021) defines, not his formula.
    """
    return threshold / gain


def airy_diameter(wavelength: float, f_number: float) -> float:
    """Return the 1/e2 diameter of the Gaussian spot that heats its centre as much as an Airy spot
    of equal peak: 1.725 lambda N.

    The steady heat at the centre is the integral of the irradiance along a radius: w sqrt(pi / 8)
    for a Gaussian spot, 16 lambda N / (3 pi^2) for an Airy spot.
    """
    return 2 * 16 / (3 * math.pi**2) / math.sqrt(math.pi / 8) * wavelength * f_number


def defocus_of_source(
    distance: float, diameter: float, wavelength: float, focused_at: float = math.inf
) -> float:
    """Return the defocus in waves at the rim of the pupil for a source at the distance R: D^2 / (8
    lambda) (1 / R - 1 / R0).

    ``distance`` R is the radius of curvature of the wavefront at the lens, for a distant laser its
    distance; ``focused_at`` is R0.
    """
    return diameter**2 / (8 * wavelength) * (1 / distance - 1 / focused_at)


def distance_intervals(
    margin: Callable[[float], float], near: float, far: float, samples: int = _SAMPLED_DISTANCES
) -> list[tuple[float, float]]:
    """Return the intervals of distance in m between ``near`` and ``far`` in which a margin is above
    0, in rising order.

    ``margin(distance)`` is above 0 where a limit is exceeded, such as ln(exposure / limit); -inf
    and inf are allowed. It need not be monotone: a near source is out of focus, so that a zone may
    begin away from the laser. The margin is sampled at equal ratios of distance, each local
    extremum that stays on one side is refined, and each end is found by bisection. A zone whose
    margin has several extrema within one step of the samples may be missed. The first end is
    ``near``, or the last end ``far``, where the margin is still above 0 there.

    Raises ValueError unless 0 < near < far, and for a margin that is not a number.
    """
    if not 0 < near < far < math.inf:
        raise ValueError(
            f"distances from {near:g} m to {far:g} m: give 0 < near < far, both finite"
        )

    def value(distance: float) -> float:
        at_distance = float(margin(distance))
        if math.isnan(at_distance):
            raise ValueError(f"the margin at {distance:g} m is not a number")
        return at_distance

    distances = [near * (far / near) ** (i / (samples - 1)) for i in range(samples - 1)] + [far]
    points = _with_extrema(value, distances, [value(distance) for distance in distances])
    interval_ends: list[float] = [near] if points[0][1] > 0 else []
    for (lower, lower_margin), (upper, upper_margin) in itertools.pairwise(points):
        if (lower_margin > 0) != (upper_margin > 0):
            interval_ends.append(_crossing(value, lower, upper, lower_margin > 0))
    # an odd number of ends: the last interval reaches to `far`
    if len(interval_ends) % 2:
        interval_ends.append(far)
    return list(zip(interval_ends[::2], interval_ends[1::2], strict=True))


def _with_extrema(
    value: Callable[[float], float], distances: list[float], values: list[float]
) -> list[tuple[float, float]]:
    """Return the samples (distance, margin) in rising order, with an added sample at each local
    extremum between which the margin may change its sign.
    """
    points = list(zip(distances, values, strict=True))
    extrema = []
    for i in range(1, len(distances) - 1):
        # between samples, a maximum below 0 may hide a zone above 0, and a minimum above 0 a gap
        sign = 1.0 if values[i] <= 0 else -1.0
        previous, middle, following = (sign * x for x in values[i - 1 : i + 2])
        if middle >= max(previous, following) and middle > min(previous, following):
            extrema.append(_extremum(value, distances[i - 1], distances[i + 1], sign))
    return sorted({*points, *extrema})


def _extremum(
    value: Callable[[float], float], a: float, b: float, sign: float
) -> tuple[float, float]:
    """Return the distance between a and b at which ``sign`` x margin is largest, and the margin
    there, by golden-section search over the logarithm of the distance.
    """
    low, high = math.log(a), math.log(b)
    for _ in range(_HALVINGS):
        # two points that divide the interval in the golden ratio
        lower, upper = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        if sign * value(math.exp(lower)) > sign * value(math.exp(upper)):
            high = upper
        else:
            low = lower
    best_distance = math.exp((low + high) / 2)
    return best_distance, value(best_distance)


def _crossing(value: Callable[[float], float], a: float, b: float, above: bool) -> float:
    """Return the distance between a and b at which a margin changes sign, by bisection; ``above``
    is True if it is above 0 at a.
    """
    for _ in range(_HALVINGS):
        middle = math.sqrt(a * b)
        a, b = (middle, b) if (value(middle) > 0) == above else (a, middle)
    return math.sqrt(a * b)


# --- spot heat ------------------------------------------------------------------------------------

# The steady-state temperature rise at the hottest point of a spot: the integral of irradiance over
# distance to that point.
#
# In the steady state, a light spot on a half-space warms a point of the surface in proportion to
# the integral of E dA / (2 pi r), with r the distance to the point, called heat here. A wide spot
# of low irradiance may warm as much as a small bright one; for continuous light the heat decides
# about damage. Units and symbols are those of `round_spot`.


#: heat of the evenly lit, focused pupil: integral of (2 J1(v) / v)^2 over v from 0 to infinity
_AIRY_HEAT = 16 / (3 * math.pi)
#: largest defocus in waves, and largest fill, of the table of heat
_TABLE_WAVES, _TABLE_FILL = 8.0, 8.0
_WAVE_STEPS, _FILL_STEPS = 401, 33
#: reach v up to which irradiance is summed, twice that of the geometric edge
_LARGEST_REACH = 8 * math.pi * _TABLE_WAVES
_REACH_STEP = 0.1  #: step of the reach v
#: the hottest point is searched up to this reach v; farther out the heat of a spot only falls
_HOTTEST_REACH = 6.0
_HEATED_POINTS = 25  #: number of points at which the heat is computed
_STEP_PARTS = 32  #: subdivisions of a step over which the inverse distance is averaged
_PUPIL_NODES = 256  #: nodes of the quadrature over the pupil
#: added term that keeps the geometric-optics heat finite and flat near focus; negligible elsewhere
_FOCUS_TERM = 9.0
#: exponent with which the excess heat of the rings falls with defocus beyond the table; computed:
#: 0.93
_RING_FALL = 0.9


def spot_heat(fill: Tensor, waves: Tensor) -> Tensor:
    """Return the steady heat at the hottest point of a beam's spot, relative to that of an evenly
    lit, focused lens.

    Both beams have the same irradiance on their axis at the lens. ``fill`` is (D / (2 w))^2 of a
    Gaussian beam of 1/e2 radius w behind a clear round lens of diameter D, and ``waves`` the
    defocus at the rim of the lens.

    Shapes: fill, waves, of one shape or of shapes that broadcast -> that shape, float64.
    Units:  none.
    Error:  0.2 % below to 0.5 % above; beyond 8 waves or a fill of 8 an upper bound, at most 2.5 %
            above.
    Raises: nothing.
    Source: Carslaw, Jaeger, Conduction of Heat in Solids, 2nd ed., section 10.5, for the heat;
            `round_spot` for the irradiance; geometric optics beyond 8 waves.
    """
    # zeros of the common shape, to broadcast both arguments
    zeros = torch.zeros_like(fill.double() + waves.double())
    fill, waves = fill.double() + zeros, waves.double().abs() + zeros
    # row `_WAVE_STEPS`, used beyond the table, holds the maximum over the last wave of defocus
    table_row = (waves / _TABLE_WAVES * (_WAVE_STEPS - 1)).clamp(0, _WAVE_STEPS)
    table_column = (fill / _TABLE_FILL * (_FILL_STEPS - 1)).clamp(0, _FILL_STEPS - 1)
    heat_ratio = bilinear(_heat_table(), table_row, table_column)
    ring_excess = (heat_ratio - 1).clamp_min(0) * (
        _TABLE_WAVES / waves.clamp_min(_TABLE_WAVES)
    ) ** _RING_FALL
    return (
        _even_disc(fill, waves)
        * heat_ratio.where(waves <= _TABLE_WAVES, 1 + ring_excess)
        / _AIRY_HEAT
    )


def _even_disc(fill: Tensor, waves: Tensor) -> Tensor:
    """Return the heat in the middle of the spot by geometric optics, in the unit of `_AIRY_HEAT`;
    near focus a smooth function that stays finite.
    """
    focus_term = _FOCUS_TERM / (1 + waves.square() + fill.square() / 4)
    spot_size = torch.sqrt(fill.square() + (2 * math.pi * waves).square() + focus_term)
    root = torch.sqrt(2 * fill).clamp_min(1e-6)
    # mean of exp(-2 fill rho^2) over the radius rho from 0 to 1
    taper = math.sqrt(math.pi) / 2 * torch.erf(root) / root
    return 2 / spot_size * taper


@functools.lru_cache(maxsize=1)
def _heat_table() -> Tensor:
    """Return a table (waves, fill) of the heat of the hottest point over `_even_disc`; an added
    last row has the maxima over the last wave of defocus.
    """
    waves = torch.linspace(0, _TABLE_WAVES, _WAVE_STEPS, dtype=torch.float64)
    fills = torch.linspace(0, _TABLE_FILL, _FILL_STEPS, dtype=torch.float64)
    # reach v at the middle of each ring
    reach = (
        torch.arange(round(_LARGEST_REACH / _REACH_STEP), dtype=torch.float64) + 0.5
    ) * _REACH_STEP
    heat_weights = _mean_inverse_distance(reach)
    nodes, weights = (torch.from_numpy(x) for x in legendre(_PUPIL_NODES))
    # the quadrature is over the squared radius in the pupil, from 0 to 1
    squared_radius = (nodes + 1) / 2
    bessel = torch.special.bessel_j0(reach[:, None] * squared_radius.sqrt())
    taper = torch.exp(-fills[:, None] * squared_radius) * weights / 4
    # integral beyond `_LARGEST_REACH` of 4 exp(-2 fill) J1(v)^2 / v^2, with the mean J1^2 =
    # 1 / (pi v)
    wing_heat = 4 * torch.exp(-2 * fills) / (math.pi * _LARGEST_REACH**2) * 0.5
    rows = []
    for wave_count in waves.tolist():
        phase = 2 * math.pi * wave_count * squared_radius
        field_parts = [(taper * wave) @ bessel.T for wave in (torch.cos(phase), torch.sin(phase))]
        irradiance = 4 * (field_parts[0].square() + field_parts[1].square())
        hottest = (irradiance @ heat_weights.T).amax(1) + wing_heat
        rows.append(hottest / _even_disc(fills, torch.full_like(fills, wave_count)))
    last_rows = rows[-round(_WAVE_STEPS / _TABLE_WAVES) :]
    return torch.stack([*rows, torch.stack(last_rows).amax(0)])


def _mean_inverse_distance(reach: Tensor) -> Tensor:
    """Return the weights (point, reach) with which rings heat points: the integral of dA / (2 pi r)
    over each ring.

    A ring of radius v warms a point at the distance u from its middle by 2 / pi v / (u + v) K(m),
    with the complete elliptic integral K and m = 4 u v / (u + v)^2.
    """
    from scipy.special import ellipkm1

    points = torch.linspace(0, _HOTTEST_REACH, _HEATED_POINTS, dtype=torch.float64)[:, None, None]
    offsets = (
        (torch.arange(_STEP_PARTS, dtype=torch.float64) + 0.5) / _STEP_PARTS - 0.5
    ) * _REACH_STEP
    ring_radii = reach[:, None] + offsets
    one_minus_m = ((points - ring_radii) / (points + ring_radii)).square().clamp_min(1e-14)
    kernel = (
        2
        / math.pi
        * ring_radii
        / (points + ring_radii)
        * torch.from_numpy(ellipkm1(one_minus_m.numpy()))
    )
    return kernel.mean(-1) * _REACH_STEP


# --- spot on sensor -------------------------------------------------------------------------------

# The spot of a laser on the sensor: its size, and the mean power during a frame with at least one
# pulse.


Number = TypeVar("Number", float, Tensor)


def frame_power(beam: Beam, exposure: float) -> float:
    """Return the mean power in W of a laser during an exposure in s that contains at least one
    pulse.

    For a continuous laser it is the power, for a single pulse its energy over the exposure. For a
    pulse train it is the mean power, or one pulse energy over the exposure if that is larger: the
    frame that catches a pulse counts.
    """
    if beam.pulse_energy is None:
        assert beam.power is not None
        return beam.power
    return max(beam.power or 0.0, beam.pulse_energy / exposure)


def spot_in_pixels(
    wavelength: float, focal_length: float, diameter: float, pixel_pitch: float
) -> float:
    """Return the size of a diffraction-limited spot in pixels, lambda N / p: wavelength times
    f-number over pixel pitch.
    """
    return wavelength * focal_length / diameter / pixel_pitch


def heated_diameter(beam: Beam, distance: Number, diameter: Number, focal_length: Number) -> Number:
    """Return the 1/e2 diameter in m of the Gaussian spot that heats a sensor as much as the focused
    spot of a beam with equal peak.

    It is `airy_diameter` for a beam that overfills the lens. A narrower beam has a wider spot: for
    equal power the peak is inversely proportional to the area of the spot, so that the diameter
    grows as the peak's factor `underfilled` to the power of -1/2. In the limit of a narrow beam it
    is 4 % below the diameter of the Gaussian spot.
    """
    fill = diameter**2 / (4 * beam_radius(beam, distance) ** 2)
    airy: Number = airy_diameter(beam.wavelength, focal_length / diameter)  # type: ignore[assignment,arg-type]
    widening: Number = underfilled(fill) ** -0.5
    return airy * widening


def heated_in_spot(
    beam: Beam,
    distance: Tensor,
    diameter: Tensor,
    focal_length: Tensor,
    waves: Tensor,
    density: Tensor,
) -> Tensor:
    """Return the 1/e2 diameter in m of the Gaussian spot that heats as much as the spot behind a
    clear, defocused round lens.

    ``density`` is the peak irradiance per watt of beam power in 1/m2 (`density_in_spot`). If it is
    too high, the diameter becomes too small, and the heat stays the same.
    """
    fill = diameter**2 / (4 * beam_radius(beam, distance) ** 2)
    airy: Tensor = airy_diameter(beam.wavelength, focal_length / diameter)  # type: ignore[assignment,arg-type]
    return (
        airy
        * spot_heat(fill, waves)
        * even_density(beam, distance, diameter, focal_length)
        / density
    )


def widest_heated_diameter(clear: Number, peak_ratio: Number) -> Number:
    """Return an upper bound of the 1/e2 diameter in m of the Gaussian spot that heats as much as
    the spot behind a mask.

    ``clear`` is `heated_diameter` of the clear lens, and ``peak_ratio`` the peak behind the mask
    over that of the clear lens. Of all spots with equal power and equal peak, an evenly lit disc
    heats its centre most: 1.178 times the Airy spot, and the inverse root of the peak.

    Source: rearrangement inequality for the integral of E / r over the plane; our derivation.
    """
    # integral of E along a radius over peak x lambda N, of the Airy spot
    airy_heat = 16 / (3 * math.pi**2)
    disc_heat = 2 / math.pi  # the same of an even disc of equal power and peak: its radius
    wider: Number = clear * (disc_heat / airy_heat) / peak_ratio**0.5
    return wider
