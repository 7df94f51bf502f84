"""What the source of a module says: a digest of the whole, one of each definition, and what it uses of `neusee`."""

from __future__ import annotations

import ast
import threading
from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from neusee.workflows.keys.cache_key import digest

ROOT = "neusee.nodes"
_parsing = threading.Lock()  #: the parser of Python 3.11 loses count of its depth where two threads are in it
_SHORT = 16  #: digits of a definition's digest: it is told from its earlier self alone

Import = tuple[int, str, str]  #: level, module, name (empty: the module itself)
Use = tuple[int, str, str, str, int]  #: of an imported name: how it came in, the attributes after it, the line


class Summary(NamedTuple):
    """A module's source as far as keys, and words about them, need it."""

    tree: str  #: digest of the syntax tree without docstrings
    imports: list[Import]
    binds: list[str]  #: names bound by those imports
    uses: list[Use]
    definitions: dict[str, str]  #: digest by label: ``psf()``, ``class Psf``, ``constant _FALL``, ``imports``


def summarise(source: bytes) -> Summary:
    """Digests of a syntax tree and its parts, without docstrings, and what it imports and uses of `neusee`."""
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
    """The attribute chains that begin with an imported name, and packages that are used whole, each once."""
    found: dict[tuple[int, str, str, str], int] = {}
    for name, attributes, line in _chains(tree):
        for way in bound.get(name, ()):
            if attributes or ".".join(filter(None, way[1:])) in ("neusee", ROOT, "nodes"):
                found.setdefault((*way, ".".join(attributes)), line)
    return sorted((*use, line) for use, line in found.items())


def _chains(tree: ast.Module) -> Iterator[tuple[str, list[str], int]]:
    """``a.b.c`` as a, [b, c] and its line, for the longest chains, and names alone."""
    inner: set[int] = set()  # parts of a chain that was seen: a walk meets the whole before its parts
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
    """A digest of each definition at the top of a module; of those with one label, a digest of all."""
    found: dict[str, list[str]] = defaultdict(list)
    for item in tree.body:
        dump = ast.dump(item)
        for label in _labels(item):
            found[label].append(dump)
    return {label: digest(dumps)[:_SHORT] for label, dumps in found.items()}


def _labels(item: ast.stmt) -> Iterable[str]:
    """What a statement at the top of a module defines."""
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
    """A function's name; ``psf.check`` of one that is ``_`` and belongs to a node."""
    for mark in function.decorator_list:
        if function.name == "_" and isinstance(mark, ast.Attribute) and isinstance(mark.value, ast.Name):
            return f"{mark.value.id}.{mark.attr}"
    return function.name
