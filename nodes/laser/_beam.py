"""The Gaussian beam of a laser, and the transmittance of the air along its path."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple, TypeVar

import torch
from torch import Tensor

from neusee.nodes import ParameterError
from neusee.nodes.laser._round_spot import spot_peak

# --- beam -----------------------------------------------------------------------------------------

# The Gaussian beam of a laser: its width, its irradiance on the axis, and its power through an
# aperture.
#
# Every width is a radius at which the irradiance is 1/e2 of that on the axis (ISO 11146 for a
# Gaussian beam), and a divergence is the full angle between two such radii far away. Laser safety
# (IEC 60825-1) uses 1/e instead, which is smaller by the square root of 2: `beam` converts with
# ``convention="1/e"``. Distances are numbers or tensors in m.


Number = TypeVar("Number", float, Tensor)
Convention = Literal["1/e2", "1/e"]

#: largest relative difference between stated and derived value, because data sheets round
_STATEMENTS_AGREE = 0.02
#: argument below which a series replaces the quotient, to avoid cancellation
_SERIES_ARGUMENT = 1e-4


class Beam(NamedTuple):
    """A laser beam at the exit of the laser, in SI units; the function `beam` builds and checks
    it.
    """

    wavelength: float  #: m
    power: float | None  #: W, mean over the pulses; None for a single pulse
    pulse_energy: float | None  #: J; None for a continuous laser
    pulse_duration: float | None  #: s; None for a continuous laser
    repetition_rate: float | None  #: Hz; None for a continuous laser or a single pulse
    waist: float  #: m, 1/e2 radius of the beam where it leaves the laser
    divergence: float  #: rad, full angle at 1/e2
    m_squared: float  #: beam quality factor, 1 for a perfect Gaussian beam

    @property
    def is_pulsed(self) -> bool:
        """Return True if the laser emits pulses."""
        return self.pulse_energy is not None

    @property
    def peak_power(self) -> float | None:
        """Return the power in W during a pulse, or the power of a continuous laser."""
        if self.pulse_energy is None or self.pulse_duration is None:
            return self.power
        return self.pulse_energy / self.pulse_duration


def beam(
    wavelength: float,
    *,
    power: float | None = None,
    pulse_energy: float | None = None,
    pulse_duration: float | None = None,
    repetition_rate: float | None = None,
    waist: float | None = None,
    divergence: float | None = None,
    m_squared: float | None = None,
    convention: Convention = "1/e2",
) -> Beam:
    """Return a beam from the quantities that a data sheet states, with missing quantities derived.

    Waist w0, full divergence theta and M2 obey theta = 2 M2 wavelength / (pi w0): two of them give
    the third, and one alone is completed with M2 = 1. A pulse train obeys power = pulse energy x
    repetition rate. ``convention`` is that of `waist` and `divergence`; the result always has 1/e2.

    Raises ParameterError, with the name of the quantity, for negative values and for statements
    that differ by more than 2 %.
    """
    stated = {
        "wavelength": wavelength,
        "power": power,
        "pulse_energy": pulse_energy,
        "pulse_duration": pulse_duration,
        "repetition_rate": repetition_rate,
        "waist": waist,
        "divergence": divergence,
        "m_squared": m_squared,
    }
    for name, value in stated.items():
        if value is not None and not (math.isfinite(plain(value)) and value > 0):
            raise ParameterError(
                name, f"{value:g} is no {name.replace('_', ' ')}: give a finite number above 0"
            )
    # exp(-2 r^2 / w^2) is 1/e at w / sqrt(2)
    to_e2 = math.sqrt(2) if convention == "1/e" else 1.0
    width, angle, quality = _completed_shape(
        wavelength, waist and waist * to_e2, divergence and divergence * to_e2, m_squared
    )
    mean_power, energy, duration, rate = _completed_emission(
        power, pulse_energy, pulse_duration, repetition_rate
    )
    return Beam(
        wavelength=wavelength,
        power=mean_power,
        pulse_energy=energy,
        pulse_duration=duration,
        repetition_rate=rate,
        waist=width,
        divergence=angle,
        m_squared=quality,
    )


def _completed_emission(
    power: float | None, energy: float | None, duration: float | None, rate: float | None
) -> tuple[float | None, float | None, float | None, float | None]:
    """Return (mean power in W, pulse energy in J, pulse duration in s, repetition rate in Hz), with
    missing values derived from the others.

    The last three are None for a continuous laser, and power and rate for a single pulse. Raises
    ParameterError for statements that are missing or disagree.
    """
    if power is None and energy is None:
        raise ParameterError("power", "no power: give power, or pulse_energy with pulse_duration")
    if energy is None and duration is None and rate is None:
        return power, None, None, None
    if duration is None:
        raise _no_duration(energy)
    if rate is None:
        _refuse_single_pulse(power, energy)
        return None, energy, duration, None
    _refuse_long_pulse(duration, rate)
    if energy is None:
        assert power is not None
        return power, power / rate, duration, rate
    _refuse_other_power(power, energy, rate)
    return energy * rate, energy, duration, rate


def _no_duration(energy: float | None) -> ParameterError:
    """Return the error for pulses without a duration; it names the parameter that states the
    pulses.
    """
    name = "repetition_rate" if energy is None else "pulse_energy"
    return ParameterError(name, "a pulse needs its duration: give pulse_duration")


def _refuse_single_pulse(power: float | None, energy: float | None) -> None:
    """Raise ParameterError unless a single pulse is stated by its energy alone."""
    if energy is None:
        text = (
            "the power of a pulse is not known: give pulse_energy, or repetition_rate with the mean"
            " power"
        )
        raise ParameterError("pulse_duration", text)
    if power is not None:
        text = (
            "a single pulse has no mean power: give repetition_rate for a pulse train, or leave"
            " power out"
        )
        raise ParameterError("power", text)


def _refuse_other_power(power: float | None, energy: float, rate: float) -> None:
    """Raise ParameterError for a mean power that is not pulse energy times repetition rate."""
    mean = energy * rate
    if power is not None and not math.isclose(plain(power), plain(mean), rel_tol=_STATEMENTS_AGREE):
        text = (
            f"pulse energy {energy:.4g} J x repetition rate {rate:.4g} Hz = {mean:.4g} W, not power"
            f" {power:.4g} W"
        )
        raise ParameterError("power", f"{text}: leave one of the three out")


def _refuse_long_pulse(duration: float, rate: float) -> None:
    """Raise ParameterError if the pulses of a train would overlap."""
    if duration * rate >= 1:
        text = (
            f"a pulse of {duration:.4g} s does not fit into the period of {1 / rate:.4g} s: give a"
            " shorter pulse"
        )
        raise ParameterError("pulse_duration", f"{text}, or a lower repetition_rate")


def _completed_shape(
    wavelength: float, waist: float | None, divergence: float | None, m_squared: float | None
) -> tuple[float, float, float]:
    """Return (waist in m, divergence in rad, M2) of a beam at 1/e2, from two or three of these
    values, or with M2 = 1 from waist or divergence alone.

    Raises ParameterError for an M2 below 1, for neither waist nor divergence, and for three that
    disagree.
    """
    diffraction = 2 * wavelength / math.pi  # waist x divergence of a perfect Gaussian beam
    if m_squared is not None and m_squared < 1:
        raise ParameterError(
            "m_squared", f"M2 = {m_squared:g} is below 1, the M2 of a perfect Gaussian beam"
        )
    quality = 1.0 if m_squared is None else m_squared
    if waist is None and divergence is None:
        raise ParameterError(
            "divergence", "the width of the beam is not known: give divergence, or waist"
        )
    if waist is None and divergence is not None:
        return quality * diffraction / divergence, divergence, quality
    assert waist is not None
    if divergence is None:
        return waist, quality * diffraction / waist, quality
    implied = _implied_quality(waist, divergence, diffraction, m_squared)
    return waist, divergence, max(implied, 1.0)


def _implied_quality(
    waist: float, divergence: float, diffraction: float, m_squared: float | None
) -> float:
    """Return the M2 that follows from waist and divergence; raise ParameterError if it is below 1,
    or differs from a stated M2.
    """
    implied = waist * divergence / diffraction
    stated_text = (
        f"waist {waist:.4g} m and divergence {divergence:.4g} rad (1/e2) have M2 = {implied:.4g}"
    )
    if implied < 1 - _STATEMENTS_AGREE:
        text = (
            f"{stated_text}, but no beam has less than 1: at this waist the divergence is at least"
            f" {diffraction / waist:.4g} rad"
        )
        raise ParameterError("divergence", text)
    if m_squared is not None and not math.isclose(
        plain(implied), plain(m_squared), rel_tol=_STATEMENTS_AGREE
    ):
        raise ParameterError(
            "m_squared", f"{stated_text}, not {m_squared:g}: leave one of the three out"
        )
    return implied


def plain(value: float | Tensor) -> float:
    """Return a number or a tensor as a float, without its gradient."""
    return float(value.detach()) if isinstance(value, Tensor) else value


# --- the beam at a distance -----------------------------------------------------------------------


def beam_radius(beam: Beam, distance: Number) -> Number:
    """Return the 1/e2 radius in m of a beam at a distance from the laser: w^2 = w0^2 + (theta R
    / 2)^2.
    """
    squared = _radius_squared(beam, distance)
    return torch.sqrt(squared) if isinstance(squared, Tensor) else math.sqrt(squared)


def curvature_radius(beam: Beam, distance: Number) -> Number:
    """Return the radius of curvature in m of a beam's wavefront at the distance R: R + (2 w0 /
    theta)^2 / R.

    Far from the laser the radius is the distance. The wavefront at the laser itself is plane.
    """
    return distance + (2 * beam.waist / beam.divergence) ** 2 / distance


def axis_density(beam: Beam, distance: Number, transmittance: float = 1.0) -> Number:
    """Return the irradiance on the axis per watt of beam power at a distance, in 1/m2: 2 T / (pi
    w^2).

    Multiplied by the power it is the irradiance; multiplied by the pulse energy it is the radiant
    exposure of one pulse.
    """
    return 2 * transmittance / (math.pi * _radius_squared(beam, distance))


def axis_irradiance(beam: Beam, distance: Number, transmittance: float = 1.0) -> Number:
    """Return the irradiance in W/m2 on the axis of a beam, averaged over the pulses: 2 P T / (pi
    w^2).

    Raises ValueError for a single pulse, which has no mean power.
    """
    return _mean_power(beam) * axis_density(beam, distance, transmittance)


def share_through(
    beam: Beam, distance: Number, diameter: float, transmittance: float = 1.0
) -> Number:
    """Return the share of a beam's power that passes a round aperture centred on the axis: T (1 -
    exp(-D^2 / (2 w^2))).
    """
    return -transmittance * _expm1(-(diameter**2) / (2 * _radius_squared(beam, distance)))


def power_through(
    beam: Beam, distance: Number, diameter: float, transmittance: float = 1.0
) -> Number:
    """Return the power in W, averaged over the pulses, that passes a round aperture centred on the
    axis.

    Raises ValueError for a single pulse, which has no mean power.
    """
    return _mean_power(beam) * share_through(beam, distance, diameter, transmittance)


def sensor_density(
    beam: Beam,
    distance: Number,
    diameter: float,
    focal_length: float,
    lens_transmittance: float,
    transmittance: float = 1.0,
) -> Number:
    """Return the peak irradiance behind a clear, focused, diffraction-limited lens per watt of beam
    power, in 1/m2.

    P_in / P x tau (pi D^2 / 4) / (lambda f)^2 x (2 / x) tanh(x / 2), with x = D^2 / (4 w^2). The
    last factor is 1 for a beam that overfills the aperture. Multiplied by the power it is the peak
    irradiance; multiplied by the pulse energy it is the radiant exposure of one pulse.
    """
    passing_share = share_through(beam, distance, diameter, transmittance)
    even_gain = math.pi * diameter**2 / 4 / (beam.wavelength * focal_length) ** 2
    return (
        lens_transmittance
        * even_gain
        * passing_share
        * underfilled(diameter**2 / (4 * _radius_squared(beam, distance)))
    )


def defocus_at(
    beam: Beam,
    distance: Number,
    diameter: Number,
    focus: float = math.inf,
    lens_defocus: float = 0.0,
) -> Number:
    """Return the defocus in waves at the rim of a lens, for a laser at a distance.

    D^2 / (8 lambda) (1 / R' - 1 / R0), with the radius R' of the wavefront (`curvature_radius`) and
    the distance R0 on which the lens is focused, and ``lens_defocus``, in m of path at the rim.
    """
    curvature = 1 / curvature_radius(beam, distance) - 1 / focus
    return (diameter**2 / 8 * curvature + lens_defocus) / beam.wavelength


def density_in_spot(
    beam: Beam,
    distance: Tensor,
    diameter: Tensor,
    focal_length: Tensor,
    waves: Tensor,
    within: float = 0.0,
) -> Tensor:
    """Return the irradiance at the brightest point behind a clear, defocused round lens per watt of
    beam power, in 1/m2.

    Lens and air are lossless. It is 2 / (pi w^2) (pi D^2 / (4 lambda f))^2 times `spot_peak` for
    the fill (D / (2 w))^2 and the defocus ``waves``, with ``within`` as there. In focus it equals
    `sensor_density`.
    """
    fill = diameter**2 / (4 * _radius_squared(beam, distance))
    return even_density(beam, distance, diameter, focal_length) * spot_peak(fill, waves, within)


def even_density(beam: Beam, distance: Tensor, diameter: Tensor, focal_length: Tensor) -> Tensor:
    """Return the irradiance in focus per watt of beam power, in 1/m2, as if the axis irradiance
    filled the whole lens.
    """
    gain = (math.pi * diameter**2 / (4 * beam.wavelength * focal_length)) ** 2
    return axis_density(beam, distance) * gain


def scintillation(
    wavelength: float, distance: float | Tensor, cn2: float | Tensor, worst: float
) -> Tensor:
    """Return the quantile of irradiance over mean irradiance in turbulent air: the irradiance stays
    below it for the share ``worst`` of the time.

    The irradiance at a point is lognormal, with the variance of its logarithm 1.23 Cn2 k^(7/6)
    R^(11/6) (Rytov, plane wave, weak turbulence) and the mean of still air. It is an upper bound: a
    lens averages over its aperture, a diverging beam fluctuates less, and strong turbulence
    saturates.
    Source: Tatarskii, Wave Propagation in a Turbulent Medium (1961); Andrews, Phillips, Hopen,
            Al-Habash, J. Opt. Soc. Am. A 16, 1417 (1999).
    """
    wavenumber = 2 * math.pi / wavelength
    quantile = float(torch.special.ndtri(torch.tensor(worst, dtype=torch.float64)))
    variance = (
        1.23
        * cn2
        * wavenumber ** (7 / 6)
        * torch.as_tensor(distance, dtype=torch.float64) ** (11 / 6)
    )
    # the quantile has its maximum at spread = quantile of the normal distribution: use it as the
    # bound
    spread = variance.sqrt().clamp_max(max(quantile, 0.0))
    return torch.exp(quantile * spread - spread.square() / 2)


def peak_on_sensor(
    beam: Beam,
    distance: Number,
    diameter: float,
    focal_length: float,
    lens_transmittance: float,
    transmittance: float = 1.0,
) -> Number:
    """Return the peak irradiance in W/m2, averaged over the pulses, behind a clear, focused,
    diffraction-limited lens.

    ``transmittance`` is that of the air. Raises ValueError for a single pulse, which has no mean
    power.
    """
    density = sensor_density(
        beam, distance, diameter, focal_length, lens_transmittance, transmittance
    )
    return _mean_power(beam) * density


def underfilled(x: Number) -> Number:
    """Return (2 / x) tanh(x / 2) with x = (D / (2 w))^2: the peak behind an aperture of a Gaussian
    beam over that of an even beam of the same power in the aperture.
    """
    if isinstance(x, Tensor):
        safe_x = x.where(x > _SERIES_ARGUMENT, 1.0)
        return torch.where(
            x > _SERIES_ARGUMENT, 2 / safe_x * torch.tanh(safe_x / 2), 1 - x * x / 12
        )
    return 2 / x * math.tanh(x / 2) if x > _SERIES_ARGUMENT else 1 - x * x / 12


def _radius_squared(beam: Beam, distance: Number) -> Number:
    """Return the squared 1/e2 radius in m2 of a beam at a distance in m: w0^2 + (theta R / 2)^2."""
    return beam.waist**2 + (beam.divergence / 2 * distance) ** 2


def _mean_power(beam: Beam) -> float:
    """Return the mean power in W of a beam; raise ValueError for a single pulse."""
    if beam.power is None:
        raise ValueError(
            "a single pulse has no mean power: give repetition_rate, or use its energy with"
            " axis_density"
        )
    return beam.power


def _expm1(x: Number) -> Number:
    return torch.expm1(x) if isinstance(x, Tensor) else math.expm1(x)


# --- air ------------------------------------------------------------------------------------------

# Transmittance of the air between laser and camera, from the visibility (meteorological range).


Law = Literal["kruse", "kim"]
#: -ln 0.02: at the distance of the visibility the contrast of a black object has fallen to 2 %
_KOSCHMIEDER = 3.912
_VISIBILITY_WAVELENGTH = 550e-9  #: m, wavelength at which the visibility is defined


def air_transmittance(
    distance: Number, visibility: float | None, wavelength: float, law: Law = "kim"
) -> Number | float:
    """Return the transmittance of air of a given visibility: exp(-(3.912 / V) (lambda / 550 nm)^-q
    R).

    ``law`` names the exponent q as a function of the visibility: `kruse` has q = 0.585 V^(1/3)
    below 6 km, `kim` lets q fall to 0 in fog of less than 500 m, where Kruse's law is known to
    fail. Without a visibility (None) the air is clear and the transmittance is 1. Absorption by
    gases is left out.

    Raises ParameterError for a negative distance and a visibility that is not above 0.
    Source: Koschmieder (1924); Kruse, McGlauchlin, McQuistan, Elements of Infrared Technology
            (1962); Kim, McArthur, Korevaar, Proc. SPIE 4214, 26 (2001).
    """
    if not (math.isfinite(plain(distance)) and distance >= 0):
        raise ParameterError(
            "distance", f"{distance:g} m is no distance: give a finite number from 0"
        )
    if visibility is None:
        return 1.0
    if not visibility > 0:
        raise ParameterError(
            "visibility", f"{visibility:g} m is no visibility: give a number above 0"
        )
    exponent = size_exponent(visibility, law)
    optical_depth = (
        _KOSCHMIEDER
        / visibility
        * math.pow(wavelength / _VISIBILITY_WAVELENGTH, -exponent)
        * distance
    )
    return (
        torch.exp(-optical_depth) if isinstance(optical_depth, Tensor) else math.exp(-optical_depth)
    )


def size_exponent(visibility: float, law: Law) -> float:
    """Return the wavelength exponent q of the extinction of haze at a visibility in m."""
    km = visibility / 1e3
    if km > 50:
        return 1.6
    if km > 6:
        return 1.3
    if law == "kruse":
        return 0.585 * math.pow(km, 1 / 3)
    if km > 1:
        return 0.16 * km + 0.34
    return max(0.0, km - 0.5)
