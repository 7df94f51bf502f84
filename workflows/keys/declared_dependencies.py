"""Dependencies that a node declares with ``depends=`` or a module with ``__depends__``, and the constructs they cover.

An entry is a file or folder beside the module (``table.csv``), ``env:NAME``, the name of a module, or
``unaffected:open``: the author states that no result depends on this construct.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path, PurePath
from typing import NamedTuple

from neusee.nodes.import_times import import_time
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.input_file_digest import file_digest
from neusee.workflows.keys.unfollowed_code import UnfollowedCode
from neusee.workflows.keys.unfollowed_constructs import Construct

FREE = "unaffected:"
VARIABLE = "env:"
_FIX = {
    "file": 'give it as a parameter of type Path, or declare it: depends=["{name}"], beside the module',
    "env": 'make it a parameter, or declare it: depends=["env:{name}"]',
    "import": 'write the import as a statement, or declare each module: depends=["package.module"]',
    "run": 'declare the file or the module that it runs: depends=["kernel.cpp"]',
    "state": "make it a parameter",
    "stamp": "make it a parameter",
    "source": 'declare the file of the code, with its comments and lines: depends=["helper.py"]',
    "hash": "write sorted(...) around the set, or a digest of hashlib",
}
_NAME = {"file": "table.csv", "env": "NAME"}


class Declared(NamedTuple):
    """Declared dependencies: the digest of each, by its name, the modules among them, and the changed files."""

    parts: dict[str, dict[str, str]]
    modules: list[str]
    changed: list[str]  #: files that were changed after the import of the module that declares them


def resolve(
    entries: Sequence[str], module: str, source: Path, then: Mapping[str, str | None], exists: Callable[[str], bool]
) -> Declared:
    """Return the dependencies that a module declares; ``then`` are the variables of the environment at its import.

    Raises `LookupError` for an entry that is neither a file nor a module.
    """
    found = Declared({}, [], [])
    for entry in entries:
        if entry.startswith(VARIABLE):
            name = entry.removeprefix(VARIABLE)
            values = dict.fromkeys([then.get(name, os.environ.get(name)), os.environ.get(name)])
            found.parts[f"environment variable {name}"] = {"value": digest(*values)[:16]}
        elif not entry.startswith(FREE):
            path = source.parent / entry
            if path.exists():
                found.parts[f"file {entry}"] = {"content": _content(path)}
                found.changed.extend([entry] if _changed(path, import_time(module)) else [])
            elif all(part.isidentifier() for part in entry.split(".")) and exists(entry):
                found.modules.append(entry)
            else:
                text = f"{source}: depends={entry!r} is no file in {source.parent} and no module: correct the name"
                raise UnfollowedCode(text)
    return found


def uncovered(found: Iterable[Construct], entries: Sequence[str]) -> Construct | None:
    """Return the first construct that no entry covers, or None."""
    return next((item for item in found if not any(_covers(entry, item) for entry in entries)), None)


def refusal(item: Construct, source: Path) -> str:
    """Return the message that refuses a construct: its place, its text, the reason and the fix."""
    fix = _FIX[item.kind].format(name=item.name or _NAME.get(item.kind, ""))
    free = f'or, if no result depends on it, depends=["{FREE}{item.text if item.text.isidentifier() else item.kind}"]'
    return f"{source}:{item.line}: {item.text}: {item.why}, and a cache key cannot see it: {fix}; {free}"


def changing_refusal(name: str, what: str, source: Path) -> str:
    """Return the message that refuses a name of a module whose object changes while a process runs, or is not read."""
    return (
        f"{source}: {name} is or holds a {what}, and a cache key cannot see it: "
        f'make it inside of the function that uses it; or, if no result depends on it, depends=["{FREE}{name}"]'
    )


def _covers(entry: str, item: Construct) -> bool:
    if entry.startswith(FREE):
        free = entry.removeprefix(FREE)
        named = (item.kind, item.name, PurePath(item.name).name, item.text)
        return free in named or item.text.startswith((f"{free}.", f"{free}("))
    if entry.startswith(VARIABLE):
        return item.kind == "env" and item.name in ("", entry.removeprefix(VARIABLE))
    if item.kind == "file":
        return not item.name or not PurePath(entry).suffix or PurePath(entry).name == PurePath(item.name).name
    if item.kind == "source":
        return PurePath(entry).suffix == ".py"
    return item.kind in ("run", "import")


def _content(path: Path) -> str:
    """Return the digest of a file, or of all files of a folder with their names."""
    if not path.is_dir():
        return file_digest(path)
    files = sorted(file for file in path.rglob("*") if file.is_file() and "__pycache__" not in file.parts)
    return digest([[file.relative_to(path).as_posix(), file_digest(file)] for file in files])


def _changed(path: Path, since: int) -> bool:
    """Return True if a file, or anything in a folder, was changed after a time (ns)."""
    inside = path.rglob("*") if path.is_dir() else ()
    return any(os.stat(file).st_ctime_ns > since for file in (path, *inside))
