"""The list ``nodes`` of a recipe: the files, folders and packages with the user's own families of nodes."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

from neusee.workflows.graph.diagnostics import Diagnostic
from neusee.workflows.recipe.node_families import import_own, is_known, own_nodes
from neusee.workflows.recipe.text.no_code import VARIABLE, is_strange
from neusee.workflows.recipe.text.yaml_values import Value, kind

KEY = "nodes"
_FORM = "must be a file, a folder or a module, such as bloom.py, or `family: module`"


@dataclass
class OwnFamilies:
    """The families of nodes that a recipe names."""

    modules: dict[str, ModuleType] = field(default_factory=dict)  #: by family
    places: list[Any] = field(default_factory=list)  #: the entries, with the full path of each file
    notes: list[str] = field(default_factory=list)
    is_whole: bool = True  #: whether every family could be read


def read_own_families(root: Value, diagnostics: list[Diagnostic]) -> OwnFamilies:
    """Import what the list ``nodes`` of a recipe names, and return the families; report each mistake at its entry.

    Importing runs the code. The variable ``NEUSEE_NO_CODE`` refuses that.
    """
    found = OwnFamilies()
    given = root.items.get(KEY)
    if given is None or given.data is None:
        return found
    if not isinstance(given.data, list):
        diagnostics.append(Diagnostic(given.mark, KEY, f"must be a list of files and modules, not {kind(given)}"))
        found.is_whole = False
        return found
    before = len(diagnostics)
    for entry in given.data:
        pair = _pair(entry)
        if pair is None:
            diagnostics.append(Diagnostic(entry.mark, entry.name, _FORM))
            continue
        if is_strange():
            message = f"names code, which {VARIABLE} or --no-code refuses to run"
            diagnostics.append(Diagnostic(entry.mark, f"{entry.name} = {pair[1].data}", message))
            continue
        try:
            _add(found, *pair)
        except LookupError as error:
            diagnostics.append(Diagnostic(entry.mark, f"{entry.name} = {pair[1].data}", str(error.args[0])))
    found.is_whole = len(diagnostics) == before
    if found.modules:
        names = ", ".join(str(getattr(module, "__file__", module)) for module in found.modules.values())
        found.notes.append(f"reading this recipe ran code: {names}")
    return found


def _pair(entry: Value) -> tuple[str, Value] | None:
    """Return the family, or an empty text, and the place of an entry, or None for another form."""
    if isinstance(entry.data, str):
        return "", entry
    pair = list(entry.items.items()) if isinstance(entry.data, dict) else []
    if len(pair) == 1 and isinstance(pair[0][1].data, str) and str(pair[0][0]).isidentifier():
        return str(pair[0][0]), pair[0][1]
    return None


def _add(found: OwnFamilies, family: str, where: Value) -> None:
    """Import one entry; raise `LookupError` if that fails or if its family has the name of another one."""
    folder = Path(where.mark.folder)
    module = import_own(str(where.data), folder)
    name = family or module.__name__.rpartition(".")[2]
    if found.modules.get(name) is module:
        return
    if name in found.modules or is_known(name):
        other = getattr(found.modules.get(name), "__file__", "neusee or an installed package")
        text = f"a family of nodes {name} is there already, of {other}"
        raise LookupError(f"{text}: name yours, as in `nodes: [my_{name}: {where.data}]`")
    own_nodes(name, module)
    found.modules[name] = module
    full = folder / str(where.data)
    place = os.path.abspath(full) if full.exists() else str(where.data)
    found.places.append({family: place} if family else place)
