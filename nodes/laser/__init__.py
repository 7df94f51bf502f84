"""Laser beams in absolute units: power, pulses, divergence, distance and air."""

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
    "peak_on_sensor",
    "power_through",
    "sensor_density",
    "share_through",
    "size_exponent",
    "underfilled",
]
