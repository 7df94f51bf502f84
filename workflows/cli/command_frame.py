"""Functions of all commands: reading of a recipe, printing, errors and interruption; and the
options of several commands, with functions that check their values.
"""

from __future__ import annotations

import gc
import itertools
import json
import re
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TextIO, cast

import typer

from neusee.workflows.cli import lazy_imports as lazy
from neusee.workflows.cli.commands_and_exit_codes import BAD, FAILED, INTERRUPTED, TYPED
from neusee.workflows.cli.interrupt_signal import say_stopped
from neusee.workflows.graph.errors import RecipeError, visible
from neusee.workflows.keys.sealed_files import text_of
from neusee.workflows.report.run_folder import writable_folder
from neusee.workflows.report.terminal_text import json_line, lasts
from neusee.workflows.store.cache_settings import default_root, parse_size
from neusee.workflows.store.remote_store import open_store

if TYPE_CHECKING:
    from neusee.workflows.engine.step_job import Executor
    from neusee.workflows.graph.recipe_graph import Recipe
    from neusee.workflows.store.result_store import Store


DEFAULT = "first_light"
_MOST_ERROR_LINES = 100  #: lines of an error that are printed
#: number of new containers after which Python collects garbage; its default is 700
_NEW_OBJECTS = 10_000


def split(words: list[str] | None, before: int = 0) -> tuple[str, list[str], int]:
    """Return the recipe, by default `first_light`, and the changes in the arguments, and the first
    change's number.

    ``before`` is the number of arguments that stand before ``words`` on the command line.
    """
    words = list(words or [])
    is_named = bool(words) and not _is_change(words[0])
    name = words.pop(0) if is_named else DEFAULT
    for number, word in enumerate(words):
        if not _is_change(word):
            fail(f"{word}: not a change of a value: {_fix(words, number)}")
    # arguments count from 1
    return name, words, 1 + is_named + before


def split_frames(words: list[str]) -> tuple[list[str], list[str], int]:
    """Return the files and the changes in the arguments of a command, and the number of the first
    change.

    A file may have the sign = in its name if it exists.
    """
    frame_count = next(
        (
            position
            for position, word in enumerate(words)
            if _is_change(word) and not Path(word).exists()
        ),
        len(words),
    )
    frames, changes = words[:frame_count], words[frame_count:]
    for number, word in enumerate(changes):
        if not _is_change(word):
            fail(f"{word}: not a change of a value: {_fix(changes, number)}")
    if not frames:
        fail("no frame is named: neusee restore FRAME --camera RECIPE, then changes of values")
    return frames, changes, 1 + frame_count


def _fix(words: list[str], number: int) -> str:
    """Return the correction of the word at ``number``, which is not a change and often the rest of
    a value with a space.
    """
    if number == 0:
        return "write key=value, +key=value or ~key"
    following = itertools.takewhile(lambda word: not _is_change(word), words[number:])
    value = " ".join([words[number - 1], *following])
    return f"quote a value that has a space: {shlex.quote(value)}"


def _is_change(word: str) -> bool:
    return "=" in word or word.startswith(("~", "+"))


def search_for_garbage() -> None:
    """Switch on Python's garbage collection, which the program begins without, for objects that are
    created from here on.

    The collections are rare, because packages that are imported later make many objects and hardly
    any garbage.
    """
    gc.freeze()
    gc.set_threshold(_NEW_OBJECTS)
    gc.enable()


def load(
    words: list[str] | None,
    *command: str,
    before: int = 0,
    exact: bool = False,
    runs: bool = True,
) -> tuple[Recipe, list[str]]:
    """Return the recipe that the arguments ``words`` name, with the changes that they ask for, and
    the command line that runs it again.

    Unless the command ``runs`` steps, the recipe may have its nodes as far as a check reads them.
    """
    name, changes, first_number = split(words, before)

    with refusing():
        recipe, is_without_nodes = lazy.remembered_checks.load(
            _folder_of_cache(), name, changes, first_number
        )
    if runs and is_without_nodes:
        recipe = lazy.remembered_checks.with_nodes(recipe)
    search_for_garbage()
    command_line = ["neusee", *command, name, *changes]
    return (
        (replace(recipe, exact=True), [*command_line, "--exact"])
        if exact
        else (recipe, command_line)
    )


def _folder_of_cache() -> Path | None:
    """Return the folder of the cache, or None for a cache at a URL."""
    with suppress(ValueError):
        return default_root()
    return None


@contextmanager
def refusing() -> Iterator[None]:
    """Print every mistake of a recipe and end the command if the ``with`` block raises
    `RecipeError`.
    """
    try:
        yield
    except RecipeError as error:
        count = len(error.diagnostics)
        verdict = f"{count} problem{'s' * (count > 1)}, nothing was run"
        fail("\n".join([*_first_lines(str(error)), verdict]))


def _first_lines(text: str) -> list[str]:
    """Return the lines of an error, at most `_MOST_ERROR_LINES` of them, and how many more
    there are.
    """
    lines = text.splitlines()
    hidden = len(lines) - _MOST_ERROR_LINES
    return [*lines[:_MOST_ERROR_LINES], f"and {hidden} more like these"] if hidden > 0 else lines


@contextmanager
def failing(*errors: type[Exception], code: int = BAD, before: str = "") -> Iterator[None]:
    """If the ``with`` block raises one of ``errors``, print ``before`` and the error, and exit
    with ``code``.
    """
    try:
        yield
    except errors as error:
        fail(f"{before}{error.args[0] if isinstance(error, LookupError) else error}", code)


class _ForResult:
    """Replacement of stdout while it is reserved for the result: a stream that writes to stderr."""

    def __init__(self, result: TextIO) -> None:
        self.result = result

    def __getattr__(self, name: str) -> Any:
        return getattr(sys.stderr, name)


def keep_for_result(context: typer.Context) -> None:
    """Reserve stdout for the output of `say`: output of the user's own code goes to stderr until
    the command ends.
    """
    if not isinstance(sys.stdout, _ForResult):
        context.with_resource(redirect_stdout(cast(TextIO, _ForResult(sys.stdout))))


def say(lines: list[str]) -> None:
    """Print lines to stdout."""
    stream = sys.stdout
    result = stream.result if isinstance(stream, _ForResult) else stream
    print(*lines, sep="\n", file=result, flush=True)


def say_line(line: str) -> None:
    """Print one line to stdout."""
    say([line])


def fail(message: str, code: int = BAD) -> NoReturn:
    """Print a message to stderr and end the command."""
    print(visible(message), file=sys.stderr)
    raise typer.Exit(code)


def the_store() -> Store:
    """Open the result store that the environment variable ``NEUSEE_CACHE`` names, or the default
    store.
    """
    with failing(ValueError, ModuleNotFoundError, before="NEUSEE_CACHE: "):
        return open_store()


# --- interruption ---------------------------------------------------------------------------------

# What a command prints if it is stopped, or if its results cannot be written: what is kept, and how
# to go on.


def typed_command() -> str:
    """Return the command that runs, as the user typed it, quoted for a shell."""
    return shlex.join(["neusee", *TYPED])


@contextmanager
def resumable(state: Callable[[], str]) -> Iterator[None]:
    """If the ``with`` block is stopped by Ctrl-C or by an error of a file, say what is kept, by
    ``state``, and how to go on.

    The exit code is 130 after Ctrl-C, and 1 after an error of a file.
    """
    try:
        yield
    except KeyboardInterrupt:
        say_stopped(f"stopped: {state()}; to go on: {typed_command()}")
        raise typer.Exit(INTERRUPTED) from None
    except OSError as error:
        if isinstance(error, BrokenPipeError) or "--debug" in TYPED:
            raise
        fail(f"{error}\nfailed: {state()}; to go on: {typed_command()}", FAILED)


def kept_in(store: Store, subject: str) -> str:
    """Return a clause that says that ``subject`` is kept in the cache, or why the cache keeps
    nothing.
    """
    if store.failure:
        return f"nothing is kept, because the cache {store.root} cannot be written"
    return f"{subject} kept in the cache {store.root}"


def kept_training(out: Path, recipe: str) -> str:
    """Return a clause that says up to which iteration the newest checkpoint keeps a training of
    ``recipe``.
    """
    states = [*out.glob(f"{recipe}_*/state.pt"), *out.glob(f"{recipe}_*/mask.state")]
    if not states:
        return "no checkpoint is written yet, so nothing is kept"
    newest = max(states, key=lambda path: path.stat().st_mtime)
    state: dict[str, Any] = {}
    with suppress(ValueError):
        state = lazy.resumable_loop.StateFile(newest).read(strict=False)
    stage = f" of stage {state['stage']}" if state.get("stage") else ""
    progress_text = f" up to iteration {state['iteration']}{stage}" if "iteration" in state else ""
    return f"the training{progress_text} is kept in {newest.parent}"


def say_json(document: dict[str, Any]) -> None:
    """Print the result of a command as one JSON object on one line of stdout; a number that is
    not finite is null.
    """
    say([json_line(document)])


def say_folder(folder: Path, as_json: bool, *further: str) -> None:
    """Print the path of the page in a folder of results, or the page's document and the files
    ``further`` as JSON.
    """
    page = str(folder / "report.html")
    if not as_json:
        return say([page])
    files = ("provenance.json", *further)
    document: dict[str, Any] = {"report": page}
    for name in files:
        document |= json.loads(text_of(folder / name))
    say_json(document)
    return None


def print_warning(message: Warning | str, *where: object, **details: object) -> None:
    """Print a warning as one line on stderr, in place of Python's form, which shows a line of
    source code.
    """
    lazy.repetition.doubt_answer()
    print(f"warning: {visible(str(message))}", file=sys.stderr, flush=True)


# --- options of several commands ------------------------------------------------------------------

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
    """Reserve stdout for the result if the option is set; return its value."""
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
        self._quiet, self._clock, self._time_of_last_line = quiet, clock, clock()
        #: by kind of line: time and count from which the rate is taken
        self._began: dict[str, tuple[float, int]] = {}
        self._last: dict[str, int] = {}

    def __call__(self, line: str) -> None:
        if not self._quiet:
            print(f"{line}{self._time_left(line)}", flush=True)

    def _time_left(self, line: str) -> str:
        """Return the time that is left, as the end of a line with a count.

        The text is empty for a line without a count, and for a first count above 1: there is no
        rate yet.
        """
        present_time, previous_time = self._clock(), self._time_of_last_line
        self._time_of_last_line = present_time
        if not (count := _COUNT_AT_END.search(line) or _COUNT.match(line)):
            return ""
        task, done_count, total = count["what"], int(count["done"]), int(count["all"])
        # the rate is taken from the first count of a kind of line, which is above 1 where a stopped
        # study goes on; a count that does not rise begins a new series
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
    """A printer of lines of progress that prints few of the lines with a count.

    On a terminal a line with a count takes the place of the one before. Elsewhere, as in a file, it
    is printed after half a minute, and then each time when the command has run twice as long.
    """

    def __init__(self, quiet: bool, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(quiet, clock)
        self._began_at, self._next, self._open = clock(), 30.0, False

    def __call__(self, line: str) -> None:
        has_count = _STEPS.match(line) is not None
        time_left = self._time_left(line)
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
    """Yield the value of ``--memory`` in bytes, as `memory_limit` does, and limit the readers of
    input files to it.
    """
    limit = memory_limit(text)
    if limit is None:
        yield None
        return

    with lazy.machine_resources.limited(limit):
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

    ``job`` has the options of jobs of SLURM. ``say`` receives a line on what the executor waits
    for.
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
    """End the command before any work if ``place`` names no executor, or if the options of
    jobs do not belong to it.
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
