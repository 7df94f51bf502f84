"""Digest of the program's own code, over given modules and all modules of `neusee.workflows` that they import.

The key of a stored study, design or posterior contains this digest, so that changed code never leads to an old
result. `code_digest.Code` computes the digests of nodes.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from pathlib import Path

import xxhash

from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.code_memo import EDITION, Outline, outlines
from neusee.workflows.keys.code_objects import PYTHON
from neusee.workflows.keys.source_summary import module_file, syntax_outline

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
        seen[name], imports = outline(path.read_bytes())
        todo += imported(imports)
    return digest(seen)


def outline(source: bytes) -> Outline:
    """Return the digest of a source file and the import statements at its top level; an equal source is parsed once."""
    name = f"{PYTHON}:{EDITION}:{xxhash.xxh3_128_hexdigest(source)}"
    if name not in outlines:
        outlines[name] = Outline(*syntax_outline(source))
    return outlines[name]


def imported(statements: Iterable[tuple[str, list[str]]]) -> Iterator[str]:
    """Yield the name of each module of neusee.workflows in import statements, such as ``engine.runner``."""
    for base, names in statements:
        if not base:
            yield from (_below(name) for name in names if name.startswith(f"{_ROOT}."))
        elif f"{base}.".startswith(f"{_ROOT}."):
            below = _below(base)
            for name in names:
                module = f"{below}.{name}".lstrip(".")
                yield module if _source(module) is not None or not below else below


def _below(module: str) -> str:
    return module.removeprefix(_ROOT).lstrip(".")


def _source(name: str) -> Path | None:
    return module_file(_HERE, name.split("."))
