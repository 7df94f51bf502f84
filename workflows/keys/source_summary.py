"""Summary of a module's source: a digest of the whole, a digest of each definition, and the used `neusee` names."""

from __future__ import annotations

import ast
import threading
from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from neusee.workflows.keys.cache_key import digest

ROOT = "neusee.nodes"
_parsing = threading.Lock()  #: the parser of Python 3.11 miscounts its recursion depth if two threads use it
_SHORT = 16  #: digits of a definition's digest, which is compared with its earlier versions only

Import = tuple[int, str, str]  #: level, module, name (empty for the module itself)
Use = tuple[int, str, str, str, int]  #: an imported name: its import, the attributes after the name, the line


class Summary(NamedTuple):
    """The parts of a module's source that keys and reports of changes need."""

    tree: str  #: digest of the syntax tree without docstrings
    imports: list[Import]
    binds: list[str]  #: names bound by those imports
    uses: list[Use]
    definitions: dict[str, str]  #: digest by label: ``psf()``, ``class Psf``, ``constant _FALL``, ``imports``


def summarise(source: bytes) -> Summary:
    """Return the digests of a syntax tree and its definitions, without docstrings, and the `neusee` names in use."""
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


def _uses(tree: ast.Module, bound: dict[str, set[Import]]) -> list[Use]:
    """Return the attribute chains that begin with an imported name, and packages used as a whole, each once."""
    found: dict[tuple[int, str, str, str], int] = {}
    for name, attributes, line in _chains(tree):
        for way in bound.get(name, ()):
            if attributes or ".".join(filter(None, way[1:])) in ("neusee", ROOT, "nodes"):
                found.setdefault((*way, ".".join(attributes)), line)
    return sorted((*use, line) for use, line in found.items())


def _chains(tree: ast.Module) -> Iterator[tuple[str, list[str], int]]:
    """Yield ``a.b.c`` as a, [b, c] and its line, for the longest chains, and also names alone."""
    inner: set[int] = set()  # parts of chains already seen: a walk meets a chain before its parts
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
    """Return a digest for each top-level definition; definitions with the same label share a digest."""
    found: dict[str, list[str]] = defaultdict(list)
    for item in tree.body:
        dump = ast.dump(item)
        for label in _labels(item):
            found[label].append(dump)
    return {label: digest(dumps)[:_SHORT] for label, dumps in found.items()}


def _labels(item: ast.stmt) -> Iterable[str]:
    """Return the labels of the definitions in a top-level statement."""
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
    """Return a function's name, or ``psf.check`` for a function ``_`` that is a hook of the node ``psf``."""
    for mark in function.decorator_list:
        if function.name == "_" and isinstance(mark, ast.Attribute) and isinstance(mark.value, ast.Name):
            return f"{mark.value.id}.{mark.attr}"
    return function.name
