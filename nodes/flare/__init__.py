"""Flare: dirt in the pupil, ghosts on the sensor, and stray light of the lens."""

from neusee.nodes.flare import _result_shapes  # noqa: F401  attaches the shape rules
from neusee.nodes.flare._dirt import dirt
from neusee.nodes.flare._ghosts import ghosts
from neusee.nodes.flare._stray_light import (
    StrayShares,
    Surfaces,
    light_within,
    lobe,
    on_pixels,
    scattered_share,
    stray_light,
    stray_shares,
    surface_of,
    veil_at,
)

__all__ = [
    "StrayShares",
    "Surfaces",
    "dirt",
    "ghosts",
    "light_within",
    "lobe",
    "on_pixels",
    "scattered_share",
    "stray_light",
    "stray_shares",
    "surface_of",
    "veil_at",
]
