"""Restoration: from raw digital numbers back to colour."""

from neusee.nodes.restore._electrons import clipped, colour, electrons
from neusee.nodes.restore._fft_mamba import fft_mamba
from neusee.nodes.restore._matrix import colour_matrix
from neusee.nodes.restore._nafnet import nafnet
from neusee.nodes.restore._unet import unet
from neusee.nodes.restore._wiener import wiener

__all__ = ["clipped", "colour", "colour_matrix", "electrons", "fft_mamba", "nafnet", "unet", "wiener"]
