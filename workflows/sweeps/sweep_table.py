"""Table of the results of a sweep: its columns, its rows in a file, and the text of its cells."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from neusee.nodes import units

if TYPE_CHECKING:
    from neusee.workflows.sweeps.axes import Axis, Point
    from neusee.workflows.sweeps.sweep_points import PointOutcome, ResultNumber

AFTER = ("status", "step", "field", "index", "value", "seconds", "cached", "message")  #: columns after the axes


@dataclass(frozen=True, slots=True)
class AxisColumn:
    """Table column of one axis of a sweep; its header has a unit if all values have the same physical dimension."""

    name: str
    header: str
    cells: tuple[Any, ...]  #: the values of the axis, in order
    si: tuple[Any, ...]
    unit: str  #: of ``si``; empty for pure numbers and for words


def column(axis: Axis) -> AxisColumn:
    """Return the table column of an axis of a sweep: numbers in their common unit, or in SI units if units differ.

    Words are unchanged.
    """
    values = [c.value for c in axis.coordinates]
    quantities = [q for q in map(_quantity, values) if q is not None]
    header = f"{axis.name} (axis)" if axis.name in ("point", *AFTER) else axis.name
    if len(quantities) == len(values) and len({q.si_unit for q in quantities}) == 1:
        si, unit = tuple(q.si for q in quantities), quantities[0].si_unit
        if len({q.unit for q in quantities}) > 1:
            return AxisColumn(axis.name, f"{header} ({unit})", si, si, unit)
        return AxisColumn(axis.name, f"{header} ({quantities[0].unit})", tuple(q.number for q in quantities), si, unit)
    if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        return AxisColumn(axis.name, header, tuple(values), tuple(map(float, values)), "")
    words = tuple(c.shown for c in axis.coordinates)
    return AxisColumn(axis.name, header, words, words, "")


@dataclass(frozen=True, slots=True)
class _Quantity:
    number: float
    unit: str
    si: float
    si_unit: str


def _quantity(value: Any) -> _Quantity | None:
    match = units._NUMBER.fullmatch(value.strip()) if isinstance(value, str) else None
    for si_unit, scale in units._SCALE.items():
        if match and match[2].strip() in scale:
            return _Quantity(float(match[1]), match[2].strip(), units.read_quantity(value, si_unit), si_unit)
    return None


# --- rows -----------------------------------------------------------------------------------------------------------


def header(columns: Sequence[AxisColumn]) -> list[str]:
    """Return the names of all columns of ``sweep.csv``."""
    return ["point", *(c.header for c in columns), *AFTER]


def rows_of(outcome: PointOutcome, columns: Sequence[AxisColumn]) -> Iterator[list[Any]]:
    """Yield the table rows of one point of a sweep: one row for each number, or a single row without a number.

    A point has no numbers if it failed or if its results have none.
    """
    where = [outcome.point.number, *point_cells(outcome.point, columns)]
    status = "failed" if outcome.state == "failed" else "ok"
    last = [round(outcome.seconds, 6), outcome.state == "cached", outcome.message]
    for number in outcome.numbers or ((outcome.step, "", "", ""),):
        yield [*where, status, *number, *last]


def headline(numbers: Sequence[ResultNumber]) -> dict[str, str]:
    """Return each result of one point of a sweep as text: a single number, or the range of the numbers of an array.

    Single numbers come first.
    """
    results: dict[str, list[float]] = {}
    for step, part, _, value in numbers:
        results.setdefault(f"{step}.{part}".rstrip("."), []).append(value)
    return {name: _range_of(values) for name, values in sorted(results.items(), key=lambda item: len(item[1]) > 1)}


def wide(outcomes: Sequence[PointOutcome], columns: Sequence[AxisColumn]) -> list[list[str]]:
    """Return the rows of a text table of a sweep: a header, then one row for each point with its results."""
    results = [headline(outcome.numbers) for outcome in outcomes]
    names = list(dict.fromkeys(name for result in results for name in result))
    rows = [["point", *(c.header for c in columns), *names, "state", "seconds"]]
    for outcome, result in zip(outcomes, results, strict=True):
        cells = [cell_text(cell) for cell in point_cells(outcome.point, columns)]
        values = [result.get(name, "") for name in names]
        rows.append([str(outcome.point.number), *cells, *values, outcome.state, f"{outcome.seconds:.3f}"])
    return rows


def point_cells(point: Point, columns: Sequence[AxisColumn]) -> list[Any]:
    """Return the axis values of one point of a sweep as they appear in the table."""
    return [c.cells[i] for c, i in zip(columns, point.place, strict=True)]


def _range_of(values: Sequence[float]) -> str:
    return f"{values[0]:.4g}" if len(values) == 1 else f"{min(values):.3g} … {max(values):.3g}"


def cell_text(cell: Any) -> str:
    """Return a table cell as text; a float has at most six significant digits."""
    return f"{cell:.6g}" if isinstance(cell, float) else str(cell)
