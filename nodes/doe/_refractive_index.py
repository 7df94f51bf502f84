"""Materials of the mask, their refractive indices, and the height for a given phase.

A material is one of four built-in ones, or a glass of the user: Sellmeier coefficients, or a table
of index over wavelength.
"""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import torch
from pydantic import (
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    WithJsonSchema,
    with_config,
)
from torch import Tensor
from typing_extensions import TypedDict

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.input_files import once_per_version
from neusee.nodes.optics._pupil_grid import PupilGrid, inside_stop
from neusee.nodes.spectra._cie_tables import Table
from neusee.nodes.spectra._table_files import LENGTHS, Curves, Rows, curves, table_error, table_rows
from neusee.nodes.units import DataFile, Real, Wavelength
from neusee.nodes.values import Bands

# --- glass of the user ----------------------------------------------------------------------------

_UM2_PER_UNIT = {
    "um^2": 1.0,
    "um2": 1.0,
    "µm^2": 1.0,
    "µm2": 1.0,
    "µm²": 1.0,
    "um²": 1.0,
    "nm^2": 1e-6,
    "nm2": 1e-6,
}
_COLUMN_ADVICE = (
    "write a header such as wavelength (um),n (1) and two columns, or B (1),C (um^2),from (nm),to"
    " (nm) with one row for each term of the Sellmeier formula"
)
_LEAST_INDEX, _LARGEST_INDEX = 1.0, 5.0  #: plausible range of a refractive index
_AREA = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*)")


def _area(value: Any) -> float:
    """Return an area in um^2 from a text with a unit, such as ``0.0135 um^2``; raise ValueError
    for other values.
    """
    match = _AREA.fullmatch(str(value).strip())
    if match is None or isinstance(value, bool):
        raise ValueError("is not a quantity: write a number and a unit, such as '0.0135 um^2'")
    if match[2] not in _UM2_PER_UNIT:
        raise ValueError(f"needs the unit um^2: write '{match[1]} um^2', or nm^2")
    return float(match[1]) * _UM2_PER_UNIT[match[2]]


Area = Annotated[float, BeforeValidator(_area, json_schema_input_type=str)]  #: um^2


@with_config(ConfigDict(extra="forbid"))
class Sellmeier(TypedDict):
    """Coefficients of the Sellmeier formula n^2 = 1 + sum of B w^2 / (w^2 - C), and the range of
    wavelengths over which they were fitted.
    """

    B: Annotated[tuple[Real, ...], Field(min_length=1)]
    C: tuple[Area, ...]  #: um^2
    range: tuple[Wavelength, Wavelength]  #: m


#: JSON schema of `Sellmeier` in a recipe
SELLMEIER_SCHEMA = {
    "type": "object",
    "properties": {
        "B": {"type": "array", "items": {"type": "number"}},
        "C": {"type": "array", "items": {"type": "string"}},
        "range": {"type": "array", "items": {"type": "string"}, "minItems": 2, "maxItems": 2},
    },
    "required": ["B", "C", "range"],
    "additionalProperties": False,
}


def glass_index(glass: Path | Sellmeier, wavelengths: Tensor) -> Tensor:
    """Return the refractive index of a glass at wavelengths in m, differentiable and in their
    dtype.

    Raises ValueError for wavelengths outside the range of the table or the coefficients.
    """
    low, high = glass_range(glass)
    first_wavelength, last_wavelength = (float(end) for end in torch.aminmax(wavelengths.detach()))
    if first_wavelength < low * (1 - 1e-12) or last_wavelength > high * (1 + 1e-12):
        outside_text = (
            f"{first_wavelength * 1e9:.5g} nm"
            if first_wavelength < low
            else f"{last_wavelength * 1e9:.5g} nm"
        )
        range_text = f"{low * 1e9:.5g} to {high * 1e9:.5g} nm"
        fix = "an index is not extrapolated: give a longer range, or other wavelengths"
        raise ValueError(
            f"the index of {_glass_name(glass)} is known from {range_text}, not at {outside_text};"
            f" {fix}"
        )
    index_data = _index_of_file(glass) if isinstance(glass, Path) else glass
    return (
        _interpolated_index(index_data, wavelengths)
        if isinstance(index_data, Table)
        else _sellmeier_index(index_data, wavelengths)
    )


def glass_range(glass: Path | Sellmeier) -> tuple[float, float]:
    """Return the shortest and the longest wavelength in m at which the index of a glass is
    known.
    """
    index_data = _index_of_file(glass) if isinstance(glass, Path) else glass
    if isinstance(index_data, Table):
        return float(index_data.wavelengths[0]), float(index_data.wavelengths[-1])
    return index_data["range"]


def index_rows(file: Path) -> tuple[Tensor, Tensor] | None:
    """Return the wavelengths in m and the indices of the table in a file, or None for a file of
    coefficients.
    """
    index_data = _index_of_file(file)
    return (index_data.wavelengths, index_data.values[0]) if isinstance(index_data, Table) else None


def refuse_glass(glass: Path | Sellmeier) -> None:
    """Raise ParameterError for a glass with an implausible index somewhere in its range."""
    try:
        index_data = _index_of_file(glass) if isinstance(glass, Path) else glass
        if not isinstance(index_data, Table):
            _refuse_coefficients(index_data, _glass_name(glass))
    except (OSError, ValueError) as error:
        if isinstance(glass, Path):
            raise table_error("material", _COLUMN_ADVICE, error) from None
        raise ParameterError("material", str(error)) from None


def _glass_name(glass: Path | Sellmeier) -> str:
    return glass.name if isinstance(glass, Path) else "the own Sellmeier coefficients"


def _refuse_coefficients(glass: Sellmeier, name: str) -> None:
    """Raise ValueError for coefficients that give an implausible index somewhere in their range."""
    low, high = glass["range"]
    if len(glass["B"]) != len(glass["C"]):
        raise ValueError(
            f"{len(glass['B'])} coefficients B for {len(glass['C'])} C: give one C for each B"
        )
    if not low < high:
        raise ValueError(
            f"the range {low * 1e9:g} to {high * 1e9:g} nm of {name} is empty: exchange the two"
            " wavelengths"
        )
    index = _sellmeier_index(glass, torch.linspace(low, high, 1001, dtype=torch.float64))
    implausible = ~((index > _LEAST_INDEX) & (index < _LARGEST_INDEX))
    if implausible.any():
        first_bad = low + (high - low) * int(implausible.nonzero()[0]) / 1000
        fix = "give C in um^2 as in a data sheet, not its root, and a range without resonance"
        raise ValueError(
            f"{name} give no index between 1 and {_LARGEST_INDEX:g} at {first_bad * 1e9:.4g} nm:"
            f" {fix}"
        )


def _sellmeier_index(glass: Sellmeier, wavelengths: Tensor) -> Tensor:
    """Return the index from the Sellmeier formula n^2 = 1 + sum of B w^2 / (w^2 - C), w in um."""
    squared_um = (wavelengths * 1e6).square()
    terms = [b * squared_um / (squared_um - c) for b, c in zip(glass["B"], glass["C"], strict=True)]
    return (1 + torch.stack(terms).sum(0)).sqrt()


def _interpolated_index(table: Table, wavelengths: Tensor) -> Tensor:
    """Interpolate a table by the polynomial through the four nearest rows, or through all rows
    if there are fewer.
    """
    count = min(4, len(table.wavelengths))
    table_wavelengths, values = table.wavelengths.to(wavelengths), table.values[0].to(wavelengths)
    flat_wavelengths = wavelengths.reshape(-1)
    next_row = torch.searchsorted(table_wavelengths, flat_wavelengths.detach())
    first = (next_row - count // 2).clamp(0, len(table_wavelengths) - count)
    rows = first[:, None] + torch.arange(count, device=flat_wavelengths.device)
    row_wavelengths, row_values = table_wavelengths[rows], values[rows]
    distances = row_wavelengths[:, :, None] - row_wavelengths[:, None, :]
    is_same_row = torch.eye(count, dtype=torch.bool, device=flat_wavelengths.device)
    ratios = (
        flat_wavelengths[:, None, None] - row_wavelengths[:, None, :]
    ) / distances.masked_fill(is_same_row, 1.0)
    # Lagrange basis polynomials: product over all other rows
    weights = ratios.masked_fill(is_same_row, 1.0).prod(2)
    return (weights * row_values).sum(1).reshape(wavelengths.shape)


@once_per_version
def _index_of_file(file: Path) -> Table | Sellmeier:
    """Read a glass from a CSV file; its header tells a table from coefficients."""
    rows = table_rows(file)
    if rows.columns[0].quantity.upper() == "B":
        return _coefficients(file, rows)
    index_curve = curves(file, ("1",))
    if len(index_curve.values) != 1:
        raise ValueError(f"{file.name} has {len(index_curve.values) + 1} columns in place of 2")
    implausible = (index_curve.values <= _LEAST_INDEX) | (index_curve.values >= _LARGEST_INDEX)
    index_curve.refuse(
        implausible,
        lambda n: (
            f"{n:g} is no refractive index: write n, between 1 and {_LARGEST_INDEX:g}, and not"
            " n - 1"
        ),
    )
    _refuse_gap(index_curve)
    return index_curve.table()


def _refuse_gap(index_curve: Curves) -> None:
    """Raise ValueError for a gap between two rows in which cubic and linear interpolation differ by
    more than half a step of the index.

    The step is the largest among the gap and its two neighbours. This finds wide gaps in which a
    few close rows would determine the slope.
    """
    table = index_curve.table()
    wavelengths, values = table.wavelengths, table.values[0]
    middle = (wavelengths[1:] + wavelengths[:-1]) / 2
    deviation = (_interpolated_index(table, middle) - (values[1:] + values[:-1]) / 2).abs()
    steps = torch.nn.functional.pad(values.diff().abs(), (1, 1))
    wrong_gaps = (
        deviation > 1e-5 + torch.stack([steps[:-2], steps[1:-1], steps[2:]]).amax(0) / 2
    ).nonzero()
    if len(wrong_gaps):
        row = int(wrong_gaps[0])
        gap_text = f"{float(wavelengths[row]) * 1e9:g} and {float(wavelengths[row + 1]) * 1e9:g} nm"
        fix = "give rows there, in steps as small as beside the gap"
        raise ValueError(
            f"{index_curve.file.name}:{index_curve.lines[row + 1]}: the rows do not tell the"
            f" index between {gap_text}: {fix}"
        )


def _coefficients(file: Path, rows: Rows) -> Sellmeier:
    """Return the glass from a table of Sellmeier coefficients with one term per row."""
    um2_per_unit, from_unit, to_unit = _column_units(file, rows)
    values = rows.values
    if len({tuple(row) for row in values[:, 2:]}) > 1:
        raise ValueError(
            f"{file.name}: from and to differ between the rows: repeat the one range in each row"
        )
    glass = Sellmeier(
        B=tuple(map(float, values[:, 0])),
        C=tuple(float(x) * um2_per_unit for x in values[:, 1]),
        range=(float(values[0, 2]) * from_unit, float(values[0, 3]) * to_unit),
    )
    _refuse_coefficients(glass, f"{file.name}: the coefficients")
    return glass


def _column_units(file: Path, rows: Rows) -> tuple[float, float, float]:
    """Return the factors that convert column C to um^2, and the columns `from` and `to` to m; raise
    ValueError for other columns.
    """
    names = [column.quantity.lower() for column in rows.columns]
    if names != ["b", "c", "from", "to"]:
        raise ValueError(
            f"{file.name} has the columns {', '.join(c.heading for c in rows.columns)}"
        )
    _, c, from_unit, to_unit = (column.unit for column in rows.columns)
    if c not in _UM2_PER_UNIT or from_unit not in LENGTHS or to_unit not in LENGTHS:
        raise ValueError(
            f"{file.name}: C needs a unit such as um^2, and from and to need a unit such as nm"
        )
    return _UM2_PER_UNIT[c], LENGTHS[from_unit], LENGTHS[to_unit]


# --- refractive index -----------------------------------------------------------------------------

# Materials of the mask, and their refractive indices relative to air.


Material = Literal["fused silica", "PMMA", "BK7", "photoresist"]
#: a built-in material, a file with a table or coefficients, or coefficients
Glass = Annotated[
    Annotated[Material | DataFile, Tag("file")]
    | Annotated[Sellmeier, Tag("coefficients"), WithJsonSchema(SELLMEIER_SCHEMA)],
    Discriminator(lambda value: "coefficients" if isinstance(value, Mapping) else "file"),
]
AnyGlass = str | Path | Sellmeier  #: a `Glass` after validation


class _Dispersion(NamedTuple):
    #: (B, C): n**2 = 1 + sum of B w**2 / (w**2 - C), w in µm
    sellmeier: tuple[tuple[float, float], ...]
    cauchy: tuple[float, ...]  #: n = a0 + a1 / w**2 + a2 / w**4; empty where Sellmeier is given
    fit: tuple[float, float]  #: wavelengths, m, over which the formula was fitted


_DISPERSION: dict[str, _Dispersion] = {
    # Malitson, J. Opt. Soc. Am. 55, 1205 (1965), at 20 °C
    "fused silica": _Dispersion(
        ((0.6961663, 0.0684043**2), (0.4079426, 0.1162414**2), (0.8974794, 9.896161**2)),
        (),
        (0.21e-6, 3.71e-6),
    ),
    # one-term fit to Sultanova, Kasarova, Nikolov, Acta Phys. Pol. A 116, 585 (2009), at 20 °C
    "PMMA": _Dispersion(((1.1819, 0.011313),), (), (0.4368e-6, 1.052e-6)),
    # SCHOTT, optical glass data sheet N-BK7
    "BK7": _Dispersion(
        ((1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653)),
        (),
        (0.3e-6, 2.5e-6),
    ),
    # MicroChem, SU-8 3000 data sheet (2011)
    "photoresist": _Dispersion((), (1.5525, 0.00629, 0.0004), (0.32e-6, 1.7e-6)),
}


def excess_index(name: AnyGlass, wavelengths: Tensor) -> Tensor:
    """Return n - 1 of a material at wavelengths in m, differentiable and in their dtype.

    Raises ValueError for wavelengths outside the range of a user's glass.
    """
    if not isinstance(name, str):
        return glass_index(name, wavelengths) - 1
    material, squared_um = _DISPERSION[name], (wavelengths * 1e6).square()
    if material.cauchy:
        return torch.stack([a / squared_um**k for k, a in enumerate(material.cauchy)]).sum(0) - 1
    return (
        1 + torch.stack([b * squared_um / (squared_um - c) for b, c in material.sellmeier]).sum(0)
    ).sqrt() - 1


def wave_height(name: AnyGlass, wavelength: float) -> float:
    """Return the height of the mask, in m, that delays light of ``wavelength`` by one wave."""
    return wavelength / float(excess_index(name, torch.tensor(wavelength, dtype=torch.float64)))


def index_curve(glass: AnyGlass, count: int = 400) -> tuple[Tensor, Tensor]:
    """Return ``count`` wavelengths in m over the range in which the index of a material is known,
    and the index there.
    """
    _, (low, high) = _name_and_range(glass)
    wavelengths = torch.linspace(low, high, count, dtype=torch.float64)
    return wavelengths, excess_index(glass, wavelengths) + 1


def nearest_known(name: AnyGlass, wavelength: float) -> float:
    """Return the wavelength in m, nearest to ``wavelength``, at which the index of a user's glass
    is known; for a built-in material ``wavelength`` itself.
    """
    if isinstance(name, str):
        return wavelength
    low, high = glass_range(name)
    return min(max(wavelength, low), high)


@node(rtol=1e-12)
def material(bands: Bands, *, material: Glass = "fused silica") -> Tensor:
    """Compute the refractive index of the mask minus the refractive index of air, which is taken as
    1.

    ``material`` is one of four names; or Sellmeier coefficients, B without unit and C in um^2, with
    the range of wavelengths over which they were fitted; or a CSV file with either, with a header
    such as ``wavelength (um),n (1)`` or ``B (1),C (um^2),from (nm),to (nm)``.

    Shapes: bands -> (band,), float64.
    Units:  wavelengths m; result 1.
    Error:  error of the fit: 1e-5 for the glasses, 1e-3 for the polymers. A table is interpolated
            by the cubic through the four nearest rows: 1e-7 for glass in steps of 10 nm. A glass of
            your own is never extrapolated.
    Raises: ParameterError before the run for a glass that does not reach over the bands, and for a
            file without such numbers.
    Source: fused silica: Malitson, J. Opt. Soc. Am. 55, 1205 (1965); N-BK7: SCHOTT data sheet;
        PMMA: fit to Sultanova et al., Acta Phys. Pol. A 116, 585 (2009); photoresist: MicroChem
                SU-8 3000 data sheet (2011), Cauchy.
    """
    return excess_index(material, bands.centres.to(torch.float64))


@material.preflight
def _(*, bands: Bands | None = None, material: AnyGlass = "fused silica") -> list[str]:
    wavelengths = None if bands is None or bands.centres.is_meta else bands.centres
    return refuse_material("material", material, wavelengths)


def refuse_material(parameter: str, material: AnyGlass, wavelengths: Tensor | None) -> list[str]:
    """Raise ParameterError for a user's glass that is invalid, or not known at the wavelengths in
    m; return no notes.

    An error of the wavelengths names ``parameter``, from which they come; an error of the file
    names ``material``.
    """
    if isinstance(material, str):
        return []
    refuse_glass(material)
    if wavelengths is not None:
        try:
            glass_index(material, wavelengths)
        except ValueError as error:
            raise ParameterError(parameter, str(error)) from None
    return []


@material.check
def _(result: Tensor, bands: Bands, *, material: AnyGlass) -> list[Check]:
    name, (shortest, longest) = _name_and_range(material)
    text = f"{name}: n - 1 from {float(result[0]):.4f} to {float(result[-1]):.4f}"
    range_text = f"formula fitted over {shortest * 1e9:.0f} to {longest * 1e9:.0f} nm"
    if not isinstance(material, str):
        range_text = f"known from {shortest * 1e9:.0f} to {longest * 1e9:.0f} nm"
    is_covered = shortest <= float(bands.centres.min()) and float(bands.centres.max()) <= longest
    if not is_covered:
        range_text += ", used outside it"
    return [Check(text, bool((result > 0).all())), Check(range_text, is_covered)]


def _name_and_range(material: AnyGlass) -> tuple[str, tuple[float, float]]:
    """Return the name of a material, and the shortest and the longest wavelength in m at which its
    index is known.
    """
    if isinstance(material, str):
        return material, _DISPERSION[material].fit
    return material.name if isinstance(
        material, Path
    ) else "own Sellmeier coefficients", glass_range(material)


# --- height from phase ----------------------------------------------------------------------------

# The height map that produces a given phase, and the check of a height map.


def height_from_phase(
    phase: Tensor, grid: PupilGrid, wavelength: float, material: AnyGlass
) -> Tensor:
    """Return the height map (v, u), float32, in m, that delays light of ``wavelength`` by ``phase``
    in rad, with a minimum of 0.

    Outside the stop the height is 0.
    """
    in_stop = inside_stop(grid, phase.device)
    phase_from_lowest = phase - torch.where(in_stop, phase, math.inf).min()
    return torch.where(
        in_stop, phase_from_lowest * (wave_height(material, wavelength) / (2 * math.pi)), 0.0
    ).to(torch.float32)


def height_checks(height: Tensor, *_: Any, **__: Any) -> list[Check]:
    """Check that all heights are finite and not negative; the text states the smallest and the
    largest height.
    """
    lowest, highest = (float(value) for value in torch.aminmax(height))
    is_valid = math.isfinite(lowest) and math.isfinite(highest) and lowest >= 0
    return [Check(f"height map from {lowest * 1e6:.3g} to {highest * 1e6:.4g} um", is_valid)]
