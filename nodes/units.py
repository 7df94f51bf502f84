"""Physical units: a recipe writes ``550 nm``, and a node receives metres.

A parameter with a dimension must carry a unit in the recipe, so that no reader mistakes
micrometres for nanometres. Inside the program every quantity is in SI units, e- or DN.
A gain is K of EMVA 1288 inside the program, DN/e-; a recipe may also give the reciprocal, ``0.37 e-/DN``.
"""

from __future__ import annotations

import math
import re
from glob import glob
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import AfterValidator, BeforeValidator, Field

_SCALE: dict[str, dict[str, float]] = {
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "nm": 1e-9, "km": 1e3},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "ps": 1e-12, "fs": 1e-15},
    "rad": {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": math.pi / 180.0},
    "K": {"K": 1.0},
    "e-": {"e-": 1.0, "ke-": 1e3},
    "e-/s": {"e-/s": 1.0, "ke-/s": 1e3},
    "W": {"W": 1.0, "kW": 1e3, "mW": 1e-3, "uW": 1e-6, "µW": 1e-6, "nW": 1e-9},
    "J": {"J": 1.0, "mJ": 1e-3, "uJ": 1e-6, "µJ": 1e-6, "nJ": 1e-9},
    "Hz": {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6},
    "lx": {"lx": 1.0, "klx": 1e3},
    "cd/m2": {"cd/m2": 1.0, "kcd/m2": 1e3},
    "waves": {"waves": 1.0, "wave": 1.0},
    "DN/e-": {"DN/e-": 1.0, "e-/DN": 1.0},
}
_USUAL = {
    "m": "um",
    "s": "ms",
    "rad": "mrad",
    "W": "mW",
    "J": "uJ",
    "Hz": "kHz",
}  #: the unit that messages suggest for an SI unit
_RECIPROCAL = {"e-/DN"}  #: units of the reciprocal of the quantity
_NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*)")


def read_quantity(value: Any, si: str) -> float:
    """Convert a text such as ``"550 nm"`` to the SI unit ``si``; raise ValueError for a wrong or missing unit."""
    match = _NUMBER.fullmatch(str(value).strip())
    if isinstance(value, bool) or match is None:
        raise ValueError(f"is not a quantity: write a number and a unit, such as '1 {_USUAL.get(si, si)}'")
    number, unit = float(match[1]), match[2].strip()
    if not unit:
        raise ValueError(f"needs a unit: write {_with_unit(match[1], si)}")
    if unit not in _SCALE[si]:
        raise ValueError(f"has the wrong unit {unit!r}: write one of {', '.join(_SCALE[si])}")
    if not math.isfinite(number):
        raise ValueError("the number must be finite")
    return _in_si(number, si, unit)


def _with_unit(number: str, si: str) -> str:
    """Return the example that an error message suggests for a number without a unit."""
    if si == "DN/e-":
        return f"{number} e-/DN or {number} DN/e- (EMVA's K is DN/e-)"
    return f"{number} {_USUAL.get(si, si)} (one of {', '.join(_SCALE[si])})"


def _in_si(number: float, si: str, unit: str) -> float:
    if unit not in _RECIPROCAL:
        return number * _SCALE[si][unit]
    if number == 0:
        raise ValueError("the number must be greater than 0")
    return 1.0 / number


def read_any(text: Any) -> tuple[float, str]:
    """Convert a text such as ``"550 nm"`` or ``0.56`` to a finite number and its SI unit, "" for no unit.

    Raises ValueError for other text.
    """
    number, si, reciprocal = read_written(text)
    return (_in_si(number, si, "e-/DN"), si) if reciprocal else (number, si)


def read_written(text: Any) -> tuple[float, str, bool]:
    """Return the number in a text, the SI unit, and True if the number has a reciprocal unit such as e-/DN.

    A number with a reciprocal unit is not converted, because the reciprocal of a normal distribution, such as that of
    0.37 e-/DN, is not normal.
    """
    match = _NUMBER.fullmatch(str(text).strip())
    unit = match[2].strip() if match else ""
    si = next((si for si, known in _SCALE.items() if unit in known), "")
    if isinstance(text, bool) or match is None or (unit and not si):
        raise ValueError(f"{text} is neither a number nor a quantity, such as 0.5 or '1 um'")
    if not math.isfinite(float(match[1])):
        raise ValueError(f"the number {text} is not finite")
    return float(match[1]) * (_SCALE[si][unit] if si else 1.0), si, unit in _RECIPROCAL


def _reader(si: str) -> BeforeValidator:
    return BeforeValidator(lambda value: read_quantity(value, si), json_schema_input_type=str)


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("the number must be finite")
    return value


class ElectronsPerSecond(NamedTuple):
    """A dark current by time; a dark current of one exposure is a plain number of electrons."""

    rate: float  #: e-/s


def _read_dark_current(value: Any) -> float | ElectronsPerSecond:
    number, unit = str(value).strip(), "e-/s"
    by_time = not isinstance(value, bool) and number.endswith(tuple(_SCALE[unit]))
    found = read_quantity(value, unit) if by_time else read_quantity(value, "e-")
    if found < 0:
        raise ValueError("the dark current must be 0 or more")
    return ElectronsPerSecond(found) if by_time else found


#: electrons of one exposure, or electrons per second
DarkCurrent = Annotated[float | ElectronsPerSecond, BeforeValidator(_read_dark_current, json_schema_input_type=str)]
Length = Annotated[float, _reader("m")]  #: metre, any sign
PositiveLength = Annotated[float, Field(gt=0), _reader("m")]  #: metre
Wavelength = Annotated[float, Field(ge=100e-9, le=20e-6), _reader("m")]  #: metre, 100 nm to 20 µm
Time = Annotated[float, Field(gt=0), _reader("s")]  #: second
Angle = Annotated[float, _reader("rad")]  #: radian
Temperature = Annotated[float, Field(gt=0), _reader("K")]  #: kelvin
Electrons = Annotated[float, Field(ge=0), _reader("e-")]  #: electron
PositiveAngle = Annotated[float, Field(gt=0), _reader("rad")]  #: radian
Power = Annotated[float, Field(gt=0), _reader("W")]  #: watt
Energy = Annotated[float, Field(gt=0), _reader("J")]  #: joule
Frequency = Annotated[float, Field(gt=0), _reader("Hz")]  #: hertz
Delay = Annotated[float, Field(ge=0), _reader("s")]  #: second, from 0
Illuminance = Annotated[float, Field(ge=0), _reader("lx")]  #: lux
Luminance = Annotated[float, Field(ge=0), _reader("cd/m2")]  #: candela per square metre
Waves = Annotated[float, _reader("waves")]  #: optical path in wavelengths
Gain = Annotated[float, Field(gt=0, allow_inf_nan=False), _reader("DN/e-")]  #: K of EMVA 1288, DN per electron
Fraction = Annotated[float, Field(ge=0, le=1)]  #: number in [0, 1]
Transmittance = Annotated[float, Field(gt=0, le=1)]  #: share of the light that passes, above 0
Efficiency = Annotated[float, Field(gt=0, le=1)]  #: electrons per photon
Count = Annotated[int, Field(ge=1)]  #: whole number from 1
Real = Annotated[float, AfterValidator(_finite)]  #: finite number
Shape = tuple[Count, Count]  #: (y, x) in pixels


class IsFile:
    """The annotation of a file parameter, which makes the content of the file part of the cache key."""


def _existing(path: Path) -> Path:
    if path.is_dir():
        raise ValueError(f"{path} is a folder, not a file: give a file in this folder")
    if not path.is_file():
        raise ValueError(f"no such file: {path}")
    return path


DataFile = Annotated[Path, AfterValidator(_existing), IsFile()]  #: path of a file that exists


def _files(written: Any) -> list[Path]:
    """Return all files given by a path, a pattern, a folder or a list.

    The files of a pattern or a folder are sorted by name.
    """
    if isinstance(written, list | tuple):
        return [path for each in written for path in _files(each)]
    path = Path(written)
    if path.is_file():
        return [path]
    inside = path.iterdir() if path.is_dir() else map(Path, glob(str(written)))
    files = sorted(each for each in inside if each.is_file() and not each.name.startswith("."))
    if not files:
        raise ValueError(f"no such file, and no folder or pattern that matches a file: {path}")
    return files


#: one or more files: a path, a folder, a pattern such as ``dark/*.png``, or a list of these
DataFiles = Annotated[tuple[Path, ...], BeforeValidator(_files, json_schema_input_type=str | list[str]), IsFile()]
