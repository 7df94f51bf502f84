"""Irradiance of the brightest pixel of the sensor, compared with saturation and with a multiple of saturation."""

import math
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.sensor._channel_sums import weighted
from neusee.nodes.sensor._saturation import Efficiency, Well, saturation
from neusee.nodes.units import Exposure, PixelPitch
from neusee.nodes.values import Bands, Channels


class Peak(NamedTuple):
    """The irradiance of the brightest pixel, in multiples of the saturation irradiance, and of the lasers there."""

    irradiance: Tensor  #: () float64, multiple of saturation
    above: Tensor  #: () float64, 1 where the irradiance exceeds `multiple` times saturation; NaN without `multiple`
    laser: Tensor  #: () float64, W/m2 that all lasers together send to this pixel


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
    pixel_pitch: PixelPitch,
    exposure: Exposure,
    multiple: Annotated[float, Field(gt=0, le=1e18)] | None = 1e6,
) -> Peak:
    """Find the brightest pixel: the largest sum of I / I_sat over wavelengths, for the scene and all lasers together.

    Saturation is that of ``exposure``: the same light is ten times as many multiples in ten times the exposure.
    ``multiple`` is the multiple of saturation at which the paper expects damage. It is a reading of the paper and no
    verdict: at the exposure of the paper 1e6 are 2 W/cm2, far below every threshold that is known, and it falls with a
    longer exposure and a smaller well, as no damage does. `laser.damage` compares W/cm2 and J/cm2 with thresholds.

    Shapes: image (band, y, x), level (band,), each spot (line band, y, x) -> three scalars, float64.
    Units:  irradiance and multiple in multiples of saturation; laser W/m2.
    Error:  computed before the colour filters: a real channel receives less.
    Raises: ValueError where spots and lines differ in number, or where the `Channels` of an image hold no row of the
            well.
    Source: NeuSee, Eq. (peak_irrad_coded), which expects damage above 1e6.
    """
    spots, lines = spots or [], lines or []
    _refuse_unpaired(spots, lines)
    sensor = {
        "full_well": full_well,
        "quantum_efficiency": quantum_efficiency,
        "pixel_pitch": pixel_pitch,
        "exposure": exposure,
    }
    total = _in_wells(image, saturation(bands, **sensor) / level)
    for spot, line in zip(spots, lines, strict=True):
        total = total + _in_wells(spot, saturation(line, **sensor))
    brightest = total.flatten().argmax()
    top = total.flatten().take(brightest).double()
    return Peak(top, _above(top, multiple), _of_lasers(spots, brightest, top))


def _refuse_unpaired(spots: Sequence[Tensor], lines: Sequence[Bands]) -> None:
    """Raise ValueError unless each spot has its laser line."""
    if len(spots) != len(lines):
        raise ValueError(f"{len(spots)} spots and {len(lines)} laser lines: give one line for each spot")


def _above(top: Tensor, multiple: float | None) -> Tensor:
    """Return 1 where the irradiance exceeds a multiple of saturation, else 0; NaN without a multiple."""
    if multiple is None:
        return torch.full_like(top, math.nan)
    return (top > multiple).double()


def _of_lasers(spots: Sequence[Tensor], pixel: Tensor, like: Tensor) -> Tensor:
    """Return the W/m2 that all lasers together send to a pixel, summed over their bands."""
    total = torch.zeros_like(like)
    for spot in spots:
        total = total + spot.sum(-3).flatten().take(pixel).double()
    return total


def _in_wells(irradiance: Tensor | Channels, saturating: Tensor) -> Tensor:
    """Return the irradiance of each pixel in multiples of saturation: the sum of I / I_sat over wavelengths."""
    return weighted(irradiance, (1.0 / saturating)[None])[0]


@peak_irradiance.check
def _(result: Peak, *inputs: Any, exposure: float, multiple: float | None = 1e6, **params: Any) -> list[Check]:
    density = f", {float(result.laser) * 1e-4:.3g} W/cm2 of lasers" if float(result.laser) > 0 else ""
    text = f"brightest pixel {float(result.irradiance):.3g} times the saturation irradiance of {exposure:g} s{density}"
    if not float(result.above) > 0:
        return [Check(text)]
    return [Check(f"{text}; above the {multiple:g} that the paper names (C10), which is no threshold of damage")]
