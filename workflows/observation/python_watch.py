"""Observation of a call by Python itself: audit events, imports and threads."""

from __future__ import annotations

import _imp
import _thread
import builtins
import functools
import importlib
import os
import pickle
import random
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any, Protocol, Self

import numpy as np

from neusee.workflows.observation.covered_paths import is_installed
from neusee.workflows.observation.system_calls import CHILD, TRUSTED, UNTRUSTED, Does, Record

# --- replaced functions ---------------------------------------------------------------------------

# Functions of modules and classes that are replaced by others while a call is observed.


#: module or class of a function, the function's name there, and the wrapper
Wrapping = tuple[Any, str, Callable[[Any], Any]]


def wrapped(wrappings: Iterable[Wrapping]) -> list[tuple[Any, str, Any]]:
    """Return the module or class, the name and the wrapped function for each wrapping that this
    Python supports.
    """
    return [
        (holder, name, wrap(getattr(holder, name)))
        for holder, name, wrap in wrappings
        if hasattr(holder, name)
    ]


class ReplacedFunctions:
    """Functions that are replaced inside a ``with`` block."""

    def __init__(self, replacements: Sequence[tuple[Any, str, Any]]) -> None:
        """Take the module or class and the name of each function, and its replacement."""
        self._meanwhile = replacements
        self._before = [(holder, name, getattr(holder, name)) for holder, name, _ in replacements]

    def __enter__(self) -> Self:
        for holder, name, function in self._meanwhile:
            setattr(holder, name, function)
        return self

    def __exit__(self, *_: object) -> None:
        for holder, name, function in self._before:
            setattr(holder, name, function)


# --- kept generators ------------------------------------------------------------------------------

# Generators that installed packages make for themselves when they are imported.
#
# No result depends on an import that makes one. But a step that later draws from it depends on
# random numbers, or on the steps that drew before.


_kept: dict[int, tuple[str, Any]] = {}  #: module and generator, by id


class KeptGenerators:
    """Generators that installed packages keep, with their states before an observed call, or just
    after import for packages first imported during that call.
    """

    def __init__(self) -> None:
        self.drew = False  #: True if an installed package drew random numbers during its import
        self._modules = set(sys.modules)  # loaded before the call
        self._states = {number: _state(generator) for number, (_, generator) in _kept.items()}
        self._drawn: list[str] = []  #: modules with a generator that drew during their import

    def keep(self, generator: Any, module: str) -> None:
        """Remember the bit generator of NumPy, or the generator of Python, that a module of an
        installed package makes.
        """
        _kept[id(generator)] = module, generator

    def note(self) -> None:
        """Note the states of new generators of packages, at the end of an import."""
        if self.drew:
            self.drew = False
            self._keep_of_modules()
        for number in _kept.keys() - self._states.keys():
            module, generator = _kept[number]
            self._states[number] = _state(generator)
            # only legacy generators have this method; for others `bool()` returns False
            if getattr(generator, "has_drawn_by_chance", bool)():
                self._drawn.append(module)

    def changed(self) -> list[str]:
        """Return a text for each module with a generator that has drawn since its state was
        noted.
        """
        modules_drawn = [
            # the name of the module
            _kept[number][0]
            for number, state in self._states.items()
            if _state(_kept[number][1]) != state
        ]
        return [
            f"a generator that {module} keeps"
            for module in dict.fromkeys([*self._drawn, *modules_drawn])
        ]

    def _keep_of_modules(self) -> None:
        """Remember the generators in newly loaded modules of installed packages."""
        for name, module in sys.modules.copy().items():
            values = getattr(module, "__dict__", {})
            if name not in self._modules and is_installed(str(values.get("__file__"))):
                for value in values.copy().values():
                    # subclasses do not count
                    if type(value) in (np.random.Generator, np.random.RandomState):
                        self.keep(value._bit_generator, name)
                    elif type(value) is random.Random:
                        self.keep(value, name)


def _state(generator: Any) -> bytes:
    """Return the state of a generator of Python, or of a bit generator of NumPy, as bytes."""
    is_of_python = isinstance(generator, random.Random)
    state = generator.getstate() if is_of_python else generator.state
    return pickle.dumps(state)


# --- python watch ---------------------------------------------------------------------------------

# What this process itself sees of the present observed call: its threads, its imports, and the
# records of its hooks.


class Seedable(Protocol):
    """A generator that knows whether a seed determines its numbers."""

    def is_seeded(self) -> bool:
        """Return True if a seed determines its numbers."""


class Watch:
    """The observation of one call."""

    def __init__(self, kernel: bool) -> None:
        #: True if the kernel watches too, and so sees every file that is opened
        self.kernel = kernel
        self.records: list[Record] = []
        self.draws: set[str] = set()  #: sources of random numbers that were used
        self.kept = KeptGenerators()  #: generators of installed packages
        #: generators made before their seed, if any, was known
        self.generators: list[Seedable] = []
        #: file of each module of the user that was executed, by name
        self.bodies: dict[str, str] = {}
        #: source files and copied files: True if no read of them needs a record
        self.quiet: dict[str, bool] = {}
        #: files that installed packages read while they were imported
        self.settings: set[str] = set()
        self.temporary: set[str] = set()  #: files and folders with random names
        self._threads: set[threading.Thread] = set()  # the threads of the call
        self._local = threading.local()  # whether the current thread is trusted

    def add(self, thread: threading.Thread) -> None:
        """Count a thread as part of the call."""
        self._threads.add(thread)

    def is_here(self) -> bool:
        """Return True if the current thread is part of the call."""
        return threading._active.get(threading.get_ident()) in self._threads  # type: ignore[attr-defined]

    def chance(self) -> set[str]:
        """Return the sources of random numbers that the call has used so far."""
        has_unseeded = any(not generator.is_seeded() for generator in self.generators)
        return self.draws | ({"numpy.random.RandomState without a seed"} if has_unseeded else set())

    def trusted(self) -> bool:
        """Return True if the current thread imports an installed package, or searches for a
        module.
        """
        return bool(getattr(self._local, "trusted", False))

    def needs_record(self) -> bool:
        """Return True if the kernel does not watch and the current thread is not trusted."""
        return not self.kernel and not self.trusted()

    def trust(self, trusted: bool) -> bool:
        """Set whether the current thread is trusted, and return whether it was trusted before."""
        was_trusted = self.trusted()
        if was_trusted != trusted:
            self._local.trusted = trusted
            mark = TRUSTED if trusted else UNTRUSTED
            self._mark(mark)
        return was_trusted

    def heard(self, path: str, quiet: bool) -> None:
        """Note a read of a file; ``quiet``: the read needs no record."""
        self.quiet[path] = quiet and self.quiet.get(path, True)

    def trust_child(self) -> None:
        """Trust the next child process that this process starts."""
        self._mark(CHILD)

    def _mark(self, mark: int) -> None:
        """Tell the kernel layer whose the next calls are, through a call of ``access`` that always
        fails.
        """
        if self.kernel:
            os.access("/", mark)


_current: list[Watch] = []  #: the present observed call; empty or one entry


def begin(watch: Watch) -> None:
    """Make a call the present observed call."""
    _current.append(watch)


def end() -> None:
    """End the present observed call."""
    _current.clear()


def watch_here() -> Watch | None:
    """Return the observed call that the current thread belongs to, or None."""
    return _current[0] if _current and _current[0].is_here() else None


# --- watched imports ------------------------------------------------------------------------------

# Imports in an observed call: which reads belong to an installed package, and which to a module of
# the user?
#
# Python searches folders and reads byte code, and packages read their own tables: none of this is
# an input. The body of a module of the user is watched like the step itself. Wrappers of two
# functions of importlib distinguish the two cases. In a Python without these functions, every
# import counts as reading by the step.


_BOOTSTRAP: Any = importlib._bootstrap
_SEARCH, _EXECUTE = "_find_and_load", "_call_with_frames_removed"
_NATIVE = {getattr(_imp, name, None) for name in ("create_dynamic", "exec_dynamic")} - {None}


class WatchedImports(ReplacedFunctions):
    """The two functions of importlib, wrapped while a call is observed."""

    def __init__(self) -> None:
        places = [(_BOOTSTRAP, _SEARCH, _searching), (_BOOTSTRAP, _EXECUTE, _executing)]
        super().__init__(wrapped(places))


def _searching(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a wrapper of the module search that trusts the thread meanwhile."""

    def search(name: str, import_: Callable[..., Any]) -> Any:
        watch = watch_here()
        if watch is None:
            return function(name, import_)
        # the searched folders are no inputs
        was_trusted = watch.trust(True)
        try:
            return function(name, import_)
        finally:
            # the outermost import has ended
            if not was_trusted:
                watch.kept.note()
            watch.trust(was_trusted)

    return search


def _executing(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a wrapper of the execution of a module that does not trust the thread while a module
    of the user runs.
    """

    def execute(called: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        watch = watch_here()
        name_and_file = _module(called, arguments) if watch is not None else None
        if watch is None or name_and_file is None:
            return function(called, *arguments, **named)
        # name and file of a module of the user
        watch.bodies[name_and_file[0]] = name_and_file[1]
        # the body of a module is code of the user
        was_trusted = watch.trust(False)
        try:
            return function(called, *arguments, **named)
        finally:
            watch.trust(was_trusted)

    return execute


def _module(called: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[str, str] | None:
    """Return name and file of the module of the user that a call executes, or None."""
    # exec(code, namespace of the module)
    if called is builtins.exec:
        name, file = arguments[1].get("__name__"), arguments[1].get("__file__")
    elif called in _NATIVE:
        spec = getattr(arguments[0], "__spec__", arguments[0])
        name, file = getattr(spec, "name", None), getattr(spec, "origin", None)
    else:
        return None
    path = os.path.realpath(file) if file else ""
    return (str(name), path) if path and not is_installed(path) else None


# --- watched threads ------------------------------------------------------------------------------

# Threads that an observed call starts count as part of the call; other threads do not.


class WatchedThreads(ReplacedFunctions):
    """The two functions that start a thread, wrapped while a call is observed. From Python 3.12 on,
    audit events also report new threads.
    """

    def __init__(self) -> None:
        places: list[Wrapping] = [
            (threading.Thread, "start", _starting),
            (_thread, "start_new_thread", _starting_nameless),
        ]
        super().__init__(wrapped(places))


def _starting(function: Callable[[threading.Thread], None]) -> Callable[[threading.Thread], None]:
    """Return a wrapper of `Thread.start` that counts the new thread as part of the call."""

    def start(self: threading.Thread) -> None:
        if (watch := watch_here()) is not None:
            watch.add(self)
        function(self)

    return start


def _starting_nameless(function: Callable[..., int]) -> Callable[..., int]:
    """Return a wrapper of `start_new_thread`, which makes no thread object that could be
    counted.
    """

    def start_new_thread(*arguments: Any) -> int:
        watch = watch_here()
        if watch is not None and not watch.kernel:  # the calls of such a thread cannot be assigned
            watch.records.append(Record("unseen", "a thread that _thread started"))
        return function(*arguments)

    return start_new_thread


# --- quoted source --------------------------------------------------------------------------------

# Who opens a source file of the user: a message that quotes a line, an import or a compiler, or
# code that reads it?
#
# The key covers source without its comments, its layout and its docstrings. A warning or a
# traceback quotes a line for a reader, and a compiler omits comments, so neither makes a result
# depend on them. Any other reader may.


SOURCES = (".py", ".pyc", ".pyw")
#: modules that quote source in a message, import it, or compile it
_QUIET = (
    *(
        "warnings",
        "traceback",
        "logging",
        "importlib._bootstrap",
        "importlib._bootstrap_external",
        "zipimport",
    ),
    *("torch", "numba", "triton", "neusee"),
)


def quotes_source(frame: FrameType | None) -> bool:
    """Return True if a source file is opened by code that only quotes, imports or compiles it, so
    that the read needs no record.
    """
    while frame is not None:
        name = str(frame.f_globals.get("__name__", ""))
        if f"{name}.".startswith(_QUIET_STARTS):
            return True
        if _is_own(frame.f_code.co_filename):
            return False
        frame = frame.f_back
    return True


_QUIET_STARTS = tuple(f"{name}." for name in _QUIET)


@functools.lru_cache(1000)
def _is_own(file: str) -> bool:
    """Return True for a file of code that is not installed; code without a file counts as its
    caller's.
    """
    return not file.startswith("<") and not is_installed(os.path.realpath(file))


# --- audit events ---------------------------------------------------------------------------------

# Audit events of Python during an observed call.
#
# If the kernel watches, they add only what it cannot know, such as that neusee itself starts a
# child process. Otherwise they show files, processes and sockets, as far as Python code uses them.


_installed: list[bool] = []
_OF_CODE = (*SOURCES, ".pyc", ".so", ".pyd", ".zip", ".egg")  #: files that an import looks for


def listen() -> None:
    """Listen to the audit events of this process. A hook cannot be removed; between observed calls
    it returns at once.
    """
    if not _installed:
        _installed.append(True)
        sys.addaudithook(_heard)


def _heard(event: str, arguments: tuple[Any, ...]) -> None:
    """Handle an audit event of an observed call, if its kind counts."""
    if event not in _EVENTS or (watch := watch_here()) is None:
        return
    # events that add what the kernel cannot know
    if event in _FOR_BOTH and not watch.trusted():
        _FOR_BOTH[event](watch, arguments)
    # a file that an installed package reads at its import
    if event == "open" and watch.trusted():
        _settings(watch, arguments)
    if event == "subprocess.Popen":
        _program(watch, arguments)
    elif event in _HANDLERS and watch.needs_record():
        _HANDLERS[event](watch, arguments)


def _program(watch: Watch, arguments: tuple[Any, ...]) -> None:
    """Note a child process, unless neusee itself starts it to compile its C++ code."""
    if _called_by_program():
        watch.trust_child()
    elif watch.needs_record():
        # the executable, or the first argument
        command = arguments[0] or arguments[1]
        is_text = isinstance(command, str | bytes | os.PathLike)
        first_word = command if is_text else next(iter(command), "")
        watch.records.append(Record("exec", os.fsdecode(first_word)))


def _called_by_program() -> bool:
    """Return True if a function of neusee's nodes starts a process."""
    frame = sys._getframe()
    while frame.f_back is not None:
        frame = frame.f_back
        name = str(frame.f_globals.get("__name__", ""))
        if name.startswith("neusee.nodes."):
            return True
        # skip the functions of this hook and of subprocess
        if not name.startswith((__package__, "subprocess")):
            return False
    return False


@contextmanager
def _unwatched(watch: Watch) -> Iterator[None]:
    """Trust the current thread while this hook itself looks up files."""
    was_trusted = watch.trust(True)
    try:
        yield
    finally:
        watch.trust(was_trusted)


def _source(watch: Watch, arguments: tuple[Any, ...]) -> None:
    """Note a source file that is opened, and whether it is opened only for a message or a
    compiler.
    """
    path = arguments[0]
    if isinstance(path, str | bytes | os.PathLike) and os.fsdecode(path).endswith(SOURCES):
        # frame 2 opens the file; frames 0 and 1 are this handler and the hook
        frame = sys._getframe(2)
        with _unwatched(watch):
            watch.heard(os.path.realpath(os.fsdecode(path)), quotes_source(frame))


def _settings(watch: Watch, arguments: tuple[Any, ...]) -> None:
    """Note a file that an installed package reads at its import, such as settings in the home
    folder.

    Installed code, tables and caches are left out later, by `covered_paths.decides` and the
    judgement.
    """
    path, _, flags = arguments
    if (
        isinstance(path, int)
        or flags & (os.O_CREAT | os.O_TRUNC)
        or os.fsdecode(path).endswith(_OF_CODE)
    ):
        return
    real_path = os.path.realpath(os.fsdecode(path))
    if os.path.isfile(real_path):
        watch.settings.add(real_path)


def _copied(watch: Watch, arguments: tuple[Any, ...]) -> None:
    """Note whether the extended attributes of a file are read only to copy the file."""
    path = arguments[0]
    if not isinstance(path, int):
        # frame 2 is the caller; frames 0 and 1 are this handler and the hook
        copies = sys._getframe(2).f_globals.get("__name__") == "shutil"
        with _unwatched(watch):
            watch.heard(os.path.realpath(os.fsdecode(path)), copies)


def _named_by_chance(watch: Watch, arguments: tuple[Any, ...]) -> None:
    """Note a temporary file or folder, whose random name no other process expects."""
    parent_folder, name = os.path.split(os.path.abspath(os.fsdecode(arguments[0])))
    with _unwatched(watch):
        watch.temporary.add(os.path.join(os.path.realpath(parent_folder), name))


def _file(watch: Watch, arguments: tuple[Any, ...]) -> None:
    """Record a file that is opened."""
    path, mode, flags = arguments
    if isinstance(path, int):
        return
    given_path = os.fsdecode(path)
    real_path = os.path.realpath(given_path)
    if mode is None and not os.path.isabs(given_path) and not os.path.lexists(real_path):
        real_path = given_path  # below an open folder, which the event of ``os.open`` does not name
    # the flags as a positive number of 31 bits
    watch.records.append(
        Record("open", real_path, "", flags & 0x7FFFFFFF, os.path.lexists(real_path))
    )


def _of_path(does: Does) -> Callable[[Watch, tuple[Any, ...]], None]:
    """Return a handler that records an event whose first argument is a path."""

    def note(watch: Watch, arguments: tuple[Any, ...]) -> None:
        path = "." if arguments[0] is None else arguments[0]
        # a number is the descriptor of an open file, whose opening was recorded
        if not isinstance(path, int):
            real_path = os.path.realpath(os.fsdecode(path))
            watch.records.append(Record(does, real_path, there=os.path.lexists(real_path)))

    return note


def _of_named_path(does: Does) -> Callable[[Watch, tuple[Any, ...]], None]:
    """Return a handler that records an event whose first argument is a path; a symbolic link at its
    end is not followed.
    """

    def note(watch: Watch, arguments: tuple[Any, ...]) -> None:
        given_path, folder = os.fsdecode(arguments[0]), arguments[-1]
        if not os.path.isabs(given_path) and folder != -1:
            return  # below an open folder that the event does not name
        parent_folder, name = os.path.split(os.path.abspath(given_path))
        path = os.path.join(os.path.realpath(parent_folder), name)
        watch.records.append(Record(does, path, there=os.path.lexists(path)))

    return note


def _of_two_paths(does: Does) -> Callable[[Watch, tuple[Any, ...]], None]:
    """Return a handler that records an event whose first two arguments are paths."""

    def note(watch: Watch, arguments: tuple[Any, ...]) -> None:
        first_path, second_path = (os.path.abspath(os.fsdecode(path)) for path in arguments[:2])
        watch.records.append(
            Record(does, first_path, second_path, there=os.path.lexists(first_path))
        )

    return note


def _library(watch: Watch, arguments: tuple[Any, ...]) -> None:
    """Record a native library that is loaded by its path."""
    name = os.fsdecode(arguments[0] or "")
    if "/" in name:
        watch.records.append(Record("open", os.path.realpath(name), flags=os.O_RDONLY))


def _database(watch: Watch, arguments: tuple[Any, ...]) -> None:
    """Record a database file that is opened."""
    name = os.fsdecode(arguments[0])
    if name and name != ":memory:":
        real_path = os.path.realpath(name)
        watch.records.append(
            Record("open", real_path, "", os.O_RDWR | os.O_CREAT, os.path.lexists(real_path))
        )


def _of_address(does: Does) -> Callable[[Watch, tuple[Any, ...]], None]:
    """Return a handler that records an event with a socket and an address."""

    def note(watch: Watch, arguments: tuple[Any, ...]) -> None:
        address = arguments[1]
        if isinstance(address, str | bytes):
            address_text, family = os.path.realpath(os.fsdecode(address)), "unix"
        else:
            address_text, family = ":".join(map(str, address)), "internet"
        watch.records.append(Record(does, address_text, family))

    return note


def _named(does: Does, path: str) -> Callable[[Watch, tuple[Any, ...]], None]:
    """Return a handler that records an event with the fixed ``path``, without the event's
    arguments.
    """
    return lambda watch, arguments: watch.records.append(Record(does, path))


def _command(watch: Watch, arguments: tuple[Any, ...]) -> None:
    """Record a program that is started, unless neusee itself starts it. Since Python 3.13,
    `subprocess` also sends the event ``os.posix_spawn``.
    """
    if _called_by_program():
        return
    watch.records.append(Record("exec", os.fsdecode(arguments[0])))


_Handler = Callable[[Watch, tuple[Any, ...]], None]
_HANDLERS: dict[str, _Handler] = {
    "open": _file,
    "os.listdir": _of_path("list"),
    "os.scandir": _of_path("list"),
    "os.mkdir": _of_named_path("make"),
    "os.remove": _of_named_path("remove"),
    "os.rmdir": _of_named_path("remove"),
    "os.symlink": lambda watch, arguments: _of_named_path("make")(
        watch, (arguments[1], arguments[2])
    ),
    "os.rename": _of_two_paths("move"),
    "os.link": _of_two_paths("link"),
    "os.truncate": _of_path("check"),
    "os.chmod": _of_path("check"),
    "os.utime": _of_path("check"),
    "os.getxattr": _of_path("xattr"),
    "os.listxattr": _of_path("xattr"),
    "os.system": _command,
    "os.posix_spawn": _command,
    "os.exec": _command,
    "os.spawn": lambda watch, arguments: _command(watch, arguments[1:]),
    "os.startfile": _command,
    "os.fork": _named("fork", "fork"),
    "os.forkpty": _named("fork", "fork"),
    "pty.spawn": lambda watch, arguments: watch.records.append(Record("exec", str(arguments[0]))),
    "socket.connect": _of_address("connect"),
    "socket.sendto": _of_address("connect"),
    "socket.bind": _of_address("bind"),
    "socket.getaddrinfo": lambda watch, arguments: watch.records.append(
        Record("connect", str(arguments[0]), "internet")
    ),
    "sqlite3.connect": _database,
    "ctypes.dlopen": _library,
    "builtins.input": _named("input", "the terminal"),
}
_FOR_BOTH: dict[str, _Handler] = {
    "open": _source,
    "os.getxattr": _copied,
    "os.listxattr": _copied,
    "tempfile.mkstemp": _named_by_chance,
    "tempfile.mkdtemp": _named_by_chance,
}  #: handlers of events for which the calling code matters, which only the interpreter knows
_EVENTS = frozenset({"subprocess.Popen", *_HANDLERS, *_FOR_BOTH})
