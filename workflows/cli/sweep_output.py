"""A sweep as a terminal shows it: its opening, its points while they run, its folder, and the exit code."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

from neusee.workflows.cli.sweep_screen import screen
from neusee.workflows.store.remote_store import open_store
from neusee.workflows.store.result_store import Store
from neusee.workflows.sweeps.axes import Axis, read_words
from neusee.workflows.sweeps.sweep_files import require_xarray
from neusee.workflows.sweeps.sweep_points import OnError, Outcome, outcomes
from neusee.workflows.sweeps.sweep_run import State, Sweep, Sweeping, counted, write_sweep
from neusee.workflows.sweeps.sweep_table import lasts

DONE, FAILED, INTERRUPTED = 0, 1, 130


def run_sweep(
    recipe: str,
    words: Sequence[str],
    *,
    first: int = 2,
    zip: bool = False,
    on_error: OnError = "stop",
    netcdf: bool = False,
    device: str = "cpu",
    out: Path = Path("runs"),
    store: Store | None = None,
    quiet: bool = False,
) -> int:
    """The command ``neusee sweep``: run, show, and write ``out/sweeps/<date>_<recipe>_<key>/``; gives the exit code.

    ``words`` are the changes and axes, counted from ``first``. Raises: RecipeError with every
    mistake of every point, before anything runs.
    """
    if netcdf:
        require_xarray("--netcdf")
    began, place = time.perf_counter(), Path().absolute()
    work = Sweeping(recipe, read_words(words, place, first), place, store or open_store(), zip, device)
    again = _again(recipe, words, zip, on_error, netcdf, device, out)
    if not quiet:
        print(*_opening(work), sep="\n", flush=True)
    found, state, error = _shown(work, on_error, quiet)
    if error is not None and not (on_error == "stop" and found and found[-1].state == "failed"):
        raise error
    result = work.sweep(found, state)
    path = write_sweep(work, result, again, out, netcdf, time.perf_counter() - began)
    if quiet:
        print(*_failures(result), sep="\n", end="\n" if result.failed else "", file=sys.stderr)
        print(path / "sweep.csv", flush=True)
    else:
        print(*_closing(result, path, again, time.perf_counter() - began), sep="\n", flush=True)
    return INTERRUPTED if state == "interrupted" else FAILED if result.failed else DONE


def _opening(work: Sweeping) -> Iterator[str]:
    """The lines before anything runs."""
    recipe, sizes = work.plan.recipe, f" {'+' if work.paired else '×'} ".join(map(_sized, work.axes))
    shared = work.sharing
    yield f"neusee sweep: {recipe.title or recipe.name}"
    yield f"checked  {shared.points} points ({sizes}), {shared.steps} steps: all right"
    yield f"shared   {shared.made} different results: {100 * shared.saved:.0f} % less work than point by point"
    if work.plan.costs and any(work.plan.work):
        yield f"time     about {lasts(sum(work.plan.work))}, as earlier runs took"
    yield from (f"note     {line}" for line in work.plan.notes)


def _sized(axis: Axis) -> str:
    return f"{axis.name}: {len(axis.coordinates)}"


def _shown(work: Sweeping, on_error: OnError, quiet: bool) -> tuple[list[Outcome], State, Exception | None]:
    """Run the points on the screen that fits; Ctrl-C and a failure end the sweep, and keep what there is."""
    shown = screen(work.columns, len(work.plan.checked), quiet)
    try:
        with (
            shown,
            closing(outcomes(work.plan, work.store, on_error, work.device, shown.started, shown.watch)) as running,
        ):
            for outcome in running:
                shown.finished(outcome)
    except KeyboardInterrupt:
        return shown.outcomes, "interrupted", None
    except Exception as error:
        return shown.outcomes, "stopped", error
    return shown.outcomes, "complete", None


def _again(
    recipe: str, words: Sequence[str], paired: bool, on_error: str, netcdf: bool, device: str, out: Path
) -> list[str]:
    """The words that run a sweep again, or let it go on."""
    options = ["--zip"] * paired + ["--netcdf"] * netcdf
    options += ["--on-error", on_error] if on_error != "stop" else []
    options += ["--device", device] if device != "cpu" else []
    options += ["--out", str(out)] if out != Path("runs") else []
    return ["neusee", "sweep", recipe, *words, *options]


def _closing(result: Sweep, path: Path, again: Sequence[str], seconds: float) -> Iterator[str]:
    """The lines after the last point."""
    yield ""
    yield f"{counted(result)}  ({lasts(seconds)})"
    yield from (f"  {line}" for line in _failures(result))
    yield f"table    {path / 'sweep.csv'}"
    if result.state != "complete":
        yield f"partial: what is done is kept; to go on: {shlex.join(again)}"


def _failures(result: Sweep) -> Iterator[str]:
    for outcome in result.failed:
        yield f"failed: point {outcome.point.number}, {outcome.point.shown}: {outcome.message.splitlines()[0]}"
