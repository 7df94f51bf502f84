"""Exposure, light and level of a frame by the name of its file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

_NUMBER = r"(\d+(?:[.,]\d+)?(?:e[-+]?\d+)?)"
_EXPOSURE = re.compile(rf"(?<![a-z0-9.,])(?:exp|exposure|texp|t)?[ =_-]?{_NUMBER} ?(ns|us|µs|μs|ms|s)(?![a-z0-9])")
_AFTER = re.compile(rf"(?<![a-z0-9.,]){_NUMBER}[ _-]?(?:photons?|ph)(?![a-z])")
_BEFORE = re.compile(rf"(?<![a-z])(?:photons?|ph)[ =_-]?{_NUMBER}(?![a-z.,0-9])")
_DARK = re.compile(r"(?<![a-z])(?:darks?|bias|closed|nolight)(?![a-z])")
_INDEX = re.compile(r"(?:[ ._-]*(?:frame|image|img|shot|no|n|f|#)?[ ._-]*\d+|[ ._-][ab])$")
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9}


class NamedFrame(NamedTuple):
    """What the name of a file says of its frames; None for what it does not say."""

    level: str  #: the name without exposure, light and the number of the frame
    dark: bool
    exposure: float | None  #: s
    photons: float | None  #: per pixel and exposure


def read_name(file: Path, folder: Path) -> NamedFrame:
    """Return what the path of a file below ``folder`` says, such as ``flat_10ms_1200ph_2.tif``.

    Folders count as parts of the name: ``dark/10ms/1.png``.
    """
    parts = file.relative_to(folder).with_suffix("").parts
    text = "/".join(parts).lower()
    time, light = _last(_EXPOSURE, text), _last(_AFTER, text) or _last(_BEFORE, text)
    exposure = None if time is None else _float(time[1]) * _SECONDS[time[2]]
    dark = _DARK.search(text) is not None
    photons = 0.0 if dark else None if light is None else _float(light[1])
    left = text
    for match in (time, light):
        left = left.replace(match[0], "") if match else left
    return NamedFrame(_INDEX.sub("", left).strip(" /._-"), dark or photons == 0, exposure, photons)


def _last(pattern: re.Pattern[str], text: str) -> re.Match[str] | None:
    found = list(pattern.finditer(text))
    return found[-1] if found else None


def _float(number: str) -> float:
    return float(number.replace(",", "."))
