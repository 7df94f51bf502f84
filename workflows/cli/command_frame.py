"""What all commands share: read a recipe, print lines, report errors, stop and go on."""

from __future__ import annotations

import gc
import itertools
import json
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TextIO, cast

import typer

from neusee.workflows.cli import lazy_imports as lazy
from neusee.workflows.cli.commands_and_exit_codes import BAD, FAILED, INTERRUPTED, TYPED
from neusee.workflows.cli.interrupt_signal import say_stopped
from neusee.workflows.graph.diagnostics import RecipeError, visible
from neusee.workflows.keys.sealed_files import text_of
from neusee.workflows.report.terminal_text import json_line
from neusee.workflows.store.remote_store import open_store

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Recipe
    from neusee.workflows.store.result_store import Store


# --- command frame --------------------------------------------------------------------------------

# Functions that all commands use to read a recipe, check options, print lines and report errors.


DEFAULT = "first_light"
_MOST = 100  #: lines of an error that are printed
#: containers that are new, after which Python searches for garbage; 700 at first
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
    """Return how to write the word at ``number``, which is not a change and often the rest of a
    value with a space.
    """
    if number == 0:
        return "write key=value, +key=value or ~key"
    following = itertools.takewhile(lambda word: not _is_change(word), words[number:])
    value = " ".join([words[number - 1], *following])
    return f"quote a value that has a space: {shlex.quote(value)}"


def _is_change(word: str) -> bool:
    return "=" in word or word.startswith(("~", "+"))


def search_for_garbage() -> None:
    """Let Python search for garbage from here on, but not among what was imported; the program
    begins without.

    The searches are rare, because packages that are imported later make many objects and hardly any
    garbage.
    """
    gc.freeze()
    gc.set_threshold(_NEW_OBJECTS)
    gc.enable()


def load(
    words: list[str] | None, *command: str, before: int = 0, exact: bool = False
) -> tuple[Recipe, list[str]]:
    """Return the recipe that the arguments ``words`` name and change, and the command line that
    runs this recipe.
    """
    name, changes, first_number = split(words, before)

    with refusing():
        recipe = lazy.loading.load(name, changes, first=first_number)
    search_for_garbage()
    command_line = ["neusee", *command, name, *changes]
    return (
        (replace(recipe, exact=True), [*command_line, "--exact"])
        if exact
        else (recipe, command_line)
    )


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
    """Return the lines of an error, at most `_MOST` of them, and how many more there are."""
    lines = text.splitlines()
    hidden = len(lines) - _MOST
    return [*lines[:_MOST], f"and {hidden} more like these"] if hidden > 0 else lines


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
    """In place of stdout while it is kept for the result: a stream that writes to stderr."""

    def __init__(self, result: TextIO) -> None:
        self.result = result

    def __getattr__(self, name: str) -> Any:
        return getattr(sys.stderr, name)


def keep_for_result(context: typer.Context) -> None:
    """Keep stdout for what `say` prints: what own code prints goes to stderr until the command
    ends.
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


def print_warning(message: Warning | str, *where: object, **details: object) -> None:
    """Print a warning as one line on stderr, in place of Python's form, which shows a line of
    source code.
    """
    lazy.repetition.doubt_answer()
    print(f"warning: {visible(str(message))}", file=sys.stderr, flush=True)
