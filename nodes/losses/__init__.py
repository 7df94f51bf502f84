"""Losses: the functions that a training minimises."""

from neusee.nodes.losses._mask_losses import (
    ContrastFloor,
    HighestFrequency,
    NoiseVariance,
    OneBandShare,
    background_loss,
    contrast,
    suppression_loss,
    wiener,
)
from neusee.nodes.losses._protected_losses import (
    ContrastVariance,
    PeakLimit,
    ProtectedPicture,
    SceneLight,
    best_stop,
    filtered_error,
    information,
)
from neusee.nodes.losses._restoration_losses import (
    charbonnier,
    fft_l1,
    gradient_penalty,
    log_error,
    mrae,
)

__all__ = [
    "ContrastFloor",
    "ContrastVariance",
    "HighestFrequency",
    "NoiseVariance",
    "OneBandShare",
    "PeakLimit",
    "ProtectedPicture",
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
