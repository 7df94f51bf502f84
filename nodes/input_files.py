"""Limits of input files: memory needed to read them, and checks before the run."""

import csv
import functools
import os
import resource
import stat
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from io import BufferedReader, TextIOWrapper
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from neusee.nodes import ParameterError

# --- input size -----------------------------------------------------------------------------------

# Comparison of the memory that a reader of a file would need with the available memory, before
# anything is allocated.
#
# A reader computes the bytes from the header only and calls `needs`. Files are opened in
# non-blocking mode: a pipe, a device or a socket is refused, because it may never deliver data or
# never end.


#: available memory decides only whether a file is read, and affects no result; the files read are
#: those of the system, or arguments
__depends__ = ["unaffected:file", "unaffected:resource", "unaffected:_measures", "unaffected:time"]
SMALL = 16 << 20  #: bytes that a reader may use without a check
TEXT = 64 << 20  #: largest size in bytes of a text that is read as a whole
LINE = 1_000_000  #: largest number of characters in a line of a table
_CONTROL_GROUP = Path("/sys/fs/cgroup")
_KINDS_OF_FILE = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISDIR, "a folder"),
)


class Room(NamedTuple):
    """The memory that this process may still use, and the limit if one was set, in bytes."""

    free: float
    limit: float | None = None


class BeyondMemory(ParameterError):
    """Raised if reading a file needs more memory than is available."""


def needs(count: float, file: Path | str, content: str, parameter: str = "file") -> None:
    """Raise `BeyondMemory` if reading a file needs ``count`` bytes and less memory is available.

    ``content`` describes the content of the file, such as ``30 pages of 4000 x 3000 pixels``.
    """
    if count <= SMALL:
        return
    memory_left = _measures[-1]()
    if count <= memory_left.free:
        return
    free = max(memory_left.free, 0.0)
    if memory_left.limit is None:
        room_text, remedy = f"the {in_bytes(free)} that are free", "free memory"
    else:
        room_text = (
            f"the {in_bytes(free)} that are left of the limit of {in_bytes(memory_left.limit)}"
        )
        remedy = "raise the limit by --memory"
    text = (
        f"{file} would need {in_bytes(count)} of memory to read ({content}), more than {room_text}"
    )
    raise BeyondMemory(parameter, f"{text}: {remedy}, crop the file, or give another file")


def measured_by(measure: Callable[[], Room]) -> None:
    """Use the function ``measure`` from now on to determine the available memory; a program with a
    memory limit calls this.
    """
    _measures[1:] = [measure]


def free_memory() -> Room:
    """Return the available memory: the least of that of the machine, of the control group, and of
    the limit of the address space.
    """
    rooms = [float("inf")]
    with suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text().splitlines()
        rooms.append(
            1024.0
            * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
        )
    with suppress(OSError, ValueError):
        limit = int((_CONTROL_GROUP / "memory.max").read_text())
        statistics = dict(
            line.split() for line in (_CONTROL_GROUP / "memory.stat").read_text().splitlines()
        )
        rooms.append(
            float(
                limit
                - int((_CONTROL_GROUP / "memory.current").read_text())
                # cached files, which the system frees when memory is short
                + int(statistics["inactive_file"])
            )
        )
    addresses = resource.getrlimit(resource.RLIMIT_AS)[0]
    if addresses != resource.RLIM_INFINITY:
        with suppress(OSError, ValueError):
            # size of the address space in use, in pages
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            rooms.append(float(addresses - pages * resource.getpagesize()))
    return Room(min(rooms))


_measures: list[Callable[[], Room]] = [free_memory]  #: the last one is used


def in_bytes(count: float) -> str:
    """Return a number of bytes as text with a unit."""
    for unit, scale in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= scale:
            return f"{count / scale:.3g} {unit}"
    return f"{count:.0f} bytes"


# --- files ----------------------------------------------------------------------------------------


def kind_of(mode: int) -> str:
    """Return the kind of a file from its mode, such as ``a pipe``; empty for a regular file."""
    if stat.S_ISREG(mode):
        return ""
    return next((kind for fits, kind in _KINDS_OF_FILE if fits(mode)), "no file")


def refuse_other_than_file(file: Path | str, parameter: str = "file") -> None:
    """Raise ParameterError for a pipe, a device, a socket or a folder; a missing file is no error
    here.
    """
    try:
        mode = os.stat(file).st_mode
    except OSError:
        return
    _refuse(file, mode, parameter)


def _refuse(file: Path | str, mode: int, parameter: str) -> None:
    """Raise ParameterError unless ``mode`` is that of a regular file."""
    if kind := kind_of(mode):
        raise ParameterError(
            parameter, f"{file} is not a regular file but {kind}: give the path of a file"
        )


def opened(file: Path | str, parameter: str = "file") -> BufferedReader:
    """Open a regular file for reading bytes, in non-blocking mode; raise ParameterError for
    anything else.
    """
    # checked before, since opening some devices has side effects
    refuse_other_than_file(file, parameter)
    descriptor = os.open(file, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _refuse(file, os.fstat(descriptor).st_mode, parameter)
    except BaseException:
        os.close(descriptor)
        raise
    return os.fdopen(descriptor, "rb")


def head_of(file: Path | str, count: int) -> bytes:
    """Return the first ``count`` bytes of a file."""
    with opened(file) as bytes_in:
        return bytes_in.read(count)


def bytes_of(file: Path | str, copies: float = 1.0, parameter: str = "file") -> bytes:
    """Return all bytes of a file, after a check of memory for ``copies`` of them, including this
    one.
    """
    with opened(file, parameter) as bytes_in:
        size = os.fstat(bytes_in.fileno()).st_size
        needs(copies * size, file, f"a file of {in_bytes(size)}", parameter)
        return bytes_in.read(size + 1)


def text_of(
    file: Path | str, encoding: str = "utf-8", errors: str = "strict", max_bytes: int = TEXT
) -> str:
    """Return the text of a file of at most ``max_bytes`` bytes, with line ends converted to
    ``\\n``.
    """
    with opened(file) as bytes_in:
        size = os.fstat(bytes_in.fileno()).st_size
        if size > max_bytes:
            limit = f"more than the limit of {in_bytes(max_bytes)} for such a file"
            raise ParameterError(
                "file", f"{file} has {in_bytes(size)}, {limit}: give a shorter file"
            )
        needs(8.0 * size, file, f"a text of {in_bytes(size)}")
        return (
            bytes_in.read(max_bytes)
            .decode(encoding, errors)
            .replace("\r\n", "\n")
            .replace("\r", "\n")
        )


def lines_of(file: Path, copies: float = 1.0) -> Iterator[str]:
    """Yield the lines of a UTF-8 table with their line ends; raise ParameterError for a line of
    more than `LINE` characters.

    ``copies`` is the number of bytes that the caller keeps per byte of the file.
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
                    raise ParameterError(
                        "file", f"{file.name}:{number} has more than {LINE} characters: {fix}"
                    )
                yield line


# --- input files ----------------------------------------------------------------------------------

# Limits of input files, and checks before the run that read the content of a file only once.


#: largest number of pixels of a picture; a PNG of this size needs 1.3 GB of memory to decode and
#: convert
PIXELS = 64_000_000
#: largest number of values in a cube, a height map or a frame; 4 GB as float32
VALUES = 1_000_000_000
ROWS = 1_000_000  #: largest number of lines of a table
#: ns after a change of a file during which a second change may leave its times the same
_SETTLED = 2_000_000_000
#: bytes of memory per byte of a table, whose cells are texts of several digits
_BYTES_OF_CELLS = 8.0
_SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "vertical bars"}

Result = TypeVar("Result")


def refuse_large_picture(file: Path, rows: int, columns: int) -> None:
    """Raise ParameterError for a picture whose header states more pixels than the limit, before
    it is decoded.
    """
    if rows * columns > PIXELS:
        text = (
            f"{file.name} has {columns} x {rows} pixels, more than the limit of {PIXELS / 1e6:g}"
            " million: "
        )
        raise ParameterError(
            "file", f"{text}reduce it, such as by magick {file.name} -resize 50% small{file.suffix}"
        )


def refuse_large_array(file: Path, shape: Sequence[int]) -> None:
    """Raise ParameterError for an array whose header states more values than the limit, before
    it is read.
    """
    count = functools.reduce(lambda product, other: product * int(other), shape, 1)
    if count > VALUES:
        sizes = " x ".join(map(str, shape))
        text = (
            f"{file.name} has {sizes} values, more than the limit of {VALUES / 1e6:g} million: give"
            " a smaller array"
        )
        raise ParameterError("file", text)


def file_version(file: Path) -> tuple[int, ...] | None:
    """Return numbers that identify the version of a file, or None for a file changed less than two
    seconds ago.

    The numbers are device, inode, size, and the times of the last change of the content (mtime) and
    of the inode (ctime); no program can set the latter. A second change within a tick of the clock
    would not change them, so that a file changed less than two seconds ago has no version yet.
    """
    status = file.stat()
    changed = max(status.st_mtime_ns, status.st_ctime_ns)
    # a second change within the resolution of the clock could leave the same times
    if time.time_ns() - changed < _SETTLED:
        return None
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def once_per_version(check: Callable[..., Result]) -> Callable[..., Result]:
    """Return a function that caches the results of ``check`` until the file, its first argument,
    changes.
    """

    @functools.lru_cache(maxsize=256)
    def remembered(version: tuple[int, ...], *arguments: Any) -> Result:
        return check(*arguments)

    @functools.wraps(check)
    def checked(file: Path, *arguments: Any) -> Result:
        version = file_version(file)
        if version is None:
            return check(file.absolute(), *arguments)
        return remembered(version, file.absolute(), *arguments)

    return checked


def not_finite(file: Path, count: int) -> str:
    """Return the error message for a file with ``count`` values that are NaN or infinite; empty for
    0.
    """
    if not count:
        return ""
    fix = "replace these values by finite numbers, such as 0"
    return f"{file.name} holds {count} values that are not finite (NaN or infinity): {fix}"


def csv_rows(file: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of each row of a CSV file that is not empty.

    Lines that begin with ``#`` are comments, such as the source of the table.

    Raises ValueError for text that is not UTF-8, for another separator than a comma, and for more
    rows than the limit.
    """
    # comments become empty lines, so that line numbers stay correct
    reader = csv.reader(
        "" if line.startswith("#") else line for line in lines_of(file, _BYTES_OF_CELLS)
    )
    is_first = True
    try:
        for count, row in enumerate(reader):
            if count > ROWS:
                raise ValueError(f"{file.name} has more than {ROWS} rows: give a shorter table")
            if not row:
                continue
            if is_first:
                _refuse_separator(file, row)
            is_first = False
            yield reader.line_num, row
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(
            f"{file.name} is not a CSV file in UTF-8 ({error}): save the table as CSV"
        ) from None


def _refuse_separator(file: Path, header: list[str]) -> None:
    """Raise ValueError for a header whose columns are not separated by commas."""
    separator = next(
        (name for mark, name in _SEPARATORS.items() if len(header) == 1 and mark in header[0]), None
    )
    if separator:
        raise ValueError(
            f"{file.name} separates its columns by {separator}: separate the columns by commas"
        )
