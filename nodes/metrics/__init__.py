"""Metrics: what a reader of results asks for."""

from neusee.nodes.metrics._mask_limits import Limits, limits
from neusee.nodes.metrics._picture_quality import Quality, quality
from neusee.nodes.metrics._psf_contrast import Mtf, encircled, mtf
from neusee.nodes.metrics._suppression import Peak, Saturated, bsr, lsr, peak_irradiance, saturated

__all__ = [
    "Limits",
    "Mtf",
    "Peak",
    "Quality",
    "Saturated",
    "bsr",
    "encircled",
    "limits",
    "lsr",
    "mtf",
    "peak_irradiance",
    "quality",
    "saturated",
]
