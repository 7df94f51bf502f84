"""Diffractive optical elements: height maps and materials."""

from neusee.nodes.doe._fabricate import fabricate
from neusee.nodes.doe._masks import axicon, cubic, flat, half_rings, spiral_axicon, vortex, zernike
from neusee.nodes.doe._material import material
from neusee.nodes.doe._pixelwise import pixelwise
from neusee.nodes.doe._smooth import smooth
from neusee.nodes.doe._unet import unet

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
