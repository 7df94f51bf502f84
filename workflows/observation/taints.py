"""What the key of a step covers, and the judgement of what the step reached beyond it."""

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

# What is covered by the key of a step, and what a step reached beyond it.


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
    """What the key of a step knows: a step may reach it."""

    files: frozenset[Path]  #: real paths of files and folders; a folder covers what is in it
    modules: Callable[[str], bool]  #: True for a module whose source the key follows


class Taint(NamedTuple):
    """One thing that a step reached and its key does not know."""

    kind: Kind
    what: str  #: path, command, address, generator or module
    fix: str  #: what to write


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
#: what else to write against a draw, by what was drawn from
_OF_CHANCE = {
    "torch": f"{_SEED.format(call='torch.manual_seed(seed)')}; or {_OF_LAYERS}",
    "torch.cuda": f"{_SEED.format(call='torch.manual_seed(seed)')}; or {_OF_LAYERS}",
    "numpy.random": _SEED.format(call="np.random.seed(seed)"),
}


def taint(kind: Kind, name: str) -> Taint:
    """Return a taint with what to write against it."""
    fix = _FIX[kind].format(name=_short(kind, name))
    if kind == "random" and name in _OF_CHANCE:
        fix = f"{_OF_CHANCE[name]}; or {fix}"
    return Taint(kind, name, fix)


def _short(kind: Kind, name: str) -> str:
    """Return the last name of a file or of something in a module, by which it is declared."""
    if kind == "memory":
        return name.rpartition(".")[2]
    return Path(name).name if kind in _OF_PATHS else name


# --- judgement ------------------------------------------------------------------------------------

# Which of the things that a step reached are not covered by its key?


_ACCESS = os.O_RDONLY | os.O_WRONLY | os.O_RDWR
_PATH = getattr(os, "O_PATH", 0)
_TMPFILE = getattr(os, "O_TMPFILE", 0)
_GRND_NONBLOCK, _GRND_INSECURE = 1, 4
_NO_FILE = "<unknown>"  #: of code that `ast.parse` was given as a text


class Judgement:
    """The taints of one call, from its records in their order."""

    def __init__(
        self,
        covered: Covered,
        bodies: dict[str, str],
        quiet: Set[str] = frozenset(),
        temporary: Set[str] = frozenset(),
    ) -> None:
        """Judge by what the key covers, and by what the process knows: see `python_watch.Watch`."""
        self._covered, self._bodies = covered, bodies
        self._quiet, self._temporary = quiet, temporary
        self._files = {str(path) for path in covered.files}
        self._made: set[str] = set()  #: files and folders that the call itself made
        self._caches = set(caches())
        self._folders = _with_all_parents((*self._files, *program(), *self._caches, *looked_at()))
        self._looks: dict[str, None] = {}  #: paths that were looked at and are not covered
        self._taints: dict[Taint, None] = {}

    def judge(self, records: Iterable[Record]) -> None:
        """Add the taints of records."""
        for record in records:
            getattr(self, f"_{record.does}")(record)

    def add(self, kind: Kind, name: str) -> None:
        """Add a taint."""
        self._taints[taint(kind, name)] = None

    def judge_modules(self) -> None:
        """Add a taint for each module of the user that was executed and that the key does not
        follow.
        """
        for name in self._bodies:
            if not self._covered.modules(name):
                self.add("import", name)

    def taints(self) -> tuple[Taint, ...]:
        """Return the taints, each once; a look at a folder on the way to another one is none."""
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
        """Judge a file that was opened: whoever does not empty it may learn its length, or that
        it was there.
        """
        flags = record.flags
        # the flag has several bits
        if _TMPFILE and flags & _TMPFILE == _TMPFILE:
            return  # a new file without a name
        # made by the call, if it was not there
        if _creates(record):
            self._make(record)
        # emptied: its old content is not read
        elif flags & os.O_TRUNC and flags & _ACCESS != os.O_RDONLY:
            self._add_made(record.path)
        # a look at it
        elif flags & _PATH or os.path.isdir(record.path):
            self._check(record)
        # written without a look at its content
        elif flags & _ACCESS == os.O_WRONLY:
            self._meet(record)
        else:
            self._read(record.path)
            self._read_source(record.path)

    def _make(self, record: Record) -> None:
        """Judge what is made if it is not there: that it could be made says that it was not
        there before.
        """
        if record.there or os.path.lexists(record.path):  # the next run finds it
            self._meet(record)
        if not record.there:
            self._add_made(record.path)

    def _remove(self, record: Record) -> None:
        """Judge what is removed: that it could be removed says that it was there."""
        self._meet(record)

    def _meet(self, record: Record) -> None:
        """Judge a path where the success of a call depends on what was there before."""
        path = record.path
        named_by_chance = not self._temporary.isdisjoint(_with_parents(path))
        needs_no_taint = record.trusted or named_by_chance or path in self._folders
        if not (needs_no_taint or self._is_covered(path) or is_searched_program(path)):
            self.add("write", path)

    def _move(self, record: Record) -> None:
        """Follow a file of the step to its new name; any other file is read there, perhaps in a
        folder of the step.
        """
        if os.path.isdir(record.second):  # one that is there stops a move
            self._meet(record._replace(path=record.second))
        # its own file has another name now
        if self._is_made(record.path):
            self._add_made(record.second)
        elif record.there or not record.trusted:
            self._read(record.path)

    def _link(self, record: Record) -> None:
        """Judge a link like a move: the file has the new name too."""
        if os.path.lexists(record.second):
            self._meet(record._replace(path=record.second))
        self._move(record)

    def _xattr(self, record: Record) -> None:
        """Judge marks beside a file: no key has them, also of a file that is covered."""
        if record.path not in self._quiet and not (
            self._is_made(record.path) or self._is_of_machine(record.path)
        ):
            self.add("attribute", record.path)

    def _check(self, record: Record) -> None:
        """Judge a look at a path; whether it counts is known at the end."""
        if not (
            record.path in self._folders
            or self._is_covered(record.path)
            or is_searched_program(record.path)
        ):
            self._looks[record.path] = None

    def _list(self, record: Record) -> None:
        """Judge a folder whose names are read."""
        if not self._is_covered(record.path):
            self.add("folder", record.path)

    def _input(self, record: Record) -> None:
        """Judge what is read from an open file, such as the terminal."""
        self._read(record.path)

    def _exec(self, record: Record) -> None:
        """Judge a program that is started; a look for one that is not there is none."""
        if record.there:
            self.add("process", record.path)

    def _fork(self, record: Record) -> None:
        """Judge a fork, whose calls may be those of the step."""
        self.add("process", "a fork of this process")

    def _connect(self, record: Record) -> None:
        """Judge an address that is asked; a socket of the step or of the system is none."""
        is_own_socket = record.second == "unix" and (
            self._is_made(record.path) or is_of_system(record.path)
        )
        # an empty family reaches nothing
        if record.second and not is_own_socket:
            self.add("network", record.path)

    def _bind(self, record: Record) -> None:
        """Judge an address at which the step listens."""
        if record.second == "unix":
            self._add_made(record.path)
        else:
            self._connect(record)

    def _entropy(self, record: Record) -> None:
        """Judge a call for chance; a small one that does not wait seeds tables and names."""
        if record.flags & _GRND_INSECURE:
            return  # seeds of the hash tables of Rust, as in safetensors
        if not record.flags & _GRND_NONBLOCK or record.there:
            self.add("random", record.path)

    def _unseen(self, record: Record) -> None:
        """Judge a call that nobody can follow."""
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
        """Judge source of a module that the key follows, which has neither its comments nor its
        lines.
        """
        if (
            path not in self._quiet
            and not self._is_covered_as_a_whole(path)
            and self._is_source(path)
        ):
            self.add("file", path)

    def _is_covered(self, path: str) -> bool:
        """Return True for a path that the key covers, source of followed modules included."""
        # a text of several lines, of which a library asks whether it is the name of a file, or the
        # name that Python gives to code without a file, whose source a traceback looks for
        no_name = "\n" in path or os.path.basename(path) == _NO_FILE
        if no_name and not os.path.lexists(path):
            return True
        return self._is_covered_as_a_whole(path) or self._is_source(path)

    def _is_covered_as_a_whole(self, path: str) -> bool:
        """Return True for a path of which every byte is covered: made by the call, declared, or
        of the machine.
        """
        if self._is_made(path) or not self._files.isdisjoint(_with_parents(path)):
            return True
        return self._is_of_machine(path)

    def _is_of_machine(self, path: str) -> bool:
        """Return True for a path of installed packages, the system or a cache."""
        return is_installed(path) or is_of_system(path) or self._is_cache(path)

    def _is_cache(self, path: str) -> bool:
        """Return True for a path in a folder of caches."""
        return not self._caches.isdisjoint(_with_parents(path))

    def _is_source(self, path: str) -> bool:
        """Return True for source or byte code of a module that the key follows; a traceback
        reads the source again.
        """
        folder, name = os.path.split(path)
        if os.path.basename(folder) == "__pycache__":
            # "__pycache__/node.cpython-311.pyc" is byte code of "node.py"
            folder, name = os.path.dirname(folder), f"{name.partition('.')[0]}.py"
        source = os.path.join(folder, name)
        return any(self._covered.modules(module) for module in self._modules_of(source))

    def _modules_of(self, source: str) -> Iterator[str]:
        """Yield the modules that were made from a file."""
        yield from (module for module, file in self._bodies.items() if file == source)
        for module, loaded in sys.modules.copy().items():
            # to ask a lazy module would import it
            file = getattr(loaded, "__dict__", {}).get("__file__")
            if (
                isinstance(file, str)
                and os.path.basename(file) == os.path.basename(source)
                and os.path.realpath(file) == source
            ):
                yield module

    def _is_made(self, path: str) -> bool:
        """Return True for a path that the call made, or that is in a folder which it made."""
        if not os.path.isabs(path):  # below an open folder that nobody named
            return any(made_path.endswith(f"/{path}") for made_path in self._made)
        return not self._made.isdisjoint(_with_parents(path))

    def _add_made(self, path: str) -> None:
        """Count a path as made by the call."""
        self._made.add(path)
        self._folders.update(_with_parents(path))


def _creates(record: Record) -> bool:
    """Return True for a call that makes a file, or that one which is there stops."""
    if not record.flags & os.O_CREAT:
        return False
    return bool(record.flags & os.O_EXCL) or not (record.there or record.flags & os.O_TRUNC)


def _with_parents(path: str) -> list[str]:
    """Return a path and the folders that it is in, the innermost first."""
    paths = [path]
    while path not in ("/", "") and (parent_folder := os.path.dirname(path)) != path:
        path = parent_folder
        paths.append(path)
    return paths


def _with_all_parents(paths: Iterable[str]) -> set[str]:
    """Return paths with the folders that they are in: to look at one says only that the way to
    the end exists.
    """
    return set(chain.from_iterable(map(_with_parents, paths)))
