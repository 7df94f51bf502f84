"""The table on the screen while a sweep runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from neusee.workflows.report.console import Mode, ProgressTable
from neusee.workflows.sweeps.sweep_table import AxisColumn, cell_text, headline, lasts, point_cells

if TYPE_CHECKING:
    from neusee.workflows.engine.runner import Event
    from neusee.workflows.sweeps.axes import Point
    from neusee.workflows.sweeps.sweep_points import PointOutcome

_NUMBERS = 4  #: columns of numbers on the screen
_LAST = 25  #: points in a live table


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
        widest = [max(map(len, (c.header, *map(cell_text, c.cells)))) for c in columns]
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
        values = map(cell_text, point_cells(outcome.point, self.columns))
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
