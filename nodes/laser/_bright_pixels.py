"""The brightest pixels of a laser behind a lens or a mask: how many there are above each share of its light."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.laser._dazzle_picture import _over_feature
from neusee.nodes.sensor._digitization import crop
from neusee.nodes.torch_func import transformed
from neusee.nodes.units import Count, PositiveLength, Shape
from neusee.nodes.values import Bands, Psf

RANKS = 1500  #: numbers of pixels, at equal ratios, at which the light is kept


class BrightPixels(NamedTuple):
    """The light of a laser in the brightest pixels of a sensor, by how many pixels are at least as bright."""

    pixels: Tensor  #: (rank,) float64, number of pixels, rising from 1 to all pixels of the window
    level: Tensor  #: (rank,) float64, share of the clear pupil's light in the faintest of these pixels
    smooth: Tensor  #: (rank,) float64, the same of the mean over a feature around each pixel
    rim: Tensor  #: (rank,) float64, share of the pixels on the rim that reach `level`; 0 if the window holds the sensor


def ranks(pixels: int) -> Tensor:
    """Return the numbers of pixels, from 1 to all ``pixels``, at which the light is kept."""
    return (
        torch.logspace(0, torch.log10(torch.tensor(float(pixels))), RANKS, dtype=torch.float64).round().clamp(1, pixels)
    )


@node(rtol=1e-6)
def bright_pixels(
    psf: Psf,
    bands: Bands,
    *,
    shape: Shape,
    pixel_pitch: PositiveLength,
    sample_pitch: PositiveLength | None = None,
    feature: Count = 1,
) -> BrightPixels:
    """Rank the pixels of a sensor by the light of a laser, from the brightest to the faintest.

    ``sample_pitch`` is that of the PSF, a whole fraction of the pixel, over which its samples are averaged; without a
    value the PSF has one sample a pixel. ``shape`` is that of the sensor: pixels beyond it do not count. `smooth` ranks
    the mean over ``feature`` x ``feature`` pixels, which veils a feature of that size.

    Shapes: psf.intensity (band, y, x), bands (band,) -> four of (rank,) float64.
    Units:  pixels, and share of the light through the clear pupil, in photons.
    Error:  between two ranks, interpolated in logarithms: 0.1 %. Far from the axis, at n wavelengths times f-number, a
            pupil of M samples across repeats light of its stepped edges: 1 to 2 % too bright at n = M / 8, 5 % at
            n = M / 6 and 9 to 14 % at n = M / 4. An average of samples up to lambda N / 2 apart is that of the pixel to
            1 %.
    Raises: ParameterError before the run for a sample pitch that is no whole fraction of the pixel; ValueError for a
            PSF that is narrower than a pixel.
    Source: by definition.
    """
    weights = (bands.weights * bands.centres).double()  # photons of each wavelength, which fill wells
    weights = weights / weights.sum()
    samples = _samples(pixel_pitch, sample_pitch)
    bands_of_pixels = (_pixels(band.detach().double(), samples) for band in psf.intensity)
    image = torch.as_tensor(sum(w * band for w, band in zip(weights.tolist(), bands_of_pixels, strict=True)))
    narrow = [m < n for m, n in zip(image.shape, shape, strict=True)]
    image = crop(image, shape=(min(shape[0], image.shape[0]), min(shape[1], image.shape[1])))
    count = ranks(image.numel())
    smooth = image if feature == 1 else _over_feature(image[None], feature)[0]
    level = _ranked(image, count)
    return BrightPixels(count, level, level if feature == 1 else _ranked(smooth, count), _on_rim(image, level, narrow))


def _samples(pixel_pitch: float, sample_pitch: float | None) -> int:
    """Return the number of samples along the side of a pixel."""
    ratio = pixel_pitch / (sample_pitch or pixel_pitch)
    if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6 * ratio:
        raise ParameterError(
            "sample_pitch",
            f"{ratio:.5g} samples fit into a pixel of {pixel_pitch * 1e6:.5g} um: "
            f"give a whole fraction of the pixel, such as {pixel_pitch / max(1, round(ratio)) * 1e6:.5g} um",
        )
    return round(ratio)


def _pixels(light: Tensor, samples: int) -> Tensor:
    """Return the light (y, x) of each pixel from that of its samples; a part of a pixel at the end is left out."""
    if min(light.shape) < samples:
        size = f"{light.shape[0]} x {light.shape[1]}"
        raise ValueError(f"a PSF of {size} samples holds no pixel, which is {samples} samples wide: enlarge its window")
    return light if samples == 1 else avg_pool2d(light[None], samples)[0] * samples**2


def _ranked(image: Tensor, count: Tensor) -> Tensor:
    flat = image.flatten()
    if transformed() or flat.device.type != "cpu":
        ordered = flat.sort().values
    else:
        ordered = torch.from_numpy(np.sort(flat.numpy()))  # half of the time that torch takes
    return ordered[len(ordered) - count.long().to(ordered.device)].double().cpu()


def _on_rim(image: Tensor, level: Tensor, narrow: list[bool]) -> Tensor:
    """Return the share of the pixels on the rim that reach each level, on the sides where the sensor goes on."""
    sides = ([image[0], image[-1]] if narrow[0] else []) + ([image[:, 0], image[:, -1]] if narrow[1] else [])
    if not sides:
        return torch.zeros_like(level)
    ordered = torch.cat(sides).double().sort().values.cpu()
    return (len(ordered) - torch.searchsorted(ordered, level)).double() / len(ordered)


@bright_pixels.preflight
def _(*, pixel_pitch: float, sample_pitch: float | None = None, **_: Any) -> list[str]:
    _samples(pixel_pitch, sample_pitch)
    return []


@bright_pixels.check
def _(result: BrightPixels, *inputs: Any, **params: Any) -> list[Check]:
    good = bool((result.level[1:] <= result.level[:-1]).all()) and float(result.level[0]) > 0
    return [Check(f"{result.level[0]:.3g} of the light in the brightest of {int(result.pixels[-1])} pixels", good)]
