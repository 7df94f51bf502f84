"""Physical units: a recipe writes ``550 nm``, and a node receives metres.

A parameter with a dimension must carry a unit in the recipe, so that no reader mistakes
micrometres for nanometres. Inside the program every quantity is in SI units, e- or DN.
A gain is K of EMVA 1288 inside the program, DN/e-; a recipe may also give the reciprocal, ``0.37
e-/DN``.

Every type of number states its least and greatest value: a limit of physics, or one far beyond any
camera, laser or optic. A value outside is taken as a mistake in the recipe, such as a wrong unit,
and is refused before the run.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from glob import glob
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin

from pydantic import AfterValidator, BeforeValidator, Field

#: by SI unit: the units that a recipe may use, and the factor from each to the SI unit
SCALES: dict[str, dict[str, float]] = {
    "m": {
        "m": 1.0,
        "cm": 1e-2,
        "mm": 1e-3,
        "um": 1e-6,
        "µm": 1e-6,
        "μm": 1e-6,
        "nm": 1e-9,
        "km": 1e3,
    },
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
KNOWN_UNITS = tuple(SCALES)  #: SI units of values in a recipe
_USUAL_UNITS = {
    "m": "um",
    "s": "ms",
    "rad": "mrad",
    "W": "mW",
    "J": "uJ",
    "Hz": "kHz",
}  #: the unit that error messages suggest, by SI unit
_RECIPROCAL = {"e-/DN"}  #: units that state the reciprocal of the quantity
_NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*)")


def read_quantity(value: Any, si: str) -> float:
    """Convert a text such as ``"550 nm"`` to the SI unit ``si``; raise ValueError for a wrong or
    missing unit.
    """
    match = _NUMBER.fullmatch(str(value).strip())
    if isinstance(value, bool) or match is None:
        raise ValueError(
            f"is not a quantity: write a number and a unit, such as '1 {_USUAL_UNITS.get(si, si)}'"
        )
    number, unit = float(match[1]), match[2].strip()
    if not unit:
        raise ValueError(f"needs a unit: write {_with_unit(match[1], si)}")
    if unit not in SCALES[si]:
        raise ValueError(f"has the wrong unit {unit!r}: write one of {', '.join(SCALES[si])}")
    if not math.isfinite(number):
        raise ValueError("the number must be finite")
    return _in_si(number, si, unit)


def _with_unit(number: str, si: str) -> str:
    """Return the example that an error message suggests for a number without a unit."""
    if si == "DN/e-":
        return f"{number} e-/DN or {number} DN/e- (EMVA's K is DN/e-)"
    return f"{number} {_USUAL_UNITS.get(si, si)} (one of {', '.join(SCALES[si])})"


def _in_si(number: float, si: str, unit: str) -> float:
    """Convert a number from a unit to the SI unit ``si``; a number with a reciprocal unit is
    inverted.
    """
    if unit not in _RECIPROCAL:
        return number * SCALES[si][unit]
    if number == 0:
        raise ValueError("the number must be greater than 0")
    return 1.0 / number


def read_any(text: Any) -> tuple[float, str]:
    """Convert a text such as ``"550 nm"`` or ``0.56`` to a finite number and its SI unit (""
    without unit).

    Raises ValueError for other text.
    """
    number, si, reciprocal = read_written(text)
    return (_in_si(number, si, "e-/DN"), si) if reciprocal else (number, si)


def read_written(text: Any) -> tuple[float, str, bool]:
    """Return the number in a text, its SI unit, and True if the unit is a reciprocal one such as
    e-/DN.

    A number with a reciprocal unit is not converted, because the reciprocal of a normal
    distribution, such as that of 0.37 e-/DN, is not normal.
    """
    match = _NUMBER.fullmatch(str(text).strip())
    unit = match[2].strip() if match else ""
    si = next((si for si, units in SCALES.items() if unit in units), "")
    if isinstance(text, bool) or match is None or (unit and not si):
        raise ValueError(f"{text} is neither a number nor a quantity, such as 0.5 or '1 um'")
    if not math.isfinite(float(match[1])):
        raise ValueError(f"the number {text} is not finite")
    return float(match[1]) * (SCALES[si][unit] if si else 1.0), si, unit in _RECIPROCAL


@dataclass(frozen=True)
class QuantityReader:
    """Reader of a quantity with a unit, such as ``550 nm``, which returns the number in the SI
    unit ``si``.
    """

    si: str

    def __call__(self, value: Any) -> float:
        return read_quantity(value, self.si)


def _reader(si: str) -> BeforeValidator:
    """Return the validator that reads a quantity in the SI unit ``si``."""
    return BeforeValidator(QuantityReader(si), json_schema_input_type=str)


def in_words(number: float, si: str) -> str:
    """Return a quantity as text in a convenient unit, such as ``10 mm`` for 0.01 m; the unit "" is
    omitted.
    """
    units = {
        unit: scale
        for unit, scale in SCALES.get(si, {}).items()
        if unit.isascii() and unit not in (*_RECIPROCAL, "cm")
    }
    if si == "rad" and abs(number) > 0.1:
        return f"{math.degrees(number):.6g} deg"
    fitting_units = [unit for unit, scale in units.items() if 1 <= abs(number) / scale < 1000]
    unit = next(iter(fitting_units), si)
    return f"{number / units.get(unit, 1.0):.6g} {unit}".strip()


_LARGEST_DARK_CURRENT = 1e12  #: electrons per exposure, or per second


class ElectronsPerSecond(NamedTuple):
    """A dark current per second; a dark current per exposure is a plain number of electrons."""

    rate: float  #: e-/s


def _read_dark_current(value: Any) -> float | ElectronsPerSecond:
    """Return a dark current in e- per exposure, or in e-/s if the text has this unit."""
    quantity_text, unit = str(value).strip(), "e-/s"
    is_by_time = not isinstance(value, bool) and quantity_text.endswith(tuple(SCALES[unit]))
    current = read_quantity(value, unit) if is_by_time else read_quantity(value, "e-")
    if current < 0:
        raise ValueError("the dark current must be 0 or more")
    if current > _LARGEST_DARK_CURRENT:
        raise ValueError(f"the dark current must be at most {_LARGEST_DARK_CURRENT:.0e} e-")
    return ElectronsPerSecond(current) if is_by_time else current


#: electrons of one exposure, or electrons per second
DarkCurrent = Annotated[
    Annotated[float, Field(ge=0, le=_LARGEST_DARK_CURRENT)] | ElectronsPerSecond,
    BeforeValidator(_read_dark_current, json_schema_input_type=str),
]

# lengths, in metres
#: any sign, to the distance of the Moon
Length = Annotated[float, Field(ge=-1e9, le=1e9), _reader("m")]
PositiveLength = Annotated[float, Field(gt=0, le=1e9), _reader("m")]
Wavelength = Annotated[float, Field(ge=100e-9, le=20e-6), _reader("m")]  #: 100 nm to 20 µm
#: from 1 kHz of a visible laser to a whole band
Linewidth = Annotated[float, Field(ge=1e-18, le=20e-6), _reader("m")]
#: from a contact to the distance of the Moon
Distance = Annotated[float, Field(ge=1e-6, le=1e9), _reader("m")]
#: dense fog to air without particles, 300 km
Visibility = Annotated[float, Field(ge=1, le=1e6), _reader("m")]
#: from a microlens to the largest telescope
FocalLength = Annotated[float, Field(ge=1e-6, le=1e4), _reader("m")]
#: from a microlens to the largest telescope
Diameter = Annotated[float, Field(ge=1e-6, le=100), _reader("m")]
#: no beam is narrower than its light
BeamRadius = Annotated[float, Field(ge=10e-9, le=100), _reader("m")]
#: unit of the heights in a file
LengthUnit = Annotated[float, Field(ge=1e-15, le=1), _reader("m")]
#: pixels of sensors have 0.5 µm to 1 mm
PixelPitch = Annotated[float, Field(ge=100e-9, le=10e-3), _reader("m")]
SensorLength = Annotated[float, Field(ge=1e-9, le=10), _reader("m")]  #: on the sensor
PupilPitch = Annotated[float, Field(ge=1e-9, le=10), _reader("m")]  #: between samples of a pupil
Depth = Annotated[float, Field(ge=1e-10, le=10e-3), _reader("m")]  #: of a relief, from one atom on
#: of a surface, or an optical path, any sign
Height = Annotated[float, Field(ge=-10e-3, le=10e-3), _reader("m")]

# times, in seconds
#: from an attosecond pulse to 30 years
Time = Annotated[float, Field(ge=1e-18, le=1e9), _reader("s")]
#: from the fastest gated sensor to 12 days
Exposure = Annotated[float, Field(ge=1e-12, le=1e6), _reader("s")]
Delay = Annotated[float, Field(ge=0, le=1e9), _reader("s")]  #: from 0
Frequency = Annotated[float, Field(ge=1e-9, le=1e12), _reader("Hz")]  #: hertz

# angles, in radians
Angle = Annotated[float, Field(ge=-math.tau, le=math.tau), _reader("rad")]  #: one turn to each side
#: from the largest telescope's on
PositiveAngle = Annotated[float, Field(ge=1e-9, le=math.pi), _reader("rad")]

# light, temperature and charge
Temperature = Annotated[float, Field(ge=1, le=1e6), _reader("K")]  #: kelvin
#: watt, from a few photons to the strongest pulse
Power = Annotated[float, Field(ge=1e-18, le=1e16), _reader("W")]
#: joule, from a part of a photon to the largest laser
Energy = Annotated[float, Field(ge=1e-21, le=1e7), _reader("J")]
Illuminance = Annotated[float, Field(ge=0, le=1e8), _reader("lx")]  #: lux; the sun gives 1.3e5
#: candela per square metre; the sun has 1.6e9
Luminance = Annotated[float, Field(ge=0, le=1e11), _reader("cd/m2")]
Electrons = Annotated[float, Field(ge=0, le=1e12), _reader("e-")]  #: electron
#: K of EMVA 1288, DN per electron
Gain = Annotated[float, Field(ge=1e-9, le=1e6), _reader("DN/e-")]

# numbers without a unit
Waves = Annotated[float, Field(ge=-1e5, le=1e5), _reader("waves")]  #: optical path in wavelengths
#: optical path in wavelengths that a mask adds at its rim
Slope = Annotated[float, Field(ge=-1e5, le=1e5)]
Charge = Annotated[int, Field(ge=-1000, le=1000)]  #: turns of phase around the axis of a vortex
Fraction = Annotated[float, Field(ge=0, le=1)]  #: number in [0, 1]
Transmittance = Annotated[float, Field(gt=0, le=1)]  #: share of the light that passes, above 0
#: electrons per photon; far beyond its band a sensor has 1e-6
Efficiency = Annotated[float, Field(ge=1e-6, le=1)]
Strength = Annotated[float, Field(ge=0, le=1e18)]  #: multiple of what saturates a pixel
#: of two quantities of one kind, such as a contrast or a weight
Ratio = Annotated[float, Field(gt=0, le=1e9)]
Spread = Annotated[float, Field(ge=0, le=100)]  #: standard deviation over its mean
Count = Annotated[int, Field(ge=1, le=10**9)]  #: whole number from 1
Layers = Annotated[int, Field(ge=1, le=4096)]  #: of a network: channels, blocks or states
Real = Annotated[float, Field(ge=-1e15, le=1e15)]  #: number of any sign
Pixels = Annotated[int, Field(ge=1, le=10**6)]  #: along an axis
Shape = tuple[Pixels, Pixels]  #: (y, x) in pixels


@dataclass(frozen=True)
class NumberRange:
    """The least and the greatest allowed value of a number; None if not stated."""

    least: float | None
    greatest: float | None
    si: str = ""  #: unit of both, "" for none


def number_ranges(hint: Any) -> Iterator[NumberRange]:
    """Yield the range of each number that a type annotation of a parameter contains.

    Each number in a tuple, a list, a mapping or a union has its own range; booleans are skipped.
    """
    yield from _ranges(hint, ())


def _ranges(hint: Any, metadata: tuple[Any, ...]) -> Iterator[NumberRange]:
    """Yield the range of each number in a type, with the constraints that apply to it."""
    if get_origin(hint) is Annotated:
        yield from _ranges(get_args(hint)[0], (*metadata, *_constraints(hint)))
    elif hint in (int, float):
        lowest = max(_stated(metadata, "ge", "gt"), default=None)
        greatest = min(_stated(metadata, "le", "lt"), default=None)
        yield NumberRange(lowest, greatest, _unit_of(metadata))
    elif get_origin(hint) is not Literal:
        for argument in get_args(hint):
            yield from _ranges(argument, () if get_origin(hint) in _CONTAINERS else metadata)


_CONTAINERS = (tuple, list, dict)


def _stated(metadata: tuple[Any, ...], *limits: str) -> list[Any]:
    """Return the values of the limits with these names among constraints."""
    values = []
    for constraint in metadata:
        values += [getattr(constraint, name) for name in limits if hasattr(constraint, name)]
    return values


def _constraints(hint: Any) -> Iterator[Any]:
    """Yield the single constraints of an annotated type; `Field` holds several."""
    for constraint in hint.__metadata__:
        yield from getattr(constraint, "metadata", None) or (constraint,)


def _unit_of(metadata: tuple[Any, ...]) -> str:
    """Return the SI unit of the quantity reader among constraints, or an empty text."""
    readers = [
        constraint.func for constraint in metadata if isinstance(constraint, BeforeValidator)
    ]
    return next((reader.si for reader in readers if isinstance(reader, QuantityReader)), "")


class IsFile:
    """Annotation of a file parameter; it makes the content of the file part of the cache key."""


def existing_file(path: Path) -> Path:
    """Return the path of a regular file; raise ValueError for anything else."""
    try:
        is_folder = path.is_dir()
    except OSError as error:  # for example a path that is too long
        raise ValueError(f"{str(path)[:40]}… cannot be read: {error.strerror}") from None
    if is_folder:
        raise ValueError(f"{path} is a folder, not a file: give a file in this folder")
    if not path.is_file():
        kind_text = (
            "is not a regular file but a pipe, a device or a socket: give the path of a file"
        )
        raise ValueError(f"{path} {kind_text}" if path.exists() else f"no such file: {path}")
    return path


DataFile = Annotated[Path, AfterValidator(existing_file), IsFile()]  #: path of a file that exists


def files_of(written: Any) -> list[Path]:
    """Return all files given by a path, a pattern, a folder or a list.

    The files of a pattern or a folder are sorted by name.
    """
    if isinstance(written, list | tuple):
        return list(chain.from_iterable(files_of(entry) for entry in written))
    path = Path(written)
    try:
        if path.is_file():
            return [path]
    except OSError as error:
        raise ValueError(f"{str(path)[:40]}… cannot be read: {error.strerror}") from None
    candidates = path.iterdir() if path.is_dir() else map(Path, glob(str(written)))
    files = sorted(file for file in candidates if _is_visible_file(file))
    if not files:
        raise ValueError(f"no such file, and no folder or pattern that matches a file: {path}")
    return files


def _is_visible_file(path: Path) -> bool:
    return path.is_file() and not path.name.startswith(".")


#: one or more files: a path, a folder, a pattern such as ``dark/*.png``, or a list of these
DataFiles = Annotated[
    tuple[Path, ...], BeforeValidator(files_of, json_schema_input_type=str | list[str]), IsFile()
]
