"""Optics: pupil, point-spread function, image and laser spot."""

from neusee.nodes.optics._channels import image_channels
from neusee.nodes.optics._direction import direction
from neusee.nodes.optics._image import image
from neusee.nodes.optics._psf import psf
from neusee.nodes.optics._pupil import pupil
from neusee.nodes.optics._spot import spot

__all__ = ["direction", "image", "image_channels", "psf", "pupil", "spot"]
