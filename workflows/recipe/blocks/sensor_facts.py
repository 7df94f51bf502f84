"""The sensor of an estimate of safety: its pixels, and what fills them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from pydantic import Field, model_validator

from neusee.nodes.sensor import Bits, electrons_to_clip, refuse_without_steps
from neusee.nodes.units import Efficiency, Electrons, Exposure, Gain, PixelPitch, Shape
from neusee.workflows.recipe.blocks.settings_block import SettingsBlock

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Step

Passing = Annotated[float, Field(gt=0, le=1)]


class SensorFacts(SettingsBlock):
    """What damage and dazzle need to know of the sensor; no quantum efficiency means that none is known."""

    pixel_pitch: PixelPitch
    shape: Shape
    quantum_efficiency: Efficiency | None = (
        None  #: at the wavelength of the laser; with ``responses``, that of the sensor
    )
    responses: str | None = None  #: step of the response of each channel to the laser, such as ``laser_responses``
    full_well: Annotated[Electrons, Field(ge=1)] | None = None
    gain: Gain | None = None  #: with ``bits``: the converter may end below the full well
    bits: Bits | None = None
    offset: Electrons = 0.0  #: part of a well that is filled without light
    exposure: Exposure | None = None

    @property
    def fills(self) -> float:
        """Return the electrons of light that fill a pixel, to its full well or to the end of the converter."""
        well = self.full_well or math.inf
        if self.gain is None or self.bits is None or self.full_well is None:
            return well - self.offset
        return electrons_to_clip(well, self.gain, self.bits, self.offset)

    @model_validator(mode="after")
    def _leaves_room_for_light(self) -> SensorFacts:
        if not self.fills > 0:
            full = f"an offset of {self.offset:g} e- leaves no room for light"
            raise ValueError(f"{full} in a full well of {self.full_well:g} e-, or in the range of the converter")
        if self.full_well is not None and self.gain is not None and self.bits is not None:
            refuse_without_steps(self.full_well, gain=self.gain, bits=self.bits)
        return self


@dataclass(frozen=True)
class LaserChannels:
    """The responses of the colour channels to a laser, as steps that can be asked at another wavelength too."""

    line: Step  #: of the bands of the laser
    responses: Step
    largest: float  #: response of the channel that responds most, relative to the quantum efficiency of the sensor
    key: str  #: of the responses, for the key of an estimate
