"""Scenes: where light enters a recipe."""

from neusee.nodes.scene._exr import exr
from neusee.nodes.scene._hyperspectral import hyperspectral
from neusee.nodes.scene._photograph import photograph
from neusee.nodes.scene._targets import targets

__all__ = ["exr", "hyperspectral", "photograph", "targets"]
