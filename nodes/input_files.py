"""Limits of input files, and checks that read the content of a file once, before the run."""

import csv
import functools
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from neusee.nodes import ParameterError
from neusee.nodes.input_size import lines_of

PIXELS = 64_000_000  #: of a picture, at most; a PNG of this size takes 1.3 GB of memory to decode and convert
VALUES = 1_000_000_000  #: numbers in a cube, a height map or a frame, at most; 4 GB as float32
ROWS = 1_000_000  #: lines of a table, at most
__depends__ = ["unaffected:time"]  #: the clock decides whether a file is read again, and no result
_SETTLED = 2_000_000_000  #: ns after a change of a file in which a second change may not change its times
_CELLS = 8.0  #: bytes in memory for each byte of a table, in texts of cells of several digits
_SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "vertical bars"}

Result = TypeVar("Result")


def refuse_large_picture(file: Path, rows: int, columns: int) -> None:
    """Raise ParameterError for a picture whose header states more pixels than the limit, before it is decoded."""
    if rows * columns > PIXELS:
        text = f"{file.name} has {columns} x {rows} pixels, more than the limit of {PIXELS / 1e6:g} million: "
        raise ParameterError("file", f"{text}reduce it, such as by magick {file.name} -resize 50% small{file.suffix}")


def refuse_large_array(file: Path, shape: Sequence[int]) -> None:
    """Raise ParameterError for an array whose header states more values than the limit, before it is read."""
    count = functools.reduce(lambda one, other: one * int(other), shape, 1)
    if count > VALUES:
        sizes = " x ".join(map(str, shape))
        text = f"{file.name} has {sizes} values, more than the limit of {VALUES / 1e6:g} million: give a smaller array"
        raise ParameterError("file", text)


def file_version(file: Path) -> tuple[int, ...] | None:
    """Return numbers that differ for each version of a file, or None for a file that has just been changed.

    The numbers are device, inode, size, and the times of the last change of content and of the entry, which no program
    can set. A second change within a tick of the clock leaves them as they are, so that a file younger than two seconds
    has no version yet.
    """
    about = file.stat()
    changed = max(about.st_mtime_ns, about.st_ctime_ns)
    if time.time_ns() - changed < _SETTLED:
        return None
    return about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns


def once_per_version(check: Callable[..., Result]) -> Callable[..., Result]:
    """Return a function that remembers the results of ``check`` until the file, its first argument, changes."""

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
    """Return the message for a file with values that are NaN or infinite, or an empty text for a count of 0."""
    fix = "replace these values by finite numbers, such as 0"
    return f"{file.name} holds {count} values that are not finite (NaN or infinity): {fix}" if count else ""


def csv_rows(file: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of the line and the cells of each row of a CSV file that is not empty.

    A line that begins with ``#`` is a comment, such as the source of the table.

    Raises ValueError for text that is not UTF-8, for another separator than a comma, and for more rows than the limit.
    """
    reader = csv.reader("" if line.startswith("#") else line for line in lines_of(file, _CELLS))
    first = True
    try:
        for count, row in enumerate(reader):
            if count > ROWS:
                raise ValueError(f"{file.name} has more than {ROWS} rows: give a shorter table")
            if not row:
                continue
            if first:
                _refuse_separator(file, row)
            first = False
            yield reader.line_num, row
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{file.name} is not a CSV file in UTF-8 ({error}): save the table as CSV") from None


def _refuse_separator(file: Path, header: list[str]) -> None:
    found = next((name for mark, name in _SEPARATORS.items() if len(header) == 1 and mark in header[0]), None)
    if found:
        raise ValueError(f"{file.name} separates its columns by {found}: separate the columns by commas")
