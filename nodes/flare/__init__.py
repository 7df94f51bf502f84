"""Flare: dirt in the pupil and ghosts on the sensor."""

from neusee.nodes.flare import _result_shapes  # noqa: F401  attaches the shape rules
from neusee.nodes.flare._dirt import dirt
from neusee.nodes.flare._ghosts import ghosts

__all__ = ["dirt", "ghosts"]
