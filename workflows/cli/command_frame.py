"""What every command does with its words: read the recipe they name, refuse what cannot be, print, stop."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

if TYPE_CHECKING:
    from neusee.workflows.engine.step_job import Executor
    from neusee.workflows.graph.diagnostics import RecipeError
    from neusee.workflows.graph.recipe_graph import Recipe
    from neusee.workflows.store.result_store import Store

DONE, FAILED, BAD, MISSED = 0, 1, 2, 3
DEFAULT = "first_light"

Words = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[RECIPE] [OVERRIDE]...",
        help="A recipe's name or file, then changes: a.b=1, +a.b=1, ~a.b, laser=six.",
        show_default=False,
    ),
]
Debug = Annotated[bool, typer.Option("--debug", help="Show where in the code an error arose.")]
Device = Annotated[str, typer.Option("--device", help="Where to compute: cpu, cuda, or several: cuda:0,cuda:1,cpu.")]
Exact = Annotated[bool, typer.Option("--exact", help="Compute every step in full; omit nothing.")]
Memory = Annotated[
    str, typer.Option("--memory", help="Limit of a device's memory, such as 6 GB, as far as earlier runs tell.")
]
Out = Annotated[Path, typer.Option("--out", help="Folder in which to make the folder of results.")]


def split(words: list[str] | None, before: int = 0) -> tuple[str, list[str], int]:
    """The recipe that the words name (`first_light` if none does), its changes, and the number of the first of these.

    ``before``: how many arguments stand before the words.
    """
    words = list(words or [])
    named = bool(words) and not _is_change(words[0])
    name = words.pop(0) if named else DEFAULT
    for word in words:
        if not _is_change(word):
            fail(f"{word}: not a change of a value: write key=value, +key=value or ~key")
    return name, words, 1 + named + before


def load(words: list[str] | None, before: int = 0, exact: bool = False) -> tuple[Recipe, list[str]]:
    """The recipe that the words name with its changes, and the words to run it again."""
    name, changes, first = split(words, before)
    from neusee.workflows.graph.diagnostics import RecipeError
    from neusee.workflows.recipe.loading import load as read

    try:
        recipe = read(name, changes, first=first)
    except RecipeError as error:
        refuse(error)
    gc.freeze()
    gc.enable()
    if exact:
        return replace(recipe, exact=True), ["neusee", "run", name, *changes, "--exact"]
    return recipe, ["neusee", "run", name, *changes]


def refuse(error: RecipeError) -> NoReturn:
    """Say every mistake of a recipe and stop."""
    count = len(error.diagnostics)
    fail(f"{error}\n{count} problem{'s' * (count > 1)}, nothing was run")


def check_device(device: str) -> None:
    """Refuse what is no device, or is not here; several are separated by commas."""
    import torch

    names = device.split(",")
    if len(set(names)) < len(names):
        fail(f"--device {device}: names one device twice")
    for name in names:
        try:
            torch.empty(0, device=name)
        except (RuntimeError, AssertionError) as error:
            fail(f"--device {name}: {str(error).partition(chr(10))[0]}")


def _is_change(word: str) -> bool:
    return "=" in word or word.startswith(("~", "+"))


def say(lines: list[str]) -> None:
    """Print lines to stdout."""
    print(*lines, sep="\n", flush=True)


def fail(message: str, code: int = BAD) -> NoReturn:
    """Say on stderr what is wrong and stop."""
    print(message, file=sys.stderr)
    raise typer.Exit(code)


def the_store() -> Store:
    """The store that ``$NEUSEE_CACHE`` names, or the usual one."""
    from neusee.workflows.store.remote_store import open_store

    try:
        return open_store()
    except (ValueError, ModuleNotFoundError) as error:
        fail(f"NEUSEE_CACHE: {error}")


def bytes_of(text: str, option: str) -> int:
    """``6 GB`` as bytes; anything else is refused, with what may be written."""
    from neusee.workflows.store.budget_eviction import bytes_of as read

    try:
        return read(text)
    except ValueError as error:
        fail(f"{option}: {error}")


@contextmanager
def executor_of(where: str, store: Store) -> Iterator[Executor | None]:
    """Who computes: this process (None), or a cluster for as long as the command runs."""
    if where == "local":
        yield None
        return
    kind, _, count = where.partition(":")
    if not (kind == "dask" and (not count or count == "here" or count.isdecimal())) and "://" not in where:
        fail(f"--executor {where}: write local, dask, dask:4, or a scheduler's address such as tcp://host:8786")
    try:
        from neusee.workflows.engine.dask_executor import cluster
    except ModuleNotFoundError as error:
        fail(f'--executor {where}: {error.name} is not installed: pip install "neusee[distributed]"')
    with cluster(where, store) as found:
        yield found
