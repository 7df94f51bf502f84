"""The refractive index of a glass of the user: Sellmeier coefficients, or a table of the index
by wavelength.
"""

import re
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import BeforeValidator, ConfigDict, Field, with_config
from torch import Tensor
from typing_extensions import TypedDict

from neusee.nodes import ParameterError
from neusee.nodes.input_files import once_per_version
from neusee.nodes.spectra._cie_tables import Table
from neusee.nodes.spectra._table_files import LENGTHS, Curves, Rows, curves, refused, table_rows
from neusee.nodes.units import Real, Wavelength

_AREAS = {
    "um^2": 1.0,
    "um2": 1.0,
    "µm^2": 1.0,
    "µm2": 1.0,
    "µm²": 1.0,
    "um²": 1.0,
    "nm^2": 1e-6,
    "nm2": 1e-6,
}
_COLUMNS = (
    "write a header such as wavelength (um),n (1) and two columns, or B (1),C (um^2),from (nm),to"
    " (nm) with one row for each term of the Sellmeier formula"
)
_FROM_AIR, _LARGEST = 1.0, 5.0  #: no glass has an index outside these
_AREA = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*)")


def _area(value: Any) -> float:
    """Return an area in um^2 from a text with a unit, such as ``0.0135 um^2``; raise ValueError
    for other values.
    """
    match = _AREA.fullmatch(str(value).strip())
    if match is None or isinstance(value, bool):
        raise ValueError("is not a quantity: write a number and a unit, such as '0.0135 um^2'")
    if match[2] not in _AREAS:
        raise ValueError(f"needs the unit um^2: write '{match[1]} um^2', or nm^2")
    return float(match[1]) * _AREAS[match[2]]


Area = Annotated[float, BeforeValidator(_area, json_schema_input_type=str)]  #: um^2


@with_config(ConfigDict(extra="forbid"))
class Sellmeier(TypedDict):
    """Coefficients of n^2 = 1 + sum of B w^2 / (w^2 - C), and the range of wavelengths over
    which they were fitted.
    """

    B: Annotated[tuple[Real, ...], Field(min_length=1)]
    C: tuple[Area, ...]  #: um^2
    range: tuple[Wavelength, Wavelength]  #: m


#: of `Sellmeier` as a recipe writes the coefficients
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
    """Return the refractive index of a glass at wavelengths in m; the result is differentiable and
    keeps the dtype.

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
            f"the index of {_name(glass)} is known from {range_text}, not at {outside_text}; {fix}"
        )
    index_data = _from_file(glass) if isinstance(glass, Path) else glass
    return (
        _interpolated(index_data, wavelengths)
        if isinstance(index_data, Table)
        else _formula(index_data, wavelengths)
    )


def glass_range(glass: Path | Sellmeier) -> tuple[float, float]:
    """Return the wavelengths in m between which the index of a glass is known."""
    index_data = _from_file(glass) if isinstance(glass, Path) else glass
    if isinstance(index_data, Table):
        return float(index_data.wavelengths[0]), float(index_data.wavelengths[-1])
    return index_data["range"]


def index_rows(file: Path) -> tuple[Tensor, Tensor] | None:
    """Return the wavelengths in m and the indices in the rows of a file, or None for a file of
    coefficients.
    """
    index_data = _from_file(file)
    return (index_data.wavelengths, index_data.values[0]) if isinstance(index_data, Table) else None


def refuse_glass(glass: Path | Sellmeier) -> None:
    """Raise ParameterError for a glass without a plausible index anywhere in its range."""
    try:
        index_data = _from_file(glass) if isinstance(glass, Path) else glass
        if not isinstance(index_data, Table):
            _refuse_coefficients(index_data, _name(glass))
    except (OSError, ValueError) as error:
        if isinstance(glass, Path):
            raise refused("material", _COLUMNS, error) from None
        raise ParameterError("material", str(error)) from None


def _name(glass: Path | Sellmeier) -> str:
    return glass.name if isinstance(glass, Path) else "the own Sellmeier coefficients"


def _refuse_coefficients(glass: Sellmeier, name: str) -> None:
    """Raise ValueError for coefficients that give no plausible index at some wavelength of their
    range.
    """
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
    index = _formula(glass, torch.linspace(low, high, 1001, dtype=torch.float64))
    implausible = ~((index > _FROM_AIR) & (index < _LARGEST))
    if implausible.any():
        first_bad = low + (high - low) * int(implausible.nonzero()[0]) / 1000
        fix = "give C in um^2 as in a data sheet, not its root, and a range without resonance"
        raise ValueError(
            f"{name} give no index between 1 and {_LARGEST:g} at {first_bad * 1e9:.4g} nm: {fix}"
        )


def _formula(glass: Sellmeier, wavelengths: Tensor) -> Tensor:
    """Return the index by the Sellmeier formula, n^2 = 1 + sum of B w^2 / (w^2 - C), w in um."""
    squared_um = (wavelengths * 1e6).square()
    terms = [b * squared_um / (squared_um - c) for b, c in zip(glass["B"], glass["C"], strict=True)]
    return (1 + torch.stack(terms).sum(0)).sqrt()


def _interpolated(table: Table, wavelengths: Tensor) -> Tensor:
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
    # Lagrange's polynomials: the product over all other rows
    weights = ratios.masked_fill(is_same_row, 1.0).prod(2)
    return (weights * row_values).sum(1).reshape(wavelengths.shape)


@once_per_version
def _from_file(file: Path) -> Table | Sellmeier:
    """Read a glass from a CSV file; the header says if the file holds a table or coefficients."""
    rows = table_rows(file)
    if rows.columns[0].quantity.upper() == "B":
        return _coefficients(file, rows)
    index_curve = curves(file, ("1",))
    if len(index_curve.values) != 1:
        raise ValueError(f"{file.name} has {len(index_curve.values) + 1} columns in place of 2")
    implausible = (index_curve.values <= _FROM_AIR) | (index_curve.values >= _LARGEST)
    index_curve.refuse(
        implausible,
        lambda n: (
            f"{n:g} is no refractive index: write n, between 1 and {_LARGEST:g}, and not n - 1"
        ),
    )
    _refuse_gap(index_curve)
    return index_curve.table()


def _refuse_gap(index_curve: Curves) -> None:
    """Raise ValueError for a gap between two rows in which the cubic leaves the straight line by
    more than half a step.

    The step is the largest of the gap and its neighbours. A few rows close together decide the
    slope in a wide gap.
    """
    table = index_curve.table()
    wavelengths, values = table.wavelengths, table.values[0]
    middle = (wavelengths[1:] + wavelengths[:-1]) / 2
    deviation = (_interpolated(table, middle) - (values[1:] + values[:-1]) / 2).abs()
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
    """Return the glass of a table of Sellmeier coefficients, one term a row."""
    um2_per_unit, from_unit, to_unit = _units(file, rows)
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


def _units(file: Path, rows: Rows) -> tuple[float, float, float]:
    """Return the factors that bring C to um^2, and from and to to m; raise ValueError for other
    columns.
    """
    names = [column.quantity.lower() for column in rows.columns]
    if names != ["b", "c", "from", "to"]:
        raise ValueError(
            f"{file.name} has the columns {', '.join(c.heading for c in rows.columns)}"
        )
    _, c, from_unit, to_unit = (column.unit for column in rows.columns)
    if c not in _AREAS or from_unit not in LENGTHS or to_unit not in LENGTHS:
        raise ValueError(
            f"{file.name}: C needs a unit such as um^2, and from and to need a unit such as nm"
        )
    return _AREAS[c], LENGTHS[from_unit], LENGTHS[to_unit]
