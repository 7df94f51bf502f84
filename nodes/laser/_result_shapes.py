"""Values of the results of the laser nodes before a run, which have few numbers."""

from typing import Any

from neusee.nodes.laser._light import light, wavefront
from neusee.nodes.shape_rules import known, scalars
from neusee.nodes.values import Bands, LaserLight, Stop, Wavefront


@wavefront.shape
def _(line: Bands, **params: Any) -> Wavefront:
    found: Wavefront = wavefront(line, **params) if known(line.centres) else scalars(Wavefront)()
    return found


@light.shape
def _(line: Bands, stop: Stop, **params: Any) -> LaserLight:
    found: LaserLight = light(line, stop, **params) if known(line.centres) else scalars(LaserLight)()
    return found
