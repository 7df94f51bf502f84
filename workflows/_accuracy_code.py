"""A digest of the engine: of the module that runs recipes, and of all of the program that it imports."""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

from neusee.workflows._keys import digest
from neusee.workflows._syntax import summarise

_HERE = Path(__file__).parent
_ROOT = "neusee.workflows"


@functools.cache
def engine(*modules: str) -> str:
    """The digest of ``modules`` of neusee.workflows (``_run``, if none), and of what they import there, and so on."""
    seen: dict[str, str] = {}
    todo = list(modules or ("_run",))
    while todo:
        name = todo.pop()
        path = _HERE / f"{name}.py"
        if name not in seen and path.is_file():
            source = path.read_bytes()
            seen[name] = summarise(source).tree
            todo += imported(ast.parse(source))
    return digest(seen)


def imported(tree: ast.Module) -> Iterator[str]:
    """The modules of neusee.workflows that are imported at the top: by them a run is decided."""
    for item in tree.body:
        if isinstance(item, ast.ImportFrom) and item.module == _ROOT:
            yield from (alias.name for alias in item.names)
        elif isinstance(item, ast.ImportFrom) and (item.module or "").startswith(f"{_ROOT}."):
            yield (item.module or "").removeprefix(f"{_ROOT}.")
