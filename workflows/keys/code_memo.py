"""File of the summaries of source files, with a checksum: a run from the cache parses no source.

A file that is damaged, or of another format, is ignored and written again.
"""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import xxhash
from pydantic import TypeAdapter

from neusee.workflows.keys.module_origin import distributions_of
from neusee.workflows.keys.source_summary import Summary

_SUMMARISING = ("source_summary", "unfollowed_constructs", "reachable_code", "code_objects")
#: digest of the code that summarises a source file, so that an older summary is not used
EDITION = xxhash.xxh3_64_hexdigest(b"".join(Path(__file__).with_name(f"{n}.py").read_bytes() for n in _SUMMARISING))
_KEPT = 1000  #: number of summaries in the file
_SUMMARIES = TypeAdapter(dict[str, Summary])
_NAMES = TypeAdapter(dict[str, list[str]])


def read_memo(memo: Path) -> dict[str, Summary]:
    """Return the saved summaries of source files, or an empty dict if their file is missing or damaged."""
    try:
        seal, names, text = memo.read_bytes().split(b"\n", 2)
        if seal.decode() != _checksum(names, text):
            return {}
        found = _NAMES.validate_json(names)
        summaries = _SUMMARIES.validate_json(text)
    except (OSError, ValueError):
        return {}
    for module, distributions in found.items():
        distributions_of.setdefault(module, distributions)
    return summaries


def write_memo(memo: Path, summaries: Mapping[str, Summary]) -> None:
    """Save the newest summaries of source files; do nothing if the folder cannot be written."""
    names = json.dumps(distributions_of).encode()
    text = json.dumps(dict(list(summaries.items())[-_KEPT:])).encode()
    write_file(memo, b"\n".join([_checksum(names, text).encode(), names, text]), memo.parent / "tmp")


def write_file(path: Path, content: bytes, folder: Path) -> None:
    """Write a file by atomic rename; do nothing if the folder cannot be written."""
    part = folder / f"{path.name}.{os.getpid()}.{threading.get_ident()}"
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        path.parent.mkdir(exist_ok=True)
        part.write_bytes(content)
        os.replace(part, path)


def _checksum(*parts: Any) -> str:
    return xxhash.xxh3_128_hexdigest(b"\n".join(parts))
