"""Irradiance of the brightest pixel of the sensor, compared with saturation and with a multiple of saturation."""

import math
from typing import Annotated, Any, NamedTuple

from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.sensor._channel_sums import weighted
from neusee.nodes.sensor._saturation import Efficiency, Well, saturation
from neusee.nodes.units import PositiveLength, Time
from neusee.nodes.values import Bands, Channels


class Peak(NamedTuple):
    """The irradiance of the brightest pixel, in multiples of the saturation irradiance."""

    irradiance: Tensor  #: () float64, multiple of saturation
    damaged: Tensor  #: () float64, 1 where the irradiance exceeds `damage` times saturation; NaN without `damage`


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
    damage: Annotated[float, Field(gt=0)] | None = 1e6,
) -> Peak:
    """Find the brightest pixel: the largest sum of I / I_sat over wavelengths, for the scene and all lasers together.

    ``damage`` is the paper's threshold of damage, a multiple of saturation: it falls with a longer exposure and a
    smaller well, as no damage does, and is a reading of the paper alone. `laser.damage` compares W/cm2 and J/cm2 with
    measured thresholds; a recipe in watts sets ``damage`` to null.

    Shapes: image (band, y, x), level (band,), each spot (line band, y, x) -> two scalars, float64.
    Units:  multiples of saturation.
    Error:  computed before the colour filters: a real channel receives less.
    Raises: ValueError where spots and lines differ in number, or where the `Channels` of an image hold no row of the
            well.
    Source: NeuSee, Eq. (peak_irrad_coded); damage above 1e6 as stated there.
    """
    sensor = {"full_well": full_well, "quantum_efficiency": quantum_efficiency}
    if len(spots or ()) != len(lines or ()):
        raise ValueError(f"{len(spots or ())} spots and {len(lines or ())} laser lines: give one line for each spot")
    total = _in_wells(image, saturation(bands, **sensor, pixel_pitch=pixel_pitch, exposure=exposure) / level)
    for spot, line in zip(spots or (), lines or (), strict=True):
        total = total + _in_wells(spot, saturation(line, **sensor, pixel_pitch=pixel_pitch, exposure=exposure))
    top = total.max().double()
    return Peak(top, top.new_tensor(math.nan) if damage is None else (top > damage).double())


def _in_wells(irradiance: Tensor | Channels, saturating: Tensor) -> Tensor:
    """Return the irradiance of each pixel in multiples of saturation: the sum of I / I_sat over wavelengths."""
    return weighted(irradiance, (1.0 / saturating)[None])[0]


@peak_irradiance.check
def _(result: Peak, *inputs: Any, damage: float | None = 1e6, **params: Any) -> list[Check]:
    text = f"brightest pixel {float(result.irradiance):.3g} times the saturation irradiance"
    if not float(result.damaged) > 0:
        return [Check(text)]
    return [Check(f"{text}, above the {damage:g} at which the paper expects damage (no threshold in W/cm2)", False)]
