"""Laser and background suppression of a mask, and the brightest and the saturated pixels of the sensor."""

from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import single
from neusee.nodes.metrics._mask_limits import least_lsr
from neusee.nodes.sensor._channel_sums import weighted
from neusee.nodes.sensor._digitization import Bits
from neusee.nodes.sensor._saturation import Efficiency, Well, saturation
from neusee.nodes.units import Gain, PositiveLength, Time
from neusee.nodes.values import Bands, Channels, Psf

_DARK = 1e-30  #: light below which a band counts as dark


class Peak(NamedTuple):
    """The irradiance of the brightest pixel, in multiples of the saturation irradiance."""

    irradiance: Tensor  #: () float64, multiple of saturation
    damaged: Tensor  #: () float64, 1 where the irradiance exceeds the damage threshold


class Saturated(NamedTuple):
    """The number and the share of pixels with at least one clipped channel."""

    pixels: Tensor  #: () float64
    share: Tensor  #: () float64, relative to all pixels


@node(rtol=1e-6)
def lsr(psf: Psf) -> Tensor:
    """Compute the laser suppression ratio: the peak of the PSF divided by the peak of the PSF of the clear lens.

    Shapes: psf.intensity (band, y, x) -> (band,) float64.
    Units:  none; 1 for the clear lens.
    Error:  of the sampling: a spot between two pixels reads up to 20 % low, so that the PSF convention matters.
    Source: NeuSee, section Sensor Image (LSR).
    """
    return psf.intensity.amax((-2, -1)).double() / psf.clear_peak.to(psf.intensity.device)


@lsr.check
def _(result: Tensor, *inputs: Psf) -> list[Check]:
    floor = float(least_lsr(inputs[0]).max())
    return [Check(f"LSR {float(result.min()):.3g} to {float(result.max()):.3g}", bool((result <= 1.05).all())),
            Check(f"LSR of evenly spread light would be {floor:.2g}")]  # fmt: skip


@node(rtol=1e-6, accepts_channel_sums=("image", "plain_image"))
def bsr(image: Tensor | Channels, plain_image: Tensor | Channels) -> Tensor:
    """Compute the background suppression ratio: scene light in the field, divided by the light with the plain lens.

    An image that is summed over its bands, `Channels`, still contains the light of each band.

    Shapes: image and plain_image (..., band, y, x) -> (..., band) float64.
    Units:  none; about 1 for an element that absorbs no light and scatters no light out of the field.
    Error:  rows are summed in the precision of the image, 1e-7; a band without light (1e-30) has ratio 1. The ratio
            does not measure sharpness.
    Raises: ValueError for images of different shapes.
    Source: NeuSee, section Sensor Image (BSR), as a ratio of energies.
    """
    (shape, kept), (plain_shape, plain) = _shape_and_light(image), _shape_and_light(plain_image)
    if shape != plain_shape:
        raise ValueError(f"image {shape} and plain image {plain_shape} differ in shape: use one scene for both")
    dark = plain <= _DARK  # false for NaN, so that NaN reaches the result
    ratio: Tensor = torch.where(dark, 1.0, kept / plain.where(~dark, 1.0))
    return ratio


def _shape_and_light(image: Tensor | Channels) -> tuple[tuple[int, ...], Tensor]:
    if isinstance(image, Channels):
        return (*image.flux.shape, *image.planes.shape[1:]), image.flux
    return tuple(image.shape), single(image).sum(-1).sum(-1, dtype=torch.float64)


@bsr.check
def _(result: Tensor, *inputs: Tensor | Channels) -> list[Check]:
    return [Check(f"BSR {float(result.min()):.3f} to {float(result.max()):.3f}", bool((result <= 1.05).all()))]


@node(rtol=1e-6)
def saturated(raw: Tensor, *, full_well: Well, gain: Gain, bits: Bits = 16) -> Saturated:
    """Count the pixels with a channel at the full well or at the largest number of the analogue-to-digital converter.

    Shapes: raw (..., channel, y, x) -> two scalars, float64.
    Units:  raw DN; pixels.
    Error:  a pixel within one DN of the full well counts as saturated, and so does one that is not a number.
    Source: NeuSee, Eq. (SensorImage).
    """
    full = clipped(raw, full_well=full_well, gain=gain, bits=bits).any(-3)
    pixels = full.sum().double()
    return Saturated(pixels, pixels / full.numel())


@saturated.check
def _(result: Saturated, *inputs: Tensor, **params: Any) -> list[Check]:
    return [Check(f"{int(result.pixels)} saturated pixels, {float(result.share):.2%} of all")]


def clipped(raw: Tensor, *, full_well: float, gain: float, bits: int) -> Tensor:
    """Return True for raw values at the full well, at the largest number of the converter, and for NaN."""
    full = int(full_well * gain - 0.5)
    marked: Tensor = ~(raw < max(1, min(2**bits - 1, full)))  # NaN counts as clipped
    return marked


@node(rtol=1e-6, accepts_channel_sums=("image",), needs_band_invariant=("level",), additive_inputs=[("spots", "lines")])
def peak_irradiance(
    image: Tensor | Channels,
    bands: Bands,
    level: Tensor,
    spots: list[Tensor] | None = None,
    lines: list[Bands] | None = None,
    *,
    full_well: Well,
    quantum_efficiency: Efficiency,
    pixel_pitch: PositiveLength,
    exposure: Time,
    damage: Annotated[float, Field(gt=0)] = 1e6,
) -> Peak:
    """Find the brightest pixel: the largest sum of I / I_sat over wavelengths, for the scene and all lasers together.

    Shapes: image (band, y, x), level (band,), each spot (line band, y, x) -> two scalars, float64.
    Units:  multiples of saturation; damage the multiple above which a sensor may break.
    Error:  computed before the colour filters: a real channel receives less. Damage is a threshold, not a heat model.
    Raises: ValueError where spots and lines differ in number, or where the `Channels` of an image hold no row of the
            well.
    Source: NeuSee, Eq. (peak_irrad_coded); damage above 1e6 as stated there.
    """
    sensor = {"full_well": full_well, "quantum_efficiency": quantum_efficiency}
    if len(spots or ()) != len(lines or ()):
        raise ValueError(f"{len(spots or ())} spots and {len(lines or ())} lines: give each spot its own `line` step")
    total = _in_wells(image, saturation(bands, **sensor, pixel_pitch=pixel_pitch, exposure=exposure) / level.cpu())
    for spot, line in zip(spots or (), lines or (), strict=True):
        total = total + _in_wells(spot, saturation(line, **sensor, pixel_pitch=pixel_pitch, exposure=exposure))
    top = total.max().double()
    return Peak(top, (top > damage).double())


def _in_wells(irradiance: Tensor | Channels, saturating: Tensor) -> Tensor:
    """Return the irradiance of each pixel in multiples of saturation: the sum of I / I_sat over wavelengths."""
    return weighted(irradiance, (1.0 / saturating)[None])[0]


@peak_irradiance.check
def _(result: Peak, *inputs: Any, **params: Any) -> list[Check]:
    return [Check(f"brightest pixel {float(result.irradiance):.3g} I_sat", not bool(result.damaged))]
