"""Laser beams in absolute units: power, pulses, divergence, distance and air."""

from neusee.nodes.laser import _result_shapes  # noqa: F401  attaches the shape rules
from neusee.nodes.laser._air import Law, air_transmittance, size_exponent
from neusee.nodes.laser._beam import (
    Beam,
    Convention,
    axis_density,
    axis_irradiance,
    beam,
    beam_radius,
    curvature_radius,
    peak_on_sensor,
    power_through,
    sensor_density,
    share_through,
    underfilled,
)
from neusee.nodes.laser._light import light, pulses_within, wavefront

__all__ = [
    "Beam",
    "Convention",
    "Law",
    "air_transmittance",
    "axis_density",
    "axis_irradiance",
    "beam",
    "beam_radius",
    "curvature_radius",
    "light",
    "peak_on_sensor",
    "power_through",
    "pulses_within",
    "sensor_density",
    "share_through",
    "size_exponent",
    "underfilled",
    "wavefront",
]
