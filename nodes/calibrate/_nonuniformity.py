"""DSNU, PRNU, spectrograms, profiles and defect pixels of the EMVA 1288 sheet."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neusee.nodes.calibrate._emva_quantities import NO_GAIN, FloatArray, Quantity

# --- nonuniformity --------------------------------------------------------------------------------

# DSNU and PRNU of the EMVA 1288 sheet: spatial variances of averaged frames, in total and of rows,
# columns and pixels.


_VARIANCE_SIGMA = 2.0  #: a variance of fewer standard errors than this gives only an upper limit
_SMALLEST_SIDE = 8  #: pixels, side of the smallest frame
PARTS = ("total", "row", "column", "pixel")


@dataclass(frozen=True)
class SpatialSeries:
    """The sum of a series of frames of one illumination, for spatial quantities."""

    photons: float  #: per pixel and exposure; 0 in the dark
    exposure: float  #: s
    count: int  #: L, number of frames
    total: NDArray[np.int64]  #: (y, x) DN, sum of the frames
    temporal: float  #: sigma_y.stack^2, DN2, temporal variance, averaged over the pixels

    @property
    def average(self) -> FloatArray:
        """The averaged frame (y, x), DN."""
        return np.asarray(self.total / self.count)


class SpatialVariances(NamedTuple):
    """Spatial variances of an averaged frame, DN2, with the residual temporal noise subtracted."""

    total: float
    row: float
    column: float
    pixel: float


class Nonuniformity(NamedTuple):
    """The dark and the lit series of frames of a sheet; None for a series that does not exist."""

    dark: SpatialSeries | None
    lit: SpatialSeries | None


def spatial_series(photons: float, exposure: float, frames: Iterable[Tensor]) -> SpatialSeries:
    """Sum a series of frames (y, x) of whole numbers, one frame at a time.

    Shapes: each frame (y, x).
    Units:  DN; exposure s.
    Raises: ValueError for fewer than two frames, for frames of fewer than 8 x 8 pixels or of
            different sizes.
    Source: EMVA Standard 1288, release 4.0 Linear.
    """
    sum_of_frames, sum_of_squares, count = torch.zeros(0), torch.zeros(0), 0
    for frame in frames:
        numbers = frame.to(torch.int64)
        if count and numbers.shape != sum_of_frames.shape:
            raise ValueError(
                f"frames of {tuple(sum_of_frames.shape)} and of {tuple(numbers.shape)} are no"
                " series"
            )
        sum_of_frames, sum_of_squares = (
            (sum_of_frames + numbers, sum_of_squares + numbers**2)
            if count
            else (numbers, numbers**2)
        )
        count += 1
    if count < 2:
        raise ValueError(f"{count} frame(s) are no series: give two or more")
    if min(sum_of_frames.shape) < _SMALLEST_SIDE:
        raise ValueError(
            f"frames of {tuple(sum_of_frames.shape)} are too small for a series: give"
            f" {_SMALLEST_SIDE} x {_SMALLEST_SIDE} or more"
        )
    # unbiased variance of each pixel: (n sum of squares - square of the sum) / (n (n - 1))
    temporal_variance = (count * sum_of_squares - sum_of_frames**2).double() / (count * (count - 1))
    return SpatialSeries(
        photons, exposure, count, sum_of_frames.cpu().numpy(), float(temporal_variance.mean())
    )


def spatial_variances(series: SpatialSeries) -> SpatialVariances:
    """Split the spatial variance of an averaged frame into the parts of rows, columns and single
    pixels.

    Shapes: -> scalars.
    Units:  DN2.
    Error:  the rest of the noise in time is subtracted, so that a part that is smaller may come out
            negative; see `chance_of_variances`.
    Source: EMVA Standard 1288, release 4.0 Linear (rows, columns and pixels that add up to the
            total).
    """
    rows, columns = series.total.shape
    # temporal variance left in the average of n frames; in the mean of a line it is divided by its
    # pixels
    temporal_rest = series.temporal / series.count
    variances = _measured_variances(series)
    total_variance, row_variance, column_variance = (
        variances.total - temporal_rest,
        variances.row - temporal_rest / columns,
        variances.column - temporal_rest / rows,
    )
    pixel_count = rows * columns
    # the three parts that add up to the total, as EMVA 1288 solves for them
    denominator = pixel_count - rows - columns
    return SpatialVariances(
        total_variance,
        ((pixel_count - columns) * row_variance - rows * (total_variance - column_variance))
        / denominator,
        ((pixel_count - rows) * column_variance - columns * (total_variance - row_variance))
        / denominator,
        pixel_count * (total_variance - column_variance - row_variance) / denominator,
    )


def chance_of_variances(series: SpatialSeries) -> SpatialVariances:
    """Return the standard errors of `spatial_variances`, DN2, for normally distributed noise and
    nonuniformity.
    """
    rows, columns = series.total.shape
    variances = _measured_variances(series)
    error_by_time = (
        series.temporal / series.count * math.sqrt(2 / (rows * columns * (series.count - 1)))
    )
    # a variance of n values has the relative error sqrt(2 / n)
    pixel_error = math.hypot(variances.total * math.sqrt(2 / (rows * columns)), error_by_time)
    row_error, column_error = (
        variances.row * math.sqrt(2 / rows),
        variances.column * math.sqrt(2 / columns),
    )
    return SpatialVariances(
        math.hypot(pixel_error, row_error, column_error),
        math.hypot(row_error, pixel_error / columns),
        math.hypot(column_error, pixel_error / rows),
        pixel_error,
    )


def _measured_variances(series: SpatialSeries) -> SpatialVariances:
    """Return the variances of the averaged frame, of its row means and of its column means, DN2;
    they include residual temporal noise. The variance of single pixels is NaN.
    """
    image = series.average
    rows, columns = float(image.mean(1).var()), float(image.mean(0).var())
    return SpatialVariances(float(image.var(ddof=1)), rows, columns, math.nan)


def nonuniformity(patterns: Nonuniformity, gain: float | None) -> list[Quantity]:
    """Return DSNU1288 in DN and in e-, and PRNU1288 in percent, each in total and of rows, columns
    and pixels.

    Shapes: scalars.
    Units:  as in each `Quantity`.
    Source: EMVA Standard 1288, release 4.0 Linear.
    """
    return [*_dsnu(patterns.dark, gain), *_prnu(patterns)]


def _dsnu(series: SpatialSeries | None, gain: float | None) -> list[Quantity]:
    """Return DSNU1288 in DN and in electrons, in total and of rows, columns and pixels; limits or
    reasons where the ``series`` of dark frames does not determine them.
    """
    quantities: list[Quantity] = []
    for i, pattern in enumerate(PARTS):
        key, symbol, name = _names("DSNU", pattern, "dark signal nonuniformity")
        in_numbers = Quantity(f"{key}_DN", f"{symbol}.DN", name, "DN")
        in_electrons = Quantity(key, symbol, name, "e-")
        if series is None:
            reason = "no series of dark frames is given, only pairs"
            quantities += [in_numbers.untold(reason), in_electrons.untold(reason)]
            continue
        # the fields of `SpatialVariances` have the order of `PARTS`
        numbers = _root_or_limit(
            in_numbers, spatial_variances(series)[i], chance_of_variances(series)[i]
        )
        quantities.append(numbers)
        if numbers.value is None or gain is None:
            quantities.append(in_electrons.untold(numbers.reason or NO_GAIN))
        else:
            quantities.append(
                in_electrons.told(numbers.value / gain, numbers.bound, numbers.reason)
            )
    return quantities


def _prnu(patterns: Nonuniformity) -> list[Quantity]:
    """Return PRNU1288 in percent, in total and of rows, columns and pixels, from the difference of
    the spatial variances of the lit and the dark series.
    """
    blanks = [
        Quantity(*_names("PRNU", pattern, "photo response nonuniformity"), "%") for pattern in PARTS
    ]
    if patterns.dark is None or patterns.lit is None:
        missing_frames = "lit frames" if patterns.lit is None else "dark frames"
        return [
            blank.untold(f"no series of {missing_frames} is given, only pairs") for blank in blanks
        ]
    signal = float(patterns.lit.average.mean() - patterns.dark.average.mean())
    if not signal > 0:
        return [blank.untold("the lit series is no brighter than the dark one") for blank in blanks]
    # conversion from DN2 to squared percent of the signal
    percent_squared = (100 / signal) ** 2
    variances = zip(spatial_variances(patterns.lit), spatial_variances(patterns.dark), strict=True)
    errors = zip(chance_of_variances(patterns.lit), chance_of_variances(patterns.dark), strict=True)
    rows_of_parts = zip(blanks, variances, errors, strict=True)
    return [
        _root_or_limit(
            blank, (lit - dark) * percent_squared, math.hypot(*part_errors) * percent_squared
        )
        for blank, (lit, dark), part_errors in rows_of_parts
    ]


def _names(kind: str, pattern: str, name: str) -> tuple[str, str, str]:
    """Return key, symbol and name of a quantity; a total has no suffix in its key."""
    if pattern == "total":
        return f"{kind}1288", f"{kind}1288", f"{name}, total"
    return f"{kind}1288_{pattern}", f"{kind}1288.{pattern}", f"{name}, {pattern}s"


def _root_or_limit(blank: Quantity, variance: float, error: float) -> Quantity:
    """Return the square root of a variance, or an upper limit if the variance is below two of its
    standard errors.
    """
    if variance >= _VARIANCE_SIGMA * error and variance > 0:
        return blank.told(math.sqrt(variance))
    limit = math.sqrt(max(variance, 0.0) + _VARIANCE_SIGMA * error)
    return blank.told(limit, "<", "no more than what noise in time leaves in the averaged frames")


# --- patterns -------------------------------------------------------------------------------------

# Spectrograms, profiles and histograms of defect pixels of the EMVA 1288 sheet.


_HISTOGRAM_CLASSES = 256  #: classes of a histogram
_BOX_SIDE = 5  #: pixels, side of the box whose mean is subtracted against uneven light


class Spectrogram(NamedTuple):
    """The root of the mean power spectrum of the lines of a frame, in the unit of the frame."""

    frequency: FloatArray  #: (half,) cycles per pixel, 0 to 0.5
    amplitude: FloatArray  #: (half,)


class Profiles(NamedTuple):
    """Four profiles of a frame, each (pixel,) in the unit of the frame."""

    middle: FloatArray
    mean: FloatArray
    least: FloatArray
    greatest: FloatArray


class DefectHistogram(NamedTuple):
    """The histogram of the deviations of pixels from their mean, and the share of pixels beyond
    each absolute deviation.
    """

    deviation: FloatArray  #: (class,) lower end of each class, in the unit of the frame
    pixels: NDArray[np.int64]  #: (class,)
    #: (class,) pixels of a normal distribution of the same mean and standard deviation
    normal: FloatArray
    distance: FloatArray  #: (class,) absolute deviation, rising
    beyond: FloatArray  #: (class,) % of the pixels with at least this absolute deviation


def spectrogram(image: FloatArray, vertical: bool = False) -> Spectrogram:
    """Return the spectrogram of a frame (y, x) along its rows, or along its columns if
    ``vertical``.

    White noise of standard deviation s has the amplitude s at every frequency.

    Source: EMVA Standard 1288, release 4.0 Linear.
    """
    lines = (image - image.mean()).T if vertical else image - image.mean()
    power = np.abs(np.fft.rfft(lines, axis=1)) ** 2 / lines.shape[1]
    return Spectrogram(
        np.asarray(np.fft.rfftfreq(lines.shape[1])), np.asarray(np.sqrt(power.mean(0)))
    )


def profiles(image: FloatArray, vertical: bool = False) -> Profiles:
    """Return the middle row of a frame (y, x), and mean, minimum and maximum of each column; with
    ``vertical`` rows and columns change places.

    Source: EMVA Standard 1288, release 4.0 Linear.
    """
    lines = image.T if vertical else image
    return Profiles(lines[len(lines) // 2], lines.mean(0), lines.min(0), lines.max(0))


def without_trend(total: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return 25 x (frame less its mean over 5 x 5 pixels), without a rim of two pixels; the factor
    keeps whole numbers.

    Source: EMVA Standard 1288, release 4.0 Linear (highpass filtering of the lit frame).
    """
    rim = _BOX_SIDE // 2
    windows = np.lib.stride_tricks.sliding_window_view(total, (_BOX_SIDE, _BOX_SIDE))
    return np.asarray(_BOX_SIDE**2 * total[rim:-rim, rim:-rim] - windows.sum((2, 3)))


def defects(total: NDArray[np.int64], unit: float) -> DefectHistogram:
    """Return the histogram of the deviations of a frame (y, x) of whole numbers from its mean;
    ``unit`` is the value of 1.

    Shapes: -> (class,), at most 256 classes of equal whole width.
    Source: EMVA Standard 1288, release 4.0 Linear (logarithmic and accumulated histograms).
    """
    low, high = int(total.min()), int(total.max())
    # a whole width, so that every class has the same number of whole numbers
    width = 1 if high - low < _HISTOGRAM_CLASSES else (high - low) // _HISTOGRAM_CLASSES + 1
    class_index = (total - low) // width
    count = np.bincount(class_index.reshape(-1))
    class_starts = low + width * np.arange(len(count))
    mean, sigma = float(total.mean()), float(total.std())
    normal = np.zeros(len(count))
    if sigma > 0:
        centre = class_starts + (width - 1) / 2
        normal = (
            total.size
            * width
            / (math.sqrt(2 * math.pi) * sigma)
            * np.exp(-(((centre - mean) / sigma) ** 2) / 2)
        )
    sorted_distances = np.sort(np.abs(total.reshape(-1) - mean))
    distance = np.linspace(
        0.0, float(sorted_distances[-1]), min(_HISTOGRAM_CLASSES, len(sorted_distances))
    )
    beyond = np.asarray(
        100
        * (len(sorted_distances) - np.searchsorted(sorted_distances, distance, side="left"))
        / len(sorted_distances)
    )
    deviation, distance = np.asarray((class_starts - mean) * unit), np.asarray(distance * unit)
    return DefectHistogram(deviation, count, normal, distance, beyond)
