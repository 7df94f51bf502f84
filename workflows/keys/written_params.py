"""What the parameters of an own node say beside their values: names of files, and the order of mappings.

The nodes of neusee read the content of a file and the entries of a mapping, so equal ones share results. A node of a
user may also read an exposure in ``dark_20ms.npy``, or take the first entry of a mapping.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neusee.workflows.keys.module_owner import is_own

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Step


#: parameters of nodes of neusee whose entries count in their order: light meets the first surface of a lens first
_ORDERED = frozenset({("flare.stray_light", "surfaces"), ("flare.stray_shares", "surfaces")})


def written(step: Step) -> dict[str, Any]:
    """Return the names of files and the order of mappings in the parameters of an own node, as JSON by parameter.

    Of a node of neusee only the order of a mapping counts, where the node says so.
    """
    found: dict[str, Any] = {}
    own = is_own(step.node.fn.__module__)
    for name, value in step.params.items():
        if not own and (step.node.path, name) not in _ORDERED:
            continue
        marks = [mark for mark in (step.param_marks.get(name), step.mark) if mark is not None]
        said = _said(value, [os.path.abspath(mark.folder) for mark in marks])
        if said is not None:
            found[name] = said
    return found


def _said(value: Any, folders: list[str]) -> Any:
    """Return what a value says beside its content, or None if it says nothing."""
    if isinstance(value, Path):
        return _name(value, folders)
    if isinstance(value, Mapping):
        parts = [[str(key), _said(part, folders)] for key, part in value.items()]
        return parts if len(parts) > 1 or any(part is not None for _, part in parts) else None
    if isinstance(value, tuple | list):
        said = [_said(part, folders) for part in value]
        return said if any(part is not None for part in said) else None
    return None


def _name(path: Path, folders: list[str]) -> list[str]:
    """Return the path of a file as a recipe in one of some folders writes it, and the name that links lead to."""
    full = os.path.abspath(path)
    folder = next((each for each in folders if _is_in(full, each)), None)
    real, top = os.path.realpath(full), folder and os.path.realpath(folder)
    name = Path(os.path.relpath(full, folder) if folder else full).as_posix()
    target = Path(os.path.relpath(real, top) if top and _is_in(real, top) else os.path.basename(real)).as_posix()
    plain = target == (name if top and _is_in(real, top) else os.path.basename(full))
    return [name] if plain else [name, target]


def _is_in(path: str, folder: str) -> bool:
    return path.startswith(folder.rstrip(os.sep) + os.sep)
