"""Source of a loaded module: its file is read once, and a file that was edited after the import is told.

Python runs the code that it loaded, whatever the file says later. The first reading holds for this process.
"""

from __future__ import annotations

import importlib
import os
import sys
import warnings
from contextlib import suppress
from importlib.machinery import SourceFileLoader
from pathlib import Path
from typing import Any

import xxhash

from neusee.nodes.import_times import import_time

_edited_since: set[str] = set()  #: loaded modules whose source was edited after the import
_frozen: dict[str, tuple[Any, bytes, str]] = {}  #: spec, source and its digest at the first reading, by module
_said: set[tuple[str, str]] = set()  #: warnings of this process


def source_of(module: str, path: Path) -> tuple[bytes, str]:
    """Return the source of a module and its xxh3 digest; a loaded module is read only once.

    Warn if the source was edited after the import of the module.
    """
    spec = getattr(sys.modules.get(module), "__spec__", None)
    if module in _frozen and _frozen[module][0] is spec and spec is not None:
        return _frozen[module][1:]
    source = path.read_bytes()
    found = source, xxhash.xxh3_128_hexdigest(source)
    _edited_since.discard(module)
    if spec is not None:
        _frozen[module] = (spec, *found)
        if _edited(module, spec, path):
            _edited_since.add(module)
            say_once(module, f"{path} was edited after its import: restart Python to reuse new results")
    return found


def edited_since(module: str) -> bool:
    """Return True if the source of a loaded module was edited after the import."""
    return module in _edited_since


def imported(module: str) -> bool:
    """Import a module that a function imports later, so that its values count at once; return False if it fails."""
    if module not in sys.modules:
        with suppress(Exception):
            importlib.import_module(module)
    return module in sys.modules


def compiled_as_written(module: str) -> bool:
    """Return True if the loader of a module compiles its source without a change, as an assertion rewriter does not."""
    return type(getattr(sys.modules.get(module), "__loader__", None)) is SourceFileLoader


def say_once(module: str, text: str) -> None:
    """Warn of a module whose results are not stored, once for each text."""
    if (module, text) not in _said:
        _said.add((module, text))
        warnings.warn(text, stacklevel=2)


def _edited(module: str, spec: Any, path: Path) -> bool:
    """Return True if a source file was changed after the import began, or after Python wrote the byte code."""
    stat = os.stat(path)
    if stat.st_ctime_ns > import_time(module):
        return True
    try:
        with open(spec.cached or "", "rb") as file:
            head = file.read(16)
        writable = os.access(os.path.dirname(spec.cached), os.W_OK) and not sys.dont_write_bytecode
    except OSError:
        return False
    stamp = b"".join((int(n) & 0xFFFFFFFF).to_bytes(4, "little") for n in (stat.st_mtime, stat.st_size))
    return writable and head[4:8] == bytes(4) and head[8:] != stamp
