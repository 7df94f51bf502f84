"""What Python's own audit events say of an observed call.

Where the kernel watches, they add only what it cannot know: that a child process is one of the program. Elsewhere they
are the layer that sees files, processes and sockets, as far as Python code asks for them.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from neusee.workflows.observation.python_watch import Watch, watch_here
from neusee.workflows.observation.quoted_source import SOURCES, quotes_source
from neusee.workflows.observation.recorded_call import Record
from neusee.workflows.observation.system_calls import Does

_installed: list[bool] = []
_OF_CODE = (*SOURCES, ".pyc", ".so", ".pyd", ".zip", ".egg")  #: files that an import looks for


def listen() -> None:
    """Listen to the events of this process; a hook cannot be taken away, and returns at once between the calls."""
    if not _installed:
        _installed.append(True)
        sys.addaudithook(_heard)


def _heard(event: str, arguments: tuple[Any, ...]) -> None:
    if event not in _EVENTS or (watch := watch_here()) is None:
        return
    if event in _FOR_BOTH and not watch.trusted():
        _FOR_BOTH[event](watch, arguments)
    if event == "open" and watch.trusted():
        _settings(watch, arguments)
    if event == "subprocess.Popen":
        _program(watch, arguments)
    elif event in _HANDLERS and not watch.kernel and not watch.trusted():
        _HANDLERS[event](watch, arguments)


def _program(watch: Watch, arguments: tuple[Any, ...]) -> None:
    """Take note of a child process; the program itself compiles its C++ when it is first used."""
    if _called_by_program():
        watch.trust_child()
    elif not watch.kernel and not watch.trusted():
        command = arguments[0] or arguments[1]
        words = command if isinstance(command, str | bytes | os.PathLike) else next(iter(command), "")
        watch.records.append(Record("exec", os.fsdecode(words)))


def _called_by_program() -> bool:
    """Return True if the function that starts a process is one of the nodes of the program."""
    frame = sys._getframe()
    while frame.f_back is not None:
        frame = frame.f_back
        name = str(frame.f_globals.get("__name__", ""))
        if name.startswith("neusee.nodes."):
            return True
        if not name.startswith((__package__, "subprocess")):
            return False
    return False


@contextmanager
def _unwatched(watch: Watch) -> Iterator[None]:
    """Trust the current thread while this hook itself looks at folders."""
    before = watch.trust(True)
    try:
        yield
    finally:
        watch.trust(before)


def _source(watch: Watch, arguments: tuple[Any, ...]) -> None:
    """Take note of a source file that is opened, and of whether a message or a compiler asked for it."""
    path = arguments[0]
    if isinstance(path, str | bytes | os.PathLike) and os.fsdecode(path).endswith(SOURCES):
        frame = sys._getframe(2)
        with _unwatched(watch):
            watch.heard(os.path.realpath(os.fsdecode(path)), quotes_source(frame))


def _settings(watch: Watch, arguments: tuple[Any, ...]) -> None:
    """Take note of a file that an installed package reads while it is imported, such as settings in the home folder.

    Its code, its tables and caches are installed: the judgement leaves them out.
    """
    path, _, flags = arguments
    if isinstance(path, int) or flags & (os.O_CREAT | os.O_TRUNC) or os.fsdecode(path).endswith(_OF_CODE):
        return
    real = os.path.realpath(os.fsdecode(path))
    if os.path.isfile(real):
        watch.settings.add(real)


def _copied(watch: Watch, arguments: tuple[Any, ...]) -> None:
    """Take note of whether the attributes of a file are asked for in order to copy it."""
    path = arguments[0]
    if not isinstance(path, int):
        copies = sys._getframe(2).f_globals.get("__name__") == "shutil"
        with _unwatched(watch):
            watch.heard(os.path.realpath(os.fsdecode(path)), copies)


def _named_by_chance(watch: Watch, arguments: tuple[Any, ...]) -> None:
    """Take note of a temporary file, whose name no other process expects."""
    above, name = os.path.split(os.path.abspath(os.fsdecode(arguments[0])))
    with _unwatched(watch):
        watch.temporary.add(os.path.join(os.path.realpath(above), name))


def _file(watch: Watch, arguments: tuple[Any, ...]) -> None:
    path, mode, flags = arguments
    if isinstance(path, int):
        return
    text = os.fsdecode(path)
    real = os.path.realpath(text)
    if mode is None and not os.path.isabs(text) and not os.path.lexists(real):
        real = text  # below an open folder, which the event of ``os.open`` does not name
    watch.records.append(Record("open", real, "", flags & 0x7FFFFFFF, os.path.lexists(real)))


def _of_path(does: Does) -> Callable[[Watch, tuple[Any, ...]], None]:
    """Return what takes note of an event whose first argument is a path."""

    def note(watch: Watch, arguments: tuple[Any, ...]) -> None:
        path = "." if arguments[0] is None else arguments[0]
        if not isinstance(path, int):
            real = os.path.realpath(os.fsdecode(path))
            watch.records.append(Record(does, real, there=os.path.lexists(real)))

    return note


def _of_named_path(does: Does) -> Callable[[Watch, tuple[Any, ...]], None]:
    """Return what takes note of an event whose first argument is a path, where a link at its end is meant itself."""

    def note(watch: Watch, arguments: tuple[Any, ...]) -> None:
        text, folder = os.fsdecode(arguments[0]), arguments[-1]
        if not os.path.isabs(text) and folder != -1:
            return  # below an open folder that the event does not name
        above, name = os.path.split(os.path.abspath(text))
        path = os.path.join(os.path.realpath(above), name)
        watch.records.append(Record(does, path, there=os.path.lexists(path)))

    return note


def _of_two_paths(does: Does) -> Callable[[Watch, tuple[Any, ...]], None]:
    def note(watch: Watch, arguments: tuple[Any, ...]) -> None:
        first, second = (os.path.abspath(os.fsdecode(path)) for path in arguments[:2])
        watch.records.append(Record(does, first, second, there=os.path.lexists(first)))

    return note


def _library(watch: Watch, arguments: tuple[Any, ...]) -> None:
    name = os.fsdecode(arguments[0] or "")
    if "/" in name:
        watch.records.append(Record("open", os.path.realpath(name), flags=os.O_RDONLY))


def _database(watch: Watch, arguments: tuple[Any, ...]) -> None:
    name = os.fsdecode(arguments[0])
    if name and name != ":memory:":
        real = os.path.realpath(name)
        watch.records.append(Record("open", real, "", os.O_RDWR | os.O_CREAT, os.path.lexists(real)))


def _of_address(does: Does) -> Callable[[Watch, tuple[Any, ...]], None]:
    """Return what takes note of an event with a socket and an address."""

    def note(watch: Watch, arguments: tuple[Any, ...]) -> None:
        address = arguments[1]
        unix = isinstance(address, str | bytes)
        where = os.path.realpath(os.fsdecode(address)) if unix else ":".join(map(str, address))
        watch.records.append(Record(does, where, "unix" if unix else "internet"))

    return note


def _named(does: Does, what: str) -> Callable[[Watch, tuple[Any, ...]], None]:
    """Return what takes note of an event without its arguments."""
    return lambda watch, arguments: watch.records.append(Record(does, what))


def _command(watch: Watch, arguments: tuple[Any, ...]) -> None:
    watch.records.append(Record("exec", os.fsdecode(arguments[0])))


_Handler = Callable[[Watch, tuple[Any, ...]], None]
_HANDLERS: dict[str, _Handler] = {
    "open": _file,
    "os.listdir": _of_path("list"),
    "os.scandir": _of_path("list"),
    "os.mkdir": _of_named_path("make"),
    "os.remove": _of_named_path("remove"),
    "os.rmdir": _of_named_path("remove"),
    "os.symlink": lambda watch, arguments: _of_named_path("make")(watch, (arguments[1], arguments[2])),
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
}  #: what only the interpreter knows of a call: who makes it
_EVENTS = frozenset({"subprocess.Popen", *_HANDLERS, *_FOR_BOTH})
