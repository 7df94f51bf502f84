"""Spectrograms, profiles and histograms of defect pixels of the EMVA 1288 sheet."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neusee.nodes.calibrate._sheet._nonuniformity import FloatArray

_MOST = 256  #: classes of a histogram
_BOX = 5  #: pixels, side of the box whose mean is subtracted against uneven light


class Spectrogram(NamedTuple):
    """The root of the mean power of the lines of a frame, in the unit of the frame."""

    frequency: FloatArray  #: (half,) cycles per pixel, 0 to 0.5
    amplitude: FloatArray  #: (half,)


class Profiles(NamedTuple):
    """Four lines through a frame, each (pixel,) in the unit of the frame."""

    middle: FloatArray
    mean: FloatArray
    least: FloatArray
    greatest: FloatArray


class DefectHistogram(NamedTuple):
    """The distribution of pixels over their deviation from the mean, and the share of pixels beyond each deviation."""

    deviation: FloatArray  #: (class,) lower end of each class, in the unit of the frame
    pixels: NDArray[np.int64]  #: (class,)
    normal: FloatArray  #: (class,) pixels of a normal distribution of the same mean and standard deviation
    distance: FloatArray  #: (class,) rising amount of the deviation
    beyond: FloatArray  #: (class,) %, pixels whose deviation amounts to that much or more


def spectrogram(image: FloatArray, vertical: bool = False) -> Spectrogram:
    """Return the spectrogram of a frame (y, x) along its rows, or with ``vertical`` along its columns.

    White noise of standard deviation s has the amplitude s at every frequency.

    Source: EMVA Standard 1288, release 4.0 Linear.
    """
    lines = (image - image.mean()).T if vertical else image - image.mean()
    power = np.abs(np.fft.rfft(lines, axis=1)) ** 2 / lines.shape[1]
    return Spectrogram(np.asarray(np.fft.rfftfreq(lines.shape[1])), np.asarray(np.sqrt(power.mean(0))))


def profiles(image: FloatArray, vertical: bool = False) -> Profiles:
    """Return the middle row of a frame (y, x), and mean, least and greatest number of each column; or the transposed.

    Source: EMVA Standard 1288, release 4.0 Linear.
    """
    lines = image.T if vertical else image
    return Profiles(lines[len(lines) // 2], lines.mean(0), lines.min(0), lines.max(0))


def without_trend(total: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return 25 times a frame less the mean of 5 x 5 pixels, without a rim of two pixels; whole numbers stay exact.

    Source: EMVA Standard 1288, release 4.0 Linear (highpass filtering of the lit frame).
    """
    rim = _BOX // 2
    windows = np.lib.stride_tricks.sliding_window_view(total, (_BOX, _BOX))
    return np.asarray(_BOX**2 * total[rim:-rim, rim:-rim] - windows.sum((2, 3)))


def defects(total: NDArray[np.int64], unit: float) -> DefectHistogram:
    """Return the histogram of the numbers (y, x) of a frame about their mean; ``unit`` is the value of the number 1.

    Shapes: -> (class,), at most 256 classes of equal whole width.
    Source: EMVA Standard 1288, release 4.0 Linear (logarithmic and accumulated histograms).
    """
    low, high = int(total.min()), int(total.max())
    width = 1 if high - low < _MOST else (high - low) // _MOST + 1
    index = (total - low) // width
    count = np.bincount(index.reshape(-1))
    starts = low + width * np.arange(len(count))
    mean, sigma = float(total.mean()), float(total.std())
    normal = np.zeros(len(count))
    if sigma > 0:
        centre = starts + (width - 1) / 2
        normal = total.size * width / (math.sqrt(2 * math.pi) * sigma) * np.exp(-(((centre - mean) / sigma) ** 2) / 2)
    apart = np.sort(np.abs(total.reshape(-1) - mean))
    distance = np.linspace(0.0, float(apart[-1]), min(_MOST, len(apart)))
    beyond = np.asarray(100 * (len(apart) - np.searchsorted(apart, distance, side="left")) / len(apart))
    deviation, distance = np.asarray((starts - mean) * unit), np.asarray(distance * unit)
    return DefectHistogram(deviation, count, normal, distance, beyond)
