"""A command that may have a stored answer, which is looked up before the command runs."""

from __future__ import annotations

import hashlib
import os
import re
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from neusee.workflows.answers.stored_answer import (
    RUN,
    Answer,
    kept_files,
    make_room,
    printed,
    read_answer,
    said_again,
    used,
    write_again,
    write_answer,
    write_run_again,
)
from neusee.workflows.answers.witnesses import (
    Folders,
    Listing,
    Opened,
    Unsettled,
    Witnesses,
    hold,
    note_use,
    still_there,
    taken_from,
    witnesses_of,
)
from neusee.workflows.engine.machine_resources import free_memory
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.report.run_folder import writable_folder
from neusee.workflows.store.cache_settings import budget_bytes, default_root
from neusee.workflows.store.shared_folder import Disk

if TYPE_CHECKING:
    from neusee.workflows.answers.stored_answer import RunResults
    from neusee.workflows.graph.recipe_graph import Recipe
    from neusee.workflows.report.study_report import StudyReport
    from neusee.workflows.store.result_store import Store


# --- typed command --------------------------------------------------------------------------------

# Name of a stored answer: the digest of the command as typed and of the process in which it runs.


#: environment variables of a login or a terminal window that neusee does not read; the working
#: folder counts separately, and the secret of the cache counts through the signature of each answer
IGNORED = frozenset(
    {
        "NEUSEE_CACHE_SECRET",
        "OLDPWD",
        "PWD",
        "SHLVL",
        "SSH_AUTH_SOCK",
        "SSH_CLIENT",
        "SSH_CONNECTION",
        "SSH_TTY",
        "TERM_SESSION_ID",
        "TMUX",
        "TMUX_PANE",
        "WINDOWID",
        "XDG_SESSION_ID",
        "_",
    }
)


def command_name(words: Sequence[str], terminal: Sequence[object]) -> str:
    """Return the name of the answer to a command; ``terminal`` describes the width of the terminal
    and what it can show.

    The name depends on the words, the working folder, all environment variables except
    `IGNORED`, the terminal, Python with its options and search path, and the machine. Answers of
    another form have other names.
    """
    python_state = [
        sys.version,
        sys.executable,
        list(sys.flags),
        list(sys.warnoptions),
        dict(sys._xoptions),
        sys.path,
    ]
    machine_and_folder = [
        os.getcwd(),
        sorted(_decisive(os.environ).items()),
        list(os.uname()),
        os.cpu_count(),
    ]
    return digest("answer 2", list(words), list(terminal), python_state, machine_and_folder)


def _decisive(variables: Mapping[str, str]) -> dict[str, str]:
    """Return the environment variables that may affect an answer."""
    return {name: value for name, value in variables.items() if name not in IGNORED}


# --- installed program ----------------------------------------------------------------------------

# Digest of the installed program: its source files, the packages beside it, and the graphics
# devices.


ROOT = Path(__file__).parents[2]  #: folder of the package neusee
SOURCES = ("nodes", "workflows")  #: folders of the package in which every file counts
SITES = ("site-packages", "dist-packages")  #: names of folders of installed packages
_ABOUT = (".dist-info", ".egg-info", ".egg-link", ".pth")
_CODE = (".py", ".so", ".pyd", ".zip")
_DRIVER = "/proc/driver/nvidia/version"


class ProgramState(NamedTuple):
    """Digest of the installed program, and the time of the newest change of a source file."""

    digest: str
    changed: int  #: ns since 1970


def standard_library() -> str:
    """Return the folder of Python's own modules."""
    return os.path.dirname(os.path.realpath(os.__file__))


def program_state(root: Path = ROOT) -> ProgramState:
    """Return the state of the program, which covers the content of each source file; import
    nothing.

    Raises `OSError` if the package is not a folder of files.
    """
    hasher, changed = hashlib.blake2b(digest_size=16), 0
    for name in _source_files(root):
        with open(root / name, "rb") as file:
            stat, content = os.fstat(file.fileno()), file.read()
        hasher.update(b"%s\0%d\0" % (os.fsencode(name), len(content)) + content)
        changed = max(changed, stat.st_mtime_ns, stat.st_ctime_ns)
    hasher.update(
        repr([[_importable(folder) for folder in dict.fromkeys(sys.path)], _devices()]).encode(
            errors="replace"
        )
    )
    return ProgramState(hasher.hexdigest(), changed)


def _source_files(root: Path) -> list[str]:
    """Return the paths of all source files relative to the package, sorted."""
    files = [name for name in ("__init__.py", "__main__.py") if (root / name).is_file()]
    for folder in SOURCES:
        files_of_folder = [os.path.join(folder, name) for name in _below(os.fspath(root / folder))]
        if not files_of_folder:
            raise FileNotFoundError(f"{root / folder} has no source files")
        files += files_of_folder
    return sorted(files)


def _below(folder: str, above: str = "") -> Iterator[str]:
    """Yield the paths of all files below a folder, relative to it, without byte code."""
    with os.scandir(folder) as entries:
        for entry in entries:
            name = f"{above}{entry.name}"
            if entry.name == "__pycache__":
                continue
            if entry.is_dir():
                yield from _below(entry.path, f"{name}/")
            else:
                yield name


def _importable(folder: str) -> list[tuple[str, int]]:
    """Return the entries of a folder in the search path that can be imported: installed packages
    with their time stamps, or files of code.

    The folders of Python itself count by the version of Python.
    """
    real_folder = os.path.realpath(folder or ".")
    is_site = os.path.basename(real_folder) in SITES
    if not is_site and f"{real_folder}/".startswith(f"{standard_library()}/"):
        return []
    try:
        with os.scandir(real_folder) as entries:
            code_entries = [
                entry
                for entry in entries
                if (entry.name.endswith(_ABOUT) if is_site else _is_code(entry))
            ]
            # code of the user counts only by name, since no answer is kept once such code was
            # imported
            return sorted(
                (entry.name, entry.stat().st_mtime_ns if is_site else 0) for entry in code_entries
            )
    except OSError as error:
        return [(type(error).__name__, 0)]


def _is_code(entry: os.DirEntry[str]) -> bool:
    """Return True for a file of code or a package."""
    return entry.name.endswith(_CODE) or os.path.isfile(f"{entry.path}/__init__.py")


def _devices() -> list[str]:
    """Return the names of the graphics devices and the version of their driver."""
    names = sorted(name for name in os.listdir("/dev") if name.startswith(("nvidia", "kfd", "dri")))
    try:
        return [*names, Path(_DRIVER).read_text(errors="replace")]
    except OSError:
        return names


# --- repeated command -----------------------------------------------------------------------------

# A command that may have a stored answer: the answer is looked up before the command, and stored
# after it.
#
# command = begin(["safety", "safety_pointer"], terminal)   # None where no answer can be right
# text = command.answer()                                   # None if there is none: run the command
# command.keep(...)                                         # after the command


running: list[Command] = []  #: the command of this process, if its answer may be kept
_SYSTEM = ("/proc", "/sys", "/dev")
_OUT = "runs"  #: default folder of results
_RECIPES = (".yaml", ".yml")
#: files that are derived from others: byte code, compiled modules, and matplotlib's list of fonts
_DERIVED = re.compile(r"\.pyc$|\.so$|/fontlist-v[^/]*$")
#: files of a cache that affect a forecast or an explanation, beside the results themselves
_OF_CACHE = re.compile(r"journal\.jsonl|speeds\.json|code/.*")
_SHARE = 0.9  #: share of the free memory that a run may use
#: matches the path of an unfinished folder of results
_PART = re.compile(r"/\.[^/]*\.part(/|$)")
_TICK = 20_000_000  #: ns, longer than the resolution of the clock of a file system
#: time (ns) before the start of the command in which its modules may have been imported
_IMPORTED = 2_000_000_000
_NAME = re.compile(r"\d{4}-\d\d-\d\d_(?P<label>.+)_(?P<key>[0-9a-f]{8})(_[1-9]\d{0,6})?")
_MAIN = ("__main__", "__mp_main__")  #: names of the module that the user starts
#: packages that open files outside of Python, without a parameter that states them
_NATIVE = ("h5py", "netCDF4")


def begin(words: Sequence[str], terminal: Sequence[object]) -> Command | None:
    """Return the command that may have a stored answer, or None if no answer can be read or stored.

    That is so if the cache is at a URL or not usable, and in a process that has already imported
    torch.
    """
    if "torch" in sys.modules or "://" in os.environ.get("NEUSEE_CACHE", ""):
        return None
    try:
        return Command(words, terminal, Disk(default_root()))
    except (OSError, ValueError, TypeError):
        return None


class Said(NamedTuple):
    """The dependencies of a command that writes nothing: the results that it has read from a
    store.
    """

    store: Store
    memory: float = 0.0  #: bytes that must be free
    out: None = None  #: there is no folder of results

    def fields(self) -> dict[str, Any]:
        """Return the fields of the answer that list its dependencies."""
        return {"files": {}, "stored": taken_from(self.store, {}), "memory": int(self.memory)}


class Results(NamedTuple):
    """The folder of results of a command."""

    folder: Path  #: complete
    out: Path  #: the folder that contains it
    report: StudyReport  #: the report that was written there

    def fields(self) -> dict[str, Any]:
        """Return the fields of the answer with the content of the folder."""
        return {"files": kept_files(self.folder, self.report)}


class Command:
    """A command whose answer may be stored, from its start on."""

    def __init__(self, words: Sequence[str], terminal: Sequence[object], disk: Disk) -> None:
        self._began, self._clocks = time.perf_counter(), (time.time_ns(), time.monotonic_ns())
        self._words, self._disk = list(words), disk
        self.name, self._state = command_name(words, terminal), program_state()
        self._opened, self._doubtful = Opened(), False

    def _started(self) -> int:
        """Return the start time (ns) of the command by the present clock; call this only after the
        program is imported.
        """
        from neusee.nodes.import_times import Moment

        return Moment(*self._clocks).time()

    def answer(self) -> str | None:
        """Write the folder of the stored answer again and return the text to print, or None if no
        valid answer is stored.

        If there is none, the files that this process opens from now on are recorded.
        Raises `OSError` if the folder of results cannot be written.
        """
        answer = read_answer(self._disk, self.name)
        if answer and self._holds(answer):
            # these errors come from a damaged document
            with suppress(ValueError, KeyError, TypeError, AttributeError):
                text = self._given_again(answer)
                used(self._disk, self.name)
                return text
        running[:] = [self]
        self._opened.listen()
        return None

    def _holds(self, answer: Answer) -> bool:
        """Return True if everything that the answer depends on is unchanged."""
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
            return printed(
                answer, write_again(answer, time.perf_counter() - self._began) / "report.html"
            )
        folder, document = write_run_again(answer, self._disk, time.perf_counter() - self._began)
        note_use(self._disk, answer.stored)
        return said_again(answer, folder, document)

    def doubt(self) -> None:
        """Store no answer, because the command has printed something that is not part of its text,
        such as a warning.
        """
        self._doubtful = True

    def keep(
        self,
        text: str,
        as_json: bool,
        recipe: Recipe,
        results: Results | RunResults | Said | None = None,
    ) -> None:
        """Store the answer of a command that ended well, unless one of its dependencies is in
        doubt.

        Args:
            text: of the terminal, with `stored_answer.PAGE` for the path of the page
            recipe: that of the command
            results: what the command has written, or what it has taken from a store. A command that
                writes nothing makes no cache either.
        """
        self._opened.end()
        with suppress(OSError, ValueError, KeyError, TypeError):
            inputs = [*_input_files(recipe)]
            if isinstance(results, Said):
                inputs += self._of_cache()
            out = results.out if results else None
            witnesses = self._witnesses(out, inputs)
            if self._is_doubtful() or not (out or os.path.isdir(self._disk.folder)):
                return
            answer = self._answer(witnesses, text, as_json, results)
            if write_answer(self._disk, self.name, answer):
                make_room(self._disk, budget_bytes(None))

    def _answer(
        self,
        witnesses: Witnesses,
        text: str,
        as_json: bool,
        results: Results | RunResults | Said | None,
    ) -> Answer:
        """Return the answer to store: the text, its dependencies, and the folder if there is
        one.
        """
        folder_results = results if results and results.out else None
        results_folder = str(folder_results.out) if folder_results else ""
        label, key = _parts(folder_results.folder.name) if folder_results else ("", "")
        fields = results.fields() if results else {"files": {}}
        return Answer(
            self._state.digest,
            witnesses,
            text,
            as_json,
            out=results_folder,
            label=label,
            key=key,
            **fields,
        )

    def _fits(self, answer: Answer) -> bool:
        """Return True if the command states the same folder of results as the answer, and if that
        folder can be written.

        If it cannot be written, the command itself will report why.
        """
        if not answer.key:
            return not answer.files
        if answer.out not in (
            _OUT,
            *(str(Path(word.removeprefix("--out="))) for word in self._words),
        ):
            return False
        try:
            writable_folder(answer.out)
        except ValueError:
            return False
        return True

    def _is_doubtful(self) -> bool:
        """Return True if the program may have changed since the command began, or if the command
        printed more than its text.
        """
        state_now = program_state()
        return (
            self._doubtful
            or state_now != self._state
            or state_now.changed > self._started() - _IMPORTED
            or any(name in sys.modules for name in _NATIVE)
            or any(_own_code())
        )

    def _witnesses(self, out: Path | None, inputs: Iterable[str]) -> Witnesses:
        """Return the witnesses of the answer; folders of results in ``out`` are no witnesses."""
        cache = Folders([self._disk.folder])
        written_folder = os.path.abspath(out) if out else None
        ignored = self._ignored()
        files = self._files_opened(ignored)
        # a recipe that is extended by another may lie in any folder, with options beside it
        recipe_neighbours = {os.path.dirname(path) for path in files if path.endswith(_RECIPES)}
        recipes = _recipe_folders(self._words) | recipe_neighbours
        if any(path in cache for path in (os.getcwd(), *files)) or written_folder in recipes:
            raise Unsettled("a recipe is in the folder of the cache or of results")
        folders = self._folders_listed(ignored)
        listed_folders = {
            path: listing for path, listing in folders.items() if path != written_folder
        }
        return witnesses_of(
            [*files, *inputs], recipes, listed_folders, self._started() - _TICK, written_folder
        )

    def _ignored(self) -> Folders:
        """Return the folders of installed packages and of the cache, which are checked in other
        ways.
        """
        sources = [ROOT / name for name in SOURCES]
        return Folders([*_installed(), *_SYSTEM, self._disk.folder, *sources])

    def _files_opened(self, ignored: Folders) -> list[str]:
        """Return the opened files that are neither ignored nor derived from other files."""
        opened_files = [path for path in self._opened.files if not _DERIVED.search(path)]
        return [path for path in opened_files if path.endswith(_RECIPES) or path not in ignored]

    def _folders_listed(self, ignored: Folders) -> dict[str, Listing]:
        """Return the content of the folders that were listed, except for ignored and unfinished
        folders.
        """
        return {
            path: listing
            for path, listing in self._opened.folders.items()
            if path not in ignored and not _PART.search(path)
        }

    def _of_cache(self) -> list[str]:
        """Return the files of the cache that were read and that affect a forecast or an
        explanation.
        """
        return [
            path
            for path in self._opened.files
            if _OF_CACHE.fullmatch(_inside(path, self._disk.folder))
        ]


def _are_free(memory: int) -> bool:
    """Return True if a run may use ``memory`` bytes now."""
    if not memory:
        return True
    return _SHARE * free_memory() >= memory


def _inside(path: str, folder: str) -> str:
    """Return a path relative to a folder, with symbolic links resolved."""
    return os.path.relpath(os.path.realpath(path), os.path.realpath(folder))


def _parts(folder: str) -> tuple[str, str]:
    """Return the label and the key in the name of a folder of results, such as
    ``2026-11-23_safety_82a46a54_2``.

    Raises `ValueError` for another name.
    """
    match = _NAME.fullmatch(folder)
    if not match:
        raise ValueError(f"{folder} is not the name of a folder of results")
    return match["label"], match["key"]


def _recipe_folders(words: Sequence[str]) -> set[str]:
    """Return the folders in which the recipe and its options are searched."""
    from neusee.workflows.recipe.text.recipe_files import shared_folders

    folders_of_recipes = (
        os.path.dirname(os.path.expanduser(word)) for word in words if word.endswith(_RECIPES)
    )
    return {
        os.path.abspath(folder or ".")
        for folder in [".", *folders_of_recipes, *map(str, shared_folders())]
    }


def _input_files(recipe: Recipe) -> set[str]:
    """Return the paths of all files that occur as values of a recipe; a path that is a folder is
    refused later.
    """
    values_left: list[Any] = list(recipe.config.values.values())
    paths = set()
    while values_left:
        value = values_left.pop()
        if isinstance(value, Path):
            paths.add(os.path.abspath(value))
        elif isinstance(value, dict):
            values_left += [*value, *value.values()]
        elif isinstance(value, list | tuple | set | frozenset):
            values_left += value
    return paths


def _installed() -> list[str]:
    """Return the folders of Python's own modules and of installed packages, which count by their
    versions.
    """
    return [
        standard_library(),
        *(folder for folder in sys.path if os.path.basename(folder) in SITES),
    ]


def _own_code() -> Iterable[str]:
    """Yield the loaded modules that are neither neusee's nor installed, so the user's own code."""
    covered_folders = Folders([*_installed(), ROOT])
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)  # for torch.ops, this is a name without a folder
        if (
            file
            and name not in _MAIN
            and os.path.isfile(file)
            and os.path.abspath(file) not in covered_folders
        ):
            yield name
