"""Scenes: photographs, OpenEXR pictures, spectral cubes and test targets."""

from neusee.nodes.scene import _result_shapes  # noqa: F401  attaches the shape rules
from neusee.nodes.scene._exr import exr, exr_parts, read_spectral, spectral_channels, write_spectral
from neusee.nodes.scene._hyperspectral import hyperspectral
from neusee.nodes.scene._photograph import (
    Photographs,
    choose_photograph,
    crop_photograph,
    list_photographs,
    photograph,
)
from neusee.nodes.scene._picture_changes import Change, framed_scene, grey, symmetry
from neusee.nodes.scene._test_targets import targets

__all__ = [
    "Change",
    "Photographs",
    "choose_photograph",
    "crop_photograph",
    "exr",
    "exr_parts",
    "framed_scene",
    "grey",
    "hyperspectral",
    "list_photographs",
    "photograph",
    "read_spectral",
    "spectral_channels",
    "symmetry",
    "targets",
    "write_spectral",
]
