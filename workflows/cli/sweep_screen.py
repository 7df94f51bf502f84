"""The screen of ``neusee sweep``: the table of a running sweep, and the lines before and after
the table.
"""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neusee.workflows.cli.command_frame import option_words, say_json, say_line
from neusee.workflows.cli.commands_and_exit_codes import DONE, FAILED, INTERRUPTED
from neusee.workflows.report.console import Mode, ProgressTable, mode_for
from neusee.workflows.report.terminal_text import lasts
from neusee.workflows.store.result_store import Store
from neusee.workflows.sweeps.axes import read_words
from neusee.workflows.sweeps.sweep_points import OnError, PointOutcome, outcomes
from neusee.workflows.sweeps.sweep_run import (
    AxisColumn,
    Sweep,
    Sweeping,
    SweepState,
    cell_text,
    counted,
    headline,
    point_cells,
    require_xarray,
    write_sweep,
)

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Event
    from neusee.workflows.sweeps.axes import Point

_NUMBERS = 4  #: results in the row of a point
_LAST = 25  #: points in a live table
#: default values of options, which the command line of a sweep omits
_USUAL = {"on-error": "stop", "device": "cpu", "out": Path("runs")}


@dataclass(frozen=True)
class SweepCommandOptions:
    """The options of ``neusee sweep``."""

    zip: bool = False  #: pair the values of the axes in place of combining them
    on_error: OnError = "stop"  #: what follows a failed point
    netcdf: bool = False  #: write ``sweep.nc`` too
    device: str = "cpu"
    workers: int = 0  #: points that run at the same time; 0: by free processors
    out: Path = Path("runs")  #: folder of the folders of results
    quiet: bool = False  #: print the path of the table alone
    as_json: bool = False  #: print the result as one JSON object, and nothing else

    def words(self) -> list[str]:
        """Return the words of the options that differ from the defaults, for a command that repeats
        the sweep.
        """
        values = {
            "zip": self.zip,
            "netcdf": self.netcdf,
            "on-error": self.on_error,
            "device": self.device,
            "out": self.out,
        }
        return option_words(
            {name: value for name, value in values.items() if value != _USUAL.get(name)}
        )


def run_sweep(
    recipe: str,
    words: Sequence[str],
    store: Store,
    options: SweepCommandOptions = SweepCommandOptions(),
    first: int = 2,
) -> int:
    """Run, show and write a sweep to ``out/sweeps/<date>_<recipe>_<key>/``; return the exit code of
    the command.

    ``words`` are the changes and axes; the first of them is argument ``first`` of the command line.
    Raises: RecipeError with every mistake of every point, before anything runs.
    """
    if options.netcdf:
        require_xarray("--netcdf")
    start_time, folder = time.perf_counter(), Path().absolute()
    axes_and_changes = read_words(words, folder, first)
    sweeping = Sweeping(recipe, axes_and_changes, folder, store, options.zip, options.device)
    command_line = ["neusee", "sweep", recipe, *words, *options.words()]
    silent = options.quiet or options.as_json
    if not silent:
        print(*_opening(sweeping), sep="\n", flush=True)
    outcomes_so_far, state, error = _run_points(
        sweeping, options.on_error, silent, sweeping.workers(options.workers)
    )
    # a failed last point has said why the sweep stopped
    if error is not None and not (
        options.on_error == "stop" and outcomes_so_far and outcomes_so_far[-1].state == "failed"
    ):
        raise error
    result = sweeping.sweep(outcomes_so_far, state)
    path = write_sweep(
        sweeping,
        result,
        command_line,
        options.out,
        options.netcdf,
        time.perf_counter() - start_time,
    )
    if silent:
        _say_briefly(result, path, command_line, options.as_json)
    else:
        print(
            *_closing(
                result, path, command_line, time.perf_counter() - start_time, sweeping.store.failure
            ),
            sep="\n",
            flush=True,
        )
    return _exit_code(result)


def _exit_code(result: Sweep) -> int:
    if result.state == "interrupted":
        return INTERRUPTED
    return FAILED if result.failed else DONE


def _say_briefly(result: Sweep, path: Path, command_line: Sequence[str], as_json: bool) -> None:
    """Print the path of the table of a sweep, or its document as JSON, and the failures on
    stderr.
    """
    for line in _failures(result):
        print(line, file=sys.stderr)
    if as_json:
        say_json(_document(result, path, command_line))
    else:
        say_line(str(path / "sweep.csv"))


def _document(result: Sweep, path: Path, command_line: Sequence[str]) -> dict[str, Any]:
    """Return the result of a sweep for ``--json``: its table, its state, and every number of
    every point.
    """
    return {
        "table": str(path / "sweep.csv"),
        "command": shlex.join(command_line),
        "recipe": result.recipe,
        "state": result.state,
        "points": result.points,
        "failed": [
            {"point": outcome.point.number, "step": outcome.step, "message": outcome.message}
            for outcome in result.failed
        ],
        "rows": result.rows,
    }


def _opening(work: Sweeping) -> Iterator[str]:
    """Yield the lines that appear on the screen before a sweep starts."""
    recipe, shared = work.plan.recipe, work.sharing
    sizes = f" {'+' if work.paired else '×'} ".join(
        f"{axis.name}: {len(axis.coordinates)}" for axis in work.axes
    )
    yield f"neusee sweep: {recipe.title or recipe.name}"
    yield f"checked  {shared.points} points ({sizes}), {shared.steps} steps: all right"
    yield (
        f"shared   {shared.made} different results: {100 * shared.saved:.0f} % less work than point"
        " by point"
    )
    if work.plan.costs and any(work.plan.work):
        yield f"time     about {lasts(sum(work.plan.work))}, as earlier runs took"
    yield from (f"note     {line}" for line in work.plan.notes)


def _run_points(
    work: Sweeping, on_error: OnError, quiet: bool, workers: int
) -> tuple[list[PointOutcome], SweepState, Exception | None]:
    """Run a sweep and show its progress; return the outcome of each parameter set, also after
    Ctrl-C or a failure.
    """
    table = SweepTable(work.columns, len(work.plan.checked), mode_for(quiet))
    running_points = outcomes(work.plan, work.store, on_error, table.started, table.watch, workers)
    try:
        with table, closing(running_points):
            for outcome in running_points:
                table.finished(outcome)
    except KeyboardInterrupt:
        return table.outcomes, "interrupted", None
    except Exception as error:
        return table.outcomes, "stopped", error
    return table.outcomes, "complete", None


def _closing(
    result: Sweep, path: Path, command_line: Sequence[str], seconds: float, failure: str
) -> Iterator[str]:
    """Yield the lines that appear on the screen after the end of a sweep."""
    yield ""
    yield f"{counted(result)}  ({lasts(seconds)})"
    yield from (f"  {line}" for line in _failures(result))
    yield f"table    {path / 'sweep.csv'}"
    if failure:
        yield f"warning  {failure}"
    if result.state != "complete":
        state = "nothing is kept in the cache" if failure else "what is done is kept"
        yield f"partial: {state}; to go on: {shlex.join(command_line)}"


def _failures(result: Sweep) -> Iterator[str]:
    """Yield a line for each failed point, with the first line of its error."""
    for outcome in result.failed:
        yield (
            f"failed: point {outcome.point.number}, {outcome.point.shown}:"
            f" {outcome.message.splitlines()[0]}"
        )


class SweepTable(ProgressTable):
    """The table of a sweep on the screen, with one row for each finished parameter set."""

    def __init__(self, columns: Sequence[AxisColumn], points: int, mode: Mode) -> None:
        super().__init__(mode)
        self.columns, self.points = columns, points
        self.outcomes: list[PointOutcome] = []
        self.running: Point | None = None
        self.step = ""
        self.lines = list[list[str]]()
        self.header = [
            "done",
            "point",
            *(column.header for column in columns),
            "state",
            "seconds",
            "left",
            "results",
        ]
        value_widths = [
            max(map(len, (column.header, *map(cell_text, column.cells)))) for column in columns
        ]
        digits = len(str(points))
        # in the order of the header
        self.widths = [max(4, 2 * digits + 1), max(5, digits), *value_widths, 6, 8, 12, 0]

    def started(self, point: Point) -> None:
        """Record that the run of a parameter set of the sweep begins."""
        self.running, self.step = point, ""

    def watch(self, event: Event) -> None:
        """Record that a step of a sweep begins or ends, for the parameter set that is being
        computed.
        """
        self.step = event.step if event.done is None else ""

    def finished(self, outcome: PointOutcome) -> None:
        """Record the outcome of a parameter set and show its row in the table."""
        self.outcomes.append(outcome)
        self.running = None
        self.lines.append(self.cells(outcome))
        self.show_row(self.lines[-1])
        if outcome.state == "failed":
            lines = [f"  {line}" for line in outcome.message.splitlines()]
            self.show_error(
                lines, f"point {outcome.point.number}: {outcome.point.shown}\n{outcome.message}"
            )

    def cells(self, outcome: PointOutcome) -> list[str]:
        """Return the table row of a parameter set: number, values, state, seconds, remaining
        time and first results.
        """
        values = map(cell_text, point_cells(outcome.point, self.columns))
        numbers = list(headline(outcome.numbers).items())[:_NUMBERS]
        results = "  ".join(f"{name} {value}" for name, value in numbers)
        done_text = f"{len(self.outcomes)}/{self.points}"
        time_left = lasts(outcome.left) if outcome.left else ""
        return [
            done_text,
            str(outcome.point.number),
            *values,
            outcome.state,
            f"{outcome.seconds:.3f}",
            time_left,
            results,
        ]

    def live_rows(self) -> Iterator[tuple[list[str], str]]:
        """Yield the table rows of the last parameter sets, each with its state."""
        # behind the two columns before the values
        state_column = len(self.columns) + 2
        yield from ((line, line[state_column]) for line in self.lines[-_LAST:])

    def caption(self) -> str:
        """Return the number of the running parameter set, its running step, and the remaining
        time as text.
        """
        if self.running is None:
            return ""
        seconds_left = self.outcomes[-1].left if self.outcomes else 0.0
        time_text = f"about {lasts(seconds_left)} left" if seconds_left else ""
        point = f"point {len(self.outcomes) + 1} of {self.points}: {self.running.shown}"
        return "; ".join(filter(None, (point, self.step, time_text)))
