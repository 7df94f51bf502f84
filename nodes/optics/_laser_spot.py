"""The direction of a laser, and its spot on the sensor as irradiance."""

import math
from collections.abc import Collection, Mapping
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Generator, Tensor

from neusee.nodes import Check, ParameterError, TensorStats, node
from neusee.nodes.precision import single
from neusee.nodes.sensor._saturation import Well, photons_that_fill, saturation
from neusee.nodes.units import Angle, Efficiency, Exposure, FocalLength, Fraction, PixelPitch, Shape
from neusee.nodes.values import Bands, LaserLight, Psf

# --- laser direction ------------------------------------------------------------------------------

# The direction of a laser, given in the recipe or sampled at random as in the paper.


_LARGEST_ANGLE = 1.0  #: rad, upper limit: the model takes an angle as its direction cosine
#: relative difference of an angle and its sine above which a note states the difference
_SINE_DIFFERENCE = 0.01
Rule = Literal["width_over_focal_length", "focal_length_over_width"]


@node()
def direction(
    *,
    angle: tuple[Angle, Angle] | None = None,
    focal_length: FocalLength,
    pixel_pitch: PixelPitch,
    shape: Shape,
    share: Fraction = 0.36,
    rule: Rule = "width_over_focal_length",
    rng: Generator,
) -> Tensor:
    """Return the direction of a laser: ``angle``, or a normally distributed angle with 3 sigma =
    share x W / f per axis.

    W is the side of the sensor. A draw beyond the edge of the sensor is repeated, so the spot lies
    on the sensor. The paper prints f / W instead: 6.7 rad for its camera, which no lens images. A
    draw by f / W is refused.

    Shapes: -> (2,), (n_y, n_x) float64.
    Units:  rad (direction cosines; sine and angle agree to 1e-6 at 2 mrad, and to 1 % at 14
            degrees).
    Error:  exact.
    Raises: ParameterError before the run where ``rule`` asks for a draw by f / W, and for an angle
            of 1 rad or more, which is no direction cosine.
    Source: NeuSee, section Experiment Setup; by definition.
    """
    if angle is not None:
        return torch.tensor(angle, dtype=torch.float64)
    edges = field_of_view(focal_length, pixel_pitch, shape)
    return torch.stack([_drawn_within(share * edge / 3, edge / 2, rng) for edge in edges])


def field_of_view(
    focal_length: float, pixel_pitch: float, shape: tuple[int, int]
) -> tuple[float, float]:
    """Return the differences of the direction cosines (n_y, n_x) between opposite edges of the
    sensor: side x pitch / f.
    """
    height, width = (side * pixel_pitch / focal_length for side in shape)
    return height, width


def _drawn_within(sigma: float, edge: float, rng: Generator) -> Tensor:
    """Return a draw from a normal distribution of standard deviation ``sigma``, truncated at
    -``edge`` and ``edge``.
    """
    while True:
        drawn = sigma * torch.randn((), generator=rng, device=rng.device, dtype=torch.float64)
        if float(drawn.abs()) <= edge:
            return drawn.cpu()


@direction.unused
def _(params: Mapping[str, Any]) -> Collection[str]:
    # a given angle is not drawn
    return () if params["angle"] is None else ("shape", "share", "rule", "rng")


@direction.preflight
def _(
    *,
    angle: tuple[float, float] | None,
    focal_length: float,
    pixel_pitch: float,
    shape: tuple[int, int],
    share: float,
    rule: Rule,
) -> list[str]:
    if angle is not None:
        return [*angle_notes(angle), *_beyond_notes(angle, focal_length, pixel_pitch, shape)]
    if rule == "focal_length_over_width":
        tilt = share * focal_length / (shape[1] * pixel_pitch)
        raise ParameterError(
            "rule",
            f"{share:g} f / W = {tilt:.3g} rad would put the spot {tilt * focal_length:.2g} m off"
            " the axis: set `angle`, or set rule: width_over_focal_length",
        )
    return []


def _beyond_notes(
    angle: tuple[float, float], focal_length: float, pixel_pitch: float, shape: tuple[int, int]
) -> list[str]:
    """Return a note for an angle whose spot lies beyond the edge of the sensor."""
    y, x = (component * focal_length / pixel_pitch for component in angle)
    if abs(y) <= shape[0] / 2 and abs(x) <= shape[1] / 2:
        return []
    return [
        f"the spot lies {y:+.1f}, {x:+.1f} px (y, x) off the axis, beyond the sensor of"
        f" {shape[0]} x {shape[1]} px, where only glare reaches the picture"
    ]


def angle_notes(angle: tuple[float, float]) -> list[str]:
    """Return a note for an angle that differs by more than 1 % from its sine.

    Raises ParameterError for an angle of 1 rad or more, because the model takes an angle as its
    direction cosine.
    """
    size = math.hypot(*angle)
    degrees = f"{math.degrees(size):.4g} deg"
    if size >= _LARGEST_ANGLE:
        raise ParameterError(
            "angle",
            f"{degrees} off the axis is {size:.4g} rad, but the model takes an angle in rad as its"
            " direction cosine, which is below 1: give less than 57.3 deg",
        )
    relative_difference = 1 - math.sin(size) / size if size else 0.0
    text = (
        f"{degrees} off the axis: the model takes an angle as its direction cosine, and the two"
        f" differ by {relative_difference:.1%}"
    )
    return [text] if relative_difference > _SINE_DIFFERENCE else []


@direction.check
def _(result: Tensor, *, focal_length: float, pixel_pitch: float, **_: Any) -> list[Check]:
    y, x = (float(n) * focal_length / pixel_pitch for n in result)
    degrees = math.degrees(math.hypot(*(float(n) for n in result)))
    return [Check(f"spot {y:+.1f}, {x:+.1f} px (y, x) off the axis, {degrees:.3g} deg")]


# --- laser spot -----------------------------------------------------------------------------------

# The laser spot on the sensor: a PSF scaled by the strength of a laser, or by its light in watts.


Meaning = Literal["first_channel", "irradiance"]

#: largest laser suppression ratio of a pupil that only absorbs and delays; see `zero_bound` below
_LARGEST_LSR = 2.2
_COARSE_GRID_AREA = (
    4 / math.pi
)  #: largest area of the samples of a coarse pupil grid, relative to the disc of the stop
_UNSEEN_RESPONSE = 1e-3  #: relative response below which a channel does not see a line


@node()
def laser_irradiance(
    psf: Psf,
    bands: Bands,
    responses: Tensor | None = None,
    light: LaserLight | None = None,
    *,
    strength: Annotated[float, Field(ge=0, le=1e18)] | None = None,
    meaning: Meaning = "irradiance",
    full_well: Well,
    quantum_efficiency: Efficiency,
    pixel_pitch: PixelPitch,
    exposure: Exposure,
) -> Tensor:
    """Scale the PSF of a laser so that its peak behind the clear lens, on axis, is ``strength``
    times saturation.

    By the meaning `first_channel` a laser of strength 1 fills the pixel at that peak in the channel
    that it fills first, at the nominal exposure. By the meaning `irradiance` of the paper that peak
    is the sum of I / I_sat over the wavelengths of the line, before the channels. The nominal
    exposure is ``exposure``, at which a strength is defined; a sensor that exposes longer collects
    more of the same light. Without a strength the irradiance is that of the `light` in watts. Each
    wavelength sends its share of the energy (``bands.weights``) through the pupil. The spot is
    added to the image of the scene and is not convolved.

    Shapes: psf.intensity (band, y, x), bands (band,), responses (channel, band) -> (band, y, x).
    Units:  result W/m2 of each sub-band, mean over the exposure; strength is a plain multiple.
    Error:  float32 of the PSF, 1e-6 of its peak; the scale is exact.
    Raises: ParameterError before the run for a strength at a wavelength that no channel sees;
            ValueError where PSF, line and responses have different bands, and without strength and
            light.
    Source: NeuSee, Eq. (peak_irrad_laser_coded); in watts by definition of the PSF.
    """
    if psf.intensity.shape[0] != len(bands.centres):
        raise ValueError(
            f"PSF of {psf.intensity.shape[0]} bands and line of {len(bands.centres)} bands: "
            "the numbers of bands differ, so compute both from one `line` step"
        )
    if strength is not None:
        sensor = {
            "full_well": full_well,
            "quantum_efficiency": quantum_efficiency,
            "pixel_pitch": pixel_pitch,
        }
        wells_per_irradiance = 1.0 / saturation(bands, **sensor, exposure=exposure)
        irradiance_by_band = (
            strength
            * bands.weights
            / wells_at_clear_peak(psf.clear_peak, bands, wells_per_irradiance, responses, meaning)
        )
    elif light is not None:
        irradiance_by_band = light.flux / pixel_pitch**2 * bands.weights
    else:
        raise ValueError(
            "a laser needs a strength, or its light in watts: give strength, or the input light"
        )
    intensity = single(psf.intensity)
    return intensity * irradiance_by_band.to(intensity)[:, None, None]


def wells_at_clear_peak(
    clear_peak: Tensor, bands: Bands, wells: Tensor, responses: Tensor | None, meaning: Meaning
) -> Tensor:
    """Return the exposure of the pixel at the peak of the clear lens in full wells, for an
    irradiance of 1 W/m2 per unit of the PSF: () float64.

    ``wells`` are the full wells for an irradiance of 1 W/m2 in each band.
    """
    by_band = bands.weights * clear_peak * wells
    if meaning == "irradiance":
        return by_band.sum()
    if responses is None or responses.shape[-1] != len(by_band):
        raise ValueError(
            "strength counts the channel that saturates first: give `responses` for the bands of"
            " the line"
        )
    largest = (responses.to(by_band) * by_band).sum(-1).amax()
    if not bool(largest > 0):
        raise ValueError(_no_channel(bands))
    return largest


@laser_irradiance.preflight
def _(
    *,
    bands: Bands | None = None,
    responses: Tensor | None = None,
    strength: float | None = None,
    meaning: Meaning = "irradiance",
    **sensor: float,
) -> list[str]:
    if (
        not strength
        or meaning == "irradiance"
        or bands is None
        or responses is None
        or responses.is_meta
    ):
        return []
    if float((responses * bands.weights).sum(-1).amax() / bands.weights.sum()) < _UNSEEN_RESPONSE:
        raise ParameterError("strength", _no_channel(bands))
    return []


def _no_channel(bands: Bands) -> str:
    """Return the message for a laser line that no channel of the camera sees."""
    nm = float((bands.centres * bands.weights).sum() / bands.weights.sum()) * 1e9
    text = f"no channel of the camera sees {nm:.5g} nm, so no strength can saturate one"
    return f"{text}: give power with distance and divergence, or reading.strength=irradiance"


@laser_irradiance.zero_bound
def _(
    psf: TensorStats,
    bands: TensorStats,
    responses: TensorStats | None = None,
    light: TensorStats | None = None,
    *,
    strength: float | None = None,
    meaning: Meaning = "irradiance",
    **sensor: float,
) -> float:
    """Return an upper bound of the spot's irradiance: saturation x strength x largest laser
    suppression ratio (LSR).

    The bound needs no PSF, so no PSF is computed for it. A pixel that samples a point is at most as
    bright as the clear peak, where all of the pupil is in phase. The same holds for a pixel that
    averages over a width up to lambda f / D, because within that width all pairs of pupil points
    still add up. A wider pixel within the alias-free field holds at least 1 / 2.2 of the clear
    pupil's light on axis, and no other pixel holds more than all of that light. A channel of small
    response needs more irradiance to saturate; light in watts has its peak at the mean wavelength.
    """
    if strength is None:
        return (
            math.inf
            if light is None
            else _LARGEST_LSR * _COARSE_GRID_AREA * light.max * (bands.max / bands.min) ** 2
        )
    if strength == 0:
        return 0.0
    response = 1.0
    if meaning == "first_channel":
        response = responses.min if responses else 0.0
    # the saturation irradiance falls with wavelength
    shortest_wavelength = torch.tensor([bands.min], dtype=torch.float64)
    saturation_irradiance: Tensor = saturation(
        Bands(shortest_wavelength, shortest_wavelength, shortest_wavelength), **sensor
    )
    return (
        _LARGEST_LSR * strength * float(saturation_irradiance) / response
        if response > 0
        else math.inf
    )


@laser_irradiance.expected_range
def _(
    *inputs: object,
    strength: float | None,
    full_well: float,
    quantum_efficiency: float,
    pixel_pitch: float,
    exposure: float,
    **params: object,
) -> tuple[float, float]:
    """Return the peak behind the clear lens, in photons of the brightest channel per second and
    square metre.
    """
    if strength is None:
        raise LookupError("the light of a laser in watts is known in the run only")
    return 0.0, strength * photons_that_fill(full_well, quantum_efficiency) / (
        exposure * pixel_pitch**2
    )


@laser_irradiance.check
def _(
    result: Tensor,
    psf: Psf,
    bands: Bands,
    responses: Tensor | None = None,
    light: LaserLight | None = None,
    *,
    strength: float | None = None,
    meaning: Meaning = "irradiance",
    **sensor: float,
) -> list[Check]:
    wells_per_irradiance = 1.0 / saturation(bands, **sensor)
    peak = float(result.sum(0).max())
    peak_text, exposure_text = (
        f"peak of the spot {peak:.4g} W/m2",
        f"at the nominal exposure of {sensor['exposure']:g} s",
    )
    if strength is not None:
        return [Check(f"{peak_text}, strength {strength:g} {exposure_text}", math.isfinite(peak))]
    if light is None or (
        meaning == "first_channel" and (responses is None or not float(responses.max()) > 0)
    ):
        return [Check(peak_text, math.isfinite(peak))]
    # (peak of the beam / peak of a uniform beam) x mean irradiance
    clear_irradiance = (
        light.peak / light.even_peak.clamp_min(1e-300) * light.flux / sensor["pixel_pitch"] ** 2
    )
    strength = float(
        clear_irradiance
        * wells_at_clear_peak(psf.clear_peak, bands, wells_per_irradiance, responses, meaning)
    )
    return [
        Check(
            f"{peak_text}, which is a strength of {strength:.4g} {exposure_text}",
            math.isfinite(peak),
        )
    ]
