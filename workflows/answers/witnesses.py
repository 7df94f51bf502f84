"""Files and folders on which an answer rests, and the comparison with what they are now."""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple


class Unsettled(ValueError):
    """Error for a file or folder that may have changed while the command ran, or that cannot be compared later."""


class Witnesses(NamedTuple):
    """Files and folders on which an answer rests, each with a digest."""

    files: dict[str, str]  #: by path: digest of the content
    absent: list[str]  #: paths at which a file was wanted, and where there was none
    recipes: dict[str, str]  #: by folder in which recipes and options are looked for: digest of their names
    listed: dict[str, str]  #: by another folder that was listed: digest of all names in it


class Listing(NamedTuple):
    """The names in a folder, and when the folder last changed (ns); 0 for a folder that is missing."""

    names: list[str]
    changed: int


def listing(folder: str) -> Listing:
    """Return the names in a folder as they are now."""
    try:
        about = os.stat(folder)
    except OSError:
        return Listing(all_names(folder), 0)
    return Listing(all_names(folder), max(about.st_mtime_ns, about.st_ctime_ns))


def witnesses_of(
    files: Iterable[str], recipes: Iterable[str], listed: Mapping[str, Listing], before: int, made: str | None = None
) -> Witnesses:
    """Return witnesses for these paths as they are now; a path without a file is a witness of its absence.

    ``made`` is a folder that the command itself may have made: as a new name in a listed folder it is no change.
    Raises `Unsettled` for what changed after the time ``before`` (ns), and for a folder in place of a file.
    """
    for folder, then in listed.items():
        own = os.path.relpath(made, folder).partition(os.sep)[0] if made else ""
        now = [name for name in all_names(folder) if name != own or name in then.names]
        if then.changed > before or now != then.names:
            raise Unsettled(f"{folder} changed while the command ran")
    found: dict[str, str] = {}
    absent = []
    for path in sorted(set(files)):
        try:
            found[path] = file_digest(path, before)
        except FileNotFoundError:
            absent.append(path)
        except OSError as error:
            raise Unsettled(f"{path} cannot be read: {error}") from None
    names = {folder: _digest(recipe_names(folder)) for folder in sorted(set(recipes))}
    return Witnesses(found, absent, names, {folder: _digest(all_names(folder)) for folder in sorted(listed)})


def hold(witnesses: Witnesses) -> bool:
    """Return True if every file and folder is as it was; read the content of each file."""
    try:
        return (
            not any(map(os.path.lexists, witnesses.absent))
            and all(_digest(recipe_names(folder)) == digest for folder, digest in witnesses.recipes.items())
            and all(_digest(all_names(folder)) == digest for folder, digest in witnesses.listed.items())
            and all(file_digest(path) == digest for path, digest in witnesses.files.items())
        )
    except (OSError, Unsettled):
        return False


def file_digest(path: str, before: int | None = None) -> str:
    """Return the digest of the content of a file; never wait for a pipe in its place.

    Raises `Unsettled` for what is no file, and for a file that changed after the time ``before`` (ns).
    """
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        about = os.fstat(file.fileno())
        if not stat.S_ISREG(about.st_mode):
            raise Unsettled(f"{path} is not a file")
        digits = hashlib.file_digest(file, _blake).hexdigest()
        about = os.fstat(file.fileno())
    if before is not None and max(about.st_mtime_ns, about.st_ctime_ns) > before:
        raise Unsettled(f"{path} changed while the command ran")
    return digits


def recipe_names(folder: str) -> list[str]:
    """Return the names of the recipes in a folder, and of the options in its groups, as far as they are files."""
    return sorted(_yaml_in(folder, groups=True))


def _yaml_in(folder: str, groups: bool) -> Iterator[str]:
    try:
        with os.scandir(folder) as found:
            entries = list(found)
    except OSError:
        return
    for entry in entries:
        if entry.name.endswith((".yaml", ".yml")):
            yield f"{entry.name} {os.path.isfile(entry.path)}"
        if groups and os.path.isdir(entry.path):
            yield from (f"{entry.name}/{name}" for name in _yaml_in(entry.path, groups=False))


def all_names(folder: str) -> list[str]:
    """Return all names in a folder; a folder that is missing has the name of no file."""
    try:
        return sorted(os.listdir(folder))
    except OSError as error:
        return [f"/{type(error).__name__}"]


def _blake() -> hashlib.blake2b:
    return hashlib.blake2b(digest_size=16)


def _digest(names: list[str]) -> str:
    return hashlib.blake2b("\0".join(names).encode(errors="surrogateescape"), digest_size=16).hexdigest()
