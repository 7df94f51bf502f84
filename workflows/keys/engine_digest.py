"""Digest of the program itself: of some of its modules, and of all `neusee.workflows` modules that they import.

A stored study, design or posterior has this digest in its key, so that a change of the code never leads to an old
result. This digest is the only identity of code outside the nodes; `Code` digests the nodes.
"""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterable, Iterator
from pathlib import Path

from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.source_summary import summarise

_HERE = Path(__file__).parents[1]
_ROOT = "neusee.workflows"


@functools.cache
def engine(*modules: str) -> str:
    """Return the digest of ``modules`` of neusee.workflows (default ``engine.runner``) and of their imports.

    Only imports at the top of a module count: by them a run is decided.

    Raises: `LookupError` where a module, or one that it imports, has no source file. A digest that passed over it
    would not change when that module does.
    """
    seen: dict[str, str] = {}
    todo = list(modules or ("engine.runner",))
    while todo:
        name = todo.pop()
        if name in seen:
            continue
        path = _source(name)
        if path is None:
            raise LookupError(f"{_ROOT}.{name} has no source file below {_HERE}, so its results cannot be keyed")
        seen[name], imports = _parsed(path.read_bytes())
        todo += imported(imports)
    return digest(seen)


@functools.cache
def _parsed(source: bytes) -> tuple[str, list[ast.stmt]]:
    """Return the digest of a source and its statements at the top that import; kept, since most digests share files."""
    imports: list[ast.stmt] = [item for item in ast.parse(source).body if isinstance(item, ast.Import | ast.ImportFrom)]
    return summarise(source).tree, imports


def imported(statements: Iterable[ast.stmt]) -> Iterator[str]:
    """Yield the modules of neusee.workflows that the statements import, by their names below it."""
    for item in statements:
        if isinstance(item, ast.Import):
            yield from (_below(alias.name) for alias in item.names if alias.name.startswith(f"{_ROOT}."))
        elif isinstance(item, ast.ImportFrom) and f"{item.module}.".startswith(f"{_ROOT}."):
            base = _below(item.module or "")
            for alias in item.names:
                module = f"{base}.{alias.name}".lstrip(".")
                yield module if _source(module) is not None or not base else base


def _below(module: str) -> str:
    return module.removeprefix(_ROOT).lstrip(".")


def _source(name: str) -> Path | None:
    """Return the file of a module or a package, or None."""
    stem = _HERE.joinpath(*name.split("."))
    return next((p for p in (stem.with_suffix(".py"), stem / "__init__.py") if p.is_file()), None)
