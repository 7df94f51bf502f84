"""Optics: pupil, point-spread function, image and laser spot."""

from neusee.nodes.optics._pupil import pupil

__all__ = ["pupil"]
