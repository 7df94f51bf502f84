"""Losses: what learning minimises."""

from neusee.nodes.losses._contrast_loss import ContrastFloor, HighestFrequency, contrast
from neusee.nodes.losses._gradient_penalty import gradient_penalty
from neusee.nodes.losses._mask_losses import bsr, lsr
from neusee.nodes.losses._restoration_losses import charbonnier, fft_l1
from neusee.nodes.losses._spectral_loss import mrae
from neusee.nodes.losses._wiener_loss import NoiseVariance, OneBandShare, wiener

__all__ = [
    "ContrastFloor",
    "HighestFrequency",
    "NoiseVariance",
    "OneBandShare",
    "bsr",
    "charbonnier",
    "contrast",
    "fft_l1",
    "gradient_penalty",
    "lsr",
    "mrae",
    "wiener",
]
