"""Spectrograms, profiles and histograms of defect pixels of an EMVA 1288 sheet, for its pictures and its tables."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from neusee.nodes.calibrate import (
    DefectHistogram,
    EmvaSheet,
    Profiles,
    SpatialSeries,
    Spectrogram,
    defects,
    profiles,
    spectrogram,
    without_trend,
)
from neusee.workflows.report.study_folder import CsvTable

_DIRECTIONS = {"horizontal": False, "vertical": True}
_HIGHPASS = 25  #: by which `without_trend` multiplies
_SPECTROGRAMS = ("frame", "unit", "direction", "cycles_per_pixel", "amplitude")
_PROFILES = ("frame", "direction", "pixel", *Profiles._fields)
_DEFECTS = ("frame", "unit", "deviation", "pixels", "normal")
_BEYOND = ("frame", "unit", "distance", "percent_beyond")


def spectrograms(sheet: EmvaSheet) -> dict[tuple[str, str], dict[str, Spectrogram]]:
    """Return the spectrograms by name and unit of the frame, DSNU in DN and PRNU in percent, and by direction."""
    dark, lit = sheet.spatial
    images: dict[tuple[str, str], Any] = {}
    if dark is not None:
        images["DSNU", "DN"] = dark.average
    if dark is not None and lit is not None and (signal := signal_of(dark, lit)) > 0:
        images["PRNU", "%"] = (lit.average - dark.average) * (100 / signal)
    return {key: {name: spectrogram(image, way) for name, way in _DIRECTIONS.items()} for key, image in images.items()}


def line_profiles(sheet: EmvaSheet) -> dict[str, dict[str, Profiles]]:
    """Return the profiles in DN by the name of the averaged frame and by direction."""
    dark, lit = sheet.spatial
    images = {} if dark is None else {"dark": dark.average}
    if lit is not None:
        images["lit" if dark is None else "lit, less the dark"] = lit.average - (0.0 if dark is None else dark.average)
    return {key: {name: profiles(image, way) for name, way in _DIRECTIONS.items()} for key, image in images.items()}


def defect_histograms(sheet: EmvaSheet) -> dict[tuple[str, str], DefectHistogram]:
    """Return the histograms of defect pixels by name and unit, DSNU in DN and PRNU in percent of the signal."""
    dark, lit = sheet.spatial
    found = {}
    if dark is not None:
        found["DSNU", "DN"] = defects(dark.total, 1 / dark.count)
    if dark is not None and lit is not None and (signal := signal_of(dark, lit)) > 0:
        parts = math.gcd(dark.count, lit.count)
        trendless = without_trend((lit.total * dark.count - dark.total * lit.count) // parts)
        found["PRNU", "%"] = defects(trendless, 100 * parts / (_HIGHPASS * dark.count * lit.count * signal))
    return found


def noise_in_time(sheet: EmvaSheet, name: str) -> tuple[float, float]:
    """Return the standard deviations in time of a frame and of the average, in the unit of the spectrogram."""
    dark, lit = sheet.spatial
    assert dark is not None
    if name == "DSNU" or lit is None:
        return math.sqrt(dark.temporal), math.sqrt(dark.temporal / dark.count)
    share = 100 / signal_of(dark, lit)
    return share * math.sqrt(lit.temporal), share * math.sqrt(lit.temporal / lit.count + dark.temporal / dark.count)


def signal_of(dark: SpatialSeries, lit: SpatialSeries) -> float:
    """Return the mean signal of the lit series above the dark one, DN."""
    return float(lit.average.mean() - dark.average.mean())


def pattern_tables(sheet: EmvaSheet) -> Mapping[str, CsvTable]:
    """Return the curves as tables by file name; without a series there is none."""
    if not (found := defect_histograms(sheet)):
        return {}
    return {
        "spectrograms.csv": (_SPECTROGRAMS, _spectrogram_rows(sheet)),
        "profiles.csv": (_PROFILES, _profile_rows(sheet)),
        "defects.csv": (
            _DEFECTS,
            ((*key, *row) for key, h in found.items() for row in zip(*map(_plain, h[:3]), strict=True)),
        ),
        "defects_accumulated.csv": (
            _BEYOND,
            ((*key, *row) for key, h in found.items() for row in zip(*map(_plain, h[3:]), strict=True)),
        ),
    }


def _spectrogram_rows(sheet: EmvaSheet) -> Iterator[tuple[Any, ...]]:
    for key, directions in spectrograms(sheet).items():
        for direction, found in directions.items():
            yield from ((*key, direction, *row) for row in zip(*map(_plain, found), strict=True))


def _profile_rows(sheet: EmvaSheet) -> Iterator[tuple[Any, ...]]:
    for key, directions in line_profiles(sheet).items():
        for direction, found in directions.items():
            yield from ((key, direction, at, *row) for at, row in enumerate(zip(*map(_plain, found), strict=True)))


def _plain(values: Any) -> list[Any]:
    listed: list[Any] = values.tolist()
    return listed
