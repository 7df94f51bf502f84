"""The transform from the pupil to the sensor: axes, scaled Fourier transforms and their choice.

The room belongs to `neusee.nodes.optics`, whose files import its files by their own names, so that
a cache key depends on no more than it must. A test imports the names below.
"""

from neusee.nodes.optics.transform._fft_transforms import Banded, fft_length, work_by_axis
from neusee.nodes.optics.transform._fused import fused_axis
from neusee.nodes.optics.transform._intensity import PupilIntensity, Sampling, intensity_of
from neusee.nodes.optics.transform._pupil_field import View
from neusee.nodes.optics.transform._sample_axis import (
    Axis,
    borrowed,
    centred,
    last_type,
    radians,
    unit_phasor,
)
from neusee.nodes.optics.transform._scaled_transform import Grids, cheapest, transform

__all__ = [
    "Axis",
    "Banded",
    "Grids",
    "PupilIntensity",
    "Sampling",
    "View",
    "borrowed",
    "centred",
    "cheapest",
    "fft_length",
    "fused_axis",
    "intensity_of",
    "last_type",
    "radians",
    "transform",
    "unit_phasor",
    "work_by_axis",
]
