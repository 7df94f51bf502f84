"""Suppression ratios of a mask: laser suppression ratio (LSR) and background suppression ratio (BSR)."""

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import single
from neusee.nodes.metrics._mask_limits import least_lsr
from neusee.nodes.values import Channels, Psf

_DARK = 1e-30  #: light below which a band counts as dark


@node(rtol=1e-6)
def lsr(psf: Psf) -> Tensor:
    """Compute the laser suppression ratio: the peak of the PSF divided by the peak of the PSF of the clear lens.

    Shapes: psf.intensity (band, y, x) -> (band,) float64.
    Units:  none; 1 for the clear lens.
    Error:  of the sampling: a spot between two pixels reads up to 20 % low, so that the PSF convention matters.
    Source: NeuSee, section Sensor Image (LSR).
    """
    return psf.intensity.amax((-2, -1)).double() / psf.clear_peak.to(psf.intensity.device)


@lsr.check
def _(result: Tensor, *inputs: Psf) -> list[Check]:
    floor = float(least_lsr(inputs[0]).max())
    return [
        Check(
            f"laser suppression ratio {float(result.min()):.3g} to {float(result.max()):.3g}",
            bool((result <= 1.05).all()),
        ),
        Check(f"light spread evenly over the field would give a laser suppression ratio of {floor:.2g}"),
    ]


@node(rtol=1e-6, accepts_channel_sums=("image", "plain_image"))
def bsr(image: Tensor | Channels, plain_image: Tensor | Channels) -> Tensor:
    """Compute the background suppression ratio: scene light with the mask divided by scene light without the mask.

    An image that is summed over its bands, `Channels`, still contains the light of each band.

    Shapes: image and plain_image (..., band, y, x) -> (..., band) float64.
    Units:  none; about 1 for an element that absorbs no light and scatters no light out of the field.
    Error:  rows are summed in the precision of the image, 1e-7; a band without light (1e-30) has ratio 1. The ratio
            does not measure sharpness.
    Raises: ValueError for images of different shapes.
    Source: NeuSee, section Sensor Image (BSR), as a ratio of energies.
    """
    (shape, kept), (plain_shape, plain) = _shape_and_light(image), _shape_and_light(plain_image)
    if shape != plain_shape:
        raise ValueError(f"image {shape} with and {plain_shape} without mask differ in shape: use one scene for both")
    dark = plain <= _DARK  # false for NaN, so that NaN reaches the result
    ratio: Tensor = torch.where(dark, 1.0, kept / plain.where(~dark, 1.0))
    return ratio


@node(rtol=1e-6)
def peak_bsr(image: Tensor, plain_image: Tensor) -> Tensor:
    """Compute the ratio of the brightest pixel of the scene with the mask to the brightest pixel without the mask.

    The paper scales the peak irradiance of a scene by its background suppression ratio, so that a mask that blurs has a
    low ratio although no light is lost. `metrics.bsr` is the ratio of energies.

    Shapes: image and plain_image (..., band, y, x) -> (..., band) float64.
    Units:  none; about 1 for a mask that neither absorbs nor blurs.
    Error:  that of the brightest pixels, 2e-7; a band without light (1e-30) has ratio 1.
    Raises: ValueError for images of different shapes.
    Source: NeuSee, Eq. (peak_irrad_coded).
    """
    if image.shape != plain_image.shape:
        shapes = f"{tuple(image.shape)} with and {tuple(plain_image.shape)} without mask"
        raise ValueError(f"image {shapes} differ in shape: use one scene for both")
    kept, plain = (single(x).amax((-2, -1)).double() for x in (image, plain_image))
    dark = plain <= _DARK  # false for NaN, so that NaN reaches the result
    ratio: Tensor = torch.where(dark, 1.0, kept / plain.where(~dark, 1.0))
    return ratio


def _shape_and_light(image: Tensor | Channels) -> tuple[tuple[int, ...], Tensor]:
    if isinstance(image, Channels):
        return (*image.flux.shape, *image.planes.shape[1:]), image.flux
    return tuple(image.shape), single(image).sum(-1).sum(-1, dtype=torch.float64)


@bsr.check
def _(result: Tensor, *inputs: Tensor | Channels) -> list[Check]:
    return [
        Check(
            f"background suppression ratio {float(result.min()):.3f} to {float(result.max()):.3f}",
            bool((result <= 1.05).all()),
        )
    ]
