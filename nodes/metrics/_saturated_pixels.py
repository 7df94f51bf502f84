"""Count of pixels at the full well or at the largest output of the analogue-to-digital converter."""

from typing import Any, NamedTuple

from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.sensor._digitization import Bits, clipping_number
from neusee.nodes.sensor._room_for_light import refuse_without_steps
from neusee.nodes.sensor._saturation import Well
from neusee.nodes.units import Gain


class Saturated(NamedTuple):
    """The number and the share of pixels with at least one clipped channel."""

    pixels: Tensor  #: () float64
    share: Tensor  #: () float64, relative to all pixels


@node(rtol=1e-6)
def saturated(raw: Tensor, *, full_well: Well, gain: Gain, bits: Bits = 16) -> Saturated:
    """Count the pixels with a channel at the full well or at the largest output of the analogue-to-digital converter.

    Shapes: raw (..., channel, y, x) -> two scalars, float64.
    Units:  raw DN; pixels.
    Error:  a pixel within one DN of the full well counts as saturated, and so does a pixel that is NaN.
    Source: NeuSee, Eq. (SensorImage).
    """
    full = clipped(raw, full_well=full_well, gain=gain, bits=bits).any(-3)
    pixels = full.sum().double()
    return Saturated(pixels, pixels / full.numel())


@saturated.preflight
def _(*, full_well: float, gain: float, bits: int = 16, **params: object) -> list[str]:
    refuse_without_steps(full_well, gain=gain, bits=bits)
    return []


@saturated.check
def _(result: Saturated, *inputs: Tensor, **params: Any) -> list[Check]:
    return [Check(f"{int(result.pixels)} saturated pixels, {float(result.share):.2%} of all pixels")]


def clipped(raw: Tensor, *, full_well: float, gain: float, bits: int) -> Tensor:
    """Return True for raw values in DN at the full well or at the largest output of the converter, and for NaN."""
    marked: Tensor = ~(raw < clipping_number(full_well, gain, bits))  # NaN counts as clipped
    return marked
