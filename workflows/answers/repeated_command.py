"""A command that may have a stored answer: the answer is looked for before the command, and kept after it.

command = begin(["safety", "safety_pointer"], terminal)   # None where no answer can be right
text = command.answer()                                   # None if there is none: run the command
command.keep(...)                                         # after the command
"""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from neusee.workflows.answers.answer_upkeep import make_room
from neusee.workflows.answers.installed_program import ROOT, SITES, SOURCES, program_state, standard_library
from neusee.workflows.answers.opened_files import Folders, Opened
from neusee.workflows.answers.results_folder import kept_files, printed, write_again
from neusee.workflows.answers.stored_answer import RUN, Answer, read_answer, used, write_answer
from neusee.workflows.answers.stored_results import note_use, still_there, taken_from
from neusee.workflows.answers.typed_command import command_name
from neusee.workflows.answers.witnesses import Unsettled, Witnesses, hold, witnesses_of
from neusee.workflows.report.run_folder import writable_folder
from neusee.workflows.store.environment import budget_bytes, default_root
from neusee.workflows.store.shared_folder import Disk

if TYPE_CHECKING:
    from neusee.workflows.answers.repeated_run import RunResults
    from neusee.workflows.graph.recipe_graph import Recipe
    from neusee.workflows.report.study_folder import StudyReport
    from neusee.workflows.store.result_store import Store

running: list[Command] = []  #: the command of this process, if its answer may be kept
_SYSTEM = ("/proc", "/sys", "/dev")
_OUT = "runs"  #: folder of results where the command names none
_RECIPES = (".yaml", ".yml")
#: files that are made of others: bytecode, compiled modules, and the list of fonts that matplotlib keeps
_DERIVED = re.compile(r"\.pyc$|\.so$|/fontlist-v[^/]*$")
#: files of a cache that decide what a forecast or an explanation says, beside the results themselves
_OF_CACHE = re.compile(r"journal\.jsonl|speeds\.json|code/.*")
_SHARE = 0.9  #: of the free memory, which a run may use
_PART = re.compile(r"/\.[^/]*\.part(/|$)")  #: in the path of a folder of results that is not complete
_TICK = 20_000_000  #: ns, longer than a tick of the clock of a file system
_IMPORTED = 2_000_000_000  #: ns before the command began in which its modules may have been imported
_NAME = re.compile(r"\d{4}-\d\d-\d\d_(?P<label>.+)_(?P<key>[0-9a-f]{8})(_[1-9]\d{0,6})?")
_MAIN = ("__main__", "__mp_main__")  #: the program that the user starts
_NATIVE = ("h5py", "netCDF4")  #: packages whose files are opened without Python, and named by no parameter


def begin(words: Sequence[str], terminal: Sequence[object]) -> Command | None:
    """Return the command that may have a stored answer, or None where none is looked for or kept.

    That is where the cache is at a URL or not usable, and in a process that has already imported torch.
    """
    if "torch" in sys.modules or "://" in os.environ.get("NEUSEE_CACHE", ""):
        return None
    try:
        return Command(words, terminal, Disk(default_root()))
    except (OSError, ValueError, TypeError):
        return None


class Said(NamedTuple):
    """What a command that writes nothing has taken from a store."""

    store: Store
    memory: float = 0.0  #: bytes that must be free
    out: None = None  #: no folder of results

    def fields(self) -> dict[str, Any]:
        """Return the fields of the answer that say on what it rests."""
        return {"files": {}, "stored": taken_from(self.store, {}), "memory": int(self.memory)}


class Results(NamedTuple):
    """The folder of results of a command."""

    folder: Path  #: complete
    out: Path  #: the folder that has it
    report: StudyReport  #: that was written there

    def fields(self) -> dict[str, Any]:
        """Return the fields of the answer that say what the folder holds."""
        return {"files": kept_files(self.folder, self.report)}


class Command:
    """A command whose answer may be stored, from its begin."""

    def __init__(self, words: Sequence[str], terminal: Sequence[object], disk: Disk) -> None:
        self._began, self._clocks = time.perf_counter(), (time.time_ns(), time.monotonic_ns())
        self._words, self._disk = list(words), disk
        self.name, self._state = command_name(words, terminal), program_state()
        self._opened, self._doubtful = Opened(), False

    def _started(self) -> int:
        """Return the time (ns) of the begin by the clock as it is set now; the program is imported by then."""
        from neusee.nodes.import_times import Moment

        return Moment(*self._clocks).time()

    def answer(self) -> str | None:
        """Write the folder of the stored answer again and return the text to print, or None without a right answer.

        Without one, the files that this process opens from now on are recorded.
        Raises `OSError` if the folder of results cannot be written.
        """
        answer = read_answer(self._disk, self.name)
        if answer and self._holds(answer):
            with suppress(ValueError, KeyError, TypeError, AttributeError):  # a document that is none
                text = self._given_again(answer)
                used(self._disk, self.name)
                return text
        running[:] = [self]
        self._opened.listen()
        return None

    def _holds(self, answer: Answer) -> bool:
        """Return True if everything that decided an answer is as it was."""
        return (
            answer.state == self._state.digest
            and self._fits(answer)
            and hold(answer.witnesses)
            and still_there(self._disk, answer.stored)
            and _are_free(answer.memory)
        )

    def _given_again(self, answer: Answer) -> str:
        """Write the folder of an answer again, if it has one, and return the text to print."""
        if not answer.key:
            return answer.text
        if answer.kind != RUN:
            return printed(answer, write_again(answer, time.perf_counter() - self._began) / "report.html")
        from neusee.workflows.answers.repeated_run import said_again, write_run_again

        folder, document = write_run_again(answer, self._disk, time.perf_counter() - self._began)
        note_use(self._disk, answer.stored)
        return said_again(answer, folder, document)

    def doubt(self) -> None:
        """Keep no answer: the command has said something that its text does not hold, such as a warning."""
        self._doubtful = True

    def keep(
        self, text: str, as_json: bool, recipe: Recipe, results: Results | RunResults | Said | None = None
    ) -> None:
        """Keep the answer of a command that has ended well; do so only if nothing that it rests on is in doubt.

        Args: text: of the terminal, with `results_folder.PAGE` for the path of the page. recipe: that of the command.
        results: what the command has written, or what it has taken from a store. A command that writes nothing makes no
        cache either.
        """
        self._opened.end()
        with suppress(OSError, ValueError, KeyError, TypeError):
            inputs = [*_input_files(recipe), *(self._of_cache() if isinstance(results, Said) else ())]
            witnesses = self._witnesses(results.out if results else None, inputs)
            written = results if results and results.out else None
            if self._is_doubtful() or not (written or os.path.isdir(self._disk.folder)):
                return
            place = (str(written.out), *_parts(written.folder.name)) if written else ("", "", "")
            fields = results.fields() if results else {"files": {}}
            answer = Answer(self._state.digest, witnesses, text, as_json, *place, **fields)
            if write_answer(self._disk, self.name, answer):
                make_room(self._disk, budget_bytes(None))

    def _fits(self, answer: Answer) -> bool:
        """Return True if the folder of an answer is the one that the command names, and if it can be written.

        If it cannot be written, the command itself says why.
        """
        if not answer.key:
            return not answer.files
        if answer.out not in (_OUT, *(str(Path(word.removeprefix("--out="))) for word in self._words)):
            return False
        try:
            writable_folder(answer.out)
        except ValueError:
            return False
        return True

    def _is_doubtful(self) -> bool:
        """Return True if the program may have changed since the command began, or if the command said more."""
        state = program_state()
        return (
            self._doubtful
            or state != self._state
            or state.changed > self._started() - _IMPORTED
            or any(name in sys.modules for name in _NATIVE)
            or any(_own_code())
        )

    def _witnesses(self, out: Path | None, inputs: Iterable[str]) -> Witnesses:
        """Return the witnesses of the answer; folders of results in ``out`` are no witnesses."""
        recipes = _recipe_folders(self._words)
        ignored = Folders([*_installed(), *_SYSTEM, self._disk.folder, *(ROOT / name for name in SOURCES)])
        cache, written = Folders([self._disk.folder]), os.path.abspath(out) if out else None
        opened = [path for path in self._opened.files if not _DERIVED.search(path)]
        files = [path for path in opened if path.endswith(_RECIPES) or path not in ignored]
        if any(path in cache for path in (os.getcwd(), *files)) or written in recipes:
            raise Unsettled("a recipe is in the folder of the cache or of results")
        folders = [path for path in self._opened.folders if path not in ignored and not _PART.search(path)]
        listed = {path: self._opened.folders[path] for path in folders if path != written}
        return witnesses_of([*files, *inputs], recipes, listed, self._started() - _TICK, written)

    def _of_cache(self) -> list[str]:
        """Return the files of the cache that were read and decide what a forecast or an explanation says."""
        return [path for path in self._opened.files if _OF_CACHE.fullmatch(_inside(path, self._disk.folder))]


def _are_free(memory: int) -> bool:
    """Return True if a run may use so many bytes of memory now."""
    if not memory:
        return True
    from neusee.workflows.engine.memory_use import free_memory

    return _SHARE * free_memory() >= memory


def _inside(path: str, folder: str) -> str:
    return os.path.relpath(os.path.realpath(path), os.path.realpath(folder))


def _parts(folder: str) -> tuple[str, str]:
    """Return the label and the key in the name of a folder of results, such as ``2026-11-23_safety_82a46a54_2``.

    Raises `ValueError` for another name.
    """
    found = _NAME.fullmatch(folder)
    if not found:
        raise ValueError(f"{folder} is not the name of a folder of results")
    return found["label"], found["key"]


def _recipe_folders(words: Sequence[str]) -> set[str]:
    """Return the folders in which the recipe and its options are looked for."""
    from neusee.workflows.recipe.text.option_groups import shared_folders

    beside = (os.path.dirname(os.path.expanduser(word)) for word in words if word.endswith(_RECIPES))
    return {os.path.abspath(folder or ".") for folder in [".", *beside, *map(str, shared_folders())]}


def _input_files(recipe: Recipe) -> set[str]:
    """Return the paths of all files that the values of a recipe name; one that is a folder is refused later."""
    values: list[Any] = list(recipe.config.values.values())
    found = set()
    while values:
        value = values.pop()
        if isinstance(value, Path):
            found.add(os.path.abspath(value))
        elif isinstance(value, dict):
            values += [*value, *value.values()]
        elif isinstance(value, list | tuple | set | frozenset):
            values += value
    return found


def _installed() -> list[str]:
    """Return the folders of Python's own modules and of installed packages, whose versions count."""
    return [standard_library(), *(folder for folder in sys.path if os.path.basename(folder) in SITES)]


def _own_code() -> Iterable[str]:
    """Yield the modules of this process that are neither neusee nor installed: a recipe names code of its own."""
    known = Folders([*_installed(), ROOT])
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)  # of torch.ops it is a name without a folder
        if file and name not in _MAIN and os.path.isfile(file) and os.path.abspath(file) not in known:
            yield name
