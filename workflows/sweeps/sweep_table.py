"""The table of a sweep: its columns, its rows for a file, and the words of its cells."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from neusee.nodes import units

if TYPE_CHECKING:
    from neusee.workflows.sweeps.axes import Axis, Point
    from neusee.workflows.sweeps.sweep_points import Number, Outcome

AFTER = ("status", "step", "field", "index", "value", "seconds", "cached", "message")  #: columns after the axes


@dataclass(frozen=True, slots=True)
class Column:
    """An axis as a column: with its unit in the header where all its values have one."""

    name: str
    header: str
    cells: tuple[Any, ...]  #: by place on the axis
    si: tuple[Any, ...]
    unit: str  #: of ``si``; empty for pure numbers and for words


def column(axis: Axis) -> Column:
    """Numbers in the unit that they are written in, or in SI if they are written in several; words as they are."""
    values = [c.value for c in axis.coordinates]
    found = [q for q in map(_quantity, values) if q is not None]
    header = f"{axis.name} (axis)" if axis.name in ("point", *AFTER) else axis.name
    if len(found) == len(values) and len({q.si_unit for q in found}) == 1:
        si, unit, written = tuple(q.si for q in found), found[0].si_unit, {q.unit for q in found}
        cells = tuple(q.number for q in found) if len(written) == 1 else si
        return Column(axis.name, f"{header} ({found[0].unit if len(written) == 1 else unit})", cells, si, unit)
    if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        return Column(axis.name, header, tuple(values), tuple(map(float, values)), "")
    words = tuple(c.shown for c in axis.coordinates)
    return Column(axis.name, header, words, words, "")


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


def header(columns: Sequence[Column]) -> list[str]:
    return ["point", *(c.header for c in columns), *AFTER]


def rows_of(outcome: Outcome, columns: Sequence[Column]) -> Iterator[list[Any]]:
    """One row for each number of a point; one for a point that failed or has no numbers."""
    where = [outcome.point.number, *point_cells(outcome.point, columns)]
    status = "failed" if outcome.state == "failed" else "ok"
    last = [round(outcome.seconds, 6), outcome.state == "cached", outcome.message]
    for number in outcome.numbers or ((outcome.step, "", "", ""),):
        yield [*where, status, *number, *last]


def headline(numbers: Sequence[Number]) -> dict[str, str]:
    """Every result in a word: a number alone, or the least and the largest of several; single numbers first."""
    found: dict[str, list[float]] = {}
    for step, part, _, value in numbers:
        found.setdefault(f"{step}.{part}".rstrip("."), []).append(value)
    said = {name: _said(values) for name, values in found.items()}
    return dict(sorted(said.items(), key=lambda item: len(found[item[0]]) > 1))


def wide(outcomes: Sequence[Outcome], columns: Sequence[Column]) -> list[list[str]]:
    """One row a point below a row of headers: its place, its results, its state and its seconds."""
    results = [headline(outcome.numbers) for outcome in outcomes]
    names = list(dict.fromkeys(name for result in results for name in result))
    rows = [["point", *(c.header for c in columns), *names, "state", "seconds"]]
    for outcome, result in zip(outcomes, results, strict=True):
        cells = [cell_text(cell) for cell in point_cells(outcome.point, columns)]
        values = [result.get(name, "") for name in names]
        rows.append([str(outcome.point.number), *cells, *values, outcome.state, f"{outcome.seconds:.3f}"])
    return rows


def point_cells(point: Point, columns: Sequence[Column]) -> list[Any]:
    """Return the values of a point on the axes."""
    return [c.cells[i] for c, i in zip(columns, point.place, strict=True)]


def _said(values: Sequence[float]) -> str:
    return f"{values[0]:.4g}" if len(values) == 1 else f"{min(values):.3g} … {max(values):.3g}"


def cell_text(cell: Any) -> str:
    """Return a value of an axis as a table shows it."""
    return f"{cell:.6g}" if isinstance(cell, float) else str(cell)


def lasts(seconds: float) -> str:
    """``3 h 05 min``, ``2 min 10 s``, ``4 s``."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02} min"
    return f"{whole // 60} min {whole % 60:02} s" if whole >= 60 else f"{whole} s"
