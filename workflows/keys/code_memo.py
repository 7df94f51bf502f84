"""Sealed files about code: the summaries of source files, so that a run from the cache parses no source.

A file that is damaged, of another format, or without the signature that is asked for is ignored and written again.
"""

from __future__ import annotations

import functools
import json
import os
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import xxhash
from pydantic import TypeAdapter

from neusee.workflows.keys.inherited_modes import inherit, make_folders
from neusee.workflows.keys.module_origin import distributions_of
from neusee.workflows.keys.regular_file import bytes_of
from neusee.workflows.keys.seal import seal_file, seal_record, secrets, unseal_file, unseal_record
from neusee.workflows.keys.source_summary import Summary

_SUMMARISING = (
    *("source_summary", "unfollowed_constructs", "reachable_code", "code_objects", "syntax_pass", "outward_code"),
    *("scopes_of_names", "hash_order", "facts_beside_content", "facts_of_the_moment", "literal_texts", "local_names"),
    "scratch_files",
)
#: digest of the code that summarises a source file, so that an older summary is not used
EDITION = xxhash.xxh3_64_hexdigest(b"".join(Path(__file__).with_name(f"{n}.py").read_bytes() for n in _SUMMARISING))
_KEPT = 1000  #: number of summaries in the file
_right: dict[Path, tuple[int, ...]] = {}  #: stamps of files of digests that this process has read or written

Parts = dict[str, dict[str, str]]  #: digests of definitions, versions or contents, by module or other dependency


class Outline(NamedTuple):
    """Digest of the syntax of a source file of the program, and the import statements at its top level."""

    digest: str
    imports: list[tuple[str, list[str]]]  #: of ``from a import b``: the module and the names


outlines: dict[str, Outline] = {}  #: of source files of the program, by the edition and the digest of the source
known_contents: dict[str, str] = {}  #: digests of the files of packages, by the digest of the stamps of the files


class _Known(NamedTuple):
    """What is noted of packages and of the program, beside the summaries."""

    distributions: dict[str, list[str]]
    outlines: dict[str, Outline]
    contents: dict[str, str]


_SUMMARIES = TypeAdapter(dict[str, Summary])
_KNOWN = TypeAdapter(_Known)
_PARTS = TypeAdapter(Parts)
_saved: dict[Path, int] = {}  #: number of outlines and of digests of packages in each memo


def read_memo(memo: Path) -> dict[str, Summary]:
    """Return the saved summaries of source files, or an empty dict if their file is missing or damaged."""
    _saved[memo] = 0
    try:
        known, summaries = _read(memo.name, bytes_of(memo), secrets())
    except (OSError, ValueError):
        return {}
    for module, distributions in known.distributions.items():
        distributions_of.setdefault(module, distributions)
    for name, outline in known.outlines.items():
        outlines.setdefault(name, outline)
    for stamps, content in known.contents.items():
        known_contents.setdefault(stamps, content)
    _saved[memo] = len(known.outlines) + len(known.contents)
    return dict(summaries)


@functools.lru_cache(4)
def _read(name: str, raw: bytes, signed_by: tuple[bytes, ...]) -> tuple[_Known, dict[str, Summary]]:
    """Return what a memo says; the same bytes are read once in a process, for each list of secrets."""
    seal, _, content = raw.partition(b"\n")
    known, text = unseal_file("sources", name, seal, content).split(b"\n", 1)
    return _KNOWN.validate_json(known), _SUMMARIES.validate_json(text)


def is_complete(memo: Path) -> bool:
    """Return True if a memo has an outline of each source file of the program, and of each package, that was read."""
    return _saved.get(memo, 0) >= len(outlines) + len(known_contents)


def write_memo(memo: Path, summaries: Mapping[str, Summary]) -> None:
    """Save the newest summaries of source files; do nothing if the folder cannot be written."""
    newest = dict(list(outlines.items())[-_KEPT:])
    packages = dict(list(known_contents.items())[-_KEPT:])
    _saved[memo] = len(outlines) + len(known_contents)
    known = _KNOWN.dump_json(_Known(distributions_of, newest, packages))
    text = json.dumps(dict(list(summaries.items())[-_KEPT:])).encode()
    content = b"\n".join([known, text])
    _write(memo, b"\n".join([seal_file("sources", memo.name, content), content]), memo.parent / "tmp")


def read_parts(root: Path, code: str) -> Parts:
    """Return the digest of each definition that the digest ``code`` covers; {} if the record is missing or damaged."""
    try:
        record = unseal_record("definitions", bytes_of(root / "code" / f"{code}.json"))
        return _PARTS.validate_python(record) if record.pop("key", "") == f"code/{code}" else {}
    except (OSError, ValueError):
        return {}


def write_parts(root: Path, code: str, parts: Parts) -> None:
    """Save the digest of each definition that the digest ``code`` covers, unless an undamaged record exists."""
    path = root / "code" / f"{code}.json"
    with suppress(OSError):
        stamp = _stamp(path)
        if _right.get(path) == stamp or read_parts(root, code):
            _right[path] = stamp
            return
    _write(path, seal_record("definitions", {**parts, "key": f"code/{code}"}), root / "tmp")


def _stamp(path: Path) -> tuple[int, ...]:
    stat = os.stat(path)
    return stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns


def _write(path: Path, content: bytes, folder: Path) -> None:
    """Write a file by atomic rename; do nothing if the folder cannot be written.

    ``folder`` is that of temporary files, in the root of the store.
    """
    root = str(folder.parent)
    part = folder / f"{path.name}.{os.getpid()}.{threading.get_ident()}"
    with suppress(OSError):
        make_folders(str(folder), root)
        make_folders(str(path.parent), root)
        part.write_bytes(content)
        inherit(str(part), root, 0o444)
        os.replace(part, path)
