"""Digest of the content of an input file, which is part of the cache key of each step that reads the file."""

from __future__ import annotations

import hashlib
import os
import time
from pathlib import Path

import xxhash

_SETTLED = 2_000_000_000  #: ns after a change of a file in which a second change may not change the time stamp
_files: dict[tuple[int, ...], str] = {}


def file_digest(path: Path) -> str:
    """Return the xxh3 digest of a file; an unchanged file is read only once in a process.

    A file that changed in the last two seconds is read each time, because its time stamp may not show a second change.
    """
    stat = os.stat(path)
    stamp = (stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns)
    if stamp in _files:
        return _files[stamp]
    with open(path, "rb") as file:
        digits = hashlib.file_digest(file, xxhash.xxh3_128).hexdigest()
    if time.time_ns() - max(stat.st_mtime_ns, stat.st_ctime_ns) > _SETTLED:
        _files[stamp] = digits
    return digits
