"""Small PSFs and small parts of a scene, on which the error of fewer bands is estimated."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from neusee.nodes.optics._imaging._psf_energy import centred
from neusee.nodes.optics._phase_steps import pupil_has_large_steps
from neusee.nodes.optics._psf import psf
from neusee.nodes.values import LowRankCube, Psf, Pupil

SIDE = 120  #: cells, along each side of a PSF about the axis
_PART = 240  #: cells, along each side of a part of the scene, with a margin for light from beside
_BINS = (1, 2, 4)  #: pixels along the side of a cell, the least first
_GAIN = 4  #: least ratio of the area of the PSF window to that of the thumbnail, below which a choice saves nothing
_HELD = 0.9  #: share of the light that a window of cells must hold
_SAMPLES = 256  #: least number of pupil samples across, of which a larger pupil keeps every k-th
_TILE = 32  #: cells, of the tiles of which the brightest and the one of the most contrast are found
_PLANES = 4  #: strongest planes of the scene in which the error is estimated
_SCREENS = ("aperture", "amplitude", "height", "path")  #: what a pupil holds for each sample

Lens = Mapping[str, Any]  #: the parameters of `optics.psf` but its window


class Parts(NamedTuple):
    """Parts of a scene as spectra, and the kernels of all bands: what the estimate of each choice shares."""

    scene: Tensor  #: (part, plane, y, x) spectra
    weights: Tensor  #: (row x plane, band)
    kernels: Tensor  #: (row x plane, m n) of all bands
    image: Tensor  #: (part, row, y, x) with the PSFs of all bands
    top: Tensor  #: (row,) brightest pixel of all parts


def without_gradients(pupil: Pupil, radiance: LowRankCube, rows: Tensor) -> tuple[Pupil, LowRankCube, Tensor]:
    """Return the inputs of a choice, which is constant for gradients."""
    still = pupil._replace(**{name: getattr(pupil, name).detach() for name in _SCREENS})
    return still, radiance._replace(planes=radiance.planes.detach()), rows.detach().double().cpu()


class Thumbnail(NamedTuple):
    """A thinned pupil, and the window of cells in which its PSFs are small pictures of those of the whole pupil."""

    pupil: Pupil
    pixels: int  #: along the side of a cell
    lens: Lens

    def light(self, bands: Tensor) -> Tensor:
        """Return the PSFs (band, cell, cell) of some bands about the axis."""
        some = self.pupil._replace(index=self.pupil.index[bands], wavelengths=self.pupil.wavelengths[bands])
        return binned(focused(some, (self.pixels * SIDE, self.pixels * SIDE), self.lens), self.pixels)


def thumbnail(pupil: Pupil, shape: tuple[int, int], lens: Lens) -> Thumbnail | None:
    """Return the thumbnail of the PSFs of a pupil in a window of ``shape``.

    Return None if no window of cells holds the light, or if the PSFs of ``shape`` take little longer.
    """
    small, lens = _thinned(pupil), {**lens, "pixel": "point"}  # square pixels of a thinned pupil would be too wide
    ends = torch.tensor(sorted({0, len(pupil.wavelengths) // 2, len(pupil.wavelengths) - 1}))
    some = small._replace(index=small.index[ends], wavelengths=small.wavelengths[ends])
    reach = float(small.wavelengths.min()) * lens["focal_length"] / (float(small.pitch) * lens["pixel_pitch"])
    clear, whole = small.aperture.double().square().sum(), small.amplitude.double().square().sum()
    for pixels in _BINS:
        side = pixels * SIDE
        if side > reach or side**2 * _GAIN > shape[0] * shape[1]:
            return None
        if float(focused(some, (side, side), lens).sum((1, 2)).min()) >= _HELD * float(whole / clear):
            return Thumbnail(small, pixels, lens)
    return None


def focused(pupil: Pupil, shape: tuple[int, int], lens: Lens) -> Tensor:
    """Return the PSFs (band, y, x) of a pupil in a window."""
    found: Psf = psf(pupil, **lens, shape=shape)
    return found.intensity


def binned(stack: Tensor, pixels: int) -> Tensor:
    """Return the light of each cell of ``pixels`` along its side; pixels beyond the last whole cell are left out."""
    return stack if pixels == 1 else avg_pool2d(stack, pixels) * pixels**2


def bins_of(stack: Tensor) -> int:
    """Return the least number of pixels along the side of a cell at which the cells hold the light of the PSFs."""
    whole = stack.sum((1, 2))
    for pixels in _BINS:
        if bool((centred(stack, (pixels * SIDE, pixels * SIDE)).sum((1, 2)) >= _HELD * whole).all()):
            break
    return pixels


def _thinned(pupil: Pupil) -> Pupil:
    """Return every k-th sample of a large pupil, as long as the samples that are left can follow the phase."""
    step = max(1, len(pupil.height) // _SAMPLES)
    while step > 1 and pupil_has_large_steps(_every(pupil, step)):
        step //= 2
    return _every(pupil, step)


def _every(pupil: Pupil, step: int) -> Pupil:
    return pupil._replace(**{name: getattr(pupil, name)[::step, ::step] for name in _SCREENS}, pitch=pupil.pitch * step)


def share_of_bands(used: Tensor, count: int) -> Tensor:
    """Return the weights (band, j) float64 that interpolate linearly between the bands ``used``, which rise."""
    at = torch.arange(count, dtype=torch.float64)
    if len(used) == 1:
        return torch.ones(count, 1, dtype=torch.float64)
    high = torch.searchsorted(used.double(), at).clamp(1, len(used) - 1)
    low = high - 1
    part = ((at - used[low]) / (used[high] - used[low])).clamp(0.0, 1.0)[:, None]
    share = torch.zeros(count, len(used), dtype=torch.float64)
    return share.scatter_(1, low[:, None], 1 - part).scatter_(1, high[:, None], part)


def parts_of(radiance: LowRankCube, rows: Tensor, light: Tensor, pixels: int) -> Parts:
    """Return three parts of the scene, about the brightest tile, about the tile of most contrast and in the middle.

    ``light`` has the PSFs (band, m, n) of all bands in cells of ``pixels`` along each side.
    """
    planes = binned(radiance.planes[:_PLANES], pixels) / pixels**2
    basis = radiance.basis[:, :_PLANES].detach().double().cpu()
    white = torch.tensordot((rows.sum(0) @ basis).to(planes), planes, 1)[None]
    tile = (min(_TILE, white.shape[1]), min(_TILE, white.shape[2]))
    mean = avg_pool2d(white[None], tile)[0, 0]
    spread = avg_pool2d(white[None].square(), tile)[0, 0] - mean.square()
    found = [divmod(int(x.argmax()), x.shape[1]) for x in (mean, spread)]
    about = [(y * tile[0] + tile[0] // 2, x * tile[1] + tile[1] // 2) for y, x in found]
    middle = (white.shape[1] // 2, white.shape[2] // 2)
    scene = torch.stack([_cut(planes, at) for at in dict.fromkeys([*about, middle])]).to(light)
    weights = (rows[:, None, :] * basis.T).flatten(0, 1)
    kernels = weights.to(light) @ light.flatten(1)
    spectra = torch.fft.rfft2(scene)
    image = _imaged(spectra, kernels, light)
    return Parts(spectra, weights, kernels, image, image.amax((0, 2, 3)))


def _cut(planes: Tensor, at: tuple[int, int]) -> Tensor:
    """Return a part of the scene about a pixel; a smaller scene is filled up with zeros."""
    spans = []
    for middle, size in zip(at, planes.shape[1:], strict=True):
        side = min(_PART, size)
        first = min(max(middle - side // 2, 0), size - side)
        spans.append(slice(first, first + side))
    part = planes[:, spans[0], spans[1]]
    return pad(part, (0, _PART - part.shape[2], 0, _PART - part.shape[1]))


def estimated(parts: Parts, share: Tensor, light: Tensor) -> tuple[float, float]:
    """Return the errors of the image if the PSF of each band is the mean of few PSFs ``light`` by weights ``share``.

    The first is the root mean square of the worst part and row, the second the change of the brightest pixel, or a
    quarter of the first where that is larger; both are relative to the brightest pixel of all parts.
    """
    off = (parts.weights @ share).to(light) @ light.flatten(1) - parts.kernels
    error = _imaged(parts.scene, off, light)
    scale = parts.top.where(parts.top > 0, 1.0)
    rms = error.square().mean((2, 3)).sqrt() / scale
    change = ((parts.image + error).amax((0, 2, 3)) - parts.top).abs() / scale
    return float(rms.max()), max(float(rms.max()) / 4, float(change.max()))


def _imaged(spectra: Tensor, kernels: Tensor, like: Tensor) -> Tensor:
    """Return the image (part, row, y, x) of parts of a scene, without the margin to which light comes from outside."""
    rows = kernels.view(-1, spectra.shape[1], *like.shape[1:])
    size = (_PART, _PART)
    whole = torch.fft.irfft2((spectra[:, None] * torch.fft.rfft2(rows, size)).sum(2), size)
    spans = [slice(m - 1, _PART) for m in like.shape[1:]]
    inner: Tensor = whole[..., spans[0], spans[1]]
    return inner
