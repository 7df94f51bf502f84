"""The choice of few bands whose PSFs represent the PSFs of all bands, by an estimate of the error in the picture."""

import math
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.optics._imaging._band_thumbnail import (
    SIDE,
    Parts,
    Thumbnail,
    binned,
    bins_of,
    estimated,
    focused,
    parts_of,
    share_of_bands,
    thumbnail,
    without_gradients,
)
from neusee.nodes.optics._imaging._channel_image import Share
from neusee.nodes.optics._imaging._psf_energy import centred
from neusee.nodes.optics._psf_definition import SensorSampling
from neusee.nodes.units import FocalLength, PixelPitch, Shape
from neusee.nodes.values import FewBands, LowRankCube, Psf, Pupil

_RUNGS = (2, 3, 4, 5, 6, 8, 11, 16, 21)  #: numbers of bands that are tried, the fewest first
_MOST = 0.7  #: largest share of the bands that is worth a choice
_FINER = 3  #: least ratio of the bands of a comparison to the bands that are compared
_SAFETY = 2.0  #: factor on the estimate, for the thumbnail is not the picture


@node(rtol=1e-5)
def few_bands(
    pupil: Pupil,
    radiance: LowRankCube,
    rows: Tensor,
    *,
    focal_length: FocalLength,
    pixel_pitch: PixelPitch,
    shape: Shape,
    pixel: Literal["point", "zoh"] = "point",
    sensor: SensorSampling = "point",
    within: Share = 0.0,
    largest: bool = False,
) -> FewBands:
    """Choose the fewest bands whose PSFs, interpolated linearly between the bands, give the image of the scene within
    an error.

    The error is estimated: PSFs of a thinned pupil, of every second band where at least three times as many as few
    bands are enough to compare with, else of all, are convolved with three parts of the scene: the brightest, the one
    of the most contrast, and the middle. Their window holds 90 % of the light, in cells of 1, 2 or
    4 pixels along each side. The estimate is twice the error of the worst part. With `largest`, the error of the
    brightest pixel is held too. All bands are kept where no such window is much smaller than that of the PSF.

    Shapes: pupil (v, u), radiance k planes (y, x), rows (row, band) -> used (j,), share (band, j) float64.
    Units:  errors relative to the brightest pixel of each row.
    Error:  an estimate, not a bound: `optics.few_bands_checked` compares it with a finer choice. The choice is constant
            for gradients.
    Raises: ValueError where pupil, scene and rows have different bands.
    Source: composite trapezoidal rule over wavelengths: Dahlquist and Bjorck, Numerical Methods, section 7.2 (1974).
    """
    count = _same_count(pupil, radiance, rows)
    rungs = [few for few in _RUNGS if few <= _MOST * count]
    if not rungs or within <= 0:
        return _all_bands(count)
    pupil, radiance, rows = without_gradients(pupil, radiance, rows)
    lens = {"focal_length": focal_length, "pixel_pitch": pixel_pitch, "pixel": pixel, "sensor": sensor}
    small = thumbnail(pupil, shape, lens)
    if small is None:
        return _all_bands(count)
    half = _evenly(count // 2 + 1, count)
    light_of_half = small.light(half)
    light = _interpolated(light_of_half, half, count)
    rungs_of_half = [few for few in rungs if _FINER * few <= len(half)]
    choice = _fewest(rungs_of_half, parts_of(radiance, rows, light, small.pixels), light, within, largest)
    if choice is None:
        light = _completed(light_of_half, half, count, small)
        choice = _fewest(rungs, parts_of(radiance, rows, light, small.pixels), light, within, largest)
    return choice or _all_bands(count)


def _same_count(pupil: Pupil, radiance: LowRankCube, rows: Tensor) -> int:
    """Return the number of bands; raise ValueError where pupil, radiance and rows differ in it."""
    counts = len(pupil.wavelengths), len(radiance.basis), rows.shape[-1]
    if len(set(counts)) > 1:
        text = f"{counts[0]}, {counts[1]} and {counts[2]}"
        raise ValueError(f"pupil, radiance and rows have {text} bands: compute all from the same `bands` step")
    return counts[0]


def _interpolated(light: Tensor, some: Tensor, count: int) -> Tensor:
    """Return the PSFs (band, y, x) of all bands from those of some bands, linearly between the bands."""
    planes = share_of_bands(some, count).to(light) @ light.flatten(1)
    return planes.view(count, *light.shape[1:])


def _completed(light: Tensor, some: Tensor, count: int, small: Thumbnail) -> Tensor:
    """Return the PSFs (band, y, x) of all bands, of which those of some bands are there already."""
    others = torch.tensor(sorted({*range(count)} - {*some.tolist()}))
    together = torch.cat([light, small.light(others)])
    return together[torch.cat([some, others]).argsort()]


def _fewest(rungs: list[int], parts: Parts, light: Tensor, within: float, largest: bool) -> FewBands | None:
    """Return the first number of bands whose estimated error is within the limit, or None."""
    count = len(light)
    for few in rungs:
        used = _evenly(few, count)
        share = share_of_bands(used, count)
        error, top = (_SAFETY * x for x in estimated(parts, share, light[used]))
        if max(error, top if largest else 0.0) <= within:
            return FewBands(share, used, _number(error), _number(top))
    return None


def _evenly(few: int, count: int) -> Tensor:
    """Return ``few`` indices of ``count`` bands, the first and the last among them."""
    return torch.linspace(0, count - 1, few, dtype=torch.float64).round().long()


@few_bands.check
def _(result: FewBands, *inputs: object, **params: object) -> list[Check]:
    bands, few = result.share.shape
    if few == bands:
        return [Check(f"all {bands} bands: fewer would not be within the tolerance, or save nothing")]
    return [Check(f"{few} of {bands} bands: estimated error {float(result.error):.2g} of the brightest pixel")]


@node(rtol=1e-12)
def pupil_of_bands(pupil: Pupil, few: FewBands) -> Pupil:
    """Return the pupil of some bands: the factors of all bands, and index and wavelengths of the bands in use.

    Shapes: pupil (v, u) -> (v, u), with one index and one wavelength for each band in use.
    Units:  as the pupil.
    Error:  exact.
    Source: the pupil function of `optics.pupil`, band by band.
    """
    at = few.used.to(pupil.index.device)
    return pupil._replace(index=pupil.index[at], wavelengths=pupil.wavelengths[at])


@node(rtol=1e-5)
def few_bands_checked(
    few: FewBands,
    psf: Psf,
    pupil: Pupil,
    radiance: LowRankCube,
    rows: Tensor,
    *,
    focal_length: FocalLength,
    pixel_pitch: PixelPitch,
    pixel: Literal["point", "zoh"] = "point",
    sensor: SensorSampling = "point",
) -> FewBands:
    """Compare PSFs of few bands with about twice as many bands, on parts of the scene, and raise the error estimate
    where it was too low.

    The PSFs are those of the run, and those of the bands halfway between them, from the pupil in full. The new
    estimate is the larger of the old one and twice the difference.

    Shapes: psf.intensity (j, y, x), pupil (v, u), radiance k planes (y, x), rows (row, band) -> as `few`.
    Units:  errors relative to the brightest pixel of each row.
    Error:  an estimate, not a bound: for a smooth change with the wavelength the difference is 3/4 of the error.
    Source: comparison of two composite rules: Dahlquist and Bjorck, Numerical Methods, section 7.2 (1974).
    """
    count, used = len(few.share), few.used.tolist()
    between = [(a + b) // 2 for a, b in pairwise(used) if b - a > 1]
    if not between:
        return few
    pupil, radiance, rows = without_gradients(pupil, radiance, rows)
    lens = {"focal_length": focal_length, "pixel_pitch": pixel_pitch, "pixel": pixel, "sensor": sensor}
    more, pixels = few._replace(used=torch.tensor(between)), bins_of(psf.intensity)
    window = (pixels * SIDE, pixels * SIDE)
    own = binned(centred(psf.intensity.detach(), window), pixels)
    added = binned(focused(pupil_of_bands(pupil, more), window, lens), pixels)
    order = sorted(range(len(used) + len(between)), key=[*used, *between].__getitem__)
    light = torch.cat([own, added])[order]
    finer = share_of_bands(torch.tensor(sorted([*used, *between])), count).to(light) @ light.flatten(1)
    parts = parts_of(radiance, rows, finer.view(count, *light.shape[1:]), pixels)
    error, top = estimated(parts, few.share.cpu(), own)
    raised = (max(float(old), _SAFETY * new) for old, new in ((few.error, error), (few.largest, top)))
    return few._replace(**dict(zip(("error", "largest"), map(_number, raised), strict=True)))


@few_bands_checked.approximation_error
def _(result: FewBands) -> tuple[float, float]:
    return float(result.error), float(result.largest)


few_bands_checked.hooks.estimated = True


@few_bands_checked.check
def _(result: FewBands, few: FewBands, *inputs: object, **params: object) -> list[Check]:
    bands, count = result.share.shape
    if count == bands:
        return [Check(f"all {bands} bands are in use")]
    text = f"{count} of {bands} bands, compared with the next finer choice: estimated error {float(result.error):.2g}"
    return [Check(text, math.isfinite(float(result.error)))]


def _all_bands(count: int) -> FewBands:
    return FewBands(torch.eye(count, dtype=torch.float64), torch.arange(count), _number(0.0), _number(0.0))


def _number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)
