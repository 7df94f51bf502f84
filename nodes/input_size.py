"""Bytes that a reader of a file would need, compared with the memory that is left before anything is allocated.

A reader finds the bytes in the header alone and asks `needs`. Files are opened without waiting: a pipe, a device or a
socket in the place of a file is refused, because it never ends, or never begins.
"""

import os
import resource
import stat
from collections.abc import Callable, Iterator
from contextlib import suppress
from io import BufferedReader, TextIOWrapper
from pathlib import Path
from typing import NamedTuple

from neusee.nodes import ParameterError

#: what is free decides whether a file is read, and no result; the files are those of the system, or of an argument
__depends__ = ["unaffected:file", "unaffected:resource", "unaffected:_measures"]
SMALL = 16 << 20  #: bytes that every reader may take without asking
TEXT = 64 << 20  #: bytes of a text that is read as a whole, at most
LINE = 1_000_000  #: characters of a line of a table, at most
_GROUP = Path("/sys/fs/cgroup")
_KINDS = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISDIR, "a folder"),
)


class Room(NamedTuple):
    """Memory that this process may still use, and its limit if one was set, in bytes."""

    free: float
    limit: float | None = None


class BeyondMemory(ParameterError):
    """Error of a reader whose file needs more memory than is left."""


def needs(count: float, file: Path | str, what: str, parameter: str = "file") -> None:
    """Raise `BeyondMemory` if a reader would need more than the memory that is left: ``count`` bytes.

    ``what`` says what the bytes are, such as ``30 pages of 4000 x 3000 pixels``.
    """
    if count <= SMALL:
        return
    room = _measures[-1]()
    if count <= room.free:
        return
    least = max(room.free, 0.0)
    if room.limit is None:
        there, more = f"the {in_bytes(least)} that are free", "free memory"
    else:
        there = f"the {in_bytes(least)} that are left of the limit of {in_bytes(room.limit)}"
        more = "raise the limit by --memory"
    text = f"{file} would need {in_bytes(count)} of memory to read ({what}), more than {there}"
    raise BeyondMemory(parameter, f"{text}: {more}, crop the file, or give another file")


def measured_by(measure: Callable[[], Room]) -> None:
    """Let ``measure`` say from now on what memory is left, as the program does that has a limit."""
    _measures[1:] = [measure]


def free_memory() -> Room:
    """Return the memory that is free on this machine, in its control group, and below the limit of addresses."""
    found = [float("inf")]
    with suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text().splitlines()
        found.append(1024.0 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")))
    with suppress(OSError, ValueError):
        most = int((_GROUP / "memory.max").read_text())
        kept = dict(line.split() for line in (_GROUP / "memory.stat").read_text().splitlines())
        found.append(float(most - int((_GROUP / "memory.current").read_text()) + int(kept["inactive_file"])))
    addresses = resource.getrlimit(resource.RLIMIT_AS)[0]
    if addresses != resource.RLIM_INFINITY:
        with suppress(OSError, ValueError):
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            found.append(float(addresses - pages * resource.getpagesize()))
    return Room(min(found))


_measures: list[Callable[[], Room]] = [free_memory]  #: the last one counts


def in_bytes(count: float) -> str:
    """Return a number of bytes as text with a unit."""
    for unit, scale in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= scale:
            return f"{count / scale:.3g} {unit}"
    return f"{count:.0f} bytes"


# --- files ------------------------------------------------------------------------------------------------------------


def kind_of(mode: int) -> str:
    """Return what stands in the place of a file, such as ``a pipe``, or an empty text for a regular file."""
    return "" if stat.S_ISREG(mode) else next((kind for fits, kind in _KINDS if fits(mode)), "no file")


def refuse_other_than_file(file: Path | str, parameter: str = "file") -> None:
    """Raise ParameterError for a pipe, a device, a socket or a folder; a file that is missing passes."""
    try:
        mode = os.stat(file).st_mode
    except OSError:
        return
    _refuse(file, mode, parameter)


def _refuse(file: Path | str, mode: int, parameter: str) -> None:
    if kind := kind_of(mode):
        raise ParameterError(parameter, f"{file} is not a regular file but {kind}: give the path of a file")


def opened(file: Path | str, parameter: str = "file") -> BufferedReader:
    """Open a regular file to read its bytes, without waiting for a pipe; raise ParameterError for anything else."""
    refuse_other_than_file(file, parameter)  # some devices do something when they are opened
    number = os.open(file, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _refuse(file, os.fstat(number).st_mode, parameter)
    except BaseException:
        os.close(number)
        raise
    return os.fdopen(number, "rb")


def head_of(file: Path | str, count: int) -> bytes:
    """Return the first bytes of a file."""
    with opened(file) as bytes_in:
        return bytes_in.read(count)


def bytes_of(file: Path | str, copies: float = 1.0, parameter: str = "file") -> bytes:
    """Return all bytes of a file, of which the caller makes ``copies``, the first one included."""
    with opened(file, parameter) as bytes_in:
        size = os.fstat(bytes_in.fileno()).st_size
        needs(copies * size, file, f"a file of {in_bytes(size)}", parameter)
        return bytes_in.read(size + 1)


def text_of(file: Path | str, encoding: str = "utf-8", errors: str = "strict", most: int = TEXT) -> str:
    """Return the text of a file of at most ``most`` bytes, with ``\\n`` at the end of each line."""
    with opened(file) as bytes_in:
        size = os.fstat(bytes_in.fileno()).st_size
        if size > most:
            limit = f"more than the limit of {in_bytes(most)} for such a file"
            raise ParameterError("file", f"{file} has {in_bytes(size)}, {limit}: give a shorter file")
        needs(8.0 * size, file, f"a text of {in_bytes(size)}")
        return bytes_in.read(most).decode(encoding, errors).replace("\r\n", "\n").replace("\r", "\n")


def lines_of(file: Path, copies: float = 1.0) -> Iterator[str]:
    """Yield the lines of a table in UTF-8, each with its end; refuse a line that is too long to be one of a table.

    ``copies`` are bytes that the caller keeps for each byte of the file.
    """
    with opened(file) as bytes_in:
        size = os.fstat(bytes_in.fileno()).st_size
        needs(copies * size, file, f"a table of {in_bytes(size)}")
        with TextIOWrapper(bytes_in, encoding="utf-8-sig", newline="") as text:
            number = 0
            while line := text.readline(LINE + 1):
                number += 1
                if len(line) > LINE:
                    fix = "break the line, or give another file"
                    raise ParameterError("file", f"{file.name}:{number} has more than {LINE} characters: {fix}")
                yield line
