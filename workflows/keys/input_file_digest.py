"""Digest of the content of an input file, which is part of the cache key of each step that reads the file."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import xxhash

from neusee.workflows.keys.regular_file import opened

_SETTLED = 2_000_000_000  #: ns after a change of a file in which a second change may not change the time stamp
_TICK = 20_000_000  #: ns, longer than a tick of the clock of a file system
_TRIES = 3  #: readings of a file that changes while it is read
_files: dict[tuple[int, ...], str] = {}

Stamp = tuple[int, ...]  #: device, inode, size, and the times (ns) of the last change of content and of the entry


def file_digest(path: Path) -> str:
    """Return the xxh3 digest of a file; an unchanged file is read only once in a process.

    A file that changed in the last two seconds is read each time, because its time stamp may not show a second change.
    Raises `OSError` if the file changes each time while it is read.
    """
    for _ in range(_TRIES):
        stamp = _stamp(path)
        if stamp in _files:
            return _files[stamp]
        with opened(path) as file:
            digits = hashlib.file_digest(file, xxhash.xxh3_128).hexdigest()
        if _stamp(path) == stamp:
            if time.time_ns() - max(stamp[-2:]) > _SETTLED:
                _files[stamp] = digits
            return digits
    raise OSError(f"{path} changes while it is read: wait until it is written, and run again")


def file_stamps(value: Any) -> list[Stamp]:
    """Return a stamp of each file in a parameter or a collection of parameters.

    Equal stamps before and after a reading say that the file was not replaced in between, not even by a file that was
    taken away again. A file that changed in this moment is waited for, because its next change could have its stamp.
    """
    stamps = [_stamp(path) for path in files_in(value)]
    if stamps and time.time_ns() - max(max(stamp[-2:]) for stamp in stamps) < _TICK:
        time.sleep(_TICK / 1e9)
    return stamps


def files_in(value: Any) -> Iterable[Path]:
    """Return the files in a parameter or a collection of parameters."""
    if isinstance(value, Path):
        return [value]
    if isinstance(value, Mapping):
        return [path for part in value.values() for path in files_in(part)]
    return [path for part in value for path in files_in(part)] if isinstance(value, tuple | list) else []


def _stamp(path: Path) -> Stamp:
    stat = os.stat(path)
    return stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns
