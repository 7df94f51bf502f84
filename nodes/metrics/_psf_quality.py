"""Quality of a PSF: contrast (MTF), encircled energy, error due to the number of bands, and
detection of detail by an ideal observer.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.metrics._picture_quality import channel_psf
from neusee.nodes.optics import psf as focus
from neusee.nodes.optics._lens import cut_off
from neusee.nodes.optics._psf_definition import SensorSampling
from neusee.nodes.optics._pupil import SCREENS, thinned_pupil
from neusee.nodes.precision import refuse_half
from neusee.nodes.units import FocalLength, PixelPitch, SensorLength
from neusee.nodes.values import Bands, Psf, Pupil

# --- psf contrast ---------------------------------------------------------------------------------

# Contrast (MTF) and encircled energy of a PSF.


_DARK = 1e-30  #: share of the light below which a band counts as dark


class Mtf(NamedTuple):
    """Statistics of the contrast over the spatial frequencies that the clear aperture passes."""

    rms: Tensor  #: (band,) float64, root mean square
    median: Tensor  #: (band,) float64
    low: Tensor  #: (band,) float64, the first percentile, which shows deep nulls


@node(rtol=1e-5)
def mtf(psf: Psf) -> Mtf:
    """Compute statistics of the contrast |OTF| / OTF(0) over all frequencies up to the cut-off of
    the clear aperture.

    The cut-off D / (wavelength x f) in cycles per pixel is that of the PSF, or sqrt(4 p0 / pi) with
    p0 the peak of the clear lens where the PSF does not name it. A PSF that is averaged over pixels
    has the contrast behind the pixels.
    Parseval: no mask has an rms contrast (over all frequencies that the pixels sample) above
            sqrt(LSR p0 / light kept).

    Shapes: psf.intensity (band, y, x) -> three of (band,) float64.
    Units:  none.
    Error:  round-off 1e-7, plus the error of the window: light outside the window counts as lost,
            and the window sets the frequencies. The cut-off is that of the round aperture of the
            same area. Without light (1e-30) the contrast is 0. Only `rms` has a gradient: a median
            depends on one frequency, whose choice among equal values is arbitrary.
    Source: Goodman, Introduction to Fourier Optics, 4th ed., ch. 7 (OTF as autocorrelation of the
            pupil).
    """
    rows = [
        _contrast_statistics(kernel, cut)
        for kernel, cut in zip(psf.intensity, cut_off(psf).tolist(), strict=True)
    ]
    return Mtf(*(torch.stack(column) for column in zip(*rows, strict=True)))


def _contrast_statistics(kernel: Tensor, cut: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return root mean square, median and first percentile of the contrast of one band up to
    ``cut`` cycles per pixel.
    """
    y, x = kernel.shape
    fy, fx = (torch.fft.fftfreq(n, dtype=torch.float64, device=kernel.device) for n in (y, x))
    in_band = torch.hypot(fy[:, None], fx[None, : x // 2 + 1]) <= cut
    otf = torch.fft.rfft2(kernel.double())
    passed_light = otf[0, 0].abs()
    is_dark = passed_light <= _DARK
    relative_otf = otf[in_band].abs() / passed_light.where(~is_dark, 1.0)
    contrast = relative_otf.where(~is_dark, 0.0).clamp_max(1.0)
    sorted_contrast = contrast.detach().sort().values
    rms: Tensor = torch.linalg.vector_norm(contrast) / math.sqrt(len(contrast))
    return (
        rms,
        sorted_contrast[(len(sorted_contrast) - 1) // 2],
        sorted_contrast[(len(sorted_contrast) - 1) // 100],
    )


@mtf.check
def _(result: Mtf, *inputs: Psf) -> list[Check]:
    rms, median = float(result.rms.mean()), float(result.median.mean())
    return [
        Check(
            f"contrast of the PSF over frequencies: rms {rms:.3g}, median {median:.3g}",
            bool((result.rms <= 1.0 + 1e-6).all()),
        )
    ]


@node(rtol=1e-6)
def encircled(psf: Psf, *, pixel_pitch: PixelPitch, radius: SensorLength) -> Tensor:
    """Compute the share of the light, relative to the clear pupil, that falls within a radius
    around the axis.

    Shapes: psf.intensity (band, y, x) -> (band,) float64.
    Units:  radius m on the sensor; result a share of the light through the clear pupil.
    Error:  whole pixels: a pixel counts where its centre lies within the radius.
    Source: Goodman, Introduction to Fourier Optics, 4th ed.; Born and Wolf, Principles of Optics,
            7th ed., ch. 8.
    """
    sizes = psf.intensity.shape[-2:]
    steps = (
        torch.arange(n, dtype=torch.float64, device=psf.intensity.device) - n // 2 for n in sizes
    )
    y, x = (step * pixel_pitch for step in steps)
    in_radius = torch.hypot(y[:, None], x[None, :]) <= radius
    return (psf.intensity * in_radius).sum(-1).sum(-1, dtype=torch.float64)


@encircled.check
def _(result: Tensor, *inputs: Psf, **params: float) -> list[Check]:
    low, high = float(result.min()), float(result.max())
    return [Check(f"{low:.1%} to {high:.1%} of the light falls within the radius", high <= 1.01)]


# --- curves ---------------------------------------------------------------------------------------


def encircled_curve(light: Tensor) -> Tensor:
    """Return the light (radius,) of an image (y, x) within 0, 1, 2, … pixels of the optical axis,
    float64.
    """
    y, x = (torch.arange(n, dtype=torch.float64) - n // 2 for n in light.shape)
    radius = torch.hypot(y[:, None], x[None, :]).ceil().long().flatten()
    light_by_radius = torch.zeros(int(radius.max()) + 1, dtype=torch.float64)
    return light_by_radius.index_add_(0, radius, light.detach().double().cpu().flatten()).cumsum(0)


def over_clear_peak(psf: Psf, band: int) -> Tensor:
    """Return the PSF (y, x) of a band, divided by the peak of the PSF of the clear lens."""
    relative: Tensor = psf.intensity[band] / psf.clear_peak[band]
    return relative


# --- spectral error -------------------------------------------------------------------------------

# The error of a broadband PSF due to the finite number of spectral bands.


_COMPARED_SIDE = 256  #: side in pixels of the square around the axis in which PSFs are compared


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
    """Estimate the error that the number of bands causes in the PSF of a white point, or of a laser
    line.

    The bands are doubled: the light halfway between the centres of adjoining bands is added, which
    gives a rule of twice as many points. The estimate is the root mean square difference of the
    PSFs of both rules. Bands that do not adjoin are split into halves instead. Without illuminant
    and responses, the weights are those of the line. The tolerance of a recipe is relative to the
    bands of the recipe, and does not include this error.

    Shapes: pupil (v, u), bands (band,), illuminant (band,), responses (channel, band) -> (channel,)
            float64.
    Units:  none; root mean square of the error over that of the PSF, within 256 pixels about the
            axis.
    Error:  a factor of 2, compared with 8 times as many bands; up to 2.5 times too large below
            2e-4. The pupil is thinned to 256 samples or more across, and the index between bands is
            interpolated. A channel without light has error 0. The PSFs are in float64: they differ
            by as little as the rounding of float32.
    Raises: ValueError where pupil, bands, illuminant and responses have different bands.
    Source: comparison of two composite rules: Dahlquist and Bjorck, Numerical Methods, section 7.2
            (1974).
    """
    weights = _band_weights(bands, illuminant, responses)
    if not weights.shape[1] == len(bands.centres) == len(pupil.wavelengths):
        counts = f"{len(pupil.wavelengths)}, {len(bands.centres)} and {weights.shape[1]}"
        raise ValueError(
            f"pupil, bands and weights have {counts} bands: compute all from the same `bands` step"
        )
    finer_wavelengths, difference = _finer_wavelengths(bands, weights)
    thinned = _in_double(thinned_pupil(pupil))
    # first the bands of the recipe, then the added wavelengths
    index = torch.cat(
        [thinned.index, _interpolated(pupil.wavelengths, pupil.index, finer_wavelengths)]
    )
    thinned = thinned._replace(
        index=index, wavelengths=torch.cat([thinned.wavelengths, finer_wavelengths])
    )
    alias_free_pixels = (
        float(thinned.wavelengths.min()) * focal_length / (2 * float(thinned.pitch) * pixel_pitch)
    )
    side = max(1, min(_COMPARED_SIDE, math.floor(2 * alias_free_pixels)))
    lens = {"focal_length": focal_length, "pixel_pitch": pixel_pitch, "sensor": sensor}
    band_psf: Psf = focus(thinned, **lens, shape=(side, side), precision="double")
    light = band_psf.intensity.flatten(1)
    white_norm, error_norm = (
        _row_norms(w.to(light) @ light[: w.shape[1]]) for w in (weights, difference)
    )
    is_dark = white_norm <= _DARK
    share: Tensor = torch.where(is_dark, 0.0, error_norm / white_norm.where(~is_dark, 1.0))
    return share


def _row_norms(rows: Tensor) -> Tensor:
    norms: Tensor = torch.linalg.vector_norm(rows.double(), dim=1)
    return norms


def _band_weights(bands: Bands, illuminant: Tensor | None, responses: Tensor | None) -> Tensor:
    """Return the weight of each band in the photons of each channel: (channel, band) float64."""
    if illuminant is None or responses is None:
        return bands.weights.double()[None]
    return responses.double() * illuminant.double() * bands.centres * bands.widths


def _finer_wavelengths(bands: Bands, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the added wavelengths, and the weights (channel, wavelength) of the error; they are
    for the centres of bands first, then for the added wavelengths.
    """
    steps = bands.centres.diff()
    # adjoining bands of equal width: the comparison has the midpoints too
    if len(steps) and bool(((steps - bands.widths[1:]).abs() <= 0.01 * steps.abs()).all()):
        middles = (bands.centres[1:] + bands.centres[:-1]) / 2
        ends = torch.ones_like(bands.centres)
        ends[0] = ends[-1] = 0.5
        return middles, torch.cat([weights * ends, -(weights[:, 1:] + weights[:, :-1]) / 2], 1) / 2
    # otherwise each band is split into halves
    halves = torch.cat([bands.centres - bands.widths / 4, bands.centres + bands.widths / 4])
    return halves, torch.cat([weights, -weights / 2, -weights / 2], 1)


def _interpolated(points: Tensor, values: Tensor, where: Tensor) -> Tensor:
    """Return values at ``where``, by the polynomial through the four nearest points, or through all
    points if there are fewer.
    """
    nearest = (where[:, None] - points).abs().argsort(1)[:, : min(4, len(points))]
    point_places, point_values = points[nearest], values[nearest]
    distances = (
        point_places[:, :, None]
        - point_places[:, None, :]
        + torch.eye(point_places.shape[1], dtype=point_places.dtype)
    )
    # Lagrange polynomials: products over all other points
    ratio = (where[:, None, None] - point_places[:, None, :]) / distances
    is_same_point = torch.eye(point_places.shape[1], dtype=torch.bool)
    value: Tensor = (ratio.where(~is_same_point, 1.0).prod(2) * point_values).sum(1)
    return value


def _in_double(pupil: Pupil) -> Pupil:
    """Return the pupil in float64, so that the gradients of all bands add up in float64."""
    screens = {name: getattr(pupil, name) for name in SCREENS}
    refuse_half(**screens)
    return pupil._replace(**{name: screen.double() for name, screen in screens.items()})


@spectral_error.check
def _(result: Tensor, pupil: Pupil, bands: Bands, *_: Any, **__: Any) -> list[Check]:
    return [
        Check(
            f"{len(bands.centres)} bands: error of the spectral sampling {float(result.max()):.2g}"
            " of the PSF"
        )
    ]


# --- detail ---------------------------------------------------------------------------------------

# Detection of a tri-bar, an edge and a line of text by the ideal observer.

_TARGET_SAMPLES = 8  #: samples of a target per pixel along each axis; a pixel is their mean
_LETTERS = {
    "S": ("01110", "10001", "10000", "01110", "00001", "10001", "01110"),
    "T": ("11111", "00100", "00100", "00100", "00100", "00100", "00100"),
    "O": ("01110", "10001", "10001", "10001", "10001", "10001", "01110"),
    "P": ("11110", "10001", "10001", "11110", "10000", "10000", "10000"),
}  #: five by seven dots, as on a display
TEXT = "STOP"  #: the line of text
TARGETS = ("tri-bar", "edge", "text")


def detail_targets(size: float) -> dict[str, Tensor]:
    """Return the targets (y, x) with a height of ``size`` pixels, as relative contrasts with mean 0
    and a difference of 1 between bright and dark.

    tri-bar: three bars, minus a grey square with the same light. edge: a square of which one half
    is bright. text: the word "STOP" in letters of five by seven dots, minus a uniform grey line.
    """
    draw_target: Mapping[str, Callable[[float], Tensor]] = {
        "tri-bar": _bars,
        "edge": _edge,
        "text": _text,
    }
    return {name: _in_pixels(draw_target[name](size)) for name in TARGETS}


def _bars(size: float) -> Tensor:
    """Return three bright bars with two gaps of the same width, in a square of ``size`` pixels, in
    fine samples.

    The mean is subtracted: a uniform grey square with the same light would have no contrast.
    """
    sample_count = round(size * _TARGET_SAMPLES)
    columns = torch.arange(sample_count, dtype=torch.float64)
    is_bright = (torch.floor(5 * columns / sample_count) % 2 == 0).double()
    return is_bright.expand(sample_count, sample_count) - is_bright.mean()


def _edge(size: float) -> Tensor:
    """Return a square of ``size`` pixels with a dark and a bright half, in fine samples, with mean
    0.
    """
    sample_count = round(size * _TARGET_SAMPLES)
    step = torch.where(torch.arange(sample_count) < sample_count // 2, -0.5, 0.5).double()
    return step.expand(sample_count, sample_count) - step.mean()


def _text(size: float) -> Tensor:
    """Return the line of text with letters ``size`` pixels high, in fine samples, with mean 0."""
    columns = [[[int(dot) for dot in row] + [0] for row in _LETTERS[letter]] for letter in TEXT]
    # a column of space after each letter but the last
    dots = torch.cat([torch.tensor(rows, dtype=torch.float64) for rows in columns], 1)[:, :-1]
    row_count = round(size * _TARGET_SAMPLES)
    column_count = round(size * _TARGET_SAMPLES * dots.shape[1] / 7)
    rows, dot_columns = (
        torch.arange(n) * k // n for n, k in ((row_count, 7), (column_count, dots.shape[1]))
    )
    dots_in_samples = dots[rows][:, dot_columns]
    return dots_in_samples - dots_in_samples.mean()


def _in_pixels(fine: Tensor) -> Tensor:
    """Return a target in pixels: the mean of the fine samples of each pixel, padded with zeros to
    complete pixels.
    """
    sides = [-(-n // _TARGET_SAMPLES) * _TARGET_SAMPLES for n in fine.shape]
    padded = torch.zeros(*sides, dtype=torch.float64)
    padded[: fine.shape[0], : fine.shape[1]] = fine
    pixels: Tensor = padded.reshape(
        sides[0] // _TARGET_SAMPLES, _TARGET_SAMPLES, sides[1] // _TARGET_SAMPLES, _TARGET_SAMPLES
    ).mean((1, 3))
    return pixels


def detail_energy(
    psf: Psf, illuminant: Tensor, responses: Tensor, bands: Bands, size: float
) -> dict[str, Tensor]:
    """Return for each target the sum over pixels of its squared image in each channel: (channel,)
    float64.

    The image of a target is its convolution with the PSF. The window of the PSF must be at least as
    large as the target.
    """
    otf = torch.fft.fft2(channel_psf(psf, illuminant, responses, bands))
    energies = {}
    for name, target in detail_targets(size).items():
        if max(target.shape) > min(otf.shape[-2:]):
            text = (
                f"{name} of {tuple(target.shape)} pixels does not fit the PSF window"
                f" {tuple(otf.shape[-2:])}"
            )
            raise ValueError(f"{text}: choose smaller targets, or a wider window")
        spectrum = otf.abs() * torch.fft.fft2(target, s=otf.shape[-2:]).abs()
        energies[name] = spectrum.square().mean((-2, -1))  # Parseval
    return energies


def detection_snr(energy: Tensor, amplitude: float, contrast: float, noise: Tensor) -> Tensor:
    """Return the signal-to-noise ratio d' (noise,) of the ideal observer, for all channels
    together.

    ``amplitude`` is the scene light in e- times the transmittance of a filter; ``noise`` (noise,
    channel) is the noise variance in e-**2. The observer knows the target and its place. d' is the
    distance between the means of the decision variable with and without target, in standard
    deviations.

    Source: Barrett and Myers, Foundations of Image Science, section 13.2.8 (ideal observer for a
            known signal).
    """
    contributions = (amplitude * contrast) ** 2 * energy / noise
    return contributions.sum(-1).sqrt()
