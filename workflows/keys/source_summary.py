"""Summary of a source file: the digests of the file and of its definitions, and its imports from `neusee`."""

from __future__ import annotations

import ast
import os
import threading
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from neusee.workflows.keys.cache_key import digest

ROOT = "neusee.nodes"
_parsing = threading.Lock()  #: lock of the parser of Python 3.11, which miscounts the depth in two threads
_SHORT = 16  #: digits of the digest of a definition

Import = tuple[int, str, str]  #: level of a relative import, module, name (empty for ``import module``)
Use = tuple[int, str, str, str, int]  #: use of an imported name: its import, the attributes after the name, the line


class Summary(NamedTuple):
    """Summary of the source of a module, for cache keys and for reports of changed code."""

    tree: str  #: digest of the syntax tree without docstrings
    imports: list[Import]
    binds: list[str]  #: names bound by the imports
    uses: list[Use]
    definitions: dict[str, str]  #: digest by label: ``psf()``, ``class Psf``, ``constant _FALL``, ``imports``


def summarise(source: bytes) -> Summary:
    """Return the summary of a source file; comments, layout and docstrings do not affect the digests."""
    with _parsing:
        tree = ast.parse(source)
    imports: list[Import] = []
    binds: list[str] = []
    bound: dict[str, set[Import]] = defaultdict(set)
    for item in ast.walk(tree):
        if isinstance(item, ast.Module | ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            if ast.get_docstring(item, clean=False) is not None:
                item.body = item.body[1:]
        elif isinstance(item, ast.Import):
            imports += [(0, alias.name, "") for alias in item.names if alias.name.startswith(ROOT)]
            for alias in item.names:
                if alias.name.partition(".")[0] == "neusee":
                    bound[alias.asname or "neusee"].add((0, alias.name if alias.asname else "neusee", ""))
        elif isinstance(item, ast.ImportFrom) and (item.level or (item.module or "").startswith("neusee")):
            imports += [(item.level, item.module or "", alias.name) for alias in item.names]
            binds += [alias.asname or alias.name for alias in item.names]
            for alias in item.names:
                bound[alias.asname or alias.name].add((item.level, item.module or "", alias.name))
    return Summary(digest(ast.dump(tree)), imports, binds, _uses(tree, bound), _definitions(tree))


def module_file(folder: str | Path, names: Sequence[str]) -> Path | None:
    """Return the source file of a module or package below a folder, or None if there is no such file.

    ``names`` are the parts of the module's name.
    """
    stem = os.path.join(folder, *names)
    files = (f"{stem}.py", os.path.join(stem, "__init__.py"))
    return next((Path(file) for file in files if os.path.isfile(file)), None)


def _uses(tree: ast.Module, bound: dict[str, set[Import]]) -> list[Use]:
    """Return each use of an imported name in an expression such as ``a.b.c``, and each use of a whole package."""
    lines: dict[tuple[int, str, str, str], int] = {}
    for name, attributes, line in _chains(tree):
        for way in bound.get(name, ()):
            if attributes or ".".join(filter(None, way[1:])) in ("neusee", ROOT, "nodes"):
                lines.setdefault((*way, ".".join(attributes)), line)
    return sorted((*use, line) for use, line in lines.items())


def _chains(tree: ast.Module) -> Iterator[tuple[str, list[str], int]]:
    """Yield the first name, the attributes and the line number of each expression such as ``a.b.c`` in a module."""
    inner: set[int] = set()  # parts of earlier expressions, because the walk yields an expression before its parts
    for item in ast.walk(tree):
        if id(item) in inner or not isinstance(item, ast.Attribute | ast.Name):
            continue
        here: ast.expr = item
        attributes: list[str] = []
        while isinstance(here, ast.Attribute):
            attributes.append(here.attr)
            inner.add(id(here.value))
            here = here.value
        if isinstance(here, ast.Name) and (attributes or isinstance(here.ctx, ast.Load)):
            yield here.id, attributes[::-1], item.lineno


def _definitions(tree: ast.Module) -> dict[str, str]:
    """Return the digest of each top-level definition of a module, by labels such as ``psf()`` or ``class Psf``.

    Definitions with the same label share one digest.
    """
    dumps: dict[str, list[str]] = defaultdict(list)
    for item in tree.body:
        dump = ast.dump(item)
        for label in _labels(item):
            dumps[label].append(dump)
    return {label: digest(parts)[:_SHORT] for label, parts in dumps.items()}


def _labels(item: ast.stmt) -> Iterable[str]:
    """Return the labels of the definitions in a top-level statement, such as ``psf()`` or ``constant _FALL``."""
    if isinstance(item, ast.FunctionDef | ast.AsyncFunctionDef):
        return [f"{_owner(item)}()"]
    if isinstance(item, ast.ClassDef):
        return [f"class {item.name}"]
    if isinstance(item, ast.Import | ast.ImportFrom):
        return ["imports"]
    targets = item.targets if isinstance(item, ast.Assign) else [getattr(item, "target", None) or item]
    names = [n.id for t in targets if not isinstance(t, ast.stmt) for n in ast.walk(t) if isinstance(n, ast.Name)]
    return [f"constant {name}" for name in names] or ["other statements"]


def _owner(function: ast.FunctionDef | ast.AsyncFunctionDef) -> str:
    """Return the name of a function, or ``psf.check`` for a function ``_`` with the decorator ``@psf.check``."""
    for mark in function.decorator_list:
        if function.name == "_" and isinstance(mark, ast.Attribute) and isinstance(mark.value, ast.Name):
            return f"{mark.value.id}.{mark.attr}"
    return function.name
