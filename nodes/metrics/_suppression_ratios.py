"""Suppression ratios of a mask: laser suppression ratio (LSR) and background suppression ratio (BSR)."""

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from neusee.nodes import Check, node
from neusee.nodes._half_precision import single
from neusee.nodes.metrics._mask_limits import least_lsr
from neusee.nodes.optics._imaging._light_in_field import light_in_field
from neusee.nodes.optics._notch import passed_by_notches
from neusee.nodes.values import Psf, Pupil

_DARK = 1e-30  #: light below which a band counts as dark
_ROUNDED = 1e-4  #: excess of light that sampling and round-off explain


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


@node(rtol=1e-6, bands={"psf": 0, "radiance": -3, "return": -1})
def bsr(psf: Psf, radiance: Tensor | None = None) -> Tensor:
    """Compute the background suppression ratio: the share of the scene's light that a mask leaves in the field.

    The scene's light is all light that the clear pupil takes from the scene inside the field, which an unbounded sensor
    would collect behind the clear lens. Light counts as lost if it falls outside the field, outside the window of the
    PSF, or is absorbed by dirt. No light enters from outside the field, so the border of `optics.image` has no effect,
    and the ratio of a passive mask is at most 1. The ratio of the clear lens is a little below 1, for its own
    diffraction. Without a scene, the ratio is that of a point on the axis: the share of the light in the window.

    Shapes: psf.intensity (band, any, any), radiance (..., band, y, x) -> (..., band) float64.
    Units:  none; 1 where all light stays in the field.
    Error:  1e-6 in float32. A band without light (1e-30) has ratio 1. A PSF sampled at points holds more than all light
            where pixels are wider than lambda f / D, or where the light reaches the edge of the alias-free field.
            Sharpness is not measured.
    Raises: ValueError where scene and PSF have different bands.
    Source: NeuSee, section Sensor Image (BSR), as a ratio of energies; the border is left out.
    """
    if radiance is None:
        return single(psf.intensity).sum(-1).sum(-1, dtype=torch.float64)
    kept, whole = light_in_field(psf.intensity, radiance)
    dark = whole <= _DARK  # false for NaN, so that NaN reaches the result
    ratio: Tensor = torch.where(dark, 1.0, kept / whole.where(~dark, 1.0))
    return ratio


@bsr.reference
def _(psf: Psf, radiance: Tensor | None = None) -> Tensor:
    """Form the image without border, with a margin that catches all light of the PSF, and compare sums of pixels."""
    kernel = psf.intensity.double()
    if radiance is None:
        return kernel.sum((-2, -1))
    cube = radiance.double()
    scene = cube.reshape(-1, *cube.shape[-3:])
    (m, n), (y, x) = kernel.shape[-2:], scene.shape[-2:]
    around = (n - 1, n - 1, m - 1, m - 1)
    full = conv2d(pad(scene, around), kernel.flip(-1, -2)[:, None], groups=len(kernel))
    kept, whole = full[..., m // 2 : m // 2 + y, n // 2 : n // 2 + x].sum((-2, -1)), scene.sum((-2, -1))
    dark = whole <= _DARK
    return torch.where(dark, 1.0, kept / whole.where(~dark, 1.0)).reshape(cube.shape[:-2])


@bsr.check
def _(result: Tensor, *inputs: Any) -> list[Check]:
    low, high = float(result.min()), float(result.max())
    return [Check(f"background suppression ratio {low:.3f} to {high:.3f}", bool((result <= 1 + _ROUNDED).all()))]


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


@node(rtol=1e-6)
def light_outside(psf: Psf, pupil: Pupil) -> Tensor:
    """Compute the share of the light of a point that falls outside the window of its PSF, by band.

    The light is what the pupil passes, so that light that dirt absorbs does not count. No later step knows of the light
    outside the window: it is lost to the picture of the scene, and to the glare of a laser.

    Shapes: psf.intensity (band, y, x), pupil (v, u) -> (band,) float64.
    Units:  none; 0 where the window holds all light.
    Error:  1e-6 of the light. The light of a PSF sampled at points is that of the window only if no pixel is wider than
            lambda f / D. A pupil without light has no light outside: 0. The height and the path of the pupil have no
            effect, not even where they are NaN.
    Source: conservation of energy: Goodman, Introduction to Fourier Optics, 3rd ed., section 2.1.5 (Parseval).
    """
    passed, clear = (x.double().square().sum() for x in (pupil.amplitude, pupil.aperture))
    through = passed / clear * passed_by_notches(pupil).to(passed.device)
    inside = torch.stack([band.sum(dtype=torch.float64) for band in single(psf.intensity)])  # a copy of one band
    dark = through <= _DARK  # false for NaN, so that NaN reaches the result
    outside: Tensor = torch.where(dark, 0.0, 1.0 - inside / through.where(~dark, 1.0))
    return outside


@light_outside.check
def _(result: Tensor, *inputs: Any) -> list[Check]:
    low, high = float(result.min()), float(result.max())
    return [Check(f"{low:.2%} to {high:.2%} of the light falls outside the window", low >= -_ROUNDED)]
