"""What one module adds to the digest of a node, and the digest of a module with all that it imports."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from neusee.workflows.keys.code_memo import Parts
from neusee.workflows.keys.installed_content import counted
from neusee.workflows.keys.loaded_source import say_once
from neusee.workflows.keys.source_summary import Summary

OURS = frozenset({"neusee"})  #: packages that are followed by source for a node of neusee
Names = dict[str, set[str]]  #: names that are used of each module; an empty name stands for all of them


class Look(NamedTuple):
    """What one module adds to a digest, and the modules that it leads to."""

    parts: Parts
    imports: Names
    summary: Summary | None = None  #: None for a module that counts by its version
    path: Path | None = None
    state: str = ""
    changing: Mapping[str, str] = {}  #: loaded objects that no digest covers, such as generators, and why, by name
    private: bool = False  #: True if the loaded code is not that of the file


class Whole(NamedTuple):
    """The digest of a module with all that it imports."""

    code: str
    looks: dict[str, Look]
    names: Names
    parts: Parts


def parts_of(looks: dict[str, Look]) -> Parts:
    return {name: part for look in looks.values() for name, part in look.parts.items()}


def digest_of(look: Look, documents: bool) -> list[Any]:
    """Return what a module adds to the digest of a node."""
    if look.summary is None:
        return [look.parts]
    source = look.summary.whole if documents else look.summary.tree
    other = {name: part for name, part in look.parts.items() if name.startswith(("file ", "environment "))}
    return [source, look.state, other]


def installed_look(module: str, version: str, packages: frozenset[str]) -> Look:
    """Return what a module of an installed package adds, where ``packages`` are followed by source; without a version,
    that it is missing.
    """
    if not version or packages == OURS:
        return Look({f"package {module.partition('.')[0]}": {"version": version or "not installed"}}, {})
    found = counted(module, version)
    if found.edited:
        say_once(module, f"the package {found.edited} was changed after its import: restart Python to store results")
    return Look(found.parts, {}, private=bool(found.edited))
