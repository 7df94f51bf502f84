"""What a terminal shows while a sweep runs: a table that fills, one line a point, or nothing."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from neusee.workflows.sweeps.sweep_table import Column, cell_text, headline, lasts, point_cells

if TYPE_CHECKING:
    from neusee.workflows.graph.step_record import Event
    from neusee.workflows.sweeps.axes import Point
    from neusee.workflows.sweeps.sweep_points import Outcome

_NUMBERS = 4  #: columns of numbers that a screen shows
_LAST = 25  #: points that a live table shows


@dataclass
class Silent:
    """Shows nothing."""

    columns: Sequence[Column]
    points: int
    outcomes: list[Outcome] = field(default_factory=list)
    running: Point | None = None
    step: str = ""

    def __enter__(self) -> Silent:
        return self

    def __exit__(self, *error: object) -> None:
        return None

    def started(self, point: Point) -> None:
        """A point begins."""
        self.running, self.step = point, ""

    def watch(self, event: Event) -> None:
        """A step of it begins or ended."""
        self.step = event.step if event.done is None else ""

    def finished(self, outcome: Outcome) -> None:
        """A point ended."""
        self.outcomes.append(outcome)
        self.running = None

    def cells(self, outcome: Outcome) -> list[str]:
        """One row: which of how many, the values, state, seconds, the first numbers, and the time that is left."""
        values = map(cell_text, point_cells(outcome.point, self.columns))
        numbers = list(headline(outcome.numbers).items())[:_NUMBERS]
        said = "  ".join(f"{name} {value}" for name, value in numbers)
        where, left = f"{len(self.outcomes)}/{self.points}", lasts(outcome.left) if outcome.left else ""
        return [where, str(outcome.point.number), *values, outcome.state, f"{outcome.seconds:.3f}", left, said]

    @property
    def headers(self) -> list[str]:
        return ["done", "point", *(c.header for c in self.columns), "state", "seconds", "left", "results"]


class Plain(Silent):
    """One line a point."""

    def __enter__(self) -> Plain:
        widest = [max(map(len, (c.header, *map(cell_text, c.cells)))) for c in self.columns]
        count = len(str(self.points))
        self.widths = [max(4, 2 * count + 1), max(5, count), *widest, 6, 8, 12, 0]
        self._say(self.headers)
        return self

    def finished(self, outcome: Outcome) -> None:
        super().finished(outcome)
        self._say(self.cells(outcome))
        if outcome.state == "failed":
            print(*(f"  {line}" for line in outcome.message.splitlines()), sep="\n", flush=True)

    def _say(self, cells: Sequence[str]) -> None:
        line = "  ".join(f"{cell:<{width}}" for cell, width in zip(cells, self.widths, strict=True))
        print(f"  {line}".rstrip(), flush=True)


class Live(Silent):
    """A table that fills; failures stay above it."""

    def __enter__(self) -> Live:
        from rich.live import Live as RichLive

        self.lines = list[list[str]]()
        self.live = RichLive(self, refresh_per_second=8, vertical_overflow="visible")
        self.live.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.live.stop()

    def finished(self, outcome: Outcome) -> None:
        super().finished(outcome)
        self.lines.append(self.cells(outcome))
        if outcome.state == "failed":
            told = f"point {outcome.point.number}: {outcome.point.shown}\n{outcome.message}"
            self.live.console.print(told, style="red", markup=False, highlight=False)

    def __rich__(self) -> Any:
        from rich import box
        from rich.table import Table

        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, header_style="bold")
        for name in self.headers:
            table.add_column(name, overflow="fold")
        state = len(self.columns) + 2
        for line in self.lines[-_LAST:]:
            table.add_row(*line, style={"run": "bold", "cached": "cyan", "failed": "red"}[line[state]])
        if self.running is not None:
            left = self.outcomes[-1].left if self.outcomes else 0.0
            about = [f"about {lasts(left)} left"] if left else []
            now = [f"point {len(self.outcomes) + 1} of {self.points}: {self.running.shown}", *filter(None, [self.step])]
            table.caption = "; ".join(now + about)
        return table


def screen(columns: Sequence[Column], points: int, silent: bool) -> Silent:
    """The display that fits where the output goes."""
    if silent:
        return Silent(columns, points)
    return Live(columns, points) if sys.stdout.isatty() else Plain(columns, points)
