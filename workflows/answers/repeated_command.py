"""A command that may have a stored answer, which is looked for before the command runs."""

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


#: variables of a login or a terminal window that no program of this house reads; the working folder
#: counts by itself, and the secret of the cache by the signature of each answer
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
    """Return the name of the answer to a command; ``terminal`` says how wide the terminal is and
    what it shows.

    The name depends on the words, the working folder, all variables of the environment but
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
    """Return the variables of the environment that may decide an answer."""
    return {name: value for name, value in variables.items() if name not in IGNORED}


# --- installed program ----------------------------------------------------------------------------

# Digest of the program as it is installed: its source files, the packages beside it, and the
# graphics devices.


ROOT = Path(__file__).parents[2]  #: of the package neusee
SOURCES = ("nodes", "workflows")  #: folders of the package of which every file counts
SITES = ("site-packages", "dist-packages")  #: names of folders of installed packages
_ABOUT = (".dist-info", ".egg-info", ".egg-link", ".pth")
_CODE = (".py", ".so", ".pyd", ".zip")
_DRIVER = "/proc/driver/nvidia/version"


class ProgramState(NamedTuple):
    """Digest of the installed program, and when the newest of its source files changed."""

    digest: str
    changed: int  #: ns since 1970


def standard_library() -> str:
    """Return the folder of Python's own modules."""
    return os.path.dirname(os.path.realpath(os.__file__))


def program_state(root: Path = ROOT) -> ProgramState:
    """Return the state of the program, with the content of each of its source files; import
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
    """Return what a folder of the search path can import: installed packages with their time, or
    files of code.

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
            # code of the user counts by name: with imported code no answer is kept
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

# A command that may have a stored answer: the answer is looked for before the command, and kept
# after it.
#
# command = begin(["safety", "safety_pointer"], terminal)   # None where no answer can be right
# text = command.answer()                                   # None if there is none: run the command
# command.keep(...)                                         # after the command


running: list[Command] = []  #: the command of this process, if its answer may be kept
_SYSTEM = ("/proc", "/sys", "/dev")
_OUT = "runs"  #: folder of results where the command names none
_RECIPES = (".yaml", ".yml")
#: files that are made of others: bytecode, compiled modules, and the list of fonts that matplotlib
#: keeps
_DERIVED = re.compile(r"\.pyc$|\.so$|/fontlist-v[^/]*$")
#: files of a cache that decide what a forecast or an explanation says, beside the results
#: themselves
_OF_CACHE = re.compile(r"journal\.jsonl|speeds\.json|code/.*")
_SHARE = 0.9  #: of the free memory, which a run may use
#: in the path of a folder of results that is not complete
_PART = re.compile(r"/\.[^/]*\.part(/|$)")
_TICK = 20_000_000  #: ns, longer than a tick of the clock of a file system
#: ns before the command began in which its modules may have been imported
_IMPORTED = 2_000_000_000
_NAME = re.compile(r"\d{4}-\d\d-\d\d_(?P<label>.+)_(?P<key>[0-9a-f]{8})(_[1-9]\d{0,6})?")
_MAIN = ("__main__", "__mp_main__")  #: the program that the user starts
#: packages whose files are opened without Python, and named by no parameter
_NATIVE = ("h5py", "netCDF4")


def begin(words: Sequence[str], terminal: Sequence[object]) -> Command | None:
    """Return the command that may have a stored answer, or None where none is looked for or kept.

    That is where the cache is at a URL or not usable, and in a process that has already imported
    torch.
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
        """Return the time (ns) of the begin by the clock as it is set now; the program is
        imported by then.
        """
        from neusee.nodes.import_times import Moment

        return Moment(*self._clocks).time()

    def answer(self) -> str | None:
        """Write the folder of the stored answer again and return the text to print, or None without
        a right answer.

        Without one, the files that this process opens from now on are recorded.
        Raises `OSError` if the folder of results cannot be written.
        """
        answer = read_answer(self._disk, self.name)
        if answer and self._holds(answer):
            # a damaged document
            with suppress(ValueError, KeyError, TypeError, AttributeError):
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
            return printed(
                answer, write_again(answer, time.perf_counter() - self._began) / "report.html"
            )
        folder, document = write_run_again(answer, self._disk, time.perf_counter() - self._began)
        note_use(self._disk, answer.stored)
        return said_again(answer, folder, document)

    def doubt(self) -> None:
        """Keep no answer: the command has said something that its text does not hold, such as a
        warning.
        """
        self._doubtful = True

    def keep(
        self,
        text: str,
        as_json: bool,
        recipe: Recipe,
        results: Results | RunResults | Said | None = None,
    ) -> None:
        """Keep the answer of a command that has ended well; do so only if nothing that it rests on
        is in doubt.

        Args: text: of the terminal, with `stored_answer.PAGE` for the path of the page. recipe:
                that of the command.
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
        """Return the answer to keep: the text, what decided it, and the folder if there is one."""
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
        """Return True if the folder of an answer is the one that the command names, and if it can
        be written.

        If it cannot be written, the command itself says why.
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
        said more.
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
        # a recipe that another one extends may lie anywhere, with options beside it
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
        """Return the folders of what is installed and of the cache, which have other witnesses."""
        sources = [ROOT / name for name in SOURCES]
        return Folders([*_installed(), *_SYSTEM, self._disk.folder, *sources])

    def _files_opened(self, ignored: Folders) -> list[str]:
        """Return the files that were opened and are neither ignored nor made from other ones."""
        opened_files = [path for path in self._opened.files if not _DERIVED.search(path)]
        return [path for path in opened_files if path.endswith(_RECIPES) or path not in ignored]

    def _folders_listed(self, ignored: Folders) -> dict[str, Listing]:
        """Return what was in the folders that were listed, but for ignored and unfinished ones."""
        return {
            path: listing
            for path, listing in self._opened.folders.items()
            if path not in ignored and not _PART.search(path)
        }

    def _of_cache(self) -> list[str]:
        """Return the files of the cache that were read and decide what a forecast or an
        explanation says.
        """
        return [
            path
            for path in self._opened.files
            if _OF_CACHE.fullmatch(_inside(path, self._disk.folder))
        ]


def _are_free(memory: int) -> bool:
    """Return True if a run may use so many bytes of memory now."""
    if not memory:
        return True
    return _SHARE * free_memory() >= memory


def _inside(path: str, folder: str) -> str:
    """Return a path relative to a folder, links followed."""
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
    """Return the folders in which the recipe and its options are looked for."""
    from neusee.workflows.recipe.text.recipe_files import shared_folders

    folders_of_recipes = (
        os.path.dirname(os.path.expanduser(word)) for word in words if word.endswith(_RECIPES)
    )
    return {
        os.path.abspath(folder or ".")
        for folder in [".", *folders_of_recipes, *map(str, shared_folders())]
    }


def _input_files(recipe: Recipe) -> set[str]:
    """Return the paths of all files that the values of a recipe name; one that is a folder is
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
    """Return the folders of Python's own modules and of installed packages, whose versions
    count.
    """
    return [
        standard_library(),
        *(folder for folder in sys.path if os.path.basename(folder) in SITES),
    ]


def _own_code() -> Iterable[str]:
    """Yield the modules of this process that are neither neusee nor installed: a recipe names
    code of its own.
    """
    covered_folders = Folders([*_installed(), ROOT])
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)  # of torch.ops it is a name without a folder
        if (
            file
            and name not in _MAIN
            and os.path.isfile(file)
            and os.path.abspath(file) not in covered_folders
        ):
            yield name
