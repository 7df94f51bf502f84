"""Optical nodes: stop, pupil function, point-spread function, image and laser spot."""

from neusee.nodes.optics import _result_shapes  # noqa: F401  attaches the shape rules
from neusee.nodes.optics._band_image import image, light_in_field
from neusee.nodes.optics._channel_image import image_channels
from neusee.nodes.optics._few_bands import few_bands, few_bands_checked, pupil_of_bands
from neusee.nodes.optics._laser_spot import direction, field_of_view, laser_irradiance
from neusee.nodes.optics._lens import (
    cut_off,
    refuse_impossible_f_number,
    round_lens,
    white_irradiance,
)
from neusee.nodes.optics._psf import psf
from neusee.nodes.optics._pupil import (
    mask_turns,
    noll,
    phase_screen,
    phase_steps,
    pupil,
    pupil_has_large_steps,
    zernike_sum,
    zernike_surface,
)
from neusee.nodes.optics._pupil_grid import (
    PupilGrid,
    clear_area,
    clear_diameter,
    gaussian_integral,
    grid_of,
    inside_stop,
    polar_coordinates,
    pupil_axes,
    pupil_grid,
    stop,
)

__all__ = [
    "PupilGrid",
    "clear_area",
    "clear_diameter",
    "cut_off",
    "direction",
    "few_bands",
    "few_bands_checked",
    "field_of_view",
    "gaussian_integral",
    "grid_of",
    "image",
    "image_channels",
    "inside_stop",
    "laser_irradiance",
    "light_in_field",
    "mask_turns",
    "noll",
    "phase_screen",
    "phase_steps",
    "polar_coordinates",
    "psf",
    "pupil",
    "pupil_axes",
    "pupil_grid",
    "pupil_has_large_steps",
    "pupil_of_bands",
    "refuse_impossible_f_number",
    "round_lens",
    "stop",
    "white_irradiance",
    "zernike_sum",
    "zernike_surface",
]
