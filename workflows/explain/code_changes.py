"""Changes of code: the functions, classes and constants that differ between two digests of code."""

from __future__ import annotations

import json
from pathlib import Path

from neusee.workflows.keys.code_digest import parts_file, source_file

Parts = dict[str, dict[str, str]]  #: digests of definitions, by module


def edits(root: Path, old: str, new: str) -> list[str]:
    """Return one text clause for each definition that differs between two versions of code; [] if no record exists."""
    before, after = _parts(root, old), _parts(root, new)
    if not before or not after:
        return []
    inside = [text for name in after if name in before for text in _inside(name, before[name], after[name])]
    came = [f"{_file(name)} is imported now" for name in after if name not in before]
    gone = [f"{_file(name)} is no longer imported" for name in before if name not in after]
    return sorted(inside, key=lambda text: text.startswith("the ")) + came + gone


def _inside(module: str, old: dict[str, str], new: dict[str, str]) -> list[str]:
    """Return one text clause for each changed, added or removed definition of a module."""
    file = _file(module)
    differ = [label for label in new if label in old and old[label] != new[label]]
    changed = [f"{'code of ' + label if label.endswith('()') else _named(label)} in {file} changed" for label in differ]
    added = [f"{_named(label)} was added to {file}" for label in new if label not in old]
    removed = [f"{_named(label)} was removed from {file}" for label in old if label not in new]
    return changed + added + removed


def _named(label: str) -> str:
    """Return the name of a definition with its kind, such as ``function psf()`` or ``the imports``."""
    if label.endswith("()"):
        return f"function {label}"
    return label if label.startswith(("class ", "constant ")) else f"the {label}"


def _file(module: str) -> str:
    path = source_file(module)
    package = path is not None and path.name == "__init__.py"
    return module.replace(".", "/") + ("/__init__.py" if package else ".py")


def _parts(root: Path, found: str) -> Parts:
    """Return the digest of each definition in a version of the code; {} if its record is missing or damaged."""
    try:
        parts = json.loads(parts_file(root, found).read_bytes())
        whole = all(isinstance(found, str) for inside in parts.values() for found in inside.values())
        return dict(parts) if whole else {}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}
