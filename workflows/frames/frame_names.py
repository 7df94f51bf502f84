"""Exposure, light and level of a frame by the name of its file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

_NUMBER = r"(\d+(?:[.,p]\d+)?(?:e[-+]?\d+)?)"  #: 10p5 is 10.5, as in names without points
_UNIT = r"(ns|us|µs|μs|ms|s)"
_WORD = r"(?:exposure|exptime|texp|exp|t)"
_SPACE = r"[ =_-]?"
#: 1/200 of a second: a file name has no stroke; after a hyphen, and between lone numbers, it may be something else
_FRACTION = re.compile(
    rf"(?<![a-z0-9.,-]){_WORD}?{_SPACE}(?<![\d.,-])1(?:[-⁄]|over|div)([1-9][\d.]*) ?s(?:ec)?(?![a-z0-9])"
)
_DOUBTFUL = re.compile(r"(?<![\d.,])(?:(?<=[a-z-])1-|1[_/ ])([1-9]\d*) ?s(?:ec)?(?![a-z0-9])")
_EXPOSURE = re.compile(rf"(?<![a-z0-9.,]){_WORD}?{_SPACE}{_NUMBER}[ _-]?{_UNIT}(?:ec)?(?![a-z0-9])")
_UNIT_FIRST = re.compile(rf"(?<![a-z0-9]){_WORD}{_SPACE}{_UNIT}{_SPACE}{_NUMBER}(?![a-z.,0-9])")
_SHORT_UNIT_FIRST = re.compile(rf"(?<![a-z0-9])(ns|us|µs|μs|ms){_SPACE}{_NUMBER}(?![a-z.,0-9])")
_AFTER = re.compile(rf"(?<![a-z0-9.,]){_NUMBER}[ _-]?(?:photons?|ph)(?![a-z])")
_BEFORE = re.compile(rf"(?<![a-z])(?:photons?|ph)[ =_-]?{_NUMBER}(?![a-z.,0-9])")
_DARK = re.compile(r"(?<![a-z])(?:darks?(?:frames?)?|bias|closed|nolight)(?![a-z])")
_INDEX = re.compile(r"(?:[ ._-]*(?:frame|image|img|shot|no|n|f|#)?[ ._-]*\d+|[ ._-][ab])$")
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9}


class NamedFrame(NamedTuple):
    """What the name of a file says of its frames; None for what it does not say."""

    level: str  #: the name without exposure, light and the number of the frame
    dark: bool
    exposure: float | None  #: s
    photons: float | None  #: per pixel and exposure
    written: str = ""  #: the part of the name that is read as the exposure
    doubtful: str = ""  #: a part that may be a fraction of a second, or a number and seconds


class _Exposure(NamedTuple):
    seconds: float
    written: str


def read_name(file: Path, folder: Path) -> NamedFrame:
    """Return what the path of a file below ``folder`` says, such as ``flat_10ms_1200ph_2.tif``.

    Folders count as parts of the name: ``dark/10ms/1.png``. An exposure is a number and its unit in either order:
    ``10ms``, ``10p5ms``, ``exp_ms_10``, or a fraction of a second such as ``1-200s``.
    """
    parts = file.relative_to(folder).with_suffix("").parts
    text = "/".join(parts).lower()
    exposure, light = _exposure(text), _last(_AFTER, text) or _last(_BEFORE, text)
    dark = _DARK.search(text) is not None
    photons = 0.0 if dark else None if light is None else _float(light[1])
    left = text.replace(exposure.written, "") if exposure else text
    left = left.replace(light[0], "") if light else left
    level = _INDEX.sub("", left).strip(" /._-")
    seconds, written = (exposure.seconds, exposure.written) if exposure else (None, "")
    doubtful = _last(_DOUBTFUL, text)
    unsure = doubtful[0] if doubtful and not _last(_FRACTION, text) else ""
    return NamedFrame(level, dark or photons == 0, seconds, photons, written.strip(" =_-"), unsure)


def _exposure(text: str) -> _Exposure | None:
    """Return the last exposure of a name; a fraction counts before a number, and a number before a unit."""
    if fraction := _last(_FRACTION, text):
        return _Exposure(1 / _float(fraction[1]), fraction[0])
    if match := _last(_EXPOSURE, text):
        return _Exposure(_float(match[1]) * _SECONDS[match[2]], match[0])
    if match := _last(_UNIT_FIRST, text) or _last(_SHORT_UNIT_FIRST, text):
        return _Exposure(_float(match[2]) * _SECONDS[match[1]], match[0])
    return None


def _last(pattern: re.Pattern[str], text: str) -> re.Match[str] | None:
    matches = list(pattern.finditer(text))
    return matches[-1] if matches else None


def _float(number: str) -> float:
    return float(number.replace(",", ".").replace("p", "."))
