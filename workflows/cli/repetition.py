"""The stored answer of a command that is repeated: printed before the command is imported, and
kept after it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from shutil import get_terminal_size
from typing import TYPE_CHECKING

from neusee.workflows.answers import repeated_command
from neusee.workflows.answers.repeated_command import Said
from neusee.workflows.answers.stored_answer import FOLDER_MARK, PAGE, SECONDS_MARK, RunResults
from neusee.workflows.cli import lazy_imports as lazy

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Recipe
    from neusee.workflows.report.study_report import StudyReport
    from neusee.workflows.simulation.simulate_recipe import Simulation
    from neusee.workflows.store.result_store import Store

_COMPUTED = {"-h", "--help", "--debug"}  #: options with which no stored answer is used


def say_stored_answer(words: Sequence[str]) -> bool:
    """Print the stored answer of a command, and write its folder of results again; return False
    if there is none.
    """
    if _COMPUTED & set(words):
        return False
    # the text depends on the width and on whether a terminal reads it
    streams = [[stream.isatty(), stream.encoding] for stream in (sys.stdout, sys.stderr)]
    command = repeated_command.begin(words, [*get_terminal_size(), *streams])
    text = command.answer() if command else None
    if text is None:
        return False
    print(text, flush=True)
    return True


def say_and_keep(
    text: str, recipe: Recipe, store: Store | None = None, memory: float = 0.0
) -> None:
    """Print the text of a command that writes no folder, and store this text as the answer of the
    command.

    ``store`` is the store whose results the answer uses. ``memory`` is the number of bytes that
    must be free; with less memory the answer would differ.
    """
    lazy.command_frame.say_line(text)
    for command in repeated_command.running:
        results = Said(store, memory) if store else None
        command.keep(text, False, recipe, results)


def keep_answer(
    text: Callable[[str], str],
    as_json: bool,
    out: Path,
    folder: Path,
    report: StudyReport,
    recipe: Recipe,
) -> None:
    """Store the printed text and the folder of a command, if its answers are stored.

    ``text`` returns the text of the command for the path of its page.
    """
    for command in repeated_command.running:
        command.keep(text(PAGE), as_json, recipe, repeated_command.Results(folder, out, report))


def keep_run(
    text: Callable[[str, str], str],
    as_json: bool,
    out: Path,
    done: Simulation,
    recipe: Recipe,
    store: Store,
) -> None:
    """Store the printed text and the folder of a run, if all its results came from the cache.

    ``text`` returns the text of the command for the path of the folder of the run and the seconds
    that it took.
    """
    for command in repeated_command.running:
        results = RunResults(done.folder, out, done.document, done.taken, store)
        command.keep(text(FOLDER_MARK, SECONDS_MARK), as_json, recipe, results)


def doubt_answer() -> None:
    """Keep no answer of the command that runs, because it has printed a warning."""
    for command in repeated_command.running:
        command.doubt()
