"""Optical nodes: stop, pupil function, point-spread function, image and laser spot."""

from neusee.nodes.optics import _result_shapes  # noqa: F401  attaches the shape rules
from neusee.nodes.optics._band_image import image
from neusee.nodes.optics._channel_image import image_channels
from neusee.nodes.optics._few_bands import few_bands, few_bands_checked, pupil_of_bands
from neusee.nodes.optics._laser_spot import direction, field_of_view, laser_irradiance
from neusee.nodes.optics._lens import refuse_impossible_f_number, white_irradiance
from neusee.nodes.optics._psf import psf
from neusee.nodes.optics._pupil import mask_turns, pupil, pupil_has_large_steps
from neusee.nodes.optics._pupil_grid import stop

__all__ = [
    "direction",
    "few_bands",
    "few_bands_checked",
    "field_of_view",
    "image",
    "image_channels",
    "laser_irradiance",
    "mask_turns",
    "psf",
    "pupil",
    "pupil_has_large_steps",
    "pupil_of_bands",
    "refuse_impossible_f_number",
    "stop",
    "white_irradiance",
]
