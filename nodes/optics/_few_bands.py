"""The choice of a few bands whose PSFs represent the PSFs of all bands."""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from neusee.nodes import Check, node
from neusee.nodes.optics._channel_image import Share
from neusee.nodes.optics._convolution_plan import central_window
from neusee.nodes.optics._psf import psf
from neusee.nodes.optics._psf_definition import SensorSampling
from neusee.nodes.optics._pupil import SCREENS, thinned_pupil
from neusee.nodes.units import FocalLength, PixelPitch, Shape
from neusee.nodes.values import FewBands, LowRankCube, Psf, Pupil

# --- band thumbnail -------------------------------------------------------------------------------

# Small PSFs and small parts of a scene, with which the error of fewer bands is estimated. A cell is
# a square of pixels.


CELLS_ACROSS = 120  #: side of a PSF around the axis, in cells
#: side of a part of the scene in cells, including a margin for light from outside
_PART_CELLS = 240
_CELL_PIXELS = (1, 2, 4)  #: sides of a cell that are tried, in pixels
#: smallest ratio of the area of the PSF window to the area of the thumbnail for which a choice
#: saves time
_LEAST_AREA_RATIO = 4
_LEAST_LIGHT_SHARE = 0.9  #: smallest share of the light that a window of cells must contain
#: side in cells of the tiles among which the brightest and the one with most contrast are found
_TILE_CELLS = 32
_STRONGEST_PLANES = 4  #: number of strongest planes of the scene for the estimate of the error

Lens = Mapping[str, Any]  #: the parameters of `optics.psf` except its window


class Parts(NamedTuple):
    """Spectra of parts of a scene, and their images with the PSFs of all bands: the common data for
    all choices of bands.
    """

    scene: Tensor  #: (part, plane, y, x), spectra of the parts
    weights: Tensor  #: (row x plane, band), weights of the PSFs in each kernel
    kernels: Tensor  #: (row x plane, m n), kernels with the PSFs of all bands
    image: Tensor  #: (part, row, y, x), images with the PSFs of all bands
    top: Tensor  #: (row,), brightest pixel of all parts


def without_gradients(
    pupil: Pupil, radiance: LowRankCube, rows: Tensor
) -> tuple[Pupil, LowRankCube, Tensor]:
    """Return the inputs without gradients, because the choice of bands counts as constant."""
    constant_pupil = pupil._replace(**{name: getattr(pupil, name).detach() for name in SCREENS})
    return (
        constant_pupil,
        radiance._replace(planes=radiance.planes.detach()),
        rows.detach().double().cpu(),
    )


class Thumbnail(NamedTuple):
    """A thinned pupil and a cell size: its PSFs, summed over cells, are small approximations of the
    PSFs of the full pupil.
    """

    pupil: Pupil
    pixels: int  #: side of a cell in pixels
    lens: Lens

    def light(self, bands: Tensor) -> Tensor:
        """Return the PSFs (band, cell, cell) of the given bands around the axis, as light per
        cell.
        """
        pupil_of_bands = self.pupil._replace(
            index=self.pupil.index[bands], wavelengths=self.pupil.wavelengths[bands]
        )
        return cell_light(
            psf_intensity(
                pupil_of_bands, (self.pixels * CELLS_ACROSS, self.pixels * CELLS_ACROSS), self.lens
            ),
            self.pixels,
        )


def thumbnail_of(pupil: Pupil, shape: tuple[int, int], lens: Lens) -> Thumbnail | None:
    """Return the thumbnail of the PSFs of a pupil in a window of ``shape``.

    Return None if no window of cells contains enough light, or if the PSFs of ``shape`` take hardly
    longer.
    """
    # point samples: the square samples of a thinned pupil would be too wide
    thinned, lens = thinned_pupil(pupil), {**lens, "pixel": "point"}
    # tested with the first, the middle and the last band
    end_bands = torch.tensor(sorted({0, len(pupil.wavelengths) // 2, len(pupil.wavelengths) - 1}))
    pupil_of_ends = thinned._replace(
        index=thinned.index[end_bands], wavelengths=thinned.wavelengths[end_bands]
    )
    alias_free = (
        float(thinned.wavelengths.min())
        * lens["focal_length"]
        / (float(thinned.pitch) * lens["pixel_pitch"])
    )
    clear_light, passed_light = (
        thinned.aperture.double().square().sum(),
        thinned.amplitude.double().square().sum(),
    )
    for pixels in _CELL_PIXELS:
        side = pixels * CELLS_ACROSS
        if side > alias_free or side**2 * _LEAST_AREA_RATIO > shape[0] * shape[1]:
            return None
        if float(
            psf_intensity(pupil_of_ends, (side, side), lens).sum((1, 2)).min()
        ) >= _LEAST_LIGHT_SHARE * float(passed_light / clear_light):
            return Thumbnail(thinned, pixels, lens)
    return None


def psf_intensity(pupil: Pupil, shape: tuple[int, int], lens: Lens) -> Tensor:
    """Return the PSFs (band, y, x) of a pupil in a window."""
    result: Psf = psf(pupil, **lens, shape=shape)
    return result.intensity


def cell_light(stack: Tensor, pixels: int) -> Tensor:
    """Return the light of each cell with a side of ``pixels``; pixels beyond the last complete cell
    are left out.
    """
    return stack if pixels == 1 else avg_pool2d(stack, pixels) * pixels**2


def pixels_per_cell(stack: Tensor) -> int:
    """Return the smallest side of a cell in pixels for which the window of cells contains enough
    light of all PSFs.
    """
    total = stack.sum((1, 2))
    for pixels in _CELL_PIXELS:
        if bool(
            (
                central_window(stack, (pixels * CELLS_ACROSS, pixels * CELLS_ACROSS)).sum((1, 2))
                >= _LEAST_LIGHT_SHARE * total
            ).all()
        ):
            break
    return pixels


def share_of_bands(bands: Tensor, count: int) -> Tensor:
    """Return the float64 weights (band, j) of linear interpolation between the bands with the
    indices ``bands``, in rising order.
    """
    band = torch.arange(count, dtype=torch.float64)
    if len(bands) == 1:
        return torch.ones(count, 1, dtype=torch.float64)
    upper = torch.searchsorted(bands.double(), band).clamp(1, len(bands) - 1)
    lower = upper - 1
    weight = ((band - bands[lower]) / (bands[upper] - bands[lower])).clamp(0.0, 1.0)[:, None]
    share = torch.zeros(count, len(bands), dtype=torch.float64)
    return share.scatter_(1, lower[:, None], 1 - weight).scatter_(1, upper[:, None], weight)


def scene_parts(radiance: LowRankCube, rows: Tensor, light: Tensor, pixels: int) -> Parts:
    """Return up to three parts of the scene: around the brightest tile, around the tile with most
    contrast, and in the middle.

    ``light`` has the PSFs (band, m, n) of all bands in cells of ``pixels`` along each side.
    """
    # mean over each cell; `cell_light` returns the sum
    planes = cell_light(radiance.planes[:_STRONGEST_PLANES], pixels) / pixels**2
    basis = radiance.basis[:, :_STRONGEST_PLANES].detach().double().cpu()
    picture = torch.tensordot((rows.sum(0) @ basis).to(planes), planes, 1)[None]
    tile_size = (min(_TILE_CELLS, picture.shape[1]), min(_TILE_CELLS, picture.shape[2]))
    tile_mean = avg_pool2d(picture[None], tile_size)[0, 0]
    tile_variance = avg_pool2d(picture[None].square(), tile_size)[0, 0] - tile_mean.square()
    tiles = [divmod(int(x.argmax()), x.shape[1]) for x in (tile_mean, tile_variance)]
    tile_middles = [
        (y * tile_size[0] + tile_size[0] // 2, x * tile_size[1] + tile_size[1] // 2)
        for y, x in tiles
    ]
    picture_middle = (picture.shape[1] // 2, picture.shape[2] // 2)
    scene = torch.stack(
        [_part_about(planes, place) for place in dict.fromkeys([*tile_middles, picture_middle])]
    ).to(light)
    weights = (rows[:, None, :] * basis.T).flatten(0, 1)
    kernels = weights.to(light) @ light.flatten(1)
    spectra = torch.fft.rfft2(scene)
    image = _image_of_parts(spectra, kernels, light)
    return Parts(spectra, weights, kernels, image, image.amax((0, 2, 3)))


def _part_about(planes: Tensor, place: tuple[int, int]) -> Tensor:
    """Return the part of the scene around a place; a smaller scene is padded with zeros."""
    part_spans = []
    for middle, size in zip(place, planes.shape[1:], strict=True):
        side = min(_PART_CELLS, size)
        first = min(max(middle - side // 2, 0), size - side)
        part_spans.append(slice(first, first + side))
    part = planes[:, part_spans[0], part_spans[1]]
    return pad(part, (0, _PART_CELLS - part.shape[2], 0, _PART_CELLS - part.shape[1]))


def estimated_errors(parts: Parts, share: Tensor, light: Tensor) -> tuple[float, float]:
    """Return two errors of the image if the PSF of each band is a weighted mean of a few PSFs
    ``light``, with the weights ``share``.

    The first is the root mean square error of the worst part and row. The second is the change of
    the brightest pixel, but at least a quarter of the first. Both are relative to the brightest
    pixel of all parts.
    """
    kernel_error = (parts.weights @ share).to(light) @ light.flatten(1) - parts.kernels
    error = _image_of_parts(parts.scene, kernel_error, light)
    scale = parts.top.where(parts.top > 0, 1.0)
    rms = error.square().mean((2, 3)).sqrt() / scale
    change = ((parts.image + error).amax((0, 2, 3)) - parts.top).abs() / scale
    return float(rms.max()), max(float(rms.max()) / 4, float(change.max()))


def _image_of_parts(spectra: Tensor, kernels: Tensor, like: Tensor) -> Tensor:
    """Return the image (part, row, y, x) of parts of a scene, without the margin that receives
    light from outside the part.
    """
    row_kernels = kernels.view(-1, spectra.shape[1], *like.shape[1:])
    size = (_PART_CELLS, _PART_CELLS)
    image = torch.fft.irfft2((spectra[:, None] * torch.fft.rfft2(row_kernels, size)).sum(2), size)
    # the circular convolution wraps around in the samples before m - 1
    valid_spans = [slice(m - 1, _PART_CELLS) for m in like.shape[1:]]
    inner: Tensor = image[..., valid_spans[0], valid_spans[1]]
    return inner


# --- few bands ------------------------------------------------------------------------------------

# The choice of a few bands whose PSFs represent the PSFs of all bands, from an estimate of the
# error of the image.


_BAND_COUNTS = (2, 3, 4, 5, 6, 8, 11, 16, 21)  #: numbers of bands that are tried, in this order
_WORTHWHILE_SHARE = 0.7  #: a choice of a larger share of the bands saves too little time
_COMPARISON_RATIO = 3  #: smallest ratio of the number of reference bands to that of chosen bands
_ESTIMATE_FACTOR = 2.0  #: safety factor, because the thumbnail only approximates the image


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
    """Choose the fewest bands whose PSFs, interpolated linearly between the bands, give the image
    of the scene within an error.

    The error is estimated: PSFs of a thinned pupil, of every second band where at least three times
    as many as few bands are enough to compare with, else of all, are convolved with three parts of
    the scene: the brightest, the one of the most contrast, and the middle. Their window holds 90 %
    of the light, in cells of 1, 2 or 4 pixels along each side. The estimate is twice the error of
    the worst part. With `largest`, the error of the brightest pixel is held too. All bands are kept
    where no such window is much smaller than that of the PSF.

    Shapes: pupil (v, u), radiance k planes (y, x), rows (row, band) -> used (j,), share (band, j)
            float64.
    Units:  errors relative to the brightest pixel of each row.
    Error:  an estimate, not a bound: `optics.few_bands_checked` compares it with a finer choice.
            The choice is constant for gradients.
    Raises: ValueError where pupil, scene and rows have different bands.
    Source: composite trapezoidal rule over wavelengths: Dahlquist and Bjorck, Numerical Methods,
            section 7.2 (1974).
    """
    count = _same_count(pupil, radiance, rows)
    rungs = [few for few in _BAND_COUNTS if few <= _WORTHWHILE_SHARE * count]
    if not rungs or within <= 0:
        return _all_bands(count)
    pupil, radiance, rows = without_gradients(pupil, radiance, rows)
    lens = {
        "focal_length": focal_length,
        "pixel_pitch": pixel_pitch,
        "pixel": pixel,
        "sensor": sensor,
    }
    thumb = thumbnail_of(pupil, shape, lens)
    if thumb is None:
        return _all_bands(count)
    # half of the bands as reference; all bands only if too many bands are needed
    half_bands = _evenly_spaced(count // 2 + 1, count)
    light_of_half = thumb.light(half_bands)
    light = _light_between_bands(light_of_half, half_bands, count)
    rungs_of_half = [few for few in rungs if _COMPARISON_RATIO * few <= len(half_bands)]
    choice = _first_within(
        rungs_of_half, scene_parts(radiance, rows, light, thumb.pixels), light, within, largest
    )
    if choice is None:
        light = _light_of_all_bands(light_of_half, half_bands, count, thumb)
        choice = _first_within(
            rungs, scene_parts(radiance, rows, light, thumb.pixels), light, within, largest
        )
    return choice or _all_bands(count)


def _same_count(pupil: Pupil, radiance: LowRankCube, rows: Tensor) -> int:
    """Return the number of bands; raise ValueError if it differs between pupil, radiance and
    rows.
    """
    counts = len(pupil.wavelengths), len(radiance.basis), rows.shape[-1]
    if len(set(counts)) > 1:
        text = f"{counts[0]}, {counts[1]} and {counts[2]}"
        raise ValueError(
            f"pupil, radiance and rows have {text} bands: compute all from the same `bands` step"
        )
    return counts[0]


def _light_between_bands(light: Tensor, some: Tensor, count: int) -> Tensor:
    """Return the PSFs (band, y, x) of all bands, by linear interpolation between those of some
    bands.
    """
    planes = share_of_bands(some, count).to(light) @ light.flatten(1)
    return planes.view(count, *light.shape[1:])


def _light_of_all_bands(light: Tensor, some: Tensor, count: int, small: Thumbnail) -> Tensor:
    """Return the PSFs (band, y, x) of all bands; those of the bands ``some`` are given as
    ``light``.
    """
    other_bands = torch.tensor(sorted({*range(count)} - {*some.tolist()}))
    all_light = torch.cat([light, small.light(other_bands)])
    return all_light[torch.cat([some, other_bands]).argsort()]


def _first_within(
    rungs: list[int], parts: Parts, light: Tensor, within: float, largest: bool
) -> FewBands | None:
    """Return the choice with the first number of bands in ``rungs`` whose estimated error is within
    the limit, or None.
    """
    count = len(light)
    for few in rungs:
        computed = _evenly_spaced(few, count)
        share = share_of_bands(computed, count)
        error, top_error = (
            _ESTIMATE_FACTOR * x for x in estimated_errors(parts, share, light[computed])
        )
        if error <= within and (not largest or top_error <= within):
            return FewBands(share, computed, _float64(error), _float64(top_error))
    return None


def _evenly_spaced(few: int, count: int) -> Tensor:
    """Return ``few`` evenly spaced indices of ``count`` bands, including the first and the last."""
    return torch.linspace(0, count - 1, few, dtype=torch.float64).round().long()


@few_bands.check
def _(result: FewBands, *inputs: object, **params: object) -> list[Check]:
    bands, few = result.share.shape
    if few == bands:
        return [
            Check(f"all {bands} bands: fewer would not be within the tolerance, or save nothing")
        ]
    return [
        Check(
            f"{few} of {bands} bands: estimated error {float(result.error):.2g} of the brightest"
            " pixel"
        )
    ]


@node(rtol=1e-12)
def pupil_of_bands(pupil: Pupil, few: FewBands) -> Pupil:
    """Return the pupil of some bands: the factors of all bands, and index and wavelengths of the
    bands in use.

    Shapes: pupil (v, u) -> (v, u), with one index and one wavelength for each band in use.
    Units:  as the pupil.
    Error:  exact.
    Source: the pupil function of `optics.pupil`, band by band.
    """
    bands = few.used.to(pupil.index.device)
    return pupil._replace(index=pupil.index[bands], wavelengths=pupil.wavelengths[bands])


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
    """Compare PSFs of few bands with about twice as many bands, on parts of the scene, and raise
    the error estimate where it was too low.

    The PSFs are those of the run, and those of the bands halfway between them, from the pupil in
    full. The new estimate is the larger of the old one and twice the difference.

    Shapes: psf.intensity (j, y, x), pupil (v, u), radiance k planes (y, x), rows (row, band) -> as
            `few`.
    Units:  errors relative to the brightest pixel of each row.
    Error:  an estimate, not a bound: for a smooth change with the wavelength the difference is 3/4
            of the error.
    Source: comparison of two composite rules: Dahlquist and Bjorck, Numerical Methods, section 7.2
            (1974).
    """
    count, computed = len(few.share), few.used.tolist()
    between = [(a + b) // 2 for a, b in pairwise(computed) if b - a > 1]
    if not between:
        return few
    pupil, radiance, rows = without_gradients(pupil, radiance, rows)
    lens = {
        "focal_length": focal_length,
        "pixel_pitch": pixel_pitch,
        "pixel": pixel,
        "sensor": sensor,
    }
    between_bands, pixels = few._replace(used=torch.tensor(between)), pixels_per_cell(psf.intensity)
    window = (pixels * CELLS_ACROSS, pixels * CELLS_ACROSS)
    own_light = cell_light(central_window(psf.intensity.detach(), window), pixels)
    added_light = cell_light(
        psf_intensity(pupil_of_bands(pupil, between_bands), window, lens), pixels
    )
    # sorted by band: chosen bands and the bands between them
    order = sorted(range(len(computed) + len(between)), key=[*computed, *between].__getitem__)
    light = torch.cat([own_light, added_light])[order]
    finer_light = share_of_bands(torch.tensor(sorted([*computed, *between])), count).to(
        light
    ) @ light.flatten(1)
    parts = scene_parts(radiance, rows, finer_light.view(count, *light.shape[1:]), pixels)
    error, top_error = estimated_errors(parts, few.share.cpu(), own_light)
    raised_errors = (
        max(float(old), _ESTIMATE_FACTOR * new)
        for old, new in ((few.error, error), (few.largest, top_error))
    )
    return few._replace(
        **dict(zip(("error", "largest"), map(_float64, raised_errors), strict=True))
    )


@few_bands_checked.approximation_error
def _(result: FewBands) -> tuple[float, float]:
    # relative errors, in root mean square and of the brightest pixel
    return float(result.error), float(result.largest)


few_bands_checked.hooks.estimated = True


@few_bands_checked.check
def _(result: FewBands, few: FewBands, *inputs: object, **params: object) -> list[Check]:
    bands, count = result.share.shape
    if count == bands:
        return [Check(f"all {bands} bands are in use")]
    text = (
        f"{count} of {bands} bands, compared with the next finer choice: estimated error"
        f" {float(result.error):.2g}"
    )
    return [Check(text, math.isfinite(float(result.error)))]


def _all_bands(count: int) -> FewBands:
    """Return the choice of all bands, with error 0."""
    return FewBands(
        torch.eye(count, dtype=torch.float64), torch.arange(count), _float64(0.0), _float64(0.0)
    )


def _float64(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)
