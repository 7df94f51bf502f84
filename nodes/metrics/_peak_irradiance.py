"""Irradiance of the brightest pixel of the sensor, compared with saturation and with a damage threshold."""

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
    damaged: Tensor  #: () float64, 1 where the irradiance exceeds the damage threshold


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
        raise ValueError(f"{len(spots or ())} spots and {len(lines or ())} laser lines: give one line for each spot")
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
    return [
        Check(
            f"brightest pixel {float(result.irradiance):.3g} times the saturation irradiance", not bool(result.damaged)
        )
    ]
