"""Reading of files of the program's own kinds: texts, documents and records, never of what is no regular file.

A pipe, a device or a socket in the place of a file makes nobody wait, and a file that is too long for its kind is not
read. This module imports little, because the fast commands read files with it.
"""

from __future__ import annotations

import os
import stat
from io import BufferedReader
from pathlib import Path

MOST = 64 << 20  #: bytes of a document or a record, at most
_KINDS = ((stat.S_ISFIFO, "a pipe"), (stat.S_ISSOCK, "a socket"), (stat.S_ISDIR, "a folder"))


class NotRegular(OSError, ValueError):
    """Error for what is no regular file, or is longer than a file of its kind."""


def refuse_other_than_file(path: Path | str) -> None:
    """Raise `NotRegular` for a pipe, a device, a socket or a folder; a file that is missing passes."""
    try:
        mode = os.stat(path).st_mode
    except OSError:
        return
    _refuse(path, mode)


def _refuse(path: Path | str, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = next((kind for fits, kind in _KINDS if fits(mode)), "a device")
        raise NotRegular(f"{path} is not a regular file but {kind}: give the path of a file")


def opened(path: Path | str) -> BufferedReader:
    """Open a regular file to read its bytes, without waiting; raise `NotRegular` for anything else."""
    refuse_other_than_file(path)  # some devices do something when they are opened
    number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _refuse(path, os.fstat(number).st_mode)
    except NotRegular:
        os.close(number)
        raise
    return os.fdopen(number, "rb")


def bytes_of(path: Path | str, most: int = MOST) -> bytes:
    """Return the bytes of a regular file; raise `NotRegular` for anything else, and for more than ``most`` bytes."""
    with opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise NotRegular(f"{path} has {size} bytes, more than the limit of {most}: give a shorter file")
        return file.read(size)


def head_of(path: Path | str, count: int) -> bytes:
    """Return the first bytes of a regular file."""
    with opened(path) as file:
        return file.read(count)


def text_of(path: Path | str, encoding: str = "utf-8", errors: str = "strict", most: int = MOST) -> str:
    """Return the text of a regular file, with ``\\n`` at the end of each line; raise what `bytes_of` raises."""
    return bytes_of(path, most).decode(encoding, errors).replace("\r\n", "\n").replace("\r", "\n")
