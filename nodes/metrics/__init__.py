"""Metrics: figures of merit of a mask, a picture and a laser spot."""

from neusee.nodes.metrics import _result_shapes  # noqa: F401  attaches the shape rules
from neusee.nodes.metrics._mask_limits import Limits, least_lsr, limits, most_contrast, most_unsuppressed
from neusee.nodes.metrics._peak_irradiance import Peak, peak_irradiance
from neusee.nodes.metrics._picture_quality import Quality, quality
from neusee.nodes.metrics._psf_contrast import Mtf, encircled, encircled_curve, mtf, over_clear_peak
from neusee.nodes.metrics._saturated_pixels import Saturated, saturated
from neusee.nodes.metrics._spectral_error import spectral_error
from neusee.nodes.metrics._suppression_ratios import bsr, light_outside, lsr, peak_bsr

__all__ = [
    "Limits",
    "Mtf",
    "Peak",
    "Quality",
    "Saturated",
    "bsr",
    "encircled",
    "encircled_curve",
    "least_lsr",
    "light_outside",
    "limits",
    "lsr",
    "most_contrast",
    "most_unsuppressed",
    "mtf",
    "over_clear_peak",
    "peak_bsr",
    "peak_irradiance",
    "quality",
    "saturated",
    "spectral_error",
]
