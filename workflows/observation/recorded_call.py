"""Record of one thing that a step reached, made from a stopped system call: what was done, with real paths."""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple

from neusee.workflows.observation.stopped_task import AT_FDCWD, Task
from neusee.workflows.observation.system_calls import Call, Does, Path


class Record(NamedTuple):
    """One thing that was reached."""

    does: Does
    path: str  #: real path, or an address
    second: str = ""  #: the other path of a call with two, or the family of an address
    flags: int = 0  #: of ``open``
    there: bool = True  #: the path existed before the call
    trusted: bool = False  #: an import of an installed package, or the program, did it


def recorded(task: Task, call: Call, arguments: Sequence[int]) -> Record:
    """Return the record of a stopped call; raise `OSError` if what the task handed over cannot be read."""
    return _READ[call.does](task, call, arguments)


def without_reading(record: Record) -> Record | None:
    """Return what remains of a call of a trusted task: the step may read what was made, and nothing else counts."""
    if record.does == "open" and record.flags & (os.O_CREAT | os.O_TRUNC):
        return record._replace(flags=(record.flags & ~os.O_ACCMODE) | os.O_WRONLY, trusted=True)
    return record._replace(trusted=True) if record.does in ("make", "move") else None


def _number(call: Call, arguments: Sequence[int]) -> int:
    return arguments[call.number] & 0x7FFFFFFF


def _path(task: Task, place: Path | None, arguments: Sequence[int], follow: bool = True) -> str:
    assert place is not None
    folder = AT_FDCWD if place.folder < 0 else _signed(arguments[place.folder])
    return task.path(task.text(arguments[place.pointer]), folder, follow)


def _signed(argument: int) -> int:
    """Return an argument of 32 bits with its sign."""
    low = argument & 0xFFFFFFFF
    return low - (low >> 31 << 32)


def _opened(task: Task, call: Call, arguments: Sequence[int]) -> Record:
    if call.does == "creat":
        flags = os.O_CREAT | os.O_WRONLY | os.O_TRUNC
    elif call.does == "openat2":  # the pointer to a ``struct open_how``, whose first field are the flags
        flags = int(struct.unpack("Q", task.memory(arguments[call.number], 8))[0])
    else:
        flags = _number(call, arguments)
    path = _path(task, call.path, arguments)
    return Record("open", path, "", flags, os.path.lexists(path))


def _at_path(task: Task, call: Call, arguments: Sequence[int]) -> Record:
    itself = call.does in ("make", "remove")  # a link at the end of the path is meant itself
    path = _path(task, call.path, arguments, follow=not itself)
    return Record(call.does, path, there=os.path.lexists(path))


def _two_paths(task: Task, call: Call, arguments: Sequence[int]) -> Record:
    first, second = (_path(task, place, arguments, follow=False) for place in (call.path, call.second))
    return Record(call.does, first, second, there=os.path.lexists(first))


def _descriptor(task: Task, call: Call, arguments: Sequence[int]) -> Record:
    does: Does = "xattr" if call.does == "xattr_open" else call.does
    return Record(does, task.link(f"fd/{_number(call, arguments)}"))


def _address(task: Task, call: Call, arguments: Sequence[int]) -> Record:
    assert call.path is not None
    data = task.memory(arguments[call.path.pointer], min(_number(call, arguments), 128))
    family = struct.unpack_from("H", data)[0] if len(data) > 1 else socket.AF_UNSPEC
    if family == socket.AF_UNIX:
        name = os.fsdecode(data[2:].partition(b"\0")[0])
        return Record(call.does, task.path(name, AT_FDCWD) if name else f"@{os.fsdecode(data[3:])}", "unix")
    if family in (socket.AF_INET, socket.AF_INET6):
        start, length = (4, 4) if family == socket.AF_INET else (8, 16)
        host = socket.inet_ntop(family, data[start : start + length])
        return Record(call.does, f"{host}:{struct.unpack_from('!H', data, 2)[0]}", "internet")
    # the kernel itself answers a netlink socket, and a socket without a family is only let go
    return Record(call.does, f"family {family}", "" if family in (socket.AF_UNSPEC, socket.AF_NETLINK) else "other")


def _named(task: Task, call: Call, arguments: Sequence[int]) -> Record:
    return Record(call.does, call.name)


def _entropy(task: Task, call: Call, arguments: Sequence[int]) -> Record:
    length, flags = arguments[call.number], arguments[call.number + 1]
    return Record("entropy", f"{call.name} of {length} bytes", flags=flags & 0xFF, there=length > _SMALL)


#: bytes of chance that Python and the library of C take for names of files and places in memory, and no result has
_SMALL = 32
_READ: dict[Does, Callable[[Task, Call, Sequence[int]], Record]] = {
    **dict.fromkeys(("open", "openat2", "creat"), _opened),
    **dict.fromkeys(("check", "xattr", "make", "remove", "exec"), _at_path),
    **dict.fromkeys(("move", "link"), _two_paths),
    **dict.fromkeys(("list", "input", "xattr_open"), _descriptor),
    **dict.fromkeys(("connect", "bind"), _address),
    **dict.fromkeys(("fork", "unseen"), _named),
    "entropy": _entropy,
}
