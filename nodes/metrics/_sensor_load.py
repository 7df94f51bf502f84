"""The light of a laser on the sensor: peak irradiance, saturated pixels, and heating."""

import math
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.sensor._digitization import Bits, is_clipped
from neusee.nodes.sensor._exposure import weighted_bands
from neusee.nodes.sensor._saturation import Well, refuse_without_steps, saturation
from neusee.nodes.units import Efficiency, Exposure, Gain, PixelPitch, Time
from neusee.nodes.values import Bands, Channels, Psf

# --- saturated pixels -----------------------------------------------------------------------------

# Number of pixels at the full well or at the largest output of the analogue-to-digital converter.


class Saturated(NamedTuple):
    """The number and the share of pixels with at least one clipped channel."""

    pixels: Tensor  #: () float64
    share: Tensor  #: () float64, relative to all pixels


@node(rtol=1e-6)
def saturated(raw: Tensor, *, full_well: Well, gain: Gain, bits: Bits = 16) -> Saturated:
    """Count the pixels with a channel at the full well or at the largest output of the
    analogue-to-digital converter.

    Shapes: raw (..., channel, y, x) -> two scalars, float64.
    Units:  raw DN; pixels.
    Error:  a pixel within one DN of the full well counts as saturated, and so does a pixel that is
            NaN.
    Source: NeuSee, Eq. (SensorImage).
    """
    is_full = is_clipped(raw, full_well=full_well, gain=gain, bits=bits).any(-3)
    pixels = is_full.sum().double()
    return Saturated(pixels, pixels / is_full.numel())


@saturated.preflight
def _(*, full_well: float, gain: float, bits: int = 16, **params: object) -> list[str]:
    refuse_without_steps(full_well, gain=gain, bits=bits)
    return []


@saturated.check
def _(result: Saturated, *inputs: Tensor, **params: Any) -> list[Check]:
    return [
        Check(f"{int(result.pixels)} saturated pixels, {float(result.share):.2%} of all pixels")
    ]


# --- peak irradiance ------------------------------------------------------------------------------

# Irradiance of the brightest pixel of the sensor, relative to saturation, and compared with a
# multiple of saturation.


class Peak(NamedTuple):
    """The irradiance of the brightest pixel in multiples of the saturation irradiance, and the
    irradiance of the lasers at this pixel.
    """

    irradiance: Tensor  #: () float64, multiple of saturation
    #: () float64, 1 where the irradiance exceeds `multiple` times saturation; NaN without
    #: `multiple`
    above: Tensor
    laser: Tensor  #: () float64, W/m2 that all lasers together send to this pixel


@node(
    rtol=1e-6,
    accepts_channel_sums=("image",),
    needs_band_invariant=("level",),
    additive_inputs=[("spots", "lines")],
)
def peak_irradiance(
    image: Tensor | Channels,
    bands: Bands,
    level: Tensor,
    spots: list[Tensor] | None = None,
    lines: list[Bands] | None = None,
    *,
    full_well: Well,
    quantum_efficiency: Efficiency,
    pixel_pitch: PixelPitch,
    exposure: Exposure,
    multiple: Annotated[float, Field(gt=0, le=1e18)] | None = 1e6,
) -> Peak:
    """Find the brightest pixel: the largest sum of I / I_sat over wavelengths, for the scene and
    all lasers together.

    Saturation is that of ``exposure``: the same light is ten times as many multiples in ten times
    the exposure. ``multiple`` is the multiple of saturation at which the paper expects damage. It
    is a reading of the paper and no verdict: at the exposure of the paper 1e6 are 2 W/cm2, far
    below every threshold that is known, and it falls with a longer exposure and a smaller well, as
    no damage does. `laser.damage` compares W/cm2 and J/cm2 with thresholds.

    Shapes: image (band, y, x), level (band,), each spot (line band, y, x) -> three scalars,
            float64.
    Units:  irradiance and multiple in multiples of saturation; laser W/m2.
    Error:  computed before the colour filters: a real channel receives less.
    Raises: ValueError where spots and lines differ in number, or where the `Channels` of an image
            hold no row of the well.
    Source: NeuSee, Eq. (peak_irrad_coded), which expects damage above 1e6.
    """
    spots, lines = spots or [], lines or []
    _refuse_unpaired_spots(spots, lines)
    sensor = {
        "full_well": full_well,
        "quantum_efficiency": quantum_efficiency,
        "pixel_pitch": pixel_pitch,
        "exposure": exposure,
    }
    # irradiance of each pixel / saturation irradiance, summed over scene and lasers
    wells = _in_wells(image, saturation(bands, **sensor) / level)
    for spot, line in zip(spots, lines, strict=True):
        wells = wells + _in_wells(spot, saturation(line, **sensor))
    brightest = wells.flatten().argmax()
    brightest_wells = wells.flatten().take(brightest).double()
    return Peak(
        brightest_wells,
        _exceeds(brightest_wells, multiple),
        _laser_irradiance(spots, brightest, brightest_wells),
    )


def _refuse_unpaired_spots(spots: Sequence[Tensor], lines: Sequence[Bands]) -> None:
    """Raise ValueError unless each spot has its laser line."""
    if len(spots) != len(lines):
        raise ValueError(
            f"{len(spots)} spots and {len(lines)} laser lines: give one line for each spot"
        )


def _exceeds(top: Tensor, multiple: float | None) -> Tensor:
    """Return 1 if the irradiance exceeds a multiple of saturation, otherwise 0; NaN without a
    multiple.
    """
    if multiple is None:
        return torch.full_like(top, math.nan)
    return (top > multiple).double()


def _laser_irradiance(spots: Sequence[Tensor], pixel: Tensor, like: Tensor) -> Tensor:
    """Return the irradiance (W/m2) of all lasers together at a pixel, summed over their bands."""
    total = torch.zeros_like(like)
    for spot in spots:
        total = total + spot.sum(-3).flatten().take(pixel).double()
    return total


def _in_wells(irradiance: Tensor | Channels, saturating: Tensor) -> Tensor:
    """Return the irradiance of each pixel in multiples of saturation: the sum of I / I_sat over
    wavelengths.
    """
    return weighted_bands(irradiance, (1.0 / saturating)[None])[0]


@peak_irradiance.check
def _(
    result: Peak, *inputs: Any, exposure: float, multiple: float | None = 1e6, **params: Any
) -> list[Check]:
    density = (
        f", {float(result.laser) * 1e-4:.3g} W/cm2 of lasers" if float(result.laser) > 0 else ""
    )
    text = (
        f"brightest pixel {float(result.irradiance):.3g} times the saturation irradiance of"
        f" {exposure:g} s{density}"
    )
    if not float(result.above) > 0:
        return [Check(text)]
    return [
        Check(
            f"{text}; above the {multiple:g} that the paper names (C10), which is no threshold of"
            " damage"
        )
    ]


# --- heat ratio -----------------------------------------------------------------------------------

# The heating of the hottest point of a sensor behind a mask, relative to the clear lens.


Diffusivity = Annotated[float, Field(ge=1e-9, le=1)]  #: m2/s
SILICON = 8.8e-5  #: m2/s, thermal diffusivity of silicon at 300 K


@node(rtol=1e-6)
def heat_ratio(
    psf: Psf,
    plain_psf: Psf,
    *,
    pixel_pitch: PixelPitch,
    dwell: Time,
    diffusivity: Diffusivity = SILICON,
) -> Tensor:
    """Compute the temperature rise of the hottest pixel after a dwell time, divided by that behind
    the clear lens.

    A half-space that absorbs at its surface warms by the sum of irradiance times erfc(r / w) / r
    over distances r, with w = sqrt(4 diffusivity dwell). For a pulse of nanoseconds w is shorter
    than a pixel, and the ratio is that of the peaks (`metrics.lsr`). For continuous light a small
    spot cools faster: at one peak, the wider spot is hotter.

    Shapes: psf.intensity (band, y, x), plain_psf.intensity (band, y, x) -> (band,) float64.
    Units:  pixel_pitch m; dwell s; diffusivity m2/s; result 1 for the clear lens.
    Error:  heat from outside the window is left out; within a pixel the light counts as even: 3 %
            for lambda f / D above 2 pixels. Silicon's thin layers on top, and melting, are left
            out.
    Raises: ValueError where the PSFs differ in shape.
    Source: Carslaw and Jaeger, Conduction of Heat in Solids, 2nd ed., section 10.4 (continuous
            point source).
    """
    if psf.intensity.shape != plain_psf.intensity.shape:
        shapes = f"{tuple(psf.intensity.shape)} and {tuple(plain_psf.intensity.shape)}"
        raise ValueError(
            f"the PSFs with and without the mask have the shapes {shapes}: use one window and one"
            " `bands` step"
        )
    y, x = psf.intensity.shape[-2:]
    # twice the window, so that no heat wraps around; w = sqrt(4 D t)
    heat_kernel = _heat_kernel((2 * y, 2 * x), pixel_pitch, math.sqrt(4 * diffusivity * dwell)).to(
        psf.intensity.device
    )
    spectrum = torch.fft.rfft2(heat_kernel)
    hottest_pixels = [
        torch.stack(
            [_heat_of(band_light, spectrum).amax() for band_light in light.intensity.double()]
        )
        for light in (psf, plain_psf)
    ]
    return hottest_pixels[0] / hottest_pixels[1]


def _heat_of(light: Tensor, spectrum: Tensor) -> Tensor:
    """Return the temperature rise (y, x) due to light, up to a constant factor, by convolution with
    the kernel whose FFT is ``spectrum``.
    """
    y, x = light.shape
    convolved: Tensor = torch.fft.irfft2(
        torch.fft.rfft2(light, s=(2 * y, 2 * x)) * spectrum, s=(2 * y, 2 * x)
    )
    return convolved[:y, :x]


def _heat_kernel(shape: tuple[int, int], pitch: float, reach: float) -> Tensor:
    """Return the kernel erfc(r / w) / r in FFT order, with w = ``reach``; the central pixel has the
    mean over a disc with the area of a pixel.
    """
    fy, fx = (torch.fft.fftfreq(n, 1 / n, dtype=torch.float64) * pitch for n in shape)
    distance = torch.hypot(fy[:, None], fx)
    kernel = torch.erfc(distance / reach) / distance.where(distance > 0, 1.0)
    disc_radius = pitch / math.sqrt(math.pi)
    # integral of erfc(r / w) from 0 to the radius of the disc
    disc_integral = disc_radius * math.erfc(disc_radius / reach) + reach * (
        1 - math.exp(-((disc_radius / reach) ** 2))
    ) / math.sqrt(math.pi)
    kernel[0, 0] = 2 * math.pi * disc_integral / pitch**2
    return kernel


@heat_ratio.reference
def _(
    psf: Psf, plain_psf: Psf, *, pixel_pitch: float, dwell: float, diffusivity: float = SILICON
) -> Tensor:
    """Return the ratio from a direct sum: the heat of every pixel at every pixel."""
    reach = math.sqrt(4 * diffusivity * dwell)
    disc_radius = pixel_pitch / math.sqrt(math.pi)
    fine_radii = (torch.arange(20000, dtype=torch.float64) + 0.5) * (disc_radius / 20000)
    # mean of erfc(r / w) / r over the disc: integral of 2 pi r erfc / r, over the area of the disc
    middle_kernel = float(2 * torch.special.erfc(fine_radii / reach).mean() / disc_radius)
    y, x = psf.intensity.shape[-2:]
    position = torch.cartesian_prod(torch.arange(y), torch.arange(x)).double() * pixel_pitch
    distance = torch.cdist(position, position, compute_mode="donot_use_mm_for_euclid_dist")
    heat = torch.where(
        distance > 0,
        torch.special.erfc(distance / reach) / distance.where(distance > 0, 1.0),
        middle_kernel,
    )
    hottest_pixels = [
        (light.intensity.double().flatten(1) @ heat).amax(1) for light in (psf, plain_psf)
    ]
    return hottest_pixels[0] / hottest_pixels[1]


@heat_ratio.check
def _(result: Tensor, *inputs: Any, dwell: float, **params: Any) -> list[Check]:
    low, high = float(result.min()), float(result.max())
    return [
        Check(
            f"after {dwell:.3g} s the hottest pixel is {low:.3g} to {high:.3g} times as hot as"
            " behind the plain lens",
            high < 1.01,
        )
    ]
