"""The arguments and options that several commands share, and functions that read and check their
values.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from neusee.workflows.cli import lazy_imports as lazy
from neusee.workflows.cli.command_frame import fail, failing, keep_for_result, print_warning
from neusee.workflows.report.run_folder import writable_folder
from neusee.workflows.report.terminal_text import lasts
from neusee.workflows.store.cache_settings import parse_size

if TYPE_CHECKING:
    from neusee.workflows.engine.step_job import Executor
    from neusee.workflows.store.result_store import Store

Words = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[RECIPE] [OVERRIDE]...",
        help="A recipe's name or file, then changes: a.b=1, +a.b=1, ~a.b, laser=six.",
        show_default=False,
    ),
]
Debug = Annotated[bool, typer.Option("--debug", help="Show where in the code an error arose.")]
Device = Annotated[
    str,
    typer.Option("--device", help="Where to compute: cpu, cuda, or several: cuda:0,cuda:1,cpu."),
]
OneDevice = Annotated[str, typer.Option("--device", help="Where to compute: cpu or cuda.")]


def _result_alone(context: typer.Context, value: bool) -> bool:
    """Print nothing but the result to stdout."""
    if value:
        keep_for_result(context)
    return value


_JSON = "Print the result as one JSON object, and nothing else."
Quiet = Annotated[
    bool, typer.Option("--quiet", help="Print only the path of the result.", callback=_result_alone)
]
AsJson = Annotated[bool, typer.Option("--json", help=_JSON, callback=_result_alone)]
Exact = Annotated[bool, typer.Option("--exact", help="Compute every step in full; omit nothing.")]
_MEMORY = (
    "Limit of the memory of the program, and of each GPU: 6 GB. One call of a library may pass it a"
    " little."
)
Memory = Annotated[str, typer.Option("--memory", help=_MEMORY)]


def _writable(out: Path) -> Path:
    """End the command before any work if the results could not be written to the folder ``out``."""
    with failing(ValueError, before="--out: "):
        return writable_folder(out)


Out = Annotated[
    Path,
    typer.Option(
        "--out", help="Folder in which to make the folder of results.", callback=_writable
    ),
]


# such as ``stage 1, iteration 3 of 20`` or ``30/100``
_COUNT = re.compile(
    r"(?P<what>(?:stage \d, )?\D{0,20})(?P<done>\d+)(?: draws)?(?: of |/)(?:about )?(?P<all>\d+)\b"
)
_STEPS = re.compile(r"\d+ of about \d+ ")
_COUNT_AT_END = re.compile(r"(?P<what>)\((?P<done>\d+) of (?P<all>\d+)\)$")


class ProgressLines:
    """A printer of lines of progress, which adds the time that is left to a line with a count,
    such as ``3 of 20``.
    """

    def __init__(self, quiet: bool, clock: Callable[[], float] = time.monotonic) -> None:
        self._quiet, self._clock, self._before = quiet, clock, clock()
        #: by kind of line: time and count from which the rate is taken
        self._began: dict[str, tuple[float, int]] = {}
        self._last: dict[str, int] = {}

    def __call__(self, line: str) -> None:
        if not self._quiet:
            print(f"{line}{self._left(line)}", flush=True)

    def _left(self, line: str) -> str:
        """Return the time that is left, as the end of a line with a count.

        Other lines, and a first count, have an empty text.
        """
        present_time, previous_time = self._clock(), self._before
        self._before = present_time
        if not (count := _COUNT_AT_END.search(line) or _COUNT.match(line)):
            return ""
        task, done_count, total = count["what"], int(count["done"]), int(count["all"])
        # a stopped study may begin with any count
        # the rate is that since the first count of a kind of line
        if task not in self._began or done_count <= self._last[task]:
            # a count of 1 began at the line before it
            self._began[task] = (
                (previous_time, 0) if done_count == 1 else (present_time, done_count)
            )
        self._last[task] = done_count
        start_time, first_count = self._began[task]
        if done_count == first_count:
            return ""
        seconds = (present_time - start_time) / (done_count - first_count) * (total - done_count)
        return f"; about {lasts(seconds)} left" if seconds >= 1 else ""


class FewLines(ProgressLines):
    """A printer of lines of progress that keeps lines with a count few.

    On a terminal a line with a count takes the place of the one before. Elsewhere, as in a file, it
    is printed after half a minute, and then each time when the command has run twice as long.
    """

    def __init__(self, quiet: bool, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(quiet, clock)
        self._began_at, self._next, self._open = clock(), 30.0, False

    def __call__(self, line: str) -> None:
        has_count = _STEPS.match(line) is not None
        time_left = self._left(line)
        seconds_so_far = self._clock() - self._began_at
        if self._quiet or (has_count and not sys.stdout.isatty() and seconds_so_far < self._next):
            return
        if has_count and sys.stdout.isatty():
            print(f"\r\x1b[K{line}{time_left}", end="", flush=True)
        else:
            self._next = 2 * seconds_so_far if has_count else self._next
            # a line feed behind a line that was to be overwritten
            print(f"{chr(10) * self._open}{line}{time_left}", flush=True)
        self._open = has_count and sys.stdout.isatty()


def progress_lines(quiet: bool) -> Callable[[str], None]:
    """Return a function that prints a line of progress, or that prints nothing if ``quiet`` is
    True.
    """
    return ProgressLines(quiet)


def option_words(options: Mapping[str, Any]) -> list[str]:
    """Return the words ``--name`` and ``value`` of each option; omit options that are False, 0 or
    empty.

    The value True has no word.
    """
    words: list[str] = []
    for name, value in options.items():
        if value is True:
            words.append(f"--{name}")
        elif value:
            words += [f"--{name}", str(value)]
    return words


def check_device(device: str) -> None:
    """End the command if this machine does not have ``device``, which may be a list with commas."""
    with failing(ValueError, before="--device "):
        lazy.local_executor.check_devices(device)


def memory_limit(text: str) -> int | None:
    """Return the value of the option ``--memory``, such as ``6 GB``, in bytes, or None for an
    empty text.
    """
    with failing(ValueError, before="--memory: "):
        return parse_size(text) if text else None


@contextmanager
def within_memory(text: str) -> Iterator[int | None]:
    """Yield the value of ``--memory`` in bytes, as `memory_limit`, and hold the readers of input
    files to it.
    """
    limit = memory_limit(text)
    if limit is None:
        yield None
        return

    with lazy.memory_limits.limited(limit):
        yield limit


@contextmanager
def executor_of(
    place: str,
    store: Store,
    job: Sequence[str] = (),
    say: Callable[[str], None] = lambda line: None,
) -> Iterator[Executor | None]:
    """Yield None for ``local``, or an executor on the cluster ``place``, and close it after the
    ``with`` block.

    ``job`` are the options of jobs of SLURM. ``say`` is told what is waited for.
    """
    if place == "local":
        yield None
        return
    try:
        # fails here, before the work, if the package is missing
        import distributed  # noqa: F401

        cluster = lazy.dask_cluster.cluster
    except ModuleNotFoundError as error:
        fail(
            f'--executor {place}: {error.name} is not installed: pip install "neusee[distributed]"'
        )
    with cluster(place, store, job, say, print_warning) as executor:
        yield executor


def check_executor(place: str, job: Sequence[str]) -> None:
    """End the command before any work for a place that is none, or for options of jobs that
    cannot be.
    """
    kind = place.partition(":")[0]
    if not _is_place(place) and "://" not in place:
        forms = "local, dask, dask:4, slurm:4, or a scheduler's address such as tcp://host:8786"
        fail(f"--executor {place}: write {forms}")
    if job and kind != "slurm":
        fail(f"--job is for jobs of SLURM: write --executor slurm:4, not {place}")
    if kind != "slurm":
        return
    if find_spec("dask_jobqueue") is None:
        fail(f'--executor {place}: dask_jobqueue is not installed: pip install "neusee[slurm]"')

    with failing(ValueError, before="--job "):
        lazy.dask_cluster.SlurmOptions.read(job)
    if name := lazy.dask_cluster.missing_command():
        fail(
            f"--executor {place}: this machine has no command {name}: run it where jobs of SLURM"
            " are submitted"
        )


def _is_place(place: str) -> bool:
    """Return True for ``local``, ``dask:here``, and ``dask`` or ``slurm`` with or without a number
    of workers.
    """
    kind, _, count = place.partition(":")
    if place == "local" or place == "dask:here":
        return True
    return kind in ("dask", "slurm") and (not count or (count.isdecimal() and int(count) > 0))
