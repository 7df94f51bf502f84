"""Transmittance of air on the way from a laser to a camera, from the visibility (meteorological range)."""

import math
from typing import Literal, TypeVar

import torch
from torch import Tensor

from neusee.nodes import ParameterError
from neusee.nodes.laser._beam import plain

Number = TypeVar("Number", float, Tensor)

Law = Literal["kruse", "kim"]
_KOSCHMIEDER = 3.912  #: -ln 0.02: at the visibility a black object has 2 % of its contrast left
_AT = 550e-9  #: m, wavelength of the visibility


def air_transmittance(
    distance: Number, visibility: float | None, wavelength: float, law: Law = "kim"
) -> Number | float:
    """Return the transmittance of air of a given visibility: exp(-(3.912 / V) (lambda / 550 nm)^-q R).

    ``law`` names the exponent q as a function of the visibility: `kruse` has q = 0.585 V^(1/3) below 6 km, `kim` lets q
    fall to 0 in fog of less than 500 m, where Kruse's law is known to fail. Without a visibility (None) the air is
    clear and the transmittance is 1. Absorption by gases is left out.

    Raises ParameterError for a negative distance and a visibility that is not above 0.
    Source: Koschmieder (1924); Kruse, McGlauchlin, McQuistan, Elements of Infrared Technology (1962); Kim, McArthur,
    Korevaar, Proc. SPIE 4214, 26 (2001).
    """
    if not (math.isfinite(plain(distance)) and distance >= 0):
        raise ParameterError("distance", f"{distance:g} m is no distance: give a finite number from 0")
    if visibility is None:
        return 1.0
    if not visibility > 0:
        raise ParameterError("visibility", f"{visibility:g} m is no visibility: give a number above 0")
    exponent = size_exponent(visibility, law)
    depth = _KOSCHMIEDER / visibility * math.pow(wavelength / _AT, -exponent) * distance
    return torch.exp(-depth) if isinstance(depth, Tensor) else math.exp(-depth)


def size_exponent(visibility: float, law: Law) -> float:
    """Return the exponent q of the wavelength in the extinction of haze at a visibility in m."""
    km = visibility / 1e3
    if km > 50:
        return 1.6
    if km > 6:
        return 1.3
    if law == "kruse":
        return 0.585 * math.pow(km, 1 / 3)
    if km > 1:
        return 0.16 * km + 0.34
    return max(0.0, km - 0.5)
