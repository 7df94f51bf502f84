"""What travels between steps when one tensor is not enough.

Every field is a tensor, so that any of these can be stored, moved and differentiated.
Spectral sampling is data: whoever needs wavelengths receives `Bands`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Bands(NamedTuple):
    """Spectral samples, of a scene (31 bands) or of one laser line (its own few)."""

    centres: Tensor  #: (band,) float64, m
    widths: Tensor  #: (band,) float64, m
    weights: Tensor  #: (band,) float64; a scene: all 1; a laser line: its share of the energy, sum 1


class Dirt(NamedTuple):
    """What lies on the window, in the plane of the pupil."""

    amplitude: Tensor  #: (v, u) transmission of the field in [0, 1]
    path: Tensor  #: (v, u) added optical path, m


class Pupil(NamedTuple):
    """The pupil function of all bands, in factors.

    The field of band b is ``amplitude * exp(2 pi i (index[b] * height + path) / wavelengths[b])``.
    Kept in factors because 31 complex fields of 2160 x 2160 are 1.2 GB and the factors 75 MB.
    """

    aperture: Tensor  #: (v, u) clear aperture: 1 inside, 0 outside
    amplitude: Tensor  #: (v, u) aperture times dirt
    height: Tensor  #: (v, u) of the diffractive element, m
    path: Tensor  #: (v, u) aberrations and dirt, m of optical path
    index: Tensor  # type: ignore[assignment]  # hides tuple.index, which no one asks of a pupil
    #: (band,) float64, refractive index of the element minus that of air
    wavelengths: Tensor  #: (band,) float64, m
    pitch: Tensor  #: () float64, m between samples, both axes


class Psf(NamedTuple):
    """Point-spread functions, as the share of the light through the clear pupil per pixel."""

    intensity: Tensor  #: (band, y, x); the sum over an infinite plane is the transmitted share
    clear_peak: Tensor  #: (band,) float64: the pixel on the axis, same lens, no element, no dirt, no aberration


class LowRankCube(NamedTuple):
    """A cube of many bands as few planes: band b is about ``sum_k basis[b, k] planes[k]``, strongest first."""

    planes: Tensor  #: (k, y, x)
    basis: Tensor  #: (band, k) float64
    residual_max: (
        Tensor  #: (k + 1, band) float64: bound of max over pixels of |band b less the first r planes|, r = 0 to k
    )
    residual_rms: Tensor = torch.zeros(0, 0, dtype=torch.float64)  #: of the same, in root mean square; empty: not known
    residual_map: Tensor = torch.zeros(
        0, 0
    )  #: (y, x) bound of |band less all planes|, the largest of all bands; empty: not known


class Channels(NamedTuple):
    """Weighted sums over the bands of an image: ``planes[i] = sum_b rows[i, b] image[b]``."""

    planes: Tensor  #: (row, y, x)
    rows: Tensor  #: (row, band) float64
    flux: Tensor  #: (band,) float64, sum of image[b] over its pixels
    bound: Tensor  #: () float64, bound of the root mean square error over max |plane|, of the worst row
    kept: Tensor = torch.zeros(5, dtype=torch.int64)  #: planes, kernels, bands, rows and columns of the PSF convolved
    largest: Tensor = torch.tensor(
        torch.inf, dtype=torch.float64
    )  #: how far max |plane| may be off, over itself; or inf


class Levels(NamedTuple):
    """Frames of one flat illumination after another, reduced to all that a fit of the sensor needs.

    Of a level whose numbers are clipped, or too few to be as good as continuous, every number is counted; a cell says
    how often one of them occurs in one level.
    """

    photons: Tensor  #: (level,) float64, mean photons in a pixel and exposure; 0 in the dark
    exposure: Tensor  #: (level,) float64, s
    pixels: Tensor  #: (level,) float64, pixels of all frames, whose mean is `mean`
    mean: Tensor  #: (level,) float64, DN
    variance: Tensor  #: (level,) float64, DN2
    degrees_of_freedom: Tensor  #: (level,) float64, of the variance
    cell_level: Tensor  #: (cell,) int64, rising
    cell_value: Tensor  #: (cell,) float64, DN, rising within a level
    cell_count: Tensor  #: (cell,) float64


#: by class, the fields with one entry a band
BAND_FIELDS: dict[type, tuple[str, ...]] = {
    Bands: Bands._fields,
    Pupil: ("index", "wavelengths"),
    Psf: Psf._fields,
}
