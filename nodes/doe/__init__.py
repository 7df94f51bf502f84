"""Diffractive optical elements: height maps and materials."""

from neusee.nodes.doe._analytic_masks import axicon, cubic, flat, half_rings, spiral_axicon, vortex, zernike
from neusee.nodes.doe._fabrication_limits import fabricate
from neusee.nodes.doe._minimum_feature import smooth
from neusee.nodes.doe._refractive_index import material
from neusee.nodes.doe._sampled_height_map import pixelwise
from neusee.nodes.doe._unet_height_map import unet

__all__ = [
    "axicon",
    "cubic",
    "fabricate",
    "flat",
    "half_rings",
    "material",
    "pixelwise",
    "smooth",
    "spiral_axicon",
    "unet",
    "vortex",
    "zernike",
]
