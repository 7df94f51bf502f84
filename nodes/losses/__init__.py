"""Losses: the functions that a training minimises."""

from neusee.nodes.losses._contrast_loss import ContrastFloor, HighestFrequency, contrast
from neusee.nodes.losses._gradient_penalty import gradient_penalty
from neusee.nodes.losses._mask_losses import background_loss, suppression_loss
from neusee.nodes.losses._protected_losses import (
    ContrastVariance,
    PeakLimit,
    SceneLight,
    best_stop,
    filtered_error,
    information,
)
from neusee.nodes.losses._restoration_losses import charbonnier, fft_l1, log_error
from neusee.nodes.losses._spectral_loss import mrae
from neusee.nodes.losses._wiener_loss import NoiseVariance, OneBandShare, wiener

__all__ = [
    "ContrastFloor",
    "ContrastVariance",
    "HighestFrequency",
    "NoiseVariance",
    "OneBandShare",
    "PeakLimit",
    "SceneLight",
    "background_loss",
    "best_stop",
    "charbonnier",
    "contrast",
    "fft_l1",
    "filtered_error",
    "gradient_penalty",
    "information",
    "log_error",
    "mrae",
    "suppression_loss",
    "wiener",
]
