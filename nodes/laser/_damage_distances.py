"""Exposure limits of a sensor, distances beyond them, size and heat of the spot."""

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

# Exposure limits of a sensor at its lens, and the intervals of distance at which a laser exceeds a
# limit.


_SAMPLED_DISTANCES = 400  #: distances at which a margin is looked at first
_HALVINGS = 60  #: halvings of an interval, to the last bit of a distance
_GOLDEN = (math.sqrt(5) - 1) / 2


def sensor_gain(
    wavelength: float,
    focal_length: float,
    diameter: float,
    lens_transmittance: float = 1.0,
    peak_ratio: float = 1.0,
) -> float:
    """Return the peak irradiance on the sensor over the irradiance at the lens: tau (pi D^2 / (4
    lambda f))^2 x ratio.

    ``peak_ratio`` is the peak of the PSF over that of the clear, focused lens, such as the laser
    suppression ratio of a mask. The beam overfills the aperture. The same ratio holds for fluences.
    """
    area = math.pi * diameter**2 / 4
    return lens_transmittance * (area / (wavelength * focal_length)) ** 2 * peak_ratio


def exposure_limit(threshold: float, gain: float) -> float:
    """Return the exposure at the lens, in the unit of the threshold, that gives the threshold on
    the sensor.

    With the damage threshold the result is the maximum permissible exposure of the sensor, MPE_S;
    with `sensor_gain` it is for a beam that overfills the aperture. Our derivation of the quantity
    that Ritt (Sensors 19, 3765, 2019, with the correction of 2021) defines, not his formula.
    """
    return threshold / gain


def airy_diameter(wavelength: float, f_number: float) -> float:
    """Return the 1/e2 diameter of the Gaussian spot that heats as an Airy spot of equal peak: 1.725
    lambda N.

    The steady heat at the centre is the integral of the irradiance along a radius: w sqrt(pi / 8)
    for a Gaussian spot, 16 lambda N / (3 pi^2) for an Airy spot.
    """
    return 2 * 16 / (3 * math.pi**2) / math.sqrt(math.pi / 8) * wavelength * f_number


def defocus_of_source(
    distance: float, diameter: float, wavelength: float, focused_at: float = math.inf
) -> float:
    """Return the defocus in waves at the rim of the pupil, D^2 / (8 lambda) (1 / R - 1 / R0), of a
    source at R.

    ``distance`` is the radius of the wavefront at the lens, which for a distant laser is the
    distance.
    """
    return diameter**2 / (8 * wavelength) * (1 / distance - 1 / focused_at)


def distance_intervals(
    margin: Callable[[float], float], near: float, far: float, samples: int = _SAMPLED_DISTANCES
) -> list[tuple[float, float]]:
    """Return the intervals of distance in m between ``near`` and ``far`` at which a margin is above
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
    # the last interval is still open
    if len(interval_ends) % 2:
        interval_ends.append(far)
    return list(zip(interval_ends[::2], interval_ends[1::2], strict=True))


def _with_extrema(
    value: Callable[[float], float], distances: list[float], values: list[float]
) -> list[tuple[float, float]]:
    """Return the samples (distance, margin) in rising order, with one more for each local extremum
    that may cross 0 between the samples.
    """
    points = list(zip(distances, values, strict=True))
    extrema = []
    for i in range(1, len(distances) - 1):
        # a hidden zone is a maximum below 0, a hidden gap a minimum above 0
        sign = 1.0 if values[i] <= 0 else -1.0
        previous, middle, following = (sign * x for x in values[i - 1 : i + 2])
        if middle >= max(previous, following) and middle > min(previous, following):
            extrema.append(_extremum(value, distances[i - 1], distances[i + 1], sign))
    return sorted({*points, *extrema})


def _extremum(
    value: Callable[[float], float], a: float, b: float, sign: float
) -> tuple[float, float]:
    """Return the distance of the largest ``sign`` x margin between the distances a and b, and the
    margin there, by golden section of the logarithm of the distance.
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
    """Return the distance between a and b at which a margin passes 0, by bisection; ``above`` says
    that it is above 0 at a.
    """
    for _ in range(_HALVINGS):
        middle = math.sqrt(a * b)
        a, b = (middle, b) if (value(middle) > 0) == above else (a, middle)
    return math.sqrt(a * b)


# --- spot heat ------------------------------------------------------------------------------------

# The steady heat at the hottest point of a spot: the integral of the irradiance over the distance
# to that point.
#
# A light spot on a half-space warms a point of its surface, in the steady state, by the integral of
# E dA / (2 pi r), where r is the distance to the point. A wide spot of low irradiance may warm as
# much as a small bright one, so that the heat decides about damage by continuous light. Units and
# symbols are those of `round_spot`.


#: of the even, focused pupil: integral of (2 J1(v) / v)^2 over v from 0 on
_AIRY_HEAT = 16 / (3 * math.pi)
#: defocus and fill up to which the heat is interpolated in a table
_TABLE_WAVES, _TABLE_FILL = 8.0, 8.0
_WAVE_STEPS, _FILL_STEPS = 401, 33
#: reach up to which irradiance is summed, twice that of the geometric edge
_LARGEST_REACH = 8 * math.pi * _TABLE_WAVES
_REACH_STEP = 0.1  #: of the reach, between its samples
#: reach within which the hottest point is looked for: farther out the heat of a spot only falls
_HOTTEST_REACH = 6.0
_HEATED_POINTS = 25  #: of them
_STEP_PARTS = 32  #: of a step, over which the inverse distance is averaged
_PUPIL_NODES = 256  #: of the quadrature over the pupil
#: what keeps the heat of straight rays finite and flat near focus, and is as good as nothing
#: elsewhere
_FOCUS_TERM = 9.0
#: power of the defocus with which the heat of the rings falls beyond the table, where it is found
#: 0.93
_RING_FALL = 0.9


def spot_heat(fill: Tensor, waves: Tensor) -> Tensor:
    """Return the steady heat at the hottest point of the spot of a beam, over that of the even and
    focused beam.

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
    # broadcasts both arguments to one shape
    zeros = torch.zeros_like(fill.double() + waves.double())
    fill, waves = fill.double() + zeros, waves.double().abs() + zeros
    # the last row of the table, beyond the last step, holds the largest of the last wave
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
    """Return the heat in the middle of the spot of straight rays, in the unit of `spot_heat`
    before its division by `_AIRY_HEAT`; near focus a smooth function that stays finite.
    """
    focus_term = _FOCUS_TERM / (1 + waves.square() + fill.square() / 4)
    spot_size = torch.sqrt(fill.square() + (2 * math.pi * waves).square() + focus_term)
    root = torch.sqrt(2 * fill).clamp_min(1e-6)
    # mean of exp(-2 fill rho^2) along a radius
    taper = math.sqrt(math.pi) / 2 * torch.erf(root) / root
    return 2 / spot_size * taper


@functools.lru_cache(maxsize=1)
def _heat_table() -> Tensor:
    """Return the heat of the hottest point over `_even_disc` as a table (waves, fill), with one
    more row: the largest values of the last wave of defocus.
    """
    waves = torch.linspace(0, _TABLE_WAVES, _WAVE_STEPS, dtype=torch.float64)
    fills = torch.linspace(0, _TABLE_FILL, _FILL_STEPS, dtype=torch.float64)
    # middles of rings of the reach v
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
    """Return the weights (point, reach) of the heat at points: the integral of dA / (2 pi r) over a
    ring of a step.

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

# Spot of a laser on the sensor: its size, and the mean power of a frame in which at least one pulse
# falls.


Number = TypeVar("Number", float, Tensor)


def frame_power(beam: Beam, exposure: float) -> float:
    """Return the mean power in W of a laser during an exposure in s, in which at least one pulse
    falls.

    A continuous laser has its power, a single pulse its energy over the exposure. A pulse train has
    its mean power, or that of one pulse if the exposure is shorter than the period: the frame that
    catches a pulse is the one that counts.
    """
    if beam.pulse_energy is None:
        assert beam.power is not None
        return beam.power
    return max(beam.power or 0.0, beam.pulse_energy / exposure)


def spot_in_pixels(
    wavelength: float, focal_length: float, diameter: float, pixel_pitch: float
) -> float:
    """Return the size of a diffraction-limited spot in pixels: wavelength times f-number over
    pixel pitch.
    """
    return wavelength * focal_length / diameter / pixel_pitch


def heated_diameter(beam: Beam, distance: Number, diameter: Number, focal_length: Number) -> Number:
    """Return the 1/e2 diameter in m of the Gaussian spot that heats a sensor as the focused spot of
    a beam.

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
    """Return the 1/e2 diameter in m of the Gaussian spot that heats as the spot behind a clear
    round lens with defocus.

    ``density`` is what counts as the peak of the spot, as a share of the beam's power per m2
    (`density_in_spot`). A peak that is stated too high has a spot that is too narrow, and the same
    heat.
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
    """Return an upper bound of the 1/e2 diameter in m of the Gaussian spot that heats as a spot
    behind a mask.

    ``clear`` is `heated_diameter` of the clear lens, and ``peak_ratio`` the peak behind the mask
    over that of the clear lens. Of all spots with equal power and equal peak, an evenly lit disc
    heats its centre most: 1.178 times the Airy spot, and the inverse root of the peak.

    Source: rearrangement inequality for the integral of E / r over the plane; our derivation.
    """
    # of the integral of E along a radius, in wavelengths times f-number and peaks
    airy_heat = 16 / (3 * math.pi**2)
    disc_heat = 2 / math.pi  # radius of the disc of equal power and peak, in the same unit
    wider: Number = clear * (disc_heat / airy_heat) / peak_ratio**0.5
    return wider
