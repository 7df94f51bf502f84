"""The error of a PSF of all bands together that comes from the number of spectral bands."""

import math
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import refuse_half
from neusee.nodes.optics import psf as focus
from neusee.nodes.optics import pupil_has_large_steps
from neusee.nodes.optics._psf_definition import SensorSampling
from neusee.nodes.units import FocalLength, PixelPitch
from neusee.nodes.values import Bands, Psf, Pupil

_SIDE = 256  #: pixels; the light within this square about the axis is compared
_SAMPLES = 256  #: least number of pupil samples across, of which a larger pupil keeps every k-th
_SCREENS = ("aperture", "amplitude", "height", "path")  #: what a pupil holds for each sample
_DARK = 1e-30  #: light below which a channel counts as dark


@node(rtol=1e-3)
def spectral_error(
    pupil: Pupil,
    bands: Bands,
    illuminant: Tensor | None = None,
    responses: Tensor | None = None,
    *,
    focal_length: FocalLength,
    pixel_pitch: PixelPitch,
    sensor: SensorSampling = "point",
) -> Tensor:
    """Estimate the error that the number of bands causes in the PSF of a white point, or of a laser line.

    The bands are doubled: the light halfway between the centres of adjoining bands is added, which gives a rule of
    twice as many points. The estimate is the root mean square difference of the PSFs of both rules. Bands that do not
    adjoin are split into halves instead. Without illuminant and responses, the weights are those of the line. The
    tolerance of a recipe is relative to the bands of the recipe, and does not include this error.

    Shapes: pupil (v, u), bands (band,), illuminant (band,), responses (channel, band) -> (channel,) float64.
    Units:  none; root mean square of the error over that of the PSF, within 256 pixels about the axis.
    Error:  a factor of 2, compared with 8 times as many bands; up to 2.5 times too large below 2e-4. The pupil is
            thinned to 256 samples or more across, and the index between bands is interpolated. A channel without light
            has error 0. The PSFs are in float64: they differ by as little as the rounding of float32.
    Raises: ValueError where pupil, bands, illuminant and responses have different bands.
    Source: comparison of two composite rules: Dahlquist and Bjorck, Numerical Methods, section 7.2 (1974).
    """
    weights = _weights(bands, illuminant, responses)
    if not weights.shape[1] == len(bands.centres) == len(pupil.wavelengths):
        counts = f"{len(pupil.wavelengths)}, {len(bands.centres)} and {weights.shape[1]}"
        raise ValueError(f"pupil, bands and weights have {counts} bands: compute all from the same `bands` step")
    more, difference = _finer(bands, weights)
    few = _in_double(_thinned(pupil))
    index = torch.cat([few.index, _interpolated(pupil.wavelengths, pupil.index, more)])
    few = few._replace(index=index, wavelengths=torch.cat([few.wavelengths, more]))
    limit = float(few.wavelengths.min()) * focal_length / (2 * float(few.pitch) * pixel_pitch)
    side = max(1, min(_SIDE, math.floor(2 * limit)))
    lens = {"focal_length": focal_length, "pixel_pitch": pixel_pitch, "sensor": sensor}
    found: Psf = focus(few, **lens, shape=(side, side), precision="double")
    light = found.intensity.flatten(1)
    whole, off = (_norms(w.to(light) @ light[: w.shape[1]]) for w in (weights, difference))
    dark = whole <= _DARK
    share: Tensor = torch.where(dark, 0.0, off / whole.where(~dark, 1.0))
    return share


def _norms(rows: Tensor) -> Tensor:
    norms: Tensor = torch.linalg.vector_norm(rows.double(), dim=1)
    return norms


def _weights(bands: Bands, illuminant: Tensor | None, responses: Tensor | None) -> Tensor:
    """Return the weight of each band in the photons of each channel: (channel, band) float64."""
    if illuminant is None or responses is None:
        return bands.weights.double()[None]
    return responses.double() * illuminant.double() * bands.centres * bands.widths


def _finer(bands: Bands, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return further wavelengths, and the weights (channel, wavelength) of the error, centres of bands first."""
    steps = bands.centres.diff()
    if len(steps) and bool(((steps - bands.widths[1:]).abs() <= 0.01 * steps.abs()).all()):
        middle = (bands.centres[1:] + bands.centres[:-1]) / 2
        ends = torch.ones_like(bands.centres)
        ends[0] = ends[-1] = 0.5
        return middle, torch.cat([weights * ends, -(weights[:, 1:] + weights[:, :-1]) / 2], 1) / 2
    halves = torch.cat([bands.centres - bands.widths / 4, bands.centres + bands.widths / 4])
    return halves, torch.cat([weights, -weights / 2, -weights / 2], 1)


def _interpolated(at: Tensor, values: Tensor, where: Tensor) -> Tensor:
    """Interpolate by the polynomial through the four nearest points, or through all points if there are fewer."""
    near = (where[:, None] - at).abs().argsort(1)[:, : min(4, len(at))]
    x, y = at[near], values[near]
    apart = x[:, :, None] - x[:, None, :] + torch.eye(x.shape[1], dtype=x.dtype)
    ratio = (where[:, None, None] - x[:, None, :]) / apart
    own = torch.eye(x.shape[1], dtype=torch.bool)
    value: Tensor = (ratio.where(~own, 1.0).prod(2) * y).sum(1)
    return value


def _thinned(pupil: Pupil) -> Pupil:
    """Return every k-th sample of a large pupil, as long as the samples that are left can follow the phase."""
    step = max(1, len(pupil.height) // _SAMPLES)
    while step > 1 and pupil_has_large_steps(_every(pupil, step)):
        step //= 2
    return _every(pupil, step)


def _every(pupil: Pupil, step: int) -> Pupil:
    return pupil._replace(**{name: getattr(pupil, name)[::step, ::step] for name in _SCREENS}, pitch=pupil.pitch * step)


def _in_double(pupil: Pupil) -> Pupil:
    """Return the pupil in float64, so that the gradients of all bands add up in float64."""
    screens = {name: getattr(pupil, name) for name in _SCREENS}
    refuse_half(**screens)
    return pupil._replace(**{name: screen.double() for name, screen in screens.items()})


@spectral_error.check
def _(result: Tensor, pupil: Pupil, bands: Bands, *_: Any, **__: Any) -> list[Check]:
    return [Check(f"{len(bands.centres)} bands: error of the spectral sampling {float(result.max()):.2g} of the PSF")]
