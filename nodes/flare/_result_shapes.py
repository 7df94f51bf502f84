"""Shapes of the results of the flare nodes."""

from typing import Any

from neusee.nodes.flare._dirt import dirt
from neusee.nodes.flare._ghosts import ghosts
from neusee.nodes.shape_rules import blank, like_first
from neusee.nodes.values import Dirt, Stop

ghosts.shape(like_first)


@dirt.shape
def _(stop: Stop, **params: Any) -> Dirt:
    samples = int(stop.samples)
    return Dirt(blank(samples, samples), blank(samples, samples))
