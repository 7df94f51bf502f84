"""Parameter sweeps: runs of a recipe at every combination of the listed values, with all results in
one table.

    sweep("first_light", {"sensor.read_noise": ["5 e-", "10 e-"], "doe": ["axicon", "vortex"]})

Results are stored by key: a stopped sweep continues when the same sweep runs again, and results
that points share are computed once. The output is a CSV file, a text table with a line for each
point, or an `xarray.Dataset`.
"""

from __future__ import annotations

import html
import importlib.util
import itertools
import os
import shlex
from collections.abc import Collection, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from neusee.nodes import units
from neusee.workflows.engine.provenance import versions
from neusee.workflows.engine.worker_processes import workers_for
from neusee.workflows.graph.errors import Diagnostic, Location, RecipeError
from neusee.workflows.graph.final_values import flow
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.recipe.text.overrides import Override
from neusee.workflows.report.run_folder import new_run
from neusee.workflows.report.terminal_text import indented
from neusee.workflows.store.remote_store import open_store
from neusee.workflows.store.result_store import Store
from neusee.workflows.sweeps.axes import Argument, Axis, points, read_axes, read_words
from neusee.workflows.sweeps.sweep_points import (
    OnError,
    PointOutcome,
    Sharing,
    SweepPlan,
    outcomes,
    plan_sweep,
    sharing,
)

if TYPE_CHECKING:
    from neusee.workflows.sweeps.axes import Point
    from neusee.workflows.sweeps.sweep_points import ResultNumber


# --- sweep table ----------------------------------------------------------------------------------

# Table of the results of a sweep: its columns, its rows in a file, and the text of its cells.


#: columns after the axes
AFTER = ("status", "step", "field", "index", "value", "seconds", "cached", "message")


@dataclass(frozen=True, slots=True)
class AxisColumn:
    """Table column for one axis of a sweep; its header has a unit if all values have the same
    dimension.
    """

    name: str
    header: str
    cells: tuple[Any, ...]  #: the values of the axis, in order
    si: tuple[Any, ...]
    unit: str  #: unit of ``si``; empty for pure numbers and for words


def column(axis: Axis) -> AxisColumn:
    """Return the table column of an axis: numbers in their common unit, or in SI units if units
    differ.

    Words are unchanged.
    """
    values = [coordinate.value for coordinate in axis.coordinates]
    header = f"{axis.name} (axis)" if axis.name in ("point", *AFTER) else axis.name
    quantities = _alike(values)
    if quantities:
        return _of_quantities(axis.name, header, quantities)
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return AxisColumn(axis.name, header, tuple(values), tuple(map(float, values)), "")
    words = tuple(coordinate.shown for coordinate in axis.coordinates)
    return AxisColumn(axis.name, header, words, words, "")


def _alike(values: Sequence[Any]) -> list[_Quantity]:
    """Return the values as quantities if all have the same SI unit; else an empty list."""
    quantities = [quantity for quantity in map(_quantity, values) if quantity is not None]
    one_unit = len({quantity.si_unit for quantity in quantities}) == 1
    return quantities if one_unit and len(quantities) == len(values) else []


def _of_quantities(name: str, header: str, quantities: Sequence[_Quantity]) -> AxisColumn:
    """Return the column of quantities with one SI unit, in their original unit if all have the
    same.
    """
    si_values, unit = tuple(quantity.si for quantity in quantities), quantities[0].si_unit
    if len({quantity.unit for quantity in quantities}) > 1:
        return AxisColumn(name, f"{header} ({unit})", si_values, si_values, unit)
    numbers = tuple(quantity.number for quantity in quantities)
    return AxisColumn(name, f"{header} ({quantities[0].unit})", numbers, si_values, unit)


@dataclass(frozen=True, slots=True)
class _Quantity:
    number: float
    unit: str
    si: float
    si_unit: str


def _quantity(value: Any) -> _Quantity | None:
    """Parse a text such as ``450 nm`` as a quantity; return None for anything else."""
    match = units._NUMBER.fullmatch(value.strip()) if isinstance(value, str) else None
    for si_unit, scale in units.SCALES.items():
        if match and match[2].strip() in scale:
            return _Quantity(
                float(match[1]), match[2].strip(), units.read_quantity(value, si_unit), si_unit
            )
    return None


# --- rows -----------------------------------------------------------------------------------------


def header(columns: Sequence[AxisColumn]) -> list[str]:
    """Return the column names of ``sweep.csv``."""
    return ["point", *(c.header for c in columns), *AFTER]


def rows_of(outcome: PointOutcome, columns: Sequence[AxisColumn]) -> Iterator[list[Any]]:
    """Yield the table rows of one point: one for each number, or a single row without a number.

    A point has no numbers if it failed or if its results contain none.
    """
    point_columns = [outcome.point.number, *point_cells(outcome.point, columns)]
    status = "failed" if outcome.state == "failed" else "ok"
    last_columns = [round(outcome.seconds, 6), outcome.state == "cached", outcome.message]
    # without numbers: one row with the failed step
    for number in outcome.numbers or ((outcome.step, "", "", ""),):
        yield [*point_columns, status, *number, *last_columns]


def headline(numbers: Sequence[ResultNumber]) -> dict[str, str]:
    """Return each result of one point as text: a single number, or the range of an array.

    Single numbers come first.
    """
    results: dict[str, list[float]] = {}
    for step, quantity, _, value in numbers:
        results.setdefault(f"{step}.{quantity}".rstrip("."), []).append(value)
    return {
        name: _range_of(values)
        # False sorts before True, so that single numbers come first
        for name, values in sorted(results.items(), key=lambda item: len(item[1]) > 1)
    }


def wide(outcomes: Sequence[PointOutcome], columns: Sequence[AxisColumn]) -> list[list[str]]:
    """Return the rows of a text table: a header, then one row for each point with its results."""
    results = [headline(outcome.numbers) for outcome in outcomes]
    names = list(dict.fromkeys(itertools.chain.from_iterable(results)))
    rows = [["point", *(axis_column.header for axis_column in columns), *names, "state", "seconds"]]
    for outcome, result in zip(outcomes, results, strict=True):
        cells = [cell_text(cell) for cell in point_cells(outcome.point, columns)]
        values = [result.get(name, "") for name in names]
        rows.append(
            [str(outcome.point.number), *cells, *values, outcome.state, f"{outcome.seconds:.3f}"]
        )
    return rows


def point_cells(point: Point, columns: Sequence[AxisColumn]) -> list[Any]:
    """Return the axis values of one point as table cells."""
    return [axis_column.cells[i] for axis_column, i in zip(columns, point.place, strict=True)]


def _range_of(values: Sequence[float]) -> str:
    """Return a single number, or the range of several, as text."""
    return f"{values[0]:.4g}" if len(values) == 1 else f"{min(values):.3g} … {max(values):.3g}"


def cell_text(cell: Any) -> str:
    """Return a table cell as text; a float has at most six significant digits."""
    return f"{cell:.6g}" if isinstance(cell, float) else str(cell)


# --- sweep files ----------------------------------------------------------------------------------

# The results of a sweep as an `xarray.Dataset`, whose named dimensions are the axes of the sweep.


_PACKAGES = ("xarray", "h5netcdf", "h5py")


def require_xarray(asked_by: str) -> None:
    """Raise `RecipeError` unless xarray, h5netcdf and h5py are installed."""
    missing = [name for name in _PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        text = f'needs {" and ".join(missing)}: pip install "neusee[xarray]"'
        raise RecipeError([Diagnostic(Location(asked_by), "", text)])


def dataset(
    outcomes: Sequence[PointOutcome],
    columns: Sequence[AxisColumn],
    paired: bool,
    about: Mapping[str, str],
) -> Any:
    """Return the results of a sweep as an `xarray.Dataset` with the axes as dimensions and
    coordinates in SI units.

    Paired axes share the single dimension ``point``. An array result has the further dimension
    ``<result> index``. A point that failed or did not run is NaN; ``ran`` is true at points with
    numbers.
    """
    import numpy
    import xarray

    shape, axis_names = _shape(columns, paired)
    coords = {axis_column.name: _coordinate(axis_column, paired) for axis_column in columns}
    has_run, seconds = numpy.zeros(shape, bool), numpy.full(shape, numpy.nan)
    arrays: dict[str, Any] = {}
    taken_names = {"ran", "seconds", *coords}
    lengths = _lengths(outcomes, taken_names)
    for outcome in outcomes:
        # paired axes share one index
        indices = outcome.point.place[:1] if paired else outcome.point.place
        seconds[indices], has_run[indices] = outcome.seconds, outcome.state != "failed"
        for name, index, value in _named(outcome, taken_names):
            if name not in arrays:
                array_shape = (*shape, lengths[name]) if name in lengths else shape
                arrays[name] = numpy.full(array_shape, numpy.nan)
            # a single number has an empty index
            arrays[name][(*indices, index or 0) if name in lengths else indices] = value
    results = {name: (_dims(name, axis_names, lengths), array) for name, array in arrays.items()}
    own_variables = {"ran": (axis_names, has_run), "seconds": (axis_names, seconds, {"units": "s"})}
    return xarray.Dataset({**results, **own_variables}, coords, dict(about))


def _shape(columns: Sequence[AxisColumn], paired: bool) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Return sizes and names of the axis dimensions."""
    if paired:
        return (len(columns[0].si),), ("point",)
    return tuple(len(axis_column.si) for axis_column in columns), tuple(
        axis_column.name for axis_column in columns
    )


def _named(outcome: PointOutcome, taken: Collection[str]) -> Iterator[tuple[str, int | str, float]]:
    """Yield (name, index, value) for each number of a point."""
    for step, quantity, index, value in outcome.numbers:
        yield _variable(step, quantity, taken), index, value


def _coordinate(column: AxisColumn, paired: bool) -> tuple[str, list[Any], dict[str, str]]:
    """Return the coordinate variable of an axis."""
    units = {"units": column.unit} if column.unit else {}
    return "point" if paired else column.name, list(column.si), units


def _dims(name: str, dims: tuple[str, ...], long: Container[str]) -> tuple[str, ...]:
    """Return the dimensions of a result: those of the axes, and one more for an array."""
    return (*dims, f"{name} index") if name in long else dims


def _lengths(outcomes: Sequence[PointOutcome], taken: Collection[str]) -> dict[str, int]:
    """Return the largest length of each array result over all points."""
    lengths: dict[str, int] = {}
    for outcome in outcomes:
        for name, index, _ in _named(outcome, taken):
            if index != "":
                lengths[name] = max(lengths.get(name, 0), int(index) + 1)
    return lengths


def _variable(step: str, field: str, taken: Collection[str]) -> str:
    """Return the name of a result in the `xarray.Dataset`, distinct from all coordinate names."""
    name = f"{step}.{field}".rstrip(".").replace("/", "_")
    return f"{name} (result)" if name in taken else name


# --- sweep ----------------------------------------------------------------------------------------

# A sweep from its axes to its result and its folder.


SweepState = Literal["complete", "stopped", "interrupted"]


@dataclass(frozen=True)
class Sweep:
    """Result of a sweep: the outcomes of the points that ran, in the order of the axes (last axis
    fastest).
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
        """Return the outcomes of the failed points."""
        return tuple(outcome for outcome in self.outcomes if outcome.state == "failed")

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Return the results in long format, with one row for each number of each point."""
        names = header(self.columns)
        rows: list[dict[str, Any]] = []
        for outcome in self.outcomes:
            numbers = rows_of(outcome, self.columns)
            rows += [dict(zip(names, row, strict=True)) for row in numbers]
        return rows

    def table(self) -> str:
        """Return the results as a text table, with one line for each point."""
        return "\n".join(indented(wide(self.outcomes, self.columns)))

    def to_xarray(self) -> Any:
        """Return the results as an `xarray.Dataset` in SI units, with the axes as dimensions.

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


@dataclass(frozen=True)
class SweepOptions:
    """How the points of a sweep follow from the axes, and how they run."""

    paired: bool = False  #: True: combine the n-th values of all axes; False: every combination
    #: ``"stop"`` raises the error of the first failed point, ``"continue"`` writes each error in
    #: its row
    on_error: OnError = "stop"
    device: str = "cpu"
    #: number of worker processes; 0 means one for each free processor, and none if the process has
    #: other threads, as in a notebook
    workers: int = 0
    folder: str | os.PathLike[str] = "."  #: base of relative paths


_USUAL_OPTIONS = SweepOptions()


def sweep(
    recipe: str | os.PathLike[str],
    axes: Mapping[str, str | Iterable[Any]],
    overrides: Sequence[str | Override] = (),
    store: Store | None = None,
    options: SweepOptions = _USUAL_OPTIONS,
) -> Sweep:
    """Run ``recipe`` at every combination of axis values.

    Args:
        axes: by parameter or group, a list of values, or a text as on the command line, such as
            ``"linspace(450 nm, 650 nm, 5)"``
        overrides: changes that are the same at every point

    Raises: RecipeError with every mistake of every point, before anything runs.
    """
    working_folder = Path(options.folder).absolute()
    arguments = [*read_words(overrides, working_folder), *read_axes(axes, working_folder)]
    sweeping = Sweeping(
        os.fspath(recipe),
        arguments,
        working_folder,
        store or open_store(),
        options.paired,
        options.device,
    )
    point_outcomes = outcomes(
        sweeping.plan,
        sweeping.store,
        options.on_error,
        workers=sweeping.workers(options.workers),
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
        """Return the number of processes that run the points: ``asked``, or for 0 one for each free
        processor; 1 with a GPU.
        """
        return workers_for(len(self.plan.checked), asked) if self.device == "cpu" else 1

    def sweep(self, outcomes: Sequence[PointOutcome], state: SweepState) -> Sweep:
        """Return the result of the sweep, with the outcomes sorted by point number."""
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
    """Write the result folder of a sweep and return its path; the name of an unfinished one
    contains ``partial``.
    """
    name = f"{result.recipe}{'' if result.state == 'complete' else '_partial'}"
    keys: list[str] = []
    for checked in work.plan.checked:
        keys += [checked.job.keys[output] for output in checked.job.outputs]
    # the name of the folder depends on all results of the sweep
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
    """Return the entries of ``sweep.yaml``, with the command that repeats the sweep."""
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
    """Return the number of points in each state as text, such as ``12 points: 8 run, 3 cached, 1
    failed``.
    """
    states = [outcome.state for outcome in result.outcomes]
    state_texts = [
        f"{states.count(state)} {state}" for state in ("run", "cached", "failed") if state in states
    ]
    not_run = result.points - len(states)
    state_texts += [f"{not_run} not run"] if not_run else []
    return f"{result.points} point{'s' * (result.points > 1)}: {', '.join(state_texts)}"
