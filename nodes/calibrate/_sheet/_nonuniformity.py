"""DSNU and PRNU of the EMVA 1288 sheet: variances of averaged frames in total, by rows, by columns and by pixels."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neusee.nodes.calibrate._sheet._quantity import Quantity

FloatArray = NDArray[np.float64]
_SURE = 2.0  #: standard errors of a variance below which only a limit follows
_LEAST = 8  #: pixels, side of the smallest frame
PARTS = ("total", "row", "column", "pixel")


@dataclass(frozen=True)
class SpatialSeries:
    """The sum of a series of frames of one illumination, from which spatial quantities are computed."""

    photons: float  #: per pixel and exposure; 0 in the dark
    exposure: float  #: s
    count: int  #: L, number of frames
    total: NDArray[np.int64]  #: (y, x) DN, sum of the frames
    temporal: float  #: sigma_y.stack^2, DN2, mean over the pixels of the variance in time

    @property
    def average(self) -> FloatArray:
        """The averaged frame (y, x), DN."""
        return np.asarray(self.total / self.count)


class SpatialVariances(NamedTuple):
    """Spatial variances of an averaged frame without what noise in time leaves in the average, DN2."""

    total: float
    row: float
    column: float
    pixel: float


class Nonuniformity(NamedTuple):
    """The dark and the lit series of a sheet; either is None if there is no such series."""

    dark: SpatialSeries | None
    lit: SpatialSeries | None


def spatial_series(photons: float, exposure: float, frames: Iterable[Tensor]) -> SpatialSeries:
    """Sum frames (y, x) of whole numbers, one by one, to a series.

    Shapes: each frame (y, x).
    Units:  DN; exposure s.
    Raises: ValueError for fewer than two frames, for frames of fewer than 8 x 8 pixels or of different sizes.
    Source: EMVA Standard 1288, release 4.0 Linear.
    """
    total, squares, count = torch.zeros(0), torch.zeros(0), 0
    for frame in frames:
        whole = frame.to(torch.int64)
        if count and whole.shape != total.shape:
            raise ValueError(f"frames of {tuple(total.shape)} and of {tuple(whole.shape)} are no series")
        total, squares = (total + whole, squares + whole**2) if count else (whole, whole**2)
        count += 1
    if count < 2:
        raise ValueError(f"{count} frame(s) are no series: give two or more")
    if min(total.shape) < _LEAST:
        raise ValueError(f"frames of {tuple(total.shape)} are too small for a series: give {_LEAST} x {_LEAST} or more")
    spread = (count * squares - total**2).double() / (count * (count - 1))
    return SpatialSeries(photons, exposure, count, total.cpu().numpy(), float(spread.mean()))


def spatial_variances(series: SpatialSeries) -> SpatialVariances:
    """Split the spatial variance of an averaged frame into the parts of rows, columns and single pixels.

    Shapes: -> scalars.
    Units:  DN2.
    Error:  the rest of the noise in time is subtracted, so that a part that is smaller may come out negative; see
            `chance_of_variances`.
    Source: EMVA Standard 1288, release 4.0 Linear (rows, columns and pixels that add up to the total).
    """
    rows, columns = series.total.shape
    left = series.temporal / series.count
    found = _measured(series)
    total, by_row, by_column = found.total - left, found.row - left / columns, found.column - left / rows
    pixels = rows * columns
    rest = pixels - rows - columns
    return SpatialVariances(
        total,
        ((pixels - columns) * by_row - rows * (total - by_column)) / rest,
        ((pixels - rows) * by_column - columns * (total - by_row)) / rest,
        pixels * (total - by_column - by_row) / rest,
    )


def chance_of_variances(series: SpatialSeries) -> SpatialVariances:
    """Return the standard errors of `spatial_variances`, DN2, for normal noise and a normal nonuniformity."""
    rows, columns = series.total.shape
    found = _measured(series)
    noise = series.temporal / series.count * math.sqrt(2 / (rows * columns * (series.count - 1)))
    pixel = math.hypot(found.total * math.sqrt(2 / (rows * columns)), noise)
    row, column = found.row * math.sqrt(2 / rows), found.column * math.sqrt(2 / columns)
    return SpatialVariances(math.hypot(pixel, row, column), math.hypot(row, pixel / columns),
                            math.hypot(column, pixel / rows), pixel)  # fmt: skip


def _measured(series: SpatialSeries) -> SpatialVariances:
    """Return the variances of the averaged frame, of the means of its rows and of the means of its columns."""
    image = series.average
    rows, columns = float(image.mean(1).var()), float(image.mean(0).var())
    return SpatialVariances(float(image.var(ddof=1)), rows, columns, math.nan)


def nonuniformity(found: Nonuniformity, gain: float | None) -> list[Quantity]:
    """Return DSNU1288 in DN and e-, PRNU1288 in percent, each in total and of rows, columns and pixels.

    Shapes: scalars.
    Units:  as in each `Quantity`.
    Source: EMVA Standard 1288, release 4.0 Linear.
    """
    return [*_dark(found.dark, gain), *_lit(found)]


def _dark(series: SpatialSeries | None, gain: float | None) -> list[Quantity]:
    quantities: list[Quantity] = []
    for i, part in enumerate(PARTS):
        names = _names("DSNU", part, "dark signal nonuniformity")
        in_numbers = Quantity(f"{names[0]}_DN", f"{names[1]}.DN", names[2], "DN")
        in_electrons = Quantity(names[0], names[1], names[2], "e-")
        if series is None:
            why = "no series of dark frames is given, only pairs"
            quantities += [in_numbers.untold(why), in_electrons.untold(why)]
            continue
        numbers = _root(in_numbers, spatial_variances(series)[i], chance_of_variances(series)[i])
        quantities.append(numbers)
        if numbers.value is None or gain is None:
            quantities.append(in_electrons.untold(numbers.reason or "K is not told, so that no value in electrons is"))
        else:
            quantities.append(in_electrons.told(numbers.value / gain, numbers.bound, numbers.reason))
    return quantities


def _lit(found: Nonuniformity) -> list[Quantity]:
    blanks = [Quantity(*_names("PRNU", part, "photo response nonuniformity"), "%") for part in PARTS]
    if found.dark is None or found.lit is None:
        which = "lit frames" if found.lit is None else "dark frames"
        return [blank.untold(f"no series of {which} is given, only pairs") for blank in blanks]
    signal = float(found.lit.average.mean() - found.dark.average.mean())
    if not signal > 0:
        return [blank.untold("the lit series is no brighter than the dark one") for blank in blanks]
    scale = (100 / signal) ** 2
    each = zip(spatial_variances(found.lit), spatial_variances(found.dark), strict=True)
    chance = zip(chance_of_variances(found.lit), chance_of_variances(found.dark), strict=True)
    both = zip(blanks, each, chance, strict=True)
    return [_root(blank, (lit - dark) * scale, math.hypot(*errors) * scale) for blank, (lit, dark), errors in both]


def _names(kind: str, part: str, name: str) -> tuple[str, str, str]:
    if part == "total":
        return f"{kind}1288", f"{kind}1288", f"{name}, total"
    return f"{kind}1288_{part}", f"{kind}1288.{part}", f"{name}, {part}s"


def _root(blank: Quantity, variance: float, error: float) -> Quantity:
    """Return the root of a variance, or a limit if the variance is less than two of its standard errors."""
    if variance >= _SURE * error and variance > 0:
        return blank.told(math.sqrt(variance))
    limit = math.sqrt(max(variance, 0.0) + _SURE * error)
    return blank.told(limit, "<", "no more than what noise in time leaves in the averaged frames")
