"""Functions that all commands use to read a recipe, check options, print lines and report errors."""

from __future__ import annotations

import gc
import itertools
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NoReturn, TextIO, cast

import typer

from neusee.workflows.cli.command_list import BAD

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Recipe
    from neusee.workflows.store.result_store import Store

DEFAULT = "first_light"
_MOST = 100  #: lines of an error that are printed
_NEW_OBJECTS = 10_000  #: containers that are new, after which Python searches for garbage; 700 at first


def split(words: list[str] | None, before: int = 0) -> tuple[str, list[str], int]:
    """Return the recipe, by default `first_light`, and the changes in the arguments, and the first change's number.

    ``before`` is the number of arguments that stand before ``words`` on the command line.
    """
    words = list(words or [])
    named = bool(words) and not _is_change(words[0])
    name = words.pop(0) if named else DEFAULT
    for number, word in enumerate(words):
        if not _is_change(word):
            fail(f"{word}: not a change of a value: {_fix(words, number)}")
    return name, words, 1 + named + before


def split_frames(words: list[str]) -> tuple[list[str], list[str], int]:
    """Return the files and the changes in the arguments of a command, and the number of the first change.

    A file may have the sign = in its name if it exists.
    """
    from pathlib import Path

    count = next((n for n, word in enumerate(words) if _is_change(word) and not Path(word).exists()), len(words))
    frames, changes = words[:count], words[count:]
    for number, word in enumerate(changes):
        if not _is_change(word):
            fail(f"{word}: not a change of a value: {_fix(changes, number)}")
    if not frames:
        fail("no frame is named: neusee restore FRAME --camera RECIPE, then changes of values")
    return frames, changes, 1 + count


def _fix(words: list[str], number: int) -> str:
    """Return how to write the word at ``number``, which is not a change and often the rest of a value with a space."""
    if number == 0:
        return "write key=value, +key=value or ~key"
    rest = itertools.takewhile(lambda word: not _is_change(word), words[number:])
    whole = " ".join([words[number - 1], *rest])
    return f"quote a value that has a space: {shlex.quote(whole)}"


def _is_change(word: str) -> bool:
    return "=" in word or word.startswith(("~", "+"))


def search_for_garbage() -> None:
    """Let Python search for garbage from here on, but not among what was imported; the program begins without.

    The searches are rare, because packages that are imported later make many objects and hardly any garbage.
    """
    gc.freeze()
    gc.set_threshold(_NEW_OBJECTS)
    gc.enable()


def load(words: list[str] | None, *command: str, before: int = 0, exact: bool = False) -> tuple[Recipe, list[str]]:
    """Return the recipe that the arguments ``words`` name and change, and the command line that runs this recipe."""
    name, changes, first = split(words, before)
    from neusee.workflows.recipe.loading import load as read

    with refusing():
        recipe = read(name, changes, first=first)
    search_for_garbage()
    again = ["neusee", *command, name, *changes]
    return (replace(recipe, exact=True), [*again, "--exact"]) if exact else (recipe, again)


@contextmanager
def refusing() -> Iterator[None]:
    """Print every mistake of a recipe and end the command if the ``with`` block raises `RecipeError`."""
    from neusee.workflows.graph.diagnostics import RecipeError

    try:
        yield
    except RecipeError as error:
        count = len(error.diagnostics)
        fail("\n".join([*_first_lines(str(error)), f"{count} problem{'s' * (count > 1)}, nothing was run"]))


def _first_lines(text: str) -> list[str]:
    """Return the lines of an error, at most `_MOST` of them, and how many more there are."""
    lines = text.splitlines()
    more = len(lines) - _MOST
    return [*lines[:_MOST], f"and {more} more like these"] if more > 0 else lines


@contextmanager
def failing(*errors: type[Exception], code: int = BAD, before: str = "") -> Iterator[None]:
    """If the ``with`` block raises one of ``errors``, print ``before`` and the error, and exit with ``code``."""
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
    """Keep stdout for what `say` prints: what own code prints goes to stderr until the command ends."""
    if not isinstance(sys.stdout, _ForResult):
        context.with_resource(redirect_stdout(cast(TextIO, _ForResult(sys.stdout))))


def say(lines: list[str]) -> None:
    """Print lines to stdout."""
    stream = sys.stdout
    print(*lines, sep="\n", file=stream.result if isinstance(stream, _ForResult) else stream, flush=True)


def say_line(line: str) -> None:
    """Print one line to stdout."""
    say([line])


def fail(message: str, code: int = BAD) -> NoReturn:
    """Print a message to stderr and end the command."""
    from neusee.workflows.graph.diagnostics import visible

    print(visible(message), file=sys.stderr)
    raise typer.Exit(code)


def the_store() -> Store:
    """Open the result store that the environment variable ``NEUSEE_CACHE`` names, or the default store."""
    from neusee.workflows.store.remote_store import open_store

    with failing(ValueError, ModuleNotFoundError, before="NEUSEE_CACHE: "):
        return open_store()
