"""Shapes of the results of the mask nodes."""

from typing import Any

from torch import Tensor

from neusee.nodes.doe._analytic_masks import (
    axicon,
    cubic,
    flat,
    half_rings,
    spiral_axicon,
    vortex,
    zernike,
)
from neusee.nodes.doe._fabrication import fabricate, height_error, smooth
from neusee.nodes.doe._parametrisations import unet
from neusee.nodes.doe._refractive_index import material
from neusee.nodes.doe._sampled_height_map import pixelwise
from neusee.nodes.doe._shade import equal_filter, shade
from neusee.nodes.shape_rules import blank, double, like_first
from neusee.nodes.values import Bands, Shade, Stop

equal_filter.shape(like_first)
fabricate.shape(like_first)
height_error.shape(like_first)
smooth.shape(like_first)


def _on_pupil(stop: Stop, **params: Any) -> Tensor:
    return blank(int(stop.samples), int(stop.samples))


for node in (flat, vortex, axicon, spiral_axicon, cubic, half_rings, zernike, pixelwise, unet):
    node.shape(_on_pupil)


@unet.work
def _(
    result: Tensor, *inputs: Any, grid: int = 270, width: int = 32, **params: Any
) -> tuple[float, float]:
    # bytes of memory during the run, beside inputs and result, and number of operations
    side = min(grid, len(result))
    return 4.0 * width * side**2, float(width * side) ** 2 + result.numel()


@shade.shape
def _(stop: Stop, *, notches: tuple[float, ...] = (), **params: Any) -> Shade:
    return Shade(blank(int(stop.samples), int(stop.samples)), double(len(notches), 3))


@material.shape
def _(bands: Bands, **params: Any) -> Tensor:
    return double(len(bands.centres))
