"""Shapes of the results of the flare nodes, and the work of stray light."""

from collections.abc import Mapping
from typing import Any

from neusee.nodes.flare._dirt import dirt
from neusee.nodes.flare._ghosts import ghosts
from neusee.nodes.flare._stray_light import StrayShares, stray_light, stray_shares
from neusee.nodes.shape_rules import at_least_single, blank, double, like_first
from neusee.nodes.values import Dirt, Psf, Pupil, Stop

#: operations per pixel for the scatter of a surface, and for its addition to a band
_LOBE, _ADD = 60.0, 3.0

ghosts.shape(like_first)


@dirt.shape
def _(stop: Stop, **params: Any) -> Dirt:
    samples = int(stop.samples)
    return Dirt(blank(samples, samples), blank(samples, samples))


@stray_light.shape
def _(psf: Psf, pupil: Pupil, *direction: Any, **params: Any) -> Psf:
    intensity = blank(*psf.intensity.shape, dtype=at_least_single(psf.intensity))
    return psf._replace(intensity=intensity, clear_peak=double(len(psf.intensity)))


@stray_light.work
def _(
    result: Psf, psf: Psf, pupil: Pupil, *direction: Any, surfaces: Mapping[str, Any], **params: Any
) -> tuple[float, float]:
    bands, y, x = result.intensity.shape
    veils = bands if params.get("scaling", "none") != "none" else 1
    return result.intensity.nbytes + 64.0 * y * x, (
        _LOBE * len(surfaces) * veils + _ADD * bands
    ) * y * x


@stray_shares.shape
def _(psf: Psf, core: Psf, pupil: Pupil, **params: Any) -> StrayShares:
    return StrayShares(*(double(len(psf.intensity)) for _ in StrayShares._fields))
