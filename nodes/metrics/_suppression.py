"""What the element does to the laser and to the scene, and what is left on the sensor."""

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

_DARK = 1e-30  #: light that counts as none


class Peak(NamedTuple):
    """The brightest pixel, as a multiple of what saturates."""

    irradiance: Tensor  #: () float64, multiple of saturation
    damaged: Tensor  #: () float64, 1 where that passes the damage threshold


class Saturated(NamedTuple):
    """Pixels with at least one clipped channel."""

    pixels: Tensor  #: () float64
    share: Tensor  #: () float64, of all pixels


@node(rtol=1e-6)
def lsr(psf: Psf) -> Tensor:
    """Find the laser suppression ratio: the brightest pixel of the PSF over that of the clear lens.

    Shapes: psf.intensity (band, y, x) -> (band,) float64.
    Units:  none; 1 for the clear lens.
    Error:  of the sampling: a spot between two pixels reads up to 20 % low, so the convention of the PSF counts.
    Source: NeuSee, section Sensor Image (LSR).
    """
    return psf.intensity.amax((-2, -1)).double() / psf.clear_peak.to(psf.intensity.device)


@lsr.check
def _(result: Tensor, *inputs: Psf) -> list[Check]:
    floor = float(least_lsr(inputs[0]).max())
    return [Check(f"LSR {float(result.min()):.3g} to {float(result.max()):.3g}", bool((result <= 1.05).all())),
            Check(f"evenly spread light would reach {floor:.2g}")]  # fmt: skip


@node(rtol=1e-6, accepts_channel_sums=("image", "plain_image"))
def bsr(image: Tensor | Channels, plain_image: Tensor | Channels) -> Tensor:
    """Find the background suppression ratio: light of the scene in the field, over that of the plain lens.

    Of an image summed over its bands, `Channels`, the light of each band is known still.

    Shapes: image and plain_image (..., band, y, x) -> (..., band) float64.
    Units:  none; about 1 for an element that absorbs nothing and scatters nothing out of the field.
    Error:  rows are summed in the precision of the image, 1e-7; a band without light (1e-30) has ratio 1. It
            says nothing of sharpness.
    Raises: ValueError for images of different shape.
    Source: NeuSee, section Sensor Image (BSR), as a ratio of energies.
    """
    here, there = ((*x.flux.shape, *x.planes.shape[1:]) if isinstance(x, Channels) else tuple(x.shape)
                   for x in (image, plain_image))  # fmt: skip
    if here != there:
        raise ValueError(f"image {here} and plain image {there} differ in shape")
    kept, plain = (x.flux if isinstance(x, Channels) else _light(x) for x in (image, plain_image))
    dark = plain <= _DARK  # so that what is not a number is seen
    ratio: Tensor = torch.where(dark, 1.0, kept / plain.where(~dark, 1.0))
    return ratio


def _light(image: Tensor) -> Tensor:
    return single(image).sum(-1).sum(-1, dtype=torch.float64)


@bsr.check
def _(result: Tensor, *inputs: Tensor | Channels) -> list[Check]:
    return [Check(f"BSR {float(result.min()):.3f} to {float(result.max()):.3f}", bool((result <= 1.05).all()))]


@node(rtol=1e-6)
def saturated(raw: Tensor, *, full_well: Well, gain: Gain, bits: Bits = 16) -> Saturated:
    """Count the pixels that hold no more: some channel is at the full well or at the end of the converter.

    Shapes: raw (..., channel, y, x) -> two scalars, float64.
    Units:  raw DN; pixels.
    Error:  a pixel within one DN of the full well counts as full, and so does one that is not a number.
    Source: NeuSee, Eq. (SensorImage).
    """
    full = clipped(raw, full_well=full_well, gain=gain, bits=bits).any(-3)
    pixels = full.sum().double()
    return Saturated(pixels, pixels / full.numel())


@saturated.check
def _(result: Saturated, *inputs: Tensor, **params: Any) -> list[Check]:
    return [Check(f"{int(result.pixels)} saturated pixels, {float(result.share):.2%}")]


def clipped(raw: Tensor, *, full_well: float, gain: float, bits: int) -> Tensor:
    """Which values have come to the full well or to the last number of the converter."""
    full = int(full_well * gain - 0.5)
    marked: Tensor = ~(raw < max(1, min(2**bits - 1, full)))  # nor is known what is not a number
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
    """Find the brightest pixel, scene and lasers together: the sum over wavelengths of I / I_sat.

    Shapes: image (band, y, x), level (band,), each spot (line band, y, x) -> two scalars, float64.
    Units:  multiples of saturation; damage the multiple at which a sensor may break.
    Error:  before the channels: a real channel takes in less. Damage is a threshold, not a model of heat.
    Raises: ValueError where spots and lines do not pair up, or channels of an image hold no row of the well.
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
    """Irradiance over what saturates, summed over wavelengths."""
    return weighted(irradiance, (1.0 / saturating)[None])[0]


@peak_irradiance.check
def _(result: Peak, *inputs: Any, **params: Any) -> list[Check]:
    return [Check(f"peak {float(result.irradiance):.3g} I_sat", not bool(result.damaged))]
