"""The light of a laser in absolute units: its wavefront at the lens of a camera, its light during
an exposure, and its attenuation by filters and a stop.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.constants import PLANCK, SPEED_OF_LIGHT
from neusee.nodes.laser._beam import (
    Beam,
    Convention,
    Law,
    air_transmittance,
    axis_density,
    beam,
    beam_radius,
    curvature_radius,
    plain,
)
from neusee.nodes.laser._damage_laws import double
from neusee.nodes.optics._lens import refuse_impossible_f_number
from neusee.nodes.optics._pupil_grid import clear_area, gaussian_integral
from neusee.nodes.spectra._bands import mean_wavelength
from neusee.nodes.spectra._cie_tables import daylight
from neusee.nodes.units import (
    BeamRadius,
    Delay,
    Distance,
    Energy,
    Exposure,
    FocalLength,
    Frequency,
    PositiveAngle,
    Power,
    Time,
    Transmittance,
    Visibility,
)
from neusee.nodes.values import Bands, LaserLight, Stop, Wavefront

Quality = Annotated[float, Field(ge=1, le=1e6)]  #: M2 of a beam
Multiple = Annotated[float, Field(ge=0, le=1e18)]
_NOTED_DEFOCUS = 0.25  #: waves of defocus at 550 nm above which a note on a near laser is given
#: largest relative error of the spot by the staircase rim of the pupil grid, over (waves of defocus
#: / samples)
_RIM_ERROR = 1.5
_DEFOCUS_WAVELENGTH = 550e-9  #: m, wavelength of the unit "waves" of defocus


class _Geometry(NamedTuple):
    """The parameters that determine the wavefront of a laser: width, divergence, quality and
    distance.
    """

    waist: float | None
    divergence: float | None
    m_squared: float | None
    convention: Convention
    distance: float | None


@node(rtol=1e-12)
def wavefront(
    line: Bands,
    *,
    waist: BeamRadius | None = None,
    divergence: PositiveAngle | None = None,
    m_squared: Quality | None = None,
    convention: Convention = "1/e2",
    distance: Distance | None = None,
) -> Wavefront:
    """Compute the taper and the curvature of a Gaussian beam in the pupil of a lens at a distance
    from the laser.

    The beam has the 1/e2 radius w and the curvature radius R + (2 w0 / divergence)^2 / R at the
    distance R, and hits the middle of the lens. Without a distance the light fills the pupil evenly
    as a plane wave.

    Shapes: -> taper, curvature ().
    Units:  taper 1/m2; curvature 1/m.
    Error:  exact for one Gaussian beam; a beam with M2 above 1 is taken as a wider Gaussian beam of
            one mode. The rim of the pupil grid is a staircase: the spot of a laser that is W waves
            out of focus is off by 1.5 W / samples of its peak at most, and usually by 0.4 W /
            samples: 0.4 % at 2 m for 8 mm and 540 samples.
    Raises: ParameterError for a waist, a divergence and an M2 that disagree, and for a distance
            without a width.
    Source: Siegman, Lasers (1986), chapter 17; ISO 11146-1 (beam of any M2).
    """
    if distance is None:
        return Wavefront(*torch.zeros(2, dtype=torch.float64))
    beam = _beam_of_line(line, _Geometry(waist, divergence, m_squared, convention, distance))
    return Wavefront(
        double(beam_radius(beam, distance) ** -2), double(1 / curvature_radius(beam, distance))
    )


@wavefront.check
def _(result: Wavefront, line: Bands, *, distance: float | None, **params: Any) -> list[Check]:
    if distance is None:
        return [Check("plane wave, even over the pupil")]
    width = float(result.taper) ** -0.5
    return [
        Check(
            f"beam of 1/e2 radius {width:.4g} m at {distance:g} m, curvature radius"
            f" {1 / result.curvature:.4g} m"
        )
    ]


@node(rtol=1e-12)
def light(
    line: Bands,
    stop: Stop,
    *,
    focal_length: FocalLength,
    exposure: Exposure,
    lens_transmittance: Transmittance = 1.0,
    strength: Multiple | None = None,
    power: Power | None = None,
    pulse_energy: Energy | None = None,
    pulse_duration: Time | None = None,
    repetition_rate: Frequency | None = None,
    pulse_delay: Delay = 0.0,
    waist: BeamRadius | None = None,
    divergence: PositiveAngle | None = None,
    m_squared: Quality | None = None,
    convention: Convention = "1/e2",
    distance: Distance | None = None,
    air_transmittance: Transmittance | None = None,
    visibility: Visibility | None = None,
    haze: Law | None = None,
) -> LaserLight:
    """Compute the light that a laser in watts or joules sends through a lens, and its peak on the
    sensor.

    The beam hits the middle of the lens. All irradiances are means over one exposure. The shutter
    is global and opens at the time 0; the pulses begin at `pulse_delay` and then every period,
    before the exposure too, and a pulse that the shutter cuts counts in part. With the delay 0 an
    exposure catches as many pulses as it can. `waist` and `divergence` are the 1/e2 radius and full
    angle, or those at 1/e by `convention`. The air is clear, or has `air_transmittance`, or the
    `visibility` with the law `haze`. A laser that has a `strength` gives zeros.

    Shapes: -> LaserLight of scalars ().
    Units:  W/m2, W, J/m2; lengths m; times s.
    Error:  peak of a diffraction-limited lens in focus at the mean wavelength of the line; the rim
            of the pupil grid adds 2 / samples at most.
    Raises: ParameterError before the run for a strength beside a power, a missing power, width or
            distance, and for statements that disagree.
    Source: Siegman, Lasers (1986), section 17.1; Goodman, Introduction to Fourier Optics, 3rd ed.,
            section 4.4.
    """
    if strength is not None:
        # a laser with a strength has no light in absolute units: all seven fields are 0
        return LaserLight(*torch.zeros(7, dtype=torch.float64))
    if distance is None:
        raise ParameterError("distance", "the distance of the laser is not known: give distance")
    geometry = _Geometry(waist, divergence, m_squared, convention, distance)
    beam = _beam_of_line(line, geometry, power, pulse_energy, pulse_duration, repetition_rate)
    air_share = _air_share(beam.wavelength, distance, air_transmittance, visibility, haze)
    pulses = pulses_within(beam, exposure, pulse_delay)
    mean_power = beam.power if beam.pulse_energy is None else beam.pulse_energy * pulses / exposure
    assert mean_power is not None
    irradiance = mean_power * axis_density(beam, distance, air_share)
    # W behind the lens, if the axis irradiance filled the clear aperture
    flux = irradiance * clear_area(stop) * lens_transmittance
    focus_area, radius_at_lens = (beam.wavelength * focal_length) ** 2, beam_radius(beam, distance)
    even_peak = flux * clear_area(stop) / focus_area
    # irradiance is the squared field, so its Gaussian radius is smaller by sqrt(2)
    power_in_lens = irradiance * gaussian_integral(stop, radius_at_lens / math.sqrt(2))
    # peak on the sensor per W: (integral of the field over the pupil / (wavelength x focal
    # length))^2
    peak_density = (
        axis_density(beam, distance, air_share)
        * lens_transmittance
        * gaussian_integral(stop, radius_at_lens) ** 2
        / focus_area
    )
    return LaserLight(
        even_peak=double(even_peak),
        flux=double(flux),
        irradiance=double(irradiance),
        power=double(power_in_lens),
        peak=double(mean_power * peak_density),
        pulses=double(pulses),
        pulse_fluence=double((beam.pulse_energy or 0.0) * peak_density),
    )


@light.unused
def _(params: Mapping[str, Any]) -> Collection[str]:
    # a laser with a strength gives zeros
    return () if params["strength"] is None else params.keys() - {"strength"}


@light.check
def _(
    result: LaserLight, line: Bands, stop: Stop, *, strength: float | None, **params: Any
) -> list[Check]:
    if strength is not None:
        return [Check(f"given by its strength, {strength:g}")]
    pulses = (
        f", {float(result.pulses):.4g} pulses in the exposure"
        if float(result.pulse_fluence) > 0
        else ""
    )
    text = (
        f"{float(result.power):.4g} W into the lens ({float(result.irradiance):.4g} W/m2 on the"
        " axis of the beam)"
    )
    peak = f"peak {float(result.peak):.4g} W/m2 on the sensor behind the clear lens in focus"
    return [Check(f"{text}, {peak}{pulses}", math.isfinite(float(result.peak)))]


def pulses_within(beam: Beam, exposure: float, delay: float) -> float:
    """Return the number of pulses during an exposure, with fractions for cut pulses; 0 for a
    continuous laser.
    """
    if beam.pulse_duration is None:
        return 0.0

    def begun(time: float) -> float:
        """Return the number of pulses from the first pulse to a time in s after its start; negative
        for earlier times.
        """
        assert beam.pulse_duration is not None
        if beam.repetition_rate is None:
            return min(max(time / beam.pulse_duration, 0.0), 1.0)
        whole_periods = math.floor(plain(time * beam.repetition_rate))
        # plus the emitted share of the current pulse
        return whole_periods + min(
            max(time - whole_periods / beam.repetition_rate, 0.0) / beam.pulse_duration, 1.0
        )

    # pulses until the shutter closes, less those before it opens at the time 0
    return begun(exposure - delay) - begun(-delay)


def _beam_of_line(line: Bands, shape: _Geometry, *emission: float | None) -> Beam:
    """Return the beam of a laser line.

    ``emission`` is (power, pulse energy, pulse duration, repetition rate). If it is empty, only the
    shape of the beam matters, and the power is set to 1 W.
    """
    power, energy, duration, rate = emission or (1.0, None, None, None)
    return beam(
        mean_wavelength(line),
        power=power,
        pulse_energy=energy,
        pulse_duration=duration,
        repetition_rate=rate,
        waist=shape.waist,
        divergence=shape.divergence,
        m_squared=shape.m_squared,
        convention=shape.convention,
    )


def _air_share(
    wavelength: float,
    distance: float,
    share: float | None,
    visibility: float | None,
    haze: Law | None,
) -> float:
    """Return the transmittance of the air between a laser and a lens: ``share`` if stated, else
    from the ``visibility`` by the law ``haze``, else 1.
    """
    if share is not None or visibility is None:
        return 1.0 if share is None else share
    if haze is None:
        text = (
            "laws of haze differ twentyfold in fog at 1550 nm: name one, haze: kruse or haze: kim"
        )
        raise ParameterError("visibility", text)
    return air_transmittance(distance, visibility, wavelength, haze)


# --- what is refused before the run ---------------------------------------------------------------

_BEAM_SETTINGS = ("waist", "divergence", "m_squared")
_PULSE_SETTINGS = ("pulse_energy", "pulse_duration", "repetition_rate")
_AIR_SETTINGS = ("air_transmittance", "visibility", "haze")
#: settings that state the light in watts and metres
_ABSOLUTE_SETTINGS = ("power", *_PULSE_SETTINGS, *_BEAM_SETTINGS, "distance", *_AIR_SETTINGS)


@light.preflight
def _(*, line: Bands | None = None, stop: Stop | None = None, **params: Any) -> list[str]:
    stated = [name for name in _ABSOLUTE_SETTINGS if params[name] is not None]
    if params["strength"] is not None:
        _refuse_beside_strength(stated)
        return []
    _refuse_unknown_light(stated)
    _refuse_air(stated)
    if line is None or stop is None or line.centres.is_meta or stop.diameter.is_meta:
        return []
    refuse_impossible_f_number(params["focal_length"], float(stop.diameter), "focal_length")
    try:
        return [
            *_out_of_focus(line, stop, params),
            *_pulse_notes(light(line, stop, **params), params),
        ]
    except ParameterError as error:
        name = error.parameter if error.parameter in stated else stated[0]
        raise ParameterError(name, str(error)) from None


def _refuse_unknown_light(stated: list[str]) -> None:
    """Raise ParameterError for a laser in absolute units without power or energy, or without a
    distance.
    """
    if "power" not in stated and "pulse_energy" not in stated:
        text = (
            "the light of this laser is not known: give strength, or power (or pulse_energy) with"
            " distance"
        )
        parameter = stated[0] if stated else "line.wavelength"
        raise ParameterError(parameter, text)
    if "distance" not in stated:
        raise ParameterError(
            stated[0],
            "a laser in watts needs its distance from the camera, such as distance: 100 m",
        )


def _refuse_beside_strength(stated: list[str]) -> None:
    """Raise ParameterError for a laser with both a strength and parameters in absolute units."""
    if stated:
        conflict = (
            f"{', '.join(stated)} state{'s' * (len(stated) == 1)} its light in absolute units"
        )
        text = (
            f"a strength states the light of the laser at the sensor, but {conflict}: leave"
            " strength or the rest out"
        )
        raise ParameterError("strength", text)


def _refuse_air(stated: list[str]) -> None:
    """Raise ParameterError if the air is stated twice, or by a law of haze without a visibility."""
    if "air_transmittance" in stated and ("visibility" in stated or "haze" in stated):
        raise ParameterError(
            "air_transmittance",
            "the air is stated twice: leave air_transmittance or visibility out",
        )
    if "haze" in stated and "visibility" not in stated:
        raise ParameterError("haze", "a law of haze needs the visibility, such as visibility: 5 km")


def _out_of_focus(line: Bands, stop: Stop, params: dict[str, Any]) -> list[str]:
    """Return a note for a laser so near that it is out of focus for a lens focused at infinity,
    else nothing.
    """
    shape = {name: params[name] for name in (*_BEAM_SETTINGS, "convention", "distance")}
    # D^2 / (8 lambda R): defocus at the rim of a lens focused at infinity
    waves = float(wavefront(line, **shape).curvature * stop.diameter**2) / 8 / _DEFOCUS_WAVELENGTH
    if waves <= _NOTED_DEFOCUS:
        return []
    accuracy_text = f"its spot is exact to {_RIM_ERROR * waves / int(stop.samples):.2g} of its peak"
    text = (
        f"a laser at {params['distance']:g} m is {waves:.3g} waves out of focus for a lens focused"
        " at infinity"
    )
    return [f'{text} ({accuracy_text}): optics.defocus="-{waves:.3g} waves" focuses it']


def _pulse_notes(light_of_laser: LaserLight, params: dict[str, Any]) -> list[str]:
    """Return a note on the number of pulses in the exposure."""
    if not params["pulse_duration"]:
        return []
    count = float(light_of_laser.pulses)
    pulse_text = (
        "no pulse falls into the exposure"
        if count == 0
        else f"{count:.4g} pulses fall into the exposure"
    )
    return [
        f"{pulse_text} of {params['exposure']:g} s, for a global shutter and pulse_delay"
        f" {params['pulse_delay']:g} s"
    ]


# --- a filter, a notch filter and a stop ----------------------------------------------------------

# Their effect on the light of a laser, and on the picture.

_WHITE_RANGE = (400e-9, 700e-9)  #: m, range of wavelengths over which white light is counted
_DAYLIGHT_TEMPERATURE = 6504.0  #: K
EDGE = 0.01  #: relative width, on each side, of the edges of a real notch beyond its band
_GREEN_WAVELENGTH = 550e-9  #: m


def optical_density(factor: float) -> float:
    """Return the optical density of a filter that attenuates light by a factor: log10(factor), or 0
    for a factor up to 1.
    """
    return math.log10(factor) if factor > 1 else 0.0


def passing(density: float) -> float:
    """Return the transmittance of a filter of a given optical density."""
    return math.pow(10, -density)


def notch_wavelength(centre: float, angle: float, index: float) -> float:
    """Return the wavelength in m that a notch filter blocks for light incident at an angle in rad
    to its normal.

    lambda(theta) = lambda_0 sqrt(1 - sin^2(theta) / n^2): an interference filter moves to shorter
    wavelengths. ``centre`` is the wavelength in m at normal incidence, ``index`` the effective
    index of the filter.

    Raises ParameterError for an index below 1, and for an angle that is not below 90 degrees.
    Source: Macleod, Thin-Film Optical Filters, on tilted narrow-band filters, from memory; by the
            phase of a layer.
    """
    if not index >= 1:
        raise ParameterError(
            "index", f"{index:g} is no effective index of a filter: give a number from 1"
        )
    if not abs(angle) < math.pi / 2:
        raise ParameterError("angle", f"{math.degrees(angle):g} deg: give an angle below 90 deg")
    return centre * math.sqrt(1 - (math.sin(angle) / index) ** 2)


def notch_band(shortest: float, longest: float, angle: float, index: float) -> tuple[float, float]:
    """Return both ends in m of the band, at normal incidence, of a notch filter that blocks a laser
    over the whole field.

    The wavelength of the laser is between ``shortest`` and ``longest`` in m, its angle of incidence
    up to ``angle`` in rad. At that angle the band is shifted to shorter wavelengths: it must begin
    at ``shortest`` and end at the wavelength that is shifted to ``longest``.
    """
    return shortest, longest / notch_wavelength(1.0, angle, index)


def white_share(low: float, high: float, edge: float = EDGE) -> float:
    """Return the share of the daylight photons between 400 and 700 nm that lie in a band from
    ``low`` to ``high`` in m.

    ``edge`` widens the band by a share of its ends, because a real notch has no vertical edges. The
    sensor counts photons with one efficiency from 400 to 700 nm.

    Source: CIE daylight of 6504 K (CIE 15:2004) by way of colour-science.
    """
    import torch

    wavelengths = (
        # every 0.5 nm; the added 0.25 nm includes the end despite rounding
        torch.arange(_WHITE_RANGE[0] * 1e9, _WHITE_RANGE[1] * 1e9 + 0.25, 0.5, dtype=torch.float64)
        * 1e-9
    )
    # spectral power times wavelength is proportional to the number of photons
    photons = daylight(_DAYLIGHT_TEMPERATURE).at(wavelengths)[0] * wavelengths
    total = torch.trapezoid(photons, wavelengths)
    band_start, band_end = (
        max(low * (1 - edge), _WHITE_RANGE[0]),
        min(high * (1 + edge), _WHITE_RANGE[1]),
    )
    if not band_end > band_start:
        return 0.0
    band_ends = torch.tensor([band_start, band_end], dtype=torch.float64)
    # grid wavelengths inside the band, with both ends of the band added
    inside_wavelengths = torch.cat(
        [
            band_ends[:1],
            wavelengths[(wavelengths > band_start) & (wavelengths < band_end)],
            band_ends[1:],
        ]
    )
    # trapezoidal rule, as for the total
    return float(
        torch.trapezoid(
            daylight(_DAYLIGHT_TEMPERATURE).at(inside_wavelengths)[0] * inside_wavelengths,
            inside_wavelengths,
        )
        / total
    )


def field_angle(shape: tuple[int, int], pixel_pitch: float, focal_length: float) -> float:
    """Return the angle in rad from the axis to the corner of a sensor of ``shape`` (y, x)
    pixels.
    """
    return math.atan(math.hypot(*shape) * pixel_pitch / 2 / focal_length)


def stopped_share(diameter: float, stopped: float) -> float:
    """Return the share of the scene's light that remains when a lens of ``diameter`` m is stopped
    down to ``stopped`` m.
    """
    return min(1.0, stopped / diameter) ** 2


def diffraction_cutoff(
    focal_length: float, diameter: float, pixel_pitch: float, wavelength: float = _GREEN_WAVELENGTH
) -> float:
    """Return the diffraction cut-off frequency in cycles per pixel: pixel pitch / (wavelength x
    f-number).

    Below 0.5, diffraction removes detail that the pixels could resolve.
    """
    return pixel_pitch * diameter / (wavelength * focal_length)


def feature_snr(
    background: float, veil: float, *, contrast: float, feature: float, read_noise: float = 0.0
) -> float:
    """Return the signal-to-noise ratio of a feature under a veil: C n sqrt(A) / sqrt(n + v +
    sigma^2).

    The feature of the Weber contrast C covers A = ``feature`` x ``feature`` pixels on a
    ``background`` of n electrons; v is the ``veil`` in electrons a pixel, and sigma the read noise.
    It is the ratio of `veil_limit` with the rule snr.
    """
    noise = background + veil + read_noise**2
    return contrast * background * feature / math.sqrt(noise) if noise > 0 else 0.0


def photons_in_joule(wavelength: float) -> float:
    """Return the number of photons in one joule of light of a wavelength in m: wavelength / (h
    c).
    """
    return wavelength / (PLANCK * SPEED_OF_LIGHT)
