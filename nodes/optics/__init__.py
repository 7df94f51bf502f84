"""Optics: pupil, point-spread function, image and laser spot."""
