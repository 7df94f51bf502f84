"""Screen output of a run: a table of the steps, updated during the run if stdout is a terminal, and
the result table.

Copies of a step, such as ``spot[mask,green]`` and ``spot[mask,red]``, share a line. All steps whose
results no other step had to load share one line.
"""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.live import Live
from rich.segment import Segment

from neusee.workflows.graph.recipe_graph import Event, StepRecord, by_family
from neusee.workflows.report.run_page import shape_of, unchecked_lines, unit_of
from neusee.workflows.report.run_summary import SENTENCES
from neusee.workflows.report.terminal_text import indented, lasts, wrapped
from neusee.workflows.report.tolerance_spent import said_of_economies, said_of_errors

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Recipe


# --- a table that is drawn again several times a second -------------------------------------------
# It is never taller than the screen: a terminal cannot draw over lines that have left the screen,
# so a taller table would be printed at each refresh.

_HEAD = 3  #: lines above the first row: a blank line, the names of the columns and a rule


class LiveTable(Live):
    """A table that is drawn again eight times a second: its last rows while it changes, all of
    its rows at the end.
    """

    def __init__(self, table: RenderableType) -> None:
        super().__init__(
            get_renderable=lambda: LastRows(table) if self.is_started else table,
            refresh_per_second=8,
            vertical_overflow="visible",
        )

    def start(self, refresh: bool = False) -> None:
        """Start to draw in a thread, which gets a name of this program."""
        super().start(refresh)
        if self._refresh_thread is not None:
            self._refresh_thread.name = "neusee table"


class LastRows:
    """The names of the columns of a table, and as many of its last lines as the screen has room
    for.
    """

    def __init__(self, table: RenderableType) -> None:
        self.table = table

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        lines = console.render_lines(self.table, options, pad=False)
        # at least one row is shown
        hidden_lines = len(lines) - max(console.size.height, _HEAD + 1)
        for line in (
            lines if hidden_lines <= 0 else [*lines[:_HEAD], *lines[_HEAD + hidden_lines :]]
        ):
            yield from line
            yield Segment.line()


# --- the table of the steps of a run --------------------------------------------------------------

Mode = Literal["silent", "plain", "live"]
_STYLES = {"run": "bold", "cached": "cyan", "left out": "dim", "failed": "red"}  #: by state

HEADER = ("step", "where", "state", "seconds", "output", "check")
_WIDTHS = (5, 19, 9, 28, 0)  #: of the columns after the first


@dataclass
class Family:
    """All copies of one step, such as ``psf[plain]`` and ``psf[mask]``, and the records of the
    finished copies.
    """

    name: str
    members: list[str]
    unit: str
    done: list[StepRecord] = field(default_factory=list)
    begun: bool = False

    @property
    def needed(self) -> list[StepRecord]:
        """Return the records of the copies of the step that the run computed, loaded or left
        out.
        """
        return [copy for copy in self.done if copy.state != "not needed"]

    def cells(self) -> tuple[str, ...]:
        """Return the table row of all copies of a step, with the columns of `HEADER`."""
        needed_copies, count = self.needed, len(self.members)
        name = f"{self.name} ×{count}" if count > 1 else self.members[0]
        if not needed_copies:
            return name, "", "…" if self.begun else "", "", "", ""
        seconds_run = sum(copy.seconds for copy in needed_copies if copy.state == "run")
        # of the copies with a known result the last, in the order of the recipe
        last_copy = max(
            needed_copies, key=lambda d: (d.facts is not None, self.members.index(d.step))
        )
        # a copy with a failed check comes first
        shown_copy = next(
            (copy for copy in needed_copies if not all(check.ok for check in copy.checks)),
            last_copy,
        )
        seconds = f"{seconds_run:.3f}" if seconds_run else ""
        return (
            name,
            shown_copy.device,
            self.state(),
            seconds,
            self._output(last_copy),
            self._check(shown_copy),
        )

    def _output(self, last: StepRecord) -> str:
        """Return the shape of a result with its unit, or an empty text."""
        shape = shape_of(last)
        return f"{shape} {self.unit}".strip() if shape else ""

    def _check(self, shown: StepRecord) -> str:
        """Return the texts of the checks of a copy, and why the first copy ran or was left out."""
        check_texts = "; ".join(
            ("" if check.ok else "LOOK: ") + check.text for check in shown.checks
        )
        reasons = (
            copy.why for copy in self.needed if copy.state in ("run", "left out") and copy.why
        )
        reason = next(reasons, "")
        return f"{check_texts}  ({reason})" if check_texts and reason else check_texts or reason

    def state(self) -> str:
        """Return the common state of all copies of a step, such as ``run``, or the number of
        copies in each state.
        """
        states = Counter(str(copy.state) for copy in self.done)
        return (
            "".join(states)
            if len(states) == 1
            else ", ".join(f"{count} {state_name}" for state_name, count in states.items())
        )


def mode_for(silent: bool) -> Mode:
    """Return how a table is printed: ``silent`` on request, ``live`` (updated) on a terminal,
    else ``plain`` lines.
    """
    if silent:
        return "silent"
    return "live" if sys.stdout.isatty() else "plain"


class ProgressTable(ABC):
    """A table on the screen that shows the progress of the code in a ``with`` block."""

    header: Sequence[str]
    widths: Sequence[int]  #: least widths of the columns of plain lines
    numbers: Sequence[str] = ()  #: columns that are aligned right

    def __init__(self, mode: Mode) -> None:
        self.mode = mode
        self._lines: list[str] = []  #: that were printed

    @abstractmethod
    def live_rows(self) -> Iterable[tuple[Sequence[str], str]]:
        """Return the cells and the state of each row of a table that is updated on the terminal."""

    @abstractmethod
    def caption(self) -> str:
        """Return the line of text below a table that is updated on the terminal."""

    def __enter__(self) -> Self:
        if self.mode == "live":
            self._live = LiveTable(self)
            self._live.start()
        self.show_row(self.header)
        return self

    def __exit__(self, *error: object) -> None:
        if self.mode == "live":
            self._live.stop()

    def show_row(self, cells: Sequence[str]) -> None:
        """Print a finished row as a line of text; do nothing if the table is updated on a
        terminal.
        """
        if self.mode != "plain":
            return
        columns = zip(self.header, cells, self.widths, strict=True)
        padded_cells = [
            f"{cell:{'>' if name in self.numbers else '<'}{width}}" for name, cell, width in columns
        ]
        self._print("  " + "  ".join(padded_cells).rstrip())

    def _print(self, line: str) -> None:
        """Print a line, and keep it for `printed`."""
        self._lines.append(line)
        print(line, flush=True)

    def printed(self) -> list[str]:
        """Return the lines of the finished table as they stand on the screen."""
        if self.mode != "live":
            return self._lines
        from rich.console import Console

        text, screen = StringIO(), self._live.console
        Console(file=text, force_terminal=True, width=screen.width, height=screen.height).print(
            self
        )
        return text.getvalue().removesuffix("\n").split("\n")

    def show_error(self, plain: Iterable[str], live: str) -> None:
        """Print an error: the lines ``plain`` to a file or pipe, or the text ``live`` above a
        table on a terminal.
        """
        if self.mode == "plain":
            print(*plain, sep="\n", flush=True)
        elif self.mode == "live":
            self._live.console.print(live, style="red", markup=False, highlight=False)

    def __rich__(self) -> Any:
        from rich import box
        from rich.table import Table

        table = Table(
            box=box.SIMPLE_HEAD, pad_edge=False, header_style="bold", caption=self.caption() or None
        )
        for name in self.header:
            table.add_column(
                name, justify="right" if name in self.numbers else "left", overflow="fold"
            )
        for cells, state in self.live_rows():
            table.add_row(*cells, style=_STYLES.get(state, ""))
        return table


class RunTable(ProgressTable):
    """Table of the steps of a run; outside a terminal, a step is printed when all its copies are
    finished.
    """

    header, numbers = HEADER, ("seconds",)

    def __init__(
        self,
        recipe: Recipe,
        names: Iterable[str],
        mode: Mode,
        predicted: Mapping[str, float] | None = None,
    ) -> None:
        """Make the table of the steps ``names``; ``predicted`` has the seconds that steps took in
        earlier runs.
        """
        super().__init__(mode)
        self._seconds_of_steps_left = dict(predicted or {})
        self.families = families(recipe, names)
        self.widths = (
            max((len(family.cells()[0]) for family in self.families.values()), default=0),
            *_WIDTHS,
        )

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        if self.mode == "plain" and self.caption():
            self._print(f"  {self.caption()}")

    def watch(self, event: Event) -> None:
        """Update the table of steps with the start or the end of a step."""
        if event.done is not None:
            self._seconds_of_steps_left.pop(event.step, None)
        family = note(self.families, event)
        if event.done is not None and family.needed and len(family.done) == len(family.members):
            self.show_row(family.cells())

    def live_rows(self) -> Iterator[tuple[tuple[str, ...], str]]:
        """Yield the table cells and the state of each step that has begun."""
        for family in self.families.values():
            if family.begun or family.needed:
                cells = family.cells()
                # cell 5: the checks; cell 2: the state
                yield cells, "failed" if "LOOK" in cells[5] else cells[2]

    @property
    def finished(self) -> int:
        """Return the number of steps that the run has computed or loaded so far."""
        return sum(copy.state in ("run", "cached") for copy in self._done())

    def _done(self) -> Iterator[StepRecord]:
        """Yield the records of the finished copies of all steps."""
        for family in self.families.values():
            yield from family.done

    def caption(self) -> str:
        """Return the remaining time, or at the end the number of steps that were neither computed
        nor loaded.
        """
        if (seconds_left := sum(self._seconds_of_steps_left.values())) >= 1:
            return f"about {lasts(seconds_left)} left, as earlier runs took"
        count = sum(copy.state == "not needed" for copy in self._done())
        steps = "1 step was" if count == 1 else f"{count} steps were"
        return f"{steps} not needed: the results that need them are in the cache" if count else ""


def families(recipe: Recipe, names: Iterable[str]) -> dict[str, Family]:
    """Group the steps of a run by the name before the bracket, in running order: ``psf[mask]``
    belongs to ``psf``.
    """
    return {
        short: Family(short, members, unit_of(recipe.steps[members[0]].node.__doc__ or ""))
        for short, members in by_family(names).items()
    }


def note(families: dict[str, Family], event: Event) -> Family:
    """Add the start or the end of one copy of a step to the group of all copies, and return this
    group.

    A second attempt of a run may have steps that the first attempt did not have.
    """
    family_name = event.step.partition("[")[0]
    family = families.setdefault(family_name, Family(family_name, [], ""))
    if event.step not in family.members:
        family.members.append(event.step)
    if event.done is None:
        family.begun = True
    else:
        # a second attempt replaces the record of the first
        family.done = [*(copy for copy in family.done if copy.step != event.step), event.done]
    return family


def forecast_line(seconds: float, steps: int, unknown: int, measured: int) -> str:
    """Return a line with the predicted time of ``steps`` steps, of which ``unknown`` have no law
    and ``measured`` ran before on this processor.
    """
    new_steps = f"; {unknown} of {steps} steps have no law of their time" if unknown else ""
    source = "as earlier runs took" if measured else "a guess by laws"
    return f"time     about {lasts(seconds)}, {source}{new_steps}"


def closing(
    doc: Mapping[str, Any], path: str, next_commands: Sequence[str], took: str = ""
) -> list[str]:
    """Return the lines to print after a run: steps left out, result table, gain by the mask,
    verdict, next commands.

    ``took`` stands in place of the seconds of the document.
    """
    took = took or f"{doc['seconds']:.2f}"
    lines = [*_error_lines(doc), *_table_lines(doc["table"]), *story_lines(doc)]
    lines += ["", f"{doc['verdict']}  ({doc['counts']}, {took} s)"]
    lines += [
        f"  missed: {e['name']} = {e['found']:.5g}, expected {e['wanted']:.5g} ±"
        f" {100 * e['rtol']:.2g} %"
        for e in doc["expected"]
        if not e["ok"]
    ]
    lines += [f"  {line}" for line in unchecked_lines(doc["unchecked"])]
    lines += [f"warning  {line}" for line in doc["warnings"]]
    has_overview = any(figure["name"] == "overview" for figure in doc["figures"])
    lines += [f"pictures {Path(path).parent / 'figures' / 'overview.png'}"] if has_overview else []
    return [*lines, f"report   {path}", "", "next", *[f"  {line}" for line in next_commands]]


def _error_lines(doc: Mapping[str, Any]) -> list[str]:
    """Return the lines on cheaper steps, steps left out, and the errors of outputs and of bands."""
    lines = [said_of_economies(doc["spent"])] if doc["spent"]["economies"] else []
    lines += [left_out_line(doc)] if doc["left_out"] else []
    # errors of the outputs, if cheaper or omitted steps can cause any
    lines += [said_of_errors(doc["spent"])] if lines else []
    lines += [doc["spectral"]["said"]] if doc.get("spectral") else []
    return lines


def _table_lines(results: Mapping[str, Any]) -> list[str]:
    """Return the result table with its legend, after an empty line."""
    rows = [[row["name"], *row["cells"]] for row in results["rows"]]
    lines = ["", *indented([["", *results["columns"]], *rows])] if rows else []
    for text in results["legend"]:
        lines += wrapped(text)
    return lines


def story_lines(doc: Mapping[str, Any]) -> list[str]:
    """Return the sentences on the benefit and cost of the mask, after an empty line and no wider
    than the terminal.
    """
    lines: list[str] = []
    for name in SENTENCES:
        if name in doc["story"]:
            lines += wrapped(doc["story"][name])
    return ["", *lines] if lines else []


def left_out_line(doc: Mapping[str, Any]) -> str:
    """Return one line with the steps that a run left out, and the bounds or estimates of what
    each changes.
    """
    bound_of_family: dict[str, float] = {}
    estimated = {
        omission["step"].partition("[")[0]
        for omission in doc["spent"]["left_out"]
        if omission["estimated"]
    }
    for omission in doc["left_out"]:
        family_name = omission["step"].partition("[")[0]
        bound_of_family[family_name] = max(
            bound_of_family.get(family_name, 0.0), omission["bound"] or 0.0
        )
    steps_with_bounds = [
        f"{name} ({'estimated' if name in estimated else 'at most'} {bound:.1e})"
        for name, bound in bound_of_family.items()
    ]
    return f"left out {', '.join(steps_with_bounds)}; tolerance {doc['tolerance']:g}"
