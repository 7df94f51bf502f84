"""Parameter sweeps: runs of a recipe at every combination of the listed values, with all results in
one table.

    sweep("first_light", {"sensor.read_noise": ["5 e-", "10 e-"], "doe": ["axicon", "vortex"]})

Results are stored by key: a stopped sweep continues when the same sweep runs again, and results
that points share are computed once.
"""

from __future__ import annotations

import html
import os
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from neusee.workflows.engine.provenance import versions
from neusee.workflows.engine.worker_processes import workers_for
from neusee.workflows.graph.final_values import flow
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.recipe.text.overrides import Override
from neusee.workflows.report.run_folder import new_run
from neusee.workflows.report.terminal_text import indented
from neusee.workflows.store.remote_store import open_store
from neusee.workflows.store.result_store import Store
from neusee.workflows.sweeps.axes import Argument, Axis, points, read_axes, read_words
from neusee.workflows.sweeps.point_order import Sharing, sharing
from neusee.workflows.sweeps.sweep_points import (
    OnError,
    PointOutcome,
    SweepPlan,
    outcomes,
    plan_sweep,
)
from neusee.workflows.sweeps.sweep_table import (
    AxisColumn,
    column,
    dataset,
    header,
    require_xarray,
    rows_of,
    wide,
)

SweepState = Literal["complete", "stopped", "interrupted"]


@dataclass(frozen=True)
class Sweep:
    """Result of a sweep: the outcomes of the points that ran, in the order of the axes, the last
    axis fastest.
    """

    recipe: str
    title: str
    columns: tuple[AxisColumn, ...] = field(repr=False)
    outcomes: tuple[PointOutcome, ...] = field(repr=False)
    points: int
    sharing: Sharing = field(repr=False)
    paired: bool = False
    state: SweepState = "complete"

    @property
    def failed(self) -> tuple[PointOutcome, ...]:
        """Return the outcomes of the points of the sweep that failed."""
        return tuple(outcome for outcome in self.outcomes if outcome.state == "failed")

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Return the results of the sweep in long format, with one table row for each number of
        each point.
        """
        names = header(self.columns)
        rows: list[dict[str, Any]] = []
        for outcome in self.outcomes:
            numbers = rows_of(outcome, self.columns)
            rows += [dict(zip(names, row, strict=True)) for row in numbers]
        return rows

    def table(self) -> str:
        """Return the results of the sweep as a text table, with one line for each point."""
        return "\n".join(indented(wide(self.outcomes, self.columns)))

    def to_xarray(self) -> Any:
        """Return the results of the sweep as an `xarray.Dataset` in SI units, whose dimensions are
        the axes.

        The results of failed points are NaN.

        Raises: RecipeError if xarray is not installed.
        """
        require_xarray("to_xarray")
        attributes = {
            "recipe": self.recipe,
            "title": self.title,
            "neusee": versions()["neusee"],
            "state": self.state,
        }
        return dataset(self.outcomes, self.columns, self.paired, attributes)

    def _repr_html_(self) -> str:
        names, *rows = wide(self.outcomes, self.columns)
        head = "".join(f"<th>{html.escape(name)}</th>" for name in names)
        body = "".join(
            "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>"
            for row in rows
        )
        summary = html.escape(f"{self.title or self.recipe}: {counted(self)}")
        return f"<p>{summary}</p><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def sweep(
    recipe: str | os.PathLike[str],
    axes: Mapping[str, str | Iterable[Any]],
    overrides: Sequence[str | Override] = (),
    zip: bool = False,
    store: Store | None = None,
    on_error: OnError = "stop",
    device: str = "cpu",
    folder: str | os.PathLike[str] | None = None,
    workers: int = 0,
) -> Sweep:
    """Run ``recipe`` at every combination of axis values, or, with ``zip``, at the n-th values of
    all axes together.

    Args: axes: by parameter or group, a list of values, or a text as on the command line, such
    as ``"linspace(450 nm, 650 nm, 5)"``. overrides: changes that are the same at every point.
    on_error: ``"stop"`` raises the error of the first failed point, ``"continue"`` writes each
    error into its row. folder: the folder to which relative paths refer, by default the current
    folder. workers: the number of processes that run points at the same time; 0 means one for each
    processor that other work leaves free, and none beside threads of others, as in a notebook.

    Raises: RecipeError with every mistake of every point, before anything runs.
    """
    working_folder = Path(folder or ".").absolute()
    arguments = [*read_words(overrides, working_folder), *read_axes(axes, working_folder)]
    sweeping = Sweeping(
        os.fspath(recipe), arguments, working_folder, store or open_store(), zip, device
    )
    point_outcomes = outcomes(
        sweeping.plan, sweeping.store, on_error, device, workers=sweeping.workers(workers)
    )
    return sweeping.sweep(list(point_outcomes), "complete")


class Sweeping:
    """A sweep whose points are checked and ready to run."""

    def __init__(
        self,
        recipe: str,
        arguments: Sequence[Argument],
        folder: Path,
        store: Store,
        paired: bool,
        device: str,
    ) -> None:
        self.axes = [argument for argument in arguments if isinstance(argument, Axis)]
        self.fixed = [argument.text for argument in arguments if not isinstance(argument, Axis)]
        self.columns = tuple(map(column, self.axes))
        self.store, self.paired, self.device = store, paired, device
        self.plan: SweepPlan = plan_sweep(
            recipe, points(arguments, paired), folder, store, paired, device
        )
        self.sharing = sharing(self.plan.jobs, self.plan.costs)

    def workers(self, asked: int) -> int:
        """Return how many processes run the points, of which ``asked`` is a wish and 0 none; one
        beside a GPU.
        """
        return workers_for(len(self.plan.checked), asked) if self.device == "cpu" else 1

    def sweep(self, outcomes: Sequence[PointOutcome], state: SweepState) -> Sweep:
        """Return the result of the sweep, with the outcomes sorted by the number of the point."""
        recipe, sorted_outcomes = (
            self.plan.recipe,
            sorted(outcomes, key=lambda outcome: outcome.point.number),
        )
        count = len(self.plan.checked)
        return Sweep(
            recipe.name,
            recipe.title,
            self.columns,
            tuple(sorted_outcomes),
            count,
            self.sharing,
            self.paired,
            state,
        )


def write_sweep(
    work: Sweeping, result: Sweep, again: Sequence[str], out: Path, netcdf: bool, seconds: float
) -> Path:
    """Write the result folder of a sweep and return its path; the name of an unfinished sweep
    contains ``partial``.
    """
    name = f"{result.recipe}{'' if result.state == 'complete' else '_partial'}"
    keys: list[str] = []
    for checked in work.plan.checked:
        keys += [checked.job.keys[output] for output in checked.job.outputs]
    # the folder is named by all results of the sweep
    key = digest(keys)
    with new_run(out / "sweeps", name, key) as folder:
        folder.write_rows(
            "sweep.csv", header(result.columns), (list(row.values()) for row in result.rows)
        )
        title = f"{(result.title or result.recipe).rstrip('.')}: {counted(result)}"
        summary = folder.said = _account(work, result, again, seconds)
        lines = [f"# {title}\n", *(f"{key}: {flow(value)}\n" for key, value in summary.items())]
        folder.write("sweep.yaml", "".join(lines))
        if netcdf:
            result.to_xarray().to_netcdf(folder.path / "sweep.nc", engine="h5netcdf")
    return folder.path


def _account(work: Sweeping, result: Sweep, again: Sequence[str], seconds: float) -> dict[str, Any]:
    """Return what the file of a sweep says of it, with the command that repeats it."""
    return {
        "recipe": result.recipe,
        "state": result.state,
        "points": result.points,
        "done": len(result.outcomes) - len(result.failed),
        "failed": [outcome.point.number for outcome in result.failed],
        "axes": {
            axis.name: [coordinate.value for coordinate in axis.coordinates] for axis in work.axes
        },
        "paired": result.paired,
        "overrides": work.fixed,
        "order": [checked.point.number for checked in work.plan.checked],
        "results": {"of all points": result.sharing.steps, "different": result.sharing.made},
        "seconds": round(seconds, 3),
        "device": work.device,
        "versions": versions(),
        "again": shlex.join(again),
    }


def counted(result: Sweep) -> str:
    """Return the number of points of a sweep in each state, such as ``12 points: 8 run, 3
    cached, 1 failed``.
    """
    states = [outcome.state for outcome in result.outcomes]
    state_texts = [
        f"{states.count(state)} {state}" for state in ("run", "cached", "failed") if state in states
    ]
    not_run = result.points - len(states)
    state_texts += [f"{not_run} not run"] if not_run else []
    return f"{result.points} point{'s' * (result.points > 1)}: {', '.join(state_texts)}"
