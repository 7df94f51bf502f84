"""Results and files of the cache on which an answer rests, and the comparison with what they are now, without torch.

A result that was loaded is compared byte by byte, as a run that loads it does; of the others the metadata are compared,
which hold the size and the checksum of the value, and the size of its file.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import xxhash

from neusee.workflows.answers.witnesses import Unsettled
from neusee.workflows.keys.seal import secrets
from neusee.workflows.store import metadata
from neusee.workflows.store.metadata import UNREADABLE, Metadata, is_kept
from neusee.workflows.store.result_store import Store
from neusee.workflows.store.shared_folder import Disk
from neusee.workflows.store.small_results import SmallResults

_KEY = re.compile(r"[0-9a-z-]{2,64}")
_FILE = re.compile(r"(files|bands)/[0-9a-z]{2}/\w[\w.-]*")


class StoredResults(NamedTuple):
    """What of a cache an answer rests on; by default nothing."""

    results: Mapping[str, str] = {}  #: by key: digest of the metadata, or an empty text for a result that was missing
    loaded: tuple[str, ...] = ()  #: keys of the results whose values were loaded
    files: Mapping[str, str] = {}  #: by path in the cache: digest of a band, a picture or an export
    taken: Mapping[str, str] = {}  #: by name in the folder of results: the path in the cache


NOTHING = StoredResults()


def taken_from(store: Store, taken: Mapping[str, Path]) -> StoredResults:
    """Return what a process has asked of a store so far, and the stored files that it took into a folder of results.

    Raises `Unsettled` for a file that is not in the store, and `OSError` for one that cannot be read.
    """
    asked, loaded = store.asked(), sorted(store.loaded())
    paths = {name: os.path.relpath(path, store.root) for name, path in taken.items()}
    bands = (f"bands/{name[:2]}/{name}" for key in loaded for name in metadata.bands(asked[key] or {}))
    used = sorted({*paths.values(), *bands})
    if outside := [path for path in used if not _FILE.fullmatch(path)]:
        raise Unsettled(f"{outside[0]} is not in the folders of a store")
    files = {path: _digest(f"{store.disk.folder}/{path}") for path in used}
    results = {key: _said(about) for key, about in sorted(asked.items())}
    return StoredResults(results, tuple(loaded), files, paths)


def still_there(disk: Disk, then: StoredResults) -> bool:
    """Return True if every result is as it was and every file has the same content; change nothing in the cache."""
    small = SmallResults(disk)
    try:
        found = {key: _about(disk, small, key) for key in then.results}
        return (
            all(_said(found[key]) == digest for key, digest in then.results.items())
            and all(_is_whole(disk, found[key]) for key in then.loaded)
            and all(_digest(f"{disk.folder}/{path}") == digest for path, digest in then.files.items())
        )
    except (*UNREADABLE, Unsettled):
        return False


def note_use(disk: Disk, then: StoredResults) -> None:
    """Record that the values were used, as a run that loads them does."""
    for key in then.loaded:
        metadata.record_use(disk, key)


def checked(fields: Mapping[str, Any]) -> StoredResults:
    """Return the results that the JSON of an answer names.

    Raises `ValueError` or `TypeError` for what `taken_from` never gives.
    """
    found = StoredResults(**{**fields, "loaded": tuple(fields.get("loaded", ()))})
    if not all(isinstance(each, dict) for each in (found.results, found.files, found.taken)):
        raise ValueError("a field of the answer is not of its type")
    names = [(_KEY, [*found.results, *found.loaded]), (_FILE, [*found.files, *found.taken.values()])]
    if any(not form.fullmatch(name) for form, many in names for name in many):
        raise ValueError("the answer names what is no result and no file of a cache")
    digests = [*found.results.values(), *found.files.values()]
    if not all(isinstance(text, str) for text in digests) or not {*found.taken.values()} <= {*found.files}:
        raise ValueError("a field of the answer is not of its type")
    if not {*found.loaded} <= {*found.results}:
        raise ValueError("a result was loaded and is not named")
    return found


def _about(disk: Disk, small: SmallResults, key: str) -> Metadata | None:
    """Return the metadata of a result as a store finds them, without moving a damaged result away."""
    about = small.find(key)
    return about if is_kept(about) else metadata.find(disk, key) or about


def _said(about: Metadata | None) -> str:
    if about is None:
        return ""
    return hashlib.blake2b(json.dumps(about, sort_keys=True).encode(), digest_size=16).hexdigest()


def _is_whole(disk: Disk, about: Metadata | None) -> bool:
    """Return True if the file of a value has the checksum in the metadata, or with a secret the signed digest."""
    if not is_kept(about):
        return False
    payload = about.get("payload")
    if not payload:
        return True
    how, name = (hashlib.sha256, "sha256") if secrets() else (xxhash.xxh3_128, "xxh3")
    return bool(_digest_by(disk.path(about["key"], "safetensors"), how) == payload.get(name))


def _digest(path: str) -> str:
    """Return a digest of a file, of the kind that the store uses for its files."""
    return _digest_by(path, hashlib.sha256 if secrets() else xxhash.xxh3_128)


def _digest_by(path: str, how: Any) -> str:
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise Unsettled(f"{path} is not a file")
        return hashlib.file_digest(file, how).hexdigest()
