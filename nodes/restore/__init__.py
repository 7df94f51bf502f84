"""Restoration nodes: from raw digital numbers back to colour."""

from neusee.nodes.restore._colour_matrix import colour_matrix
from neusee.nodes.restore._electrons_and_colour import clipped, colour, electrons
from neusee.nodes.restore._inverse._wiener import wiener
from neusee.nodes.restore._networks._fft_mamba import fft_mamba
from neusee.nodes.restore._networks._nafnet import nafnet
from neusee.nodes.restore._networks._unet import unet

__all__ = ["clipped", "colour", "colour_matrix", "electrons", "fft_mamba", "nafnet", "unet", "wiener"]
