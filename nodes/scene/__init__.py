"""Scenes: photographs, OpenEXR pictures, spectral cubes and test targets."""

from neusee.nodes.scene import _result_shapes  # noqa: F401  attaches the shape rules
from neusee.nodes.scene._augmentation import Change, symmetry
from neusee.nodes.scene._exr_picture import exr
from neusee.nodes.scene._grey import grey
from neusee.nodes.scene._hyperspectral import hyperspectral
from neusee.nodes.scene._photograph import (
    Photographs,
    choose_photograph,
    crop_photograph,
    list_photographs,
    photograph,
)
from neusee.nodes.scene._spectral_exr import write_spectral
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
