"""Digest of the program's own code, over given modules and all modules of `neusee.workflows` that they import.

The key of a stored study, design or posterior contains this digest, so that changed code never leads to an old
result. `code_digest.Code` computes the digests of nodes.
"""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterable, Iterator
from pathlib import Path

from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.source_summary import module_file, syntax_digest

_HERE = Path(__file__).parents[1]
_ROOT = "neusee.workflows"


@functools.cache
def engine(*modules: str) -> str:
    """Return the digest of the code of some modules of neusee.workflows and of all modules that these import.

    The default module is ``engine.runner``. Only imports of neusee.workflows at the top level of a module count.
    Raises `LookupError` for a module without a source file.
    """
    seen: dict[str, str] = {}
    todo = list(modules or ("engine.runner",))
    while todo:
        name = todo.pop()
        if name in seen:
            continue
        path = _source(name)
        if path is None:
            raise LookupError(f"{_ROOT}.{name} has no source file below {_HERE}, so its results have no cache key")
        seen[name], imports = _parsed(path.read_bytes())
        todo += imported(imports)
    return digest(seen)


@functools.cache
def _parsed(source: bytes) -> tuple[str, list[ast.stmt]]:
    """Return the digest of a source file and the import statements at its top level."""
    imports: list[ast.stmt] = [item for item in ast.parse(source).body if isinstance(item, ast.Import | ast.ImportFrom)]
    return syntax_digest(source), imports


def imported(statements: Iterable[ast.stmt]) -> Iterator[str]:
    """Yield the name of each module of neusee.workflows in import statements, such as ``engine.runner``."""
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
    return module_file(_HERE, name.split("."))
