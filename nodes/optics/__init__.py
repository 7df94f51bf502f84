"""Optics: pupil, point-spread function, image and laser spot."""

from neusee.nodes.optics._imaging._band_image import image
from neusee.nodes.optics._imaging._channel_image import image_channels
from neusee.nodes.optics._laser_direction import direction
from neusee.nodes.optics._laser_spot import laser_irradiance
from neusee.nodes.optics._psf import psf
from neusee.nodes.optics._pupil import pupil

__all__ = ["direction", "image", "image_channels", "laser_irradiance", "psf", "pupil"]
