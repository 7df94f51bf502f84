"""Masks (diffractive optical elements): height maps and materials."""

from neusee.nodes.doe import _result_shapes  # noqa: F401  attaches the shape rules
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
from neusee.nodes.doe._height_map_files import read_height_map, size_metadata
from neusee.nodes.doe._parametrisations import (
    PARAMETRISATIONS,
    Drawn,
    HeightNet,
    LearntStop,
    Modes,
    Pixels,
    Polynomials,
    Rings,
    Streak,
    Written,
    unet,
)
from neusee.nodes.doe._refractive_index import (
    Glass,
    Material,
    index_curve,
    index_rows,
    material,
    wave_height,
)
from neusee.nodes.doe._sampled_height_map import height_map, pixelwise
from neusee.nodes.doe._shade import equal_filter, shade

__all__ = [
    "PARAMETRISATIONS",
    "Drawn",
    "Glass",
    "HeightNet",
    "LearntStop",
    "Material",
    "Modes",
    "Pixels",
    "Polynomials",
    "Rings",
    "Streak",
    "Written",
    "axicon",
    "cubic",
    "equal_filter",
    "fabricate",
    "flat",
    "half_rings",
    "height_error",
    "height_map",
    "index_curve",
    "index_rows",
    "material",
    "pixelwise",
    "read_height_map",
    "shade",
    "size_metadata",
    "smooth",
    "spiral_axicon",
    "unet",
    "vortex",
    "wave_height",
    "zernike",
]
