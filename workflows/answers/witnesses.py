"""Witnesses of an answer: the files, folders and results that it depends on, and a check that they
are unchanged.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import xxhash

from neusee.workflows.keys.sealed_files import secrets
from neusee.workflows.store import metadata
from neusee.workflows.store.metadata import UNREADABLE, Metadata, is_kept
from neusee.workflows.store.payload import SmallResults
from neusee.workflows.store.result_store import Store
from neusee.workflows.store.shared_folder import Disk

# --- witnesses ------------------------------------------------------------------------------------

# Files and folders that an answer depends on, and their comparison with the present state.


class Unsettled(ValueError):
    """Error for a file or folder that may have changed while the command ran, or that cannot be
    compared later.
    """


class Witnesses(NamedTuple):
    """Files and folders that an answer depends on, each with a digest."""

    files: dict[str, str]  #: digest of the content, by path
    absent: list[str]  #: paths at which a file was looked for, but did not exist
    #: digest of the names of recipes and options, by the folder in which they are searched
    recipes: dict[str, str]
    listed: dict[str, str]  #: digest of all names in each other folder that was listed, by folder


class Listing(NamedTuple):
    """The names in a folder, and the time of its last change (ns); 0 for a missing folder."""

    names: list[str]
    changed: int


def listing(folder: str) -> Listing:
    """Return the present names in a folder."""
    try:
        folder_status = os.stat(folder)
    except OSError:
        return Listing(all_names(folder), 0)
    return Listing(all_names(folder), max(folder_status.st_mtime_ns, folder_status.st_ctime_ns))


def witnesses_of(
    files: Iterable[str],
    recipes: Iterable[str],
    listed: Mapping[str, Listing],
    before: int,
    made: str | None = None,
) -> Witnesses:
    """Return witnesses for the present state of these paths; a path without a file is a witness
    that the file is absent.

    ``made`` is a folder that the command itself may have made: as a new name in a listed folder it
    is no change. Raises `Unsettled` for what changed after the time ``before`` (ns), and for a
    folder in place of a file.
    """
    for folder, listing_before in listed.items():
        names_now = _names_but(folder, listing_before, made)
        if listing_before.changed > before or names_now != listing_before.names:
            raise Unsettled(f"{folder} changed while the command ran")
    digests: dict[str, str] = {}
    absent_paths = []
    # digests of the present files
    for path in sorted(set(files)):
        try:
            digests[path] = file_digest(path, before)
        except FileNotFoundError:
            absent_paths.append(path)
        except OSError as error:
            raise Unsettled(f"{path} cannot be read: {error}") from None
    recipe_digests = {folder: _digest(recipe_names(folder)) for folder in sorted(set(recipes))}
    return Witnesses(
        digests,
        absent_paths,
        recipe_digests,
        {folder: _digest(all_names(folder)) for folder in sorted(listed)},
    )


def _names_but(folder: str, then: Listing, made: str | None) -> list[str]:
    """Return the present names in a folder, without the folder ``made`` if it is new."""
    # the entry of the listed folder that contains ``made``
    made_name = os.path.relpath(made, folder).partition(os.sep)[0] if made else ""
    return [name for name in all_names(folder) if name != made_name or name in then.names]


def hold(witnesses: Witnesses) -> bool:
    """Return True if every file and folder is unchanged; the content of each file is read."""
    try:
        return (
            not any(map(os.path.lexists, witnesses.absent))
            and all(
                _digest(recipe_names(folder)) == digest
                for folder, digest in witnesses.recipes.items()
            )
            and all(
                _digest(all_names(folder)) == digest for folder, digest in witnesses.listed.items()
            )
            and all(file_digest(path) == digest for path, digest in witnesses.files.items())
        )
    except (OSError, Unsettled):
        return False


def file_digest(path: str, before: int | None = None) -> str:
    """Return the digest of the content of a file; a pipe in its place does not block.

    Raises `Unsettled` for what is no file, and for a file that changed after the time ``before``
    (ns).
    """
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        # checked again after reading
        file_status = os.fstat(file.fileno())
        if not stat.S_ISREG(file_status.st_mode):
            raise Unsettled(f"{path} is not a file")
        hex_digest = hashlib.file_digest(file, _blake).hexdigest()
        file_status = os.fstat(file.fileno())
    if before is not None and max(file_status.st_mtime_ns, file_status.st_ctime_ns) > before:
        raise Unsettled(f"{path} changed while the command ran")
    return hex_digest


def recipe_names(folder: str) -> list[str]:
    """Return the names of the recipes in a folder and of the options in its groups, each with
    whether it is a file.
    """
    return sorted(_yaml_in(folder, groups=True))


def _yaml_in(folder: str, groups: bool) -> Iterator[str]:
    """Yield the YAML files in a folder, each with whether it is a file; with ``groups``, those of
    its subfolders too.
    """
    try:
        with os.scandir(folder) as scan:
            entries = list(scan)
    except OSError:
        return
    for entry in entries:
        if entry.name.endswith((".yaml", ".yml")):
            yield f"{entry.name} {os.path.isfile(entry.path)}"
        if groups and os.path.isdir(entry.path):
            yield from (f"{entry.name}/{name}" for name in _yaml_in(entry.path, groups=False))


def all_names(folder: str) -> list[str]:
    """Return all names in a folder; for a missing folder, the type of the error as a name that no
    file can have.
    """
    try:
        return sorted(os.listdir(folder))
    except OSError as error:
        return [f"/{type(error).__name__}"]


def _blake() -> hashlib.blake2b:
    """Return a hasher of 16 bytes."""
    return hashlib.blake2b(digest_size=16)


def _digest(names: list[str]) -> str:
    """Return a digest of names in their order."""
    return hashlib.blake2b(
        "\0".join(names).encode(errors="surrogateescape"), digest_size=16
    ).hexdigest()


# --- opened files ---------------------------------------------------------------------------------

# Record of the files that this process opens for reading and of the folders that it lists, made by
# an audit hook of Python.


_LISTS = ("os.listdir", "os.scandir")
_WRITES = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
_listeners: list[Opened] = []  #: empty or one record; the hook of a process cannot be removed
_hooked: list[bool] = []


class Opened:
    """The files that were opened for reading and the folders that were listed, as absolute
    paths.
    """

    def __init__(self) -> None:
        self.files: dict[str, None] = {}
        self.folders: dict[str, Listing] = {}  #: content of each folder when it was first listed
        self._lists = False

    def listen(self) -> None:
        """Begin the record; it replaces an earlier record of this process."""
        _listeners[:] = [self]
        if not _hooked:
            _hooked.append(True)
            sys.addaudithook(_hear)

    def end(self) -> None:
        """End the record."""
        if self in _listeners:
            _listeners.remove(self)

    def hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Record one audit event of Python; an event with a file descriptor in place of a path adds
        nothing.
        """
        path = os.curdir if event in _LISTS and arguments[0] is None else arguments[0]
        if not isinstance(path, str | bytes | os.PathLike):
            return
        if event in _LISTS:
            self._list(os.path.abspath(os.fsdecode(path)))
        elif not _is_written(*arguments[1:3]):
            self.files[os.path.abspath(os.fsdecode(path))] = None

    def _list(self, folder: str) -> None:
        """Record the content of a folder when it is first listed."""
        if self._lists or folder in self.folders:
            return
        self._lists = True  # the listing made here is an event too
        try:
            self.folders[folder] = listing(folder)
        finally:
            self._lists = False


class Folders:
    """Some folders with everything below them."""

    def __init__(self, roots: Iterable[str | os.PathLike[str]]) -> None:
        paths: list[str] = []
        for root in roots:
            paths += [str(os.path.abspath(root)), str(os.path.realpath(root))]
        self._starts = tuple(f"{path.rstrip('/')}/" for path in paths)

    def __contains__(self, path: object) -> bool:
        """Return True if a path is one of the folders or below one of them, with or without
        symbolic links resolved.
        """
        return any(
            f"{form}/".startswith(self._starts) for form in (str(path), os.path.realpath(str(path)))
        )


def _is_written(mode: Any, flags: Any) -> bool:
    """Return True for a file that is opened for writing, or that is created."""
    if isinstance(mode, str):
        return mode[:1] in ("w", "x", "a")
    return isinstance(flags, int) and bool(flags & _WRITES)


def _hear(event: str, arguments: tuple[Any, ...]) -> None:
    """Pass an audit event to the present record, if there is one."""
    if _listeners and (event == "open" or event in _LISTS):
        _listeners[0].hear(event, arguments)


# --- stored results -------------------------------------------------------------------------------

# Results and files of the cache that an answer depends on, and their comparison with the present
# state, without torch.
#
# A result that was loaded is compared byte by byte, as in a run that loads it. For other results
# only the metadata are compared, which contain the size and the checksum of the value, and the size
# of its file.


_KEY = re.compile(r"[0-9a-z-]{2,64}")
_FILE = re.compile(r"(files|bands)/[0-9a-z]{2}/\w[\w.-]*")


class StoredResults(NamedTuple):
    """The results and files of a cache that an answer depends on; by default none."""

    #: digest of the metadata by key; an empty text for a result that was missing
    results: Mapping[str, str] = {}
    loaded: tuple[str, ...] = ()  #: keys of the results whose values were loaded
    files: Mapping[str, str] = {}  #: digest of a band, a picture or an export, by path in the cache
    taken: Mapping[str, str] = {}  #: path in the cache, by name in the folder of results


NOTHING = StoredResults()


def taken_from(store: Store, taken: Mapping[str, Path]) -> StoredResults:
    """Return the results that a process has looked up in a store so far, and the stored files that
    it took into a folder of results.

    Raises `Unsettled` for a file that is not in the store, and `OSError` for one that cannot be
    read.
    """
    metadata_by_key, loaded = store.asked(), sorted(store.loaded())
    paths = {name: os.path.relpath(path, store.root) for name, path in taken.items()}
    read_files = sorted(set(paths.values()))
    if foreign_paths := [path for path in read_files if not _FILE.fullmatch(path)]:
        raise Unsettled(f"{foreign_paths[0]} is not in the folders of a store")
    files = {path: _digest_of_results(f"{store.disk.folder}/{path}") for path in read_files}
    results = {
        key: _said(metadata_of_key) for key, metadata_of_key in sorted(metadata_by_key.items())
    }
    return StoredResults(results, tuple(loaded), files, paths)


def still_there(disk: Disk, then: StoredResults) -> bool:
    """Return True if every result and the content of every file are unchanged; the cache itself is
    not modified.
    """
    small_results = SmallResults(disk)
    try:
        metadata_by_key = {key: _about(disk, small_results, key) for key in then.results}
        return (
            all(_said(metadata_by_key[key]) == digest for key, digest in then.results.items())
            and all(_is_whole(disk, metadata_by_key[key]) for key in then.loaded)
            and all(
                _digest_of_results(f"{disk.folder}/{path}") == digest
                for path, digest in then.files.items()
            )
        )
    except (*UNREADABLE, Unsettled):
        return False


def note_use(disk: Disk, then: StoredResults) -> None:
    """Record that the values were used, as for a run that loads them."""
    for key in then.loaded:
        metadata.record_use(disk, key)


def checked(fields: Mapping[str, Any]) -> StoredResults:
    """Return the results that the JSON of an answer lists.

    Raises `ValueError` or `TypeError` for fields that `taken_from` never writes.
    """
    results = StoredResults(**{**fields, "loaded": tuple(fields.get("loaded", ()))})
    if not all(
        isinstance(field, dict) for field in (results.results, results.files, results.taken)
    ):
        raise ValueError("a field of the answer is not of its type")
    keys, paths = [*results.results, *results.loaded], [*results.files, *results.taken.values()]
    if not (all(map(_KEY.fullmatch, keys)) and all(map(_FILE.fullmatch, paths))):
        raise ValueError("the answer names what is no result and no file of a cache")
    digests = [*results.results.values(), *results.files.values()]
    # each taken file must have a digest
    if not all(isinstance(text, str) for text in digests) or not {*results.taken.values()} <= {
        *results.files
    }:
        raise ValueError("a field of the answer is not of its type")
    if not {*results.loaded} <= {*results.results}:
        raise ValueError("a result was loaded and is not named")
    return results


def _about(disk: Disk, small: SmallResults, key: str) -> Metadata | None:
    """Return the metadata of a result as a store would find them, but do not move a damaged
    result.
    """
    small_metadata = small.find(key)
    return small_metadata if is_kept(small_metadata) else metadata.find(disk, key) or small_metadata


def _said(about: Metadata | None) -> str:
    """Return a digest of metadata; an empty text for a missing result."""
    if about is None:
        return ""
    return hashlib.blake2b(json.dumps(about, sort_keys=True).encode(), digest_size=16).hexdigest()


def _is_whole(disk: Disk, about: Metadata | None) -> bool:
    """Return True if the file of a value has the checksum in the metadata, or the signed digest if
    a secret is set.
    """
    if not is_kept(about):
        return False
    payload = about.get("payload")
    if not payload:
        return True
    digest_name = "sha256" if secrets() else "xxh3"
    content_digest = _digest_of_results(disk.path(about["key"], "safetensors"))
    return bool(content_digest == payload.get(digest_name))


def _digest_of_results(path: str) -> str:
    """Return a digest of a file by the algorithm that the store uses for its files."""
    algorithm: Any = hashlib.sha256 if secrets() else xxhash.xxh3_128
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise Unsettled(f"{path} is not a file")
        return hashlib.file_digest(file, algorithm).hexdigest()
