"""Scenes: the sources of light in a recipe."""

from neusee.nodes.scene._exr_picture import exr
from neusee.nodes.scene._hyperspectral import hyperspectral
from neusee.nodes.scene._photograph import photograph
from neusee.nodes.scene._test_targets import targets

__all__ = ["exr", "hyperspectral", "photograph", "targets"]
