"""Scenes: photographs, OpenEXR pictures, spectral cubes and test targets."""

from neusee.nodes.scene import _result_shapes  # noqa: F401  attaches the shape rules
from neusee.nodes.scene._exr import exr, write_spectral
from neusee.nodes.scene._hyperspectral import hyperspectral
from neusee.nodes.scene._photograph import (
    Photographs,
    choose_photograph,
    crop_photograph,
    list_photographs,
    photograph,
)
from neusee.nodes.scene._picture_changes import Change, grey, symmetry
from neusee.nodes.scene._test_targets import targets

__all__ = [
    "Change",
    "Photographs",
    "choose_photograph",
    "crop_photograph",
    "exr",
    "grey",
    "hyperspectral",
    "list_photographs",
    "photograph",
    "symmetry",
    "targets",
    "write_spectral",
]
