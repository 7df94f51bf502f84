"""Named tuples that pass several tensors from one step to the next.

Every field is a tensor, so that every value can be stored, moved and differentiated.
Spectral sampling is a value, not a parameter: a node that needs wavelengths receives `Bands`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Bands(NamedTuple):
    """The spectral bands of a scene (for example 31 bands) or of one laser line (for example 5
    bands).
    """

    centres: Tensor  #: (band,) float64, m
    widths: Tensor  #: (band,) float64, m
    #: (band,) float64; for a scene all 1; for a laser line the share of the energy in each band
    weights: Tensor


class Stop(NamedTuple):
    """The circular aperture stop of the lens, and the square grid that samples the pupil.

    Sample j lies at (j - (samples - 1) / 2) * pitch on each axis.
    """

    samples: Tensor  #: () int64, number of samples along each axis
    pitch: Tensor  #: () float64, m between samples
    diameter: Tensor  #: () float64, m, of the clear aperture


class Dirt(NamedTuple):
    """Dirt on the camera window: transmission and optical path in the plane of the pupil."""

    amplitude: Tensor  #: (v, u) transmission of the field in [0, 1]
    path: Tensor  #: (v, u) added optical path, m


class Wavefront(NamedTuple):
    """The wavefront of a laser in the pupil: tapered if its beam is narrow, and curved if the laser
    is near.

    For a distant laser that fills the pupil evenly, both fields are 0.
    """

    #: () float64, 1/m2; the amplitude falls as exp(-taper r^2) with the distance r from the axis
    taper: Tensor
    #: () float64, 1/m, of the diverging wavefront: the added path is curvature r^2 / 2
    curvature: Tensor


class LaserLight(NamedTuple):
    """The light of a laser in absolute units, averaged over one exposure; all fields are 0 for a
    laser that is stated by its strength.
    """

    even_peak: (
        #: () float64, W/m2 at the peak on the sensor, if the axis irradiance filled a clear,
        #: focused lens
        Tensor
    )
    flux: Tensor  #: () float64, W behind the lens, if the axis irradiance filled the clear aperture
    irradiance: Tensor  #: () float64, W/m2 at the lens, on the axis of the beam
    power: Tensor  #: () float64, W into the aperture of the lens
    peak: Tensor  #: () float64, W/m2 at the peak on the sensor behind the clear, focused lens
    pulses: Tensor  #: () float64, pulses within the exposure; 0 for a continuous laser
    #: () float64, J/m2 of one pulse at the peak on the sensor; 0 for a continuous laser
    pulse_fluence: Tensor


class Shade(NamedTuple):
    """The transmission of a grey filter, a smaller stop and notch filters in the pupil."""

    amplitude: Tensor  #: (v, u) transmission of the field in [0, 1], the same at every wavelength
    #: (notch, 3) float64: centre in m, full width at half maximum in m, depth in [0, 1]
    notches: Tensor


class Pupil(NamedTuple):
    """The complex pupil function of each band, stored as real factors.

    The field of band b is ``amplitude * exp(2 pi i (index[b] * height + path) / wavelengths[b])``.
    The factors are stored because 31 complex fields of 2160 x 2160 take 1.2 GB and the factors 75
    MB.
    """

    aperture: Tensor  #: (v, u) clear aperture: 1 inside, 0 outside
    amplitude: Tensor  #: (v, u) aperture times dirt and shade
    height: Tensor  #: (v, u) height map of the mask, m
    path: Tensor  #: (v, u) aberrations and dirt, m of optical path
    index: Tensor  # type: ignore[assignment]  # hides tuple.index, which no caller uses
    #: (band,) float64, refractive index of the mask minus the index of air
    wavelengths: Tensor  #: (band,) float64, m
    pitch: Tensor  #: () float64, m between samples, both axes
    #: (notch, 3), `Shade.notches`; no rows without a notch filter
    notches: Tensor = torch.zeros(0, 3, dtype=torch.float64)
    #: () float64, m, diameter of the clear aperture; 0 if not known
    diameter: Tensor = torch.zeros((), dtype=torch.float64)


class Psf(NamedTuple):
    """Point-spread functions: the fraction of the light through the clear pupil that reaches
    each pixel.
    """

    intensity: Tensor  #: (band, y, x); the sum over an infinite plane is the transmitted share
    #: (band,) float64: intensity of the pixel on the axis for the same lens without mask, dirt and
    #: aberrations
    clear_peak: Tensor
    #: (band,) float64, highest spatial frequency that the clear aperture passes, cycles per pixel;
    #: empty: not known
    cut_off: Tensor = torch.zeros(0, dtype=torch.float64)
    #: (band,) float64, side in pixels of the square over which each pixel averages; 0 or empty: the
    #: PSF is sampled at points
    averaged: Tensor = torch.zeros(0, dtype=torch.float64)


class LowRankCube(NamedTuple):
    """A low-rank approximation of a spectral cube: band b is about ``sum_k basis[b, k]
    planes[k]``.
    """

    planes: Tensor  #: (k, y, x), the strongest plane first
    basis: Tensor  #: (band, k) float64
    #: (k + 1, band) float64: row r bounds |band b - its approximation by the first r planes|, r = 0
    #: to k
    residual_max: Tensor
    #: (k + 1, band): root mean square of this difference, or empty
    residual_rms: Tensor = torch.zeros(0, 0, dtype=torch.float64)
    #: (y, x) bound of |band - its approximation by all planes| over all bands, or empty
    residual_map: Tensor = torch.zeros(0, 0)


class Channels(NamedTuple):
    """Weighted sums over the bands of an image: ``planes[i] = sum_b rows[i, b] image[b]``."""

    planes: Tensor  #: (row, y, x)
    rows: Tensor  #: (row, band) float64
    #: () float64, upper bound of the root mean square error over max |plane|, for the worst row
    bound: Tensor
    #: numbers of kept planes, kernels, bands, PSF rows and PSF columns
    kept: Tensor = torch.zeros(5, dtype=torch.int64)
    #: upper bound of the relative error of max |plane|
    largest: Tensor = torch.tensor(torch.inf, dtype=torch.float64)
    #: estimated errors by `FewBands`, in addition to `bound` and `largest`
    estimated: Tensor = torch.zeros(2, dtype=torch.float64)


class FewBands(NamedTuple):
    """A few bands whose PSFs represent all: the PSF of band b is about ``sum_j share[b, j]
    PSF(used[j])``.
    """

    share: Tensor  #: (band, j) float64; each row sums to 1
    used: Tensor  #: (j,) int64, indices of the chosen bands, rising
    #: () float64, estimate of the root mean square error of the image over its brightest pixel
    error: Tensor
    largest: Tensor  #: () float64, estimate of the relative error of the brightest pixel


class Levels(NamedTuple):
    """Statistics of flat-field frames at several illuminances, from which sensor parameters are
    fitted.

    A level with clipped or coarsely quantised numbers also has a histogram; a cell is the count of
    one digital number in one level.
    """

    photons: Tensor  #: (level,) float64, mean photons per pixel and exposure; 0 in the dark
    exposure: Tensor  #: (level,) float64, s
    #: (level,) float64, count of the pixels of all frames, from which `mean` is computed
    pixels: Tensor
    mean: Tensor  #: (level,) float64, DN
    variance: Tensor  #: (level,) float64, DN2
    degrees_of_freedom: Tensor  #: (level,) float64, of the variance
    cell_level: Tensor  #: (cell,) int64, index of the level, rising
    cell_value: Tensor  #: (cell,) float64, DN, rising within a level
    cell_count: Tensor  #: (cell,) float64


class FoundLasers(NamedTuple):
    """Lasers found in a frame, the most certain first; rows from index ``number`` on are 0 and
    unused.
    """

    number: Tensor  #: () int64, number of lasers
    direction: Tensor  #: (laser, 2) float64, rad, (n_y, n_x)
    wavelength: Tensor  #: (laser,) float64, m
    #: (laser,) float64, m, full width at half maximum of the line, the best of the tried values
    fwhm: Tensor
    #: (laser, channel) float64, electrons of the whole pattern behind a clean and clear pupil
    strength: Tensor
    #: (laser, 2, 2) float64, rad: lower and upper end (90 %) along each axis
    direction_interval: Tensor
    wavelength_interval: Tensor  #: (laser, 2) float64, m: lower and upper end (90 %)
    strength_interval: Tensor  #: (laser, channel, 2) float64, electrons: lower and upper end (90 %)
    #: (laser, 2) bool: True if the frame determines the direction, and the wavelength
    identifiable: Tensor
    #: (laser, 2) float64: gain in log likelihood by the laser, and its excess over the gain by a
    #: lamp there
    gain: Tensor
    #: (laser, value, value) float64, correlation matrix of n_y, n_x, wavelength and `straight` of
    #: each channel
    correlation: Tensor
    #: (laser, channel) float64, electrons in the pattern: ``strength`` less the light that dirt
    #: removes from it
    straight: Tensor
    #: (laser, channel) float64, electrons, standard deviation of ``straight``
    straight_spread: Tensor


class WienerProblem(NamedTuple):
    """The deconvolution of `restore.wiener` as a linear problem, for a scene of mean 0 and variance
    1, with its solution.
    """

    #: (channel, y, x), picture without the glare, of mean 0, in units of ``scale``
    picture: Tensor
    weight: Tensor  #: (channel, y, x), 1 / variance of the noise; 0 where a pixel is clipped
    psf: Tensor  #: (channel, any, any), with a sum near 1
    glare: Tensor  #: (pattern, channel, y, x), additive patterns of unknown strength
    #: (pattern, channel, y, x), additive patterns whose strength has mean 0 and variance 1
    doubts: Tensor
    answer: Tensor  #: (channel, y, x), restored picture, in units of ``scale``
    #: (channel, y, x), the answer blurred by the PSF, with light from outside the frame
    seen: Tensor
    scale: Tensor  #: (channel, 1, 1) e-, of the answer behind a perfect lens
    mean: Tensor  #: (channel, 1, 1) e-, of the scene behind a perfect lens


class FilterFacts(NamedTuple):
    """Quantities that `restore.wiener` estimates or uses for a picture, as maps for the input of a
    network.
    """

    #: (channel, y, x), restored picture, of mean 0, in units of ``scale``
    answer: Tensor
    deviation: Tensor  #: (channel, y, x), predicted error of the answer, in units of ``scale``
    maps: Tensor  #: (map, y, x), in the order that `restore.filter_facts` states
    scale: Tensor  #: (channel, 1, 1) e-, of the answer behind a perfect lens
    mean: Tensor  #: (channel, 1, 1) e-, of the scene behind a perfect lens


class MeasuredPsf(NamedTuple):
    """PSFs measured from frames of point sources, at the nodes of a grid over the frame, with their
    uncertainties.

    Node (i, j) lies in the middle of its zone, which is one of rows x columns equal parts of the
    frame.
    """

    kernels: Tensor  #: (row, column, channel, y, x) float64, each of sum 1
    #: (row, column, channel, y, x) float64, standard deviation of each pixel of the kernels
    deviation: Tensor
    #: (draw, row, column, channel, y, x) float32, random draws of kernels consistent with the
    #: frames
    draws: Tensor
    #: (point, 4) float64: index of the file (from 0), y and x of each point in pixels, and its
    #: signal in e-
    places: Tensor
    #: (channel,) float64, chi-square of the frames per used pixel; 1 if the model fits within the
    #: noise
    fit: Tensor
    #: (channel,) float64, bound of the light outside the window, as a share of the light inside
    outside: Tensor
    #: (row, column) float64, number of points at the node that would determine its PSF as
    #: accurately
    support: Tensor
    inflation: (
        #: (row, column) float64, factor on the variance of the PSF, because points determine
        #: several PSFs at once; 1 is best
        Tensor
    )


#: by class: the fields with one entry per band
BAND_FIELDS: dict[type, tuple[str, ...]] = {
    Bands: Bands._fields,
    Pupil: ("index", "wavelengths"),
    Psf: Psf._fields,
}


def band_names(value: object) -> list[str]:
    """Return the names of a value's fields with one entry per band, without empty ones, which are
    unknown.
    """
    return [name for name in BAND_FIELDS.get(type(value), ()) if getattr(value, name).numel()]
