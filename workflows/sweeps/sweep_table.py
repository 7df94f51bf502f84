"""The table of a sweep: its columns, its rows for a file, and what a terminal shows while it runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from neusee.nodes import units
from neusee.workflows.report.progress_table import Mode, ProgressTable

if TYPE_CHECKING:
    from neusee.workflows.engine.runner import Event
    from neusee.workflows.sweeps.axes import Axis, Point
    from neusee.workflows.sweeps.sweep_points import PointOutcome, ResultNumber

AFTER = ("status", "step", "field", "index", "value", "seconds", "cached", "message")  #: columns after the axes
_NUMBERS = 4  #: columns of numbers that a screen shows
_LAST = 25  #: points that a live table shows


@dataclass(frozen=True, slots=True)
class AxisColumn:
    """An axis as a column: with its unit in the header where all its values have one."""

    name: str
    header: str
    cells: tuple[Any, ...]  #: by place on the axis
    si: tuple[Any, ...]
    unit: str  #: of ``si``; empty for pure numbers and for words


def column(axis: Axis) -> AxisColumn:
    """Numbers in the unit that they are written in, or in SI if they are written in several; words as they are."""
    values = [c.value for c in axis.coordinates]
    found = [q for q in map(_quantity, values) if q is not None]
    header = f"{axis.name} (axis)" if axis.name in ("point", *AFTER) else axis.name
    if len(found) == len(values) and len({q.si_unit for q in found}) == 1:
        si, unit, written = tuple(q.si for q in found), found[0].si_unit, {q.unit for q in found}
        cells = tuple(q.number for q in found) if len(written) == 1 else si
        return AxisColumn(axis.name, f"{header} ({found[0].unit if len(written) == 1 else unit})", cells, si, unit)
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
    return ["point", *(c.header for c in columns), *AFTER]


def rows_of(outcome: PointOutcome, columns: Sequence[AxisColumn]) -> Iterator[list[Any]]:
    """One row for each number of a point; one for a point that failed or has no numbers."""
    where = [outcome.point.number, *_cells(outcome.point, columns)]
    status = "failed" if outcome.state == "failed" else "ok"
    last = [round(outcome.seconds, 6), outcome.state == "cached", outcome.message]
    for number in outcome.numbers or ((outcome.step, "", "", ""),):
        yield [*where, status, *number, *last]


def headline(numbers: Sequence[ResultNumber]) -> dict[str, str]:
    """Every result in a word: a number alone, or the least and the largest of several; single numbers first."""
    found: dict[str, list[float]] = {}
    for step, part, _, value in numbers:
        found.setdefault(f"{step}.{part}".rstrip("."), []).append(value)
    said = {name: _said(values) for name, values in found.items()}
    return dict(sorted(said.items(), key=lambda item: len(found[item[0]]) > 1))


def wide(outcomes: Sequence[PointOutcome], columns: Sequence[AxisColumn]) -> list[list[str]]:
    """One row a point below a row of headers: its place, its results, its state and its seconds."""
    results = [headline(outcome.numbers) for outcome in outcomes]
    names = list(dict.fromkeys(name for result in results for name in result))
    rows = [["point", *(c.header for c in columns), *names, "state", "seconds"]]
    for outcome, result in zip(outcomes, results, strict=True):
        cells = [_text(cell) for cell in _cells(outcome.point, columns)]
        values = [result.get(name, "") for name in names]
        rows.append([str(outcome.point.number), *cells, *values, outcome.state, f"{outcome.seconds:.3f}"])
    return rows


def _cells(point: Point, columns: Sequence[AxisColumn]) -> list[Any]:
    return [c.cells[i] for c, i in zip(columns, point.place, strict=True)]


def _said(values: Sequence[float]) -> str:
    return f"{values[0]:.4g}" if len(values) == 1 else f"{min(values):.3g} … {max(values):.3g}"


def _text(cell: Any) -> str:
    return f"{cell:.6g}" if isinstance(cell, float) else str(cell)


def lasts(seconds: float) -> str:
    """``3 h 05 min``, ``2 min 10 s``, ``4 s``."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02} min"
    return f"{whole // 60} min {whole % 60:02} s" if whole >= 60 else f"{whole} s"


# --- on the screen --------------------------------------------------------------------------------------------------


class SweepTable(ProgressTable):
    """The points of a sweep, one row for each that ended."""

    def __init__(self, columns: Sequence[AxisColumn], points: int, mode: Mode) -> None:
        super().__init__(mode)
        self.columns, self.points = columns, points
        self.outcomes: list[PointOutcome] = []
        self.running: Point | None = None
        self.step = ""
        self.lines = list[list[str]]()
        self.header = ["done", "point", *(c.header for c in columns), "state", "seconds", "left", "results"]
        widest = [max(map(len, (c.header, *map(_text, c.cells)))) for c in columns]
        count = len(str(points))
        self.widths = [max(4, 2 * count + 1), max(5, count), *widest, 6, 8, 12, 0]

    def started(self, point: Point) -> None:
        """Note that a point begins."""
        self.running, self.step = point, ""

    def watch(self, event: Event) -> None:
        """Note that a step of the point begins or ended."""
        self.step = event.step if event.done is None else ""

    def finished(self, outcome: PointOutcome) -> None:
        """Note what became of a point, and show its row."""
        self.outcomes.append(outcome)
        self.running = None
        self.lines.append(self.cells(outcome))
        self.show_row(self.lines[-1])
        if outcome.state == "failed":
            lines = [f"  {line}" for line in outcome.message.splitlines()]
            self.show_error(lines, f"point {outcome.point.number}: {outcome.point.shown}\n{outcome.message}")

    def cells(self, outcome: PointOutcome) -> list[str]:
        """Return one row: which of how many, the values, state, seconds, the time that is left, the first numbers."""
        values = map(_text, _cells(outcome.point, self.columns))
        numbers = list(headline(outcome.numbers).items())[:_NUMBERS]
        results = "  ".join(f"{name} {value}" for name, value in numbers)
        where, left = f"{len(self.outcomes)}/{self.points}", lasts(outcome.left) if outcome.left else ""
        return [where, str(outcome.point.number), *values, outcome.state, f"{outcome.seconds:.3f}", left, results]

    def live_rows(self) -> Iterator[tuple[list[str], str]]:
        """Return the last points."""
        state = len(self.columns) + 2
        yield from ((line, line[state]) for line in self.lines[-_LAST:])

    def caption(self) -> str:
        """Return which point runs, its step, and the time that is left."""
        if self.running is None:
            return ""
        left = self.outcomes[-1].left if self.outcomes else 0.0
        about = f"about {lasts(left)} left" if left else ""
        point = f"point {len(self.outcomes) + 1} of {self.points}: {self.running.shown}"
        return "; ".join(filter(None, (point, self.step, about)))
