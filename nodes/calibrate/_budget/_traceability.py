"""What a laboratory states of its light and of its temperature, so that its values can be traced to a standard."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from neusee.nodes.parameter_model import ParameterModel
from neusee.nodes.units import Linewidth, Wavelength, read_quantity

_CELSIUS = re.compile(r"([-+]?\d+(?:\.\d+)?)\s*(°C|C|degC)?")
_ZERO = 273.15  #: K

Relative = Annotated[float, Field(gt=0, lt=1)]  #: a standard uncertainty over its value
Finite = Annotated[float, Field(ge=-100, le=100)]
Text = Annotated[str, BeforeValidator(lambda value: str(value).strip()), Field(min_length=1)]


def _temperature(value: Any) -> float:
    """Return a temperature such as ``25 °C`` or ``298 K`` in kelvin."""
    match = _CELSIUS.fullmatch(str(value).strip())
    if match and not match[2]:
        raise ValueError(f"needs a unit: write {value} °C or {value} K")
    kelvin = float(match[1]) + _ZERO if match else read_quantity(value, "K")
    if not 0 < kelvin < math.inf:
        raise ValueError(f"{value} is not a temperature: write it as 25 °C or 298 K")
    return kelvin


class Statement(ParameterModel):
    """Base class of what a laboratory states; an unknown key is a mistake."""


class Photometry(Statement):
    """Calibration of the light: what is known of the numbers of photons, and who says so."""

    known: Literal["absolute", "relative"] = "absolute"  #: relative: up to a factor, so that no efficiency is told
    relative_uncertainty: Relative | None = None  #: standard uncertainty of the photons over their number
    distribution: Literal["normal", "rectangular"] = "normal"
    degrees_of_freedom: Annotated[float, Field(ge=1, le=math.inf, allow_inf_nan=True)] = math.inf
    certificate: Text | None = None  #: its number
    date: Text | None = None
    laboratory: Text | None = None
    instrument: Text | None = None


class Lamp(Statement):
    """The lamp: its spectrum, and how far its light may have drifted since it was calibrated."""

    spectrum: Text | None = None  #: in words, or the name of a file
    centroid: Wavelength | None = None
    centroid_uncertainty: Linewidth | None = None  #: standard uncertainty
    fwhm: Linewidth | None = None
    efficiency_per_nm: Finite | None = None  #: relative change of the efficiency
    drift: Relative | None = None  #: relative standard uncertainty, from the calibration of the light to the frames


class SensorTemperature(Statement):
    """The temperature of the sensor, and the relative change of its parameters per kelvin."""

    value: Annotated[float, Field(gt=0, le=1e4), BeforeValidator(_temperature, json_schema_input_type=str)] | None = (
        None  #: K
    )
    uncertainty: Annotated[float, Field(gt=0, le=1e6), BeforeValidator(lambda x: read_quantity(x, "K"))] | None = None
    coefficients: Mapping[str, Finite] = Field(default_factory=dict)  #: 1/K, by parameter

    @property
    def text(self) -> str | None:
        """Return the temperature as text, such as ``25 °C``, or None."""
        return None if self.value is None else f"{self.value - _ZERO:.4g} °C"


class Traceability(Statement):
    """What a laboratory states of its photons, its lamp and its temperature: the recipe key ``traceability``."""

    photons: Photometry = Photometry()
    lamp: Lamp = Lamp()
    temperature: SensorTemperature = SensorTemperature()
