"""What the key of a step covers, and the judgement of the accesses that it does not cover
(taints).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Set
from itertools import chain
from pathlib import Path
from typing import Literal, NamedTuple

from neusee.workflows.observation.covered_paths import (
    caches,
    is_chance,
    is_installed,
    is_of_system,
    is_searched_program,
    looked_at,
    program,
)
from neusee.workflows.observation.system_calls import Record

# --- taints ---------------------------------------------------------------------------------------

# Dependencies that the key of a step covers, and those that it does not cover.


Kind = Literal[
    "file",
    "folder",
    "write",
    "attribute",
    "process",
    "network",
    "random",
    "import",
    "memory",
    "variable",
    "unknown",
]


class Covered(NamedTuple):
    """The files and modules that the key of a step covers, so that the step may read them."""

    files: frozenset[Path]  #: real paths of files and folders; a folder covers everything in it
    modules: Callable[[str], bool]  #: True for a module whose source the key follows


class Taint(NamedTuple):
    """One dependency of a step that its key does not cover."""

    kind: Kind
    what: str  #: name of the dependency: path, command, address, generator or module
    fix: str  #: advice: what to write instead


_OF_PATHS = ("file", "folder", "write", "attribute")
_FIX: dict[Kind, str] = {
    "file": (
        'declare it, depends=["{name}"], or make it a parameter of type DataFile; or write cache:'
        " false"
    ),
    "folder": (
        'declare the folder, depends=["{name}"], or make its files a parameter of type DataFiles;'
        " or write cache: false"
    ),
    "write": (
        'empty the file where it is opened, mode "w", or write to a temporary one; or, if no result'
        ' depends on what was there before, depends=["unaffected:{name}"]; or write cache: false'
    ),
    "attribute": "give it as a parameter; or write cache: false",
    "process": (
        "compute it in the node, or run it before and give its output as a DataFile; or write"
        " cache: false"
    ),
    "network": "fetch it before and give the file as a DataFile; or write cache: false",
    "random": (
        "draw from an argument rng of the node, a generator that the engine seeds; or write cache:"
        " false"
    ),
    "import": (
        'write the import as a statement, or declare the module: depends=["{name}"]; or write'
        " cache: false"
    ),
    "memory": (
        "return it as a value to the steps that read it, or, if no result depends on it, declare "
        'depends=["unaffected:{name}"]; or write cache: false'
    ),
    "variable": 'make it a parameter, or declare it, depends=["env:{name}"]; or write cache: false',
    "unknown": "write cache: false",
}
_SEED = "set the seed in the node before it draws, {call}, from a parameter or a constant"
_OF_LAYERS = (
    "make a layer whose weights the node fills itself without drawing them, "
    "torch.nn.utils.skip_init(torch.nn.Linear, 3, 2)"
)
#: further advice against drawing random numbers, by the source of the numbers
_OF_CHANCE = {
    "torch": f"{_SEED.format(call='torch.manual_seed(seed)')}; or {_OF_LAYERS}",
    "torch.cuda": f"{_SEED.format(call='torch.manual_seed(seed)')}; or {_OF_LAYERS}",
    "numpy.random": _SEED.format(call="np.random.seed(seed)"),
}


def taint(kind: Kind, name: str) -> Taint:
    """Return a taint with advice on how to avoid it."""
    fix = _FIX[kind].format(name=_short(kind, name))
    if kind == "random" and name in _OF_CHANCE:
        fix = f"{_OF_CHANCE[name]}; or {fix}"
    return Taint(kind, name, fix)


def _short(kind: Kind, name: str) -> str:
    """Return the last part of the name of a file or of a value in a module, with which it is
    declared.
    """
    if kind == "memory":
        return name.rpartition(".")[2]
    return Path(name).name if kind in _OF_PATHS else name


# --- judgement ------------------------------------------------------------------------------------

# Which accesses of a step are not covered by its key?


_ACCESS = os.O_RDONLY | os.O_WRONLY | os.O_RDWR
_PATH = getattr(os, "O_PATH", 0)
_TMPFILE = getattr(os, "O_TMPFILE", 0)
_GRND_NONBLOCK, _GRND_INSECURE = 1, 4
_NO_FILE = "<unknown>"  #: file name of code that was parsed from a text


class Judgement:
    """The taints of one call, derived from its records in their order."""

    def __init__(
        self,
        covered: Covered,
        bodies: dict[str, str],
        quiet: Set[str] = frozenset(),
        temporary: Set[str] = frozenset(),
    ) -> None:
        """Judge by what the key covers, and by what the process knows (see
        `python_watch.Watch`).
        """
        self._covered, self._bodies = covered, bodies
        self._quiet, self._temporary = quiet, temporary
        self._files = {str(path) for path in covered.files}
        self._made: set[str] = set()  #: files and folders that the call itself made
        self._caches = set(caches())
        self._folders = _with_all_parents((*self._files, *program(), *self._caches, *looked_at()))
        #: paths that were checked for existence or status and are not covered
        self._looks: dict[str, None] = {}
        self._taints: dict[Taint, None] = {}

    def judge(self, records: Iterable[Record]) -> None:
        """Add the taints that follow from some records."""
        for record in records:
            getattr(self, f"_{record.does}")(record)

    def add(self, kind: Kind, name: str) -> None:
        """Add a taint."""
        self._taints[taint(kind, name)] = None

    def judge_modules(self) -> None:
        """Add a taint for each module of the user that ran and that the key does not cover."""
        for name in self._bodies:
            if not self._covered.modules(name):
                self.add("import", name)

    def taints(self) -> tuple[Taint, ...]:
        """Return the taints, each once. A check of a folder on the way to another path is no
        taint.
        """
        kinds = ("file", "folder", "write")
        reached_paths = [
            reached_item.what for reached_item in self._taints if reached_item.kind in kinds
        ]
        on_the_way = set[str]()
        for path in (*reached_paths, *self._looks):
            # without the path itself
            on_the_way.update(_with_parents(path)[1:])
        for path in self._looks:
            if path not in on_the_way:
                self._read(path)
        return tuple(self._taints)

    # --- what was done ----------------------------------------------------------------------------

    def _open(self, record: Record) -> None:
        """Judge a file that was opened. Unless the call empties the file, the step may learn its
        length or that it existed.
        """
        flags = record.flags
        # the flag has several bits
        if _TMPFILE and flags & _TMPFILE == _TMPFILE:
            return  # a new file without a name
        # the call makes the file if it does not exist
        if _creates(record):
            self._make(record)
        # the file is emptied: its old content is not read
        elif flags & os.O_TRUNC and flags & _ACCESS != os.O_RDONLY:
            self._add_made(record.path)
        # opened only to check the path, or a folder
        elif flags & _PATH or os.path.isdir(record.path):
            self._check(record)
        # written without reading its content
        elif flags & _ACCESS == os.O_WRONLY:
            self._meet(record)
        else:
            self._read(record.path)
            self._read_source(record.path)

    def _make(self, record: Record) -> None:
        """Judge a path that a call makes: success shows that the path did not exist before."""
        if record.there or os.path.lexists(record.path):  # the next run will find this path
            self._meet(record)
        if not record.there:
            self._add_made(record.path)

    def _remove(self, record: Record) -> None:
        """Judge a path that is removed: success shows that it existed."""
        self._meet(record)

    def _meet(self, record: Record) -> None:
        """Judge a path if the success of a call depends on what existed before."""
        path = record.path
        named_by_chance = not self._temporary.isdisjoint(_with_parents(path))
        needs_no_taint = record.trusted or named_by_chance or path in self._folders
        if not (needs_no_taint or self._is_covered(path) or is_searched_program(path)):
            self.add("write", path)

    def _move(self, record: Record) -> None:
        """Follow a file that the step made to its new name. Any other file counts as read, since it
        may be moved into a folder of the step.
        """
        if os.path.isdir(record.second):  # an existing folder at the target stops a move
            self._meet(record._replace(path=record.second))
        # a file that the step made has another name now
        if self._is_made(record.path):
            self._add_made(record.second)
        elif record.there or not record.trusted:
            self._read(record.path)

    def _link(self, record: Record) -> None:
        """Judge a link like a move: the file also has the new name."""
        if os.path.lexists(record.second):
            self._meet(record._replace(path=record.second))
        self._move(record)

    def _xattr(self, record: Record) -> None:
        """Judge extended attributes of a file: no key covers them, even if it covers the file."""
        if record.path not in self._quiet and not (
            self._is_made(record.path) or self._is_of_machine(record.path)
        ):
            self.add("attribute", record.path)

    def _check(self, record: Record) -> None:
        """Judge a check of a path; whether it counts is decided at the end."""
        if not (
            record.path in self._folders
            or self._is_covered(record.path)
            or is_searched_program(record.path)
        ):
            self._looks[record.path] = None

    def _list(self, record: Record) -> None:
        """Judge a folder whose entries are listed."""
        if not self._is_covered(record.path):
            self.add("folder", record.path)

    def _input(self, record: Record) -> None:
        """Judge a read from an open file, such as the terminal."""
        self._read(record.path)

    def _exec(self, record: Record) -> None:
        """Judge the start of a program; a search for a missing program is no taint."""
        if record.there:
            self.add("process", record.path)

    def _fork(self, record: Record) -> None:
        """Judge a fork of this process, whose later calls may be part of the step."""
        self.add("process", "a fork of this process")

    def _connect(self, record: Record) -> None:
        """Judge an address that is contacted; a local socket made by the step or of the system is
        no taint.
        """
        is_own_socket = record.second == "unix" and (
            self._is_made(record.path) or is_of_system(record.path)
        )
        # an empty family connects to nothing
        if record.second and not is_own_socket:
            self.add("network", record.path)

    def _bind(self, record: Record) -> None:
        """Judge an address at which the step listens."""
        if record.second == "unix":
            self._add_made(record.path)
        else:
            self._connect(record)

    def _entropy(self, record: Record) -> None:
        """Judge a call for random bytes; a short call that does not wait only seeds hash tables and
        names.
        """
        if record.flags & _GRND_INSECURE:
            return  # seeds of the hash tables of Rust, as in safetensors
        if not record.flags & _GRND_NONBLOCK or record.there:
            self.add("random", record.path)

    def _unseen(self, record: Record) -> None:
        """Judge a call that cannot be followed."""
        self.add("unknown", record.path)

    # --- what is covered --------------------------------------------------------------------------

    def _read(self, path: str) -> None:
        """Judge a file or folder that is read."""
        if is_chance(path):
            self.add("random", path)
        elif not self._is_covered(path):
            kind: Kind = "folder" if os.path.isdir(path) else "file"
            self.add(kind, path)

    def _read_source(self, path: str) -> None:
        """Judge the source of a module of the user, of which the key covers neither comments nor
        line numbers.
        """
        if (
            path not in self._quiet
            and not self._is_covered_as_a_whole(path)
            and self._is_source(path)
        ):
            self.add("file", path)

    def _is_covered(self, path: str) -> bool:
        """Return True for a path that the key covers, including the source of followed modules."""
        # a library may check whether a text of several lines is a path, and a traceback looks for
        # the source of code without a file, under the name that Python gives it
        no_name = "\n" in path or os.path.basename(path) == _NO_FILE
        if no_name and not os.path.lexists(path):
            return True
        return self._is_covered_as_a_whole(path) or self._is_source(path)

    def _is_covered_as_a_whole(self, path: str) -> bool:
        """Return True for a path whose every byte is covered: made by the call, declared, or part
        of the machine.
        """
        if self._is_made(path) or not self._files.isdisjoint(_with_parents(path)):
            return True
        return self._is_of_machine(path)

    def _is_of_machine(self, path: str) -> bool:
        """Return True for a path of an installed package, of the system or of a cache."""
        return is_installed(path) or is_of_system(path) or self._is_cache(path)

    def _is_cache(self, path: str) -> bool:
        """Return True for a path in a folder of caches."""
        return not self._caches.isdisjoint(_with_parents(path))

    def _is_source(self, path: str) -> bool:
        """Return True for the source or byte code of a module that the key follows."""
        folder, name = os.path.split(path)
        if os.path.basename(folder) == "__pycache__":
            # "__pycache__/node.cpython-311.pyc" is byte code of "node.py"
            folder, name = os.path.dirname(folder), f"{name.partition('.')[0]}.py"
        source = os.path.join(folder, name)
        return any(self._covered.modules(module) for module in self._modules_of(source))

    def _modules_of(self, source: str) -> Iterator[str]:
        """Yield the modules that were loaded from a file."""
        yield from (module for module, file in self._bodies.items() if file == source)
        for module, loaded in sys.modules.copy().items():
            # `getattr` on a lazy module itself would import it
            file = getattr(loaded, "__dict__", {}).get("__file__")
            if (
                isinstance(file, str)
                and os.path.basename(file) == os.path.basename(source)
                and os.path.realpath(file) == source
            ):
                yield module

    def _is_made(self, path: str) -> bool:
        """Return True for a path that the call made, or that lies in a folder that the call
        made.
        """
        if not os.path.isabs(path):  # below an open folder whose path is unknown
            return any(made_path.endswith(f"/{path}") for made_path in self._made)
        return not self._made.isdisjoint(_with_parents(path))

    def _add_made(self, path: str) -> None:
        """Count a path as made by the call."""
        self._made.add(path)
        self._folders.update(_with_parents(path))


def _creates(record: Record) -> bool:
    """Return True for a call that makes a file, or that fails if the file exists."""
    if not record.flags & os.O_CREAT:
        return False
    return bool(record.flags & os.O_EXCL) or not (record.there or record.flags & os.O_TRUNC)


def _with_parents(path: str) -> list[str]:
    """Return a path and all folders above it, the innermost first."""
    paths = [path]
    while path not in ("/", "") and (parent_folder := os.path.dirname(path)) != path:
        path = parent_folder
        paths.append(path)
    return paths


def _with_all_parents(paths: Iterable[str]) -> set[str]:
    """Return paths with all folders above them: a check of such a folder shows only that the way to
    the path exists.
    """
    return set(chain.from_iterable(map(_with_parents, paths)))
