"""Metrics: figures of merit of a mask, a picture and a laser spot."""

from neusee.nodes.metrics import _result_shapes  # noqa: F401  attaches the shape rules
from neusee.nodes.metrics._attacked_picture import (
    Attacked,
    GlareLevels,
    PixelNoise,
    attacked_picture,
    glare_levels,
)
from neusee.nodes.metrics._detail_targets import TARGETS, detail_energy, detail_targets, detection_snr
from neusee.nodes.metrics._filtered_picture import Filtered, channel_psf, decibels, filtered_picture, noise_variance
from neusee.nodes.metrics._heat_ratio import heat_ratio
from neusee.nodes.metrics._mask_limits import Limits, least_lsr, limits, most_contrast, most_unsuppressed
from neusee.nodes.metrics._peak_irradiance import Peak, peak_irradiance
from neusee.nodes.metrics._picture_quality import Quality, quality
from neusee.nodes.metrics._picture_spectrum import (
    PictureSpectrum,
    information_bits,
    mean_log_neq,
    picture_spectrum,
    radial_contrast,
    remaining_error,
)
from neusee.nodes.metrics._protection_bounds import ProtectionBounds, largest_glare, protection_bounds, stop_diameter
from neusee.nodes.metrics._psf_contrast import Mtf, encircled, encircled_curve, mtf, over_clear_peak
from neusee.nodes.metrics._saturated_pixels import Saturated, saturated
from neusee.nodes.metrics._spectral_error import spectral_error
from neusee.nodes.metrics._suppression_ratios import bsr, light_outside, lsr, peak_bsr

__all__ = [
    "TARGETS",
    "Attacked",
    "Filtered",
    "GlareLevels",
    "Limits",
    "Mtf",
    "Peak",
    "PictureSpectrum",
    "PixelNoise",
    "ProtectionBounds",
    "Quality",
    "Saturated",
    "attacked_picture",
    "bsr",
    "channel_psf",
    "decibels",
    "detail_energy",
    "detail_targets",
    "detection_snr",
    "encircled",
    "encircled_curve",
    "filtered_picture",
    "glare_levels",
    "heat_ratio",
    "information_bits",
    "largest_glare",
    "least_lsr",
    "light_outside",
    "limits",
    "lsr",
    "mean_log_neq",
    "most_contrast",
    "most_unsuppressed",
    "mtf",
    "noise_variance",
    "over_clear_peak",
    "peak_bsr",
    "peak_irradiance",
    "picture_spectrum",
    "protection_bounds",
    "quality",
    "radial_contrast",
    "remaining_error",
    "saturated",
    "spectral_error",
    "stop_diameter",
]
