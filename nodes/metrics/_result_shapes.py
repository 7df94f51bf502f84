"""Shapes of the results of the figures of merit."""

from typing import Any

from torch import Tensor

from neusee.nodes.metrics._picture_quality import Filtered, Quality, filtered_picture, quality
from neusee.nodes.metrics._psf_quality import (
    _COMPARED_SIDE,
    Mtf,
    encircled,
    mtf,
    spectral_error,
)
from neusee.nodes.metrics._sensor_load import (
    Peak,
    Saturated,
    heat_ratio,
    peak_irradiance,
    saturated,
)
from neusee.nodes.metrics._suppression import (
    Limits,
    ProtectionBounds,
    bsr,
    light_outside,
    limits,
    lsr,
    peak_bsr,
    protection_bounds,
)
from neusee.nodes.optics._pupil import THINNED_SAMPLES
from neusee.nodes.shape_rules import double, scalars
from neusee.nodes.values import Bands, Psf, Pupil

quality.shape(scalars(Quality))
peak_irradiance.shape(scalars(Peak))
saturated.shape(scalars(Saturated))


def _each_band(psf: Psf, *others: Any, **params: Any) -> Tensor:
    return double(len(psf.intensity))


lsr.shape(_each_band)
heat_ratio.shape(_each_band)
encircled.shape(_each_band)


@mtf.shape
def _(psf: Psf) -> Mtf:
    return Mtf(*(_each_band(psf) for _ in Mtf._fields))


@limits.shape
def _(psf: Psf) -> Limits:
    return Limits(*(_each_band(psf) for _ in Limits._fields))


@protection_bounds.shape
def _(psf: Psf, **params: Any) -> ProtectionBounds:
    return ProtectionBounds(*(_each_band(psf) for _ in ProtectionBounds._fields))


@filtered_picture.shape
def _(psf: Psf, illuminant: Any, responses: Tensor, *others: Any, **params: Any) -> Filtered:
    return Filtered(*(double(len(responses)) for _ in Filtered._fields))


@bsr.shape
def _(psf: Psf, radiance: Tensor | None = None) -> Tensor:
    return double(len(psf.intensity)) if radiance is None else double(*radiance.shape[:-2])


@bsr.work
def _(result: Tensor, psf: Psf, radiance: Tensor | None = None) -> tuple[float, float]:
    # bytes of memory during the run, beside inputs and result, and number of operations
    return 0.0, float((psf.intensity if radiance is None else radiance).numel())


@peak_bsr.shape
def _(image: Tensor, plain_image: Any) -> Tensor:
    return double(*image.shape[:-2])


light_outside.shape(_each_band)


@spectral_error.shape
def _(
    pupil: Pupil,
    bands: Bands,
    illuminant: Any = None,
    responses: Tensor | None = None,
    **params: Any,
) -> Tensor:
    return double(1 if responses is None else len(responses))


@spectral_error.work
def _(
    result: Tensor, pupil: Pupil, bands: Bands, *others: Any, **params: Any
) -> tuple[float, float]:
    # bytes of memory during the run, beside inputs and result, and number of operations
    count, pupil_side = len(bands.centres), max(pupil.height.shape)
    psf_pixels = 2.0 * count * _COMPARED_SIDE**2
    thinned_side = -(-pupil_side // max(1, pupil_side // THINNED_SAMPLES))
    wavelengths = 2 * count - 1 if count > 1 else 3
    return 8.0 * psf_pixels, 0.5 * pupil.height.numel() + wavelengths * (
        thinned_side**2 + _COMPARED_SIDE**2
    )
