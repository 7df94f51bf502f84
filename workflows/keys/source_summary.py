"""Summary of a source file: the digests of the file and of its definitions, its imports, and what is not followed."""

from __future__ import annotations

import ast
import sys
import threading
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.code_objects import functions_of
from neusee.workflows.keys.module_origin import module_file
from neusee.workflows.keys.reachable_code import Statement, statements
from neusee.workflows.keys.unfollowed_constructs import Construct, constructs, literal_import

__all__ = ["ROOT", "Import", "Summary", "Use", "module_file", "summarise", "syntax_digest"]

ROOT = "neusee.nodes"
_parsing = threading.Lock()  #: lock of the parser of Python 3.11, which miscounts the depth in two threads
_SHORT = 16  #: digits of the digest of a definition
_LARGE = frozenset({"torch", "numpy", "scipy", *sys.stdlib_module_names})  #: packages of which no chain is noted

Import = tuple[int, str, str]  #: level of a relative import, module, name (empty for ``import module``)
Use = tuple[int, str, str, str, int]  #: use of an imported name: its import, the attributes after the name, the line


class Summary(NamedTuple):
    """Summary of the source of a module, for cache keys and for reports of changed code."""

    tree: str  #: digest of the syntax tree without docstrings
    whole: str  #: digest of the syntax tree with docstrings
    documents: bool  #: True if the code reads docstrings
    imports: list[Import]
    binds: list[str]  #: names bound by the imports
    uses: list[Use]
    definitions: dict[str, str]  #: digest by label: ``psf()``, ``class Psf``, ``constant _FALL``, ``imports``
    functions: list[str]  #: digests of the compiled functions
    constructs: list[Construct]
    statements: list[Statement]
    depends: list[str]  #: the entries of ``__depends__``


def summarise(source: bytes) -> Summary:
    """Return the summary of a source file; comments, layout and docstrings do not affect the digests."""
    with _parsing:
        tree = ast.parse(source)
        functions = functions_of(source)
    whole, documents = digest(ast.dump(tree)), any(_reads_docstrings(item) for item in ast.walk(tree))
    _without_docstrings(tree)
    text, definitions = digest(ast.dump(tree)), _definitions(tree)
    depends = [entry for item in tree.body for entry in _declared(item)]
    tree = _as_run(tree)
    imports, bound = _imports(tree)
    binds = sorted(name for name, ways in bound.items() if any(way[2] for way in ways))
    names = {
        name: ".".join(filter(None, way[1:])) for name, ways in bound.items() for way in sorted(ways) if not way[0]
    }
    imports += [way for call in ast.walk(tree) if (way := _by_literal(call, names)) is not None]
    uses = _uses(tree, {name: {way for way in ways if _chained(way)} for name, ways in bound.items()})
    found = constructs(tree, names)
    parts = statements(tree)
    return Summary(text, whole, documents, imports, binds, uses, definitions, functions, found, parts, depends)


def syntax_digest(source: bytes) -> str:
    """Return the digest of the syntax tree of a source file, which no comment, layout or docstring affects."""
    with _parsing:
        tree = ast.parse(source)
    _without_docstrings(tree)
    return digest(ast.dump(tree))


def _without_docstrings(tree: ast.Module) -> None:
    for item in ast.walk(tree):
        documented = isinstance(item, ast.Module | ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
        if documented and ast.get_docstring(item, clean=False) is not None:  # type: ignore[arg-type]
            item.body = item.body[1:]  # type: ignore[attr-defined]


def _imports(tree: ast.Module) -> tuple[list[Import], dict[str, set[Import]]]:
    """Return the imports of a module, and the import of each name that an import binds."""
    imports: list[Import] = []
    bound: dict[str, set[Import]] = defaultdict(set)
    for item in ast.walk(tree):
        if isinstance(item, ast.Import):
            imports += [(0, alias.name, "") for alias in item.names]
            for alias in item.names:
                bound[alias.asname or _top(alias.name)].add((0, alias.name if alias.asname else _top(alias.name), ""))
        elif isinstance(item, ast.ImportFrom):
            ways = [(item.level, item.module or "", alias.name) for alias in item.names]
            imports += ways
            for alias, way in zip(item.names, ways, strict=True):
                bound[alias.asname or alias.name].add(way)
    return list(dict.fromkeys(imports)), bound


def _by_literal(call: ast.AST, names: Mapping[str, str]) -> Import | None:
    """Return the import in a call such as ``import_module("a.b")``, or None for anything else."""
    module = literal_import(call, names) if isinstance(call, ast.expr) else None
    return (module and (len(module) - len(module.lstrip(".")), module.lstrip("."), "")) or None


def _as_run(tree: ast.Module) -> ast.Module:
    """Return a module without the blocks that a process does not run: for types alone, and for a program."""
    return _Run().visit(tree)  # type: ignore[no-any-return]


class _Run(ast.NodeTransformer):
    """A transformer that removes the branches for type checkers and for a program that is run by its file."""

    def visit_If(self, item: ast.If) -> list[ast.stmt] | ast.AST:
        test = ast.unparse(item.test)
        if test in ("TYPE_CHECKING", "typing.TYPE_CHECKING", "__name__ == '__main__'"):
            return [self.visit(part) for part in item.orelse] or ast.copy_location(ast.Pass(), item)
        return self.generic_visit(item)


def _reads_docstrings(item: ast.AST) -> bool:
    """Return True for an expression that reads a docstring as data."""
    attribute = isinstance(item, ast.Attribute) and item.attr in ("__doc__", "getdoc", "cleandoc", "getcomments")
    name = isinstance(item, ast.Name) and item.id in ("__doc__", "getdoc") and isinstance(item.ctx, ast.Load)
    return attribute or name or (isinstance(item, ast.Constant) and item.value == "__doc__")


def _declared(item: ast.stmt) -> list[str]:
    """Return the entries of ``__depends__ = ("table.csv", "env:NAME")``."""
    if not isinstance(item, ast.Assign) or "__depends__" not in [ast.unparse(target) for target in item.targets]:
        return []
    try:
        entries = ast.literal_eval(item.value)
    except ValueError:
        entries = None
    if not isinstance(entries, tuple | list) or not all(isinstance(entry, str) for entry in entries):
        raise ValueError(
            f"line {item.lineno}: __depends__ must be a tuple of texts, not {ast.unparse(item.value)[:60]}"
        )
    return list(entries)


def _chained(way: Import) -> bool:
    """Return True for an import of which the attributes may name a module that is followed by source."""
    return bool(way[0]) or _top(way[1]) not in _LARGE


def _top(module: str) -> str:
    return module.partition(".")[0]


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
