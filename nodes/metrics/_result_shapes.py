"""Shapes of the results of the figures of merit."""

from typing import Any

from torch import Tensor

from neusee.nodes.metrics._mask_limits import Limits, limits
from neusee.nodes.metrics._peak_irradiance import Peak, peak_irradiance
from neusee.nodes.metrics._picture_quality import Quality, quality
from neusee.nodes.metrics._psf_contrast import Mtf, encircled, mtf
from neusee.nodes.metrics._saturated_pixels import Saturated, saturated
from neusee.nodes.metrics._suppression_ratios import bsr, lsr
from neusee.nodes.shape_rules import double, scalars
from neusee.nodes.values import Channels, Psf

quality.shape(scalars(Quality))
peak_irradiance.shape(scalars(Peak))
saturated.shape(scalars(Saturated))


def _each_band(psf: Psf, **params: Any) -> Tensor:
    return double(len(psf.intensity))


lsr.shape(_each_band)
encircled.shape(_each_band)


@mtf.shape
def _(psf: Psf) -> Mtf:
    return Mtf(*(_each_band(psf) for _ in Mtf._fields))


@limits.shape
def _(psf: Psf) -> Limits:
    return Limits(*(_each_band(psf) for _ in Limits._fields))


@bsr.shape
def _(image: Tensor | Channels, plain_image: Any) -> Tensor:
    return double(*image.flux.shape) if isinstance(image, Channels) else double(*image.shape[:-2])
