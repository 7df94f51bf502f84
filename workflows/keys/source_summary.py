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
from neusee.workflows.keys.facts_beside_content import facts
from neusee.workflows.keys.facts_of_the_moment import moments
from neusee.workflows.keys.hash_order import orders
from neusee.workflows.keys.literal_texts import reads_attributes_unnamed, texts
from neusee.workflows.keys.module_origin import module_file
from neusee.workflows.keys.outward_code import NOWHERE, Reach, reach_of
from neusee.workflows.keys.reachable_code import Statement, statements
from neusee.workflows.keys.syntax_pass import Kinds, Syntax, each
from neusee.workflows.keys.unfollowed_constructs import Construct, constructs, literal_import

__all__ = ["ROOT", "Import", "Summary", "Use", "module_file", "summarise", "syntax_outline"]

ROOT = "neusee.nodes"
_parsing = threading.Lock()  #: lock of the parser of Python 3.11, which miscounts the depth in two threads
_READS = ("__doc__", "getdoc", "cleandoc", "getcomments")  #: names by which code reads docstrings
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
    reach: Reach  #: of the code of a user


def summarise(source: bytes, own: bool = False) -> Summary:
    """Return the summary of a source file; comments, layout and docstrings do not affect the digests.

    What only matters in code of a user is looked for if the file is the user's ``own``.
    """
    with _parsing:
        parsed = ast.parse(source)
        functions = functions_of(source)
    tree = Syntax(parsed)
    text = _digest_of(tree)
    depends = [entry for item, _ in tree.texts for entry in _declared(item)]
    imports, bound = _imports(tree.all)
    binds = sorted(name for name, ways in bound.items() if any(way[2] for way in ways))
    names = {
        name: ".".join(filter(None, way[1:])) for name, ways in bound.items() for way in sorted(ways) if not way[0]
    }
    imports += [way for call in each(tree.all, ast.Call) if (way := _by_literal(call, names)) is not None]
    return Summary(
        text,
        digest(text, tree.documents),
        any(_reads_docstrings(kinds, own) for kinds in (tree.all, tree.not_run)),
        imports,
        binds,
        _uses(tree.all, {name: {way for way in ways if _chained(way)} for name, ways in bound.items()}),
        _definitions(tree.texts),
        functions,
        _all_constructs(parsed, tree, names) if own else constructs(tree, names),
        statements(tree.blocks),
        depends,
        reach_of(parsed, {name: _full(ways) for name, ways in bound.items()}) if own else NOWHERE,
    )


def syntax_outline(source: bytes) -> tuple[str, list[tuple[str, list[str]]]]:
    """Return the digest of the syntax tree of a source file, and the import statements at its top level.

    No comment, layout or docstring affects the digest. An import statement is the module in ``from a import b, c`` with
    the names, or an empty text with the modules of ``import a, b``.
    """
    with _parsing:
        tree = ast.parse(source)
    found = [item for item in tree.body if isinstance(item, ast.Import | ast.ImportFrom)]
    imports = [(getattr(item, "module", "") or "", [alias.name for alias in item.names]) for item in found]
    return _digest_of(Syntax(tree)), imports


def _digest_of(tree: Syntax) -> str:
    return digest([text for _, text in tree.texts])


def _imports(kinds: Kinds) -> tuple[list[Import], dict[str, set[Import]]]:
    """Return the imports of a module, and the import of each name that an import binds."""
    imports: list[Import] = []
    bound: dict[str, set[Import]] = defaultdict(set)
    for item in each(kinds, ast.Import):
        imports += [(0, alias.name, "") for alias in item.names]
        for alias in item.names:
            bound[alias.asname or _top(alias.name)].add((0, alias.name if alias.asname else _top(alias.name), ""))
    for item in each(kinds, ast.ImportFrom):
        ways = [(item.level, item.module or "", alias.name) for alias in item.names]
        imports += ways
        for alias, way in zip(item.names, ways, strict=True):
            bound[alias.asname or alias.name].add(way)
    return list(dict.fromkeys(imports)), bound


def _by_literal(call: ast.Call, names: Mapping[str, str]) -> Import | None:
    """Return the import in a call such as ``import_module("a.b")``, or None for any other call."""
    module = literal_import(call, names)
    return (module and (len(module) - len(module.lstrip(".")), module.lstrip("."), "")) or None


def _all_constructs(parsed: ast.Module, tree: Syntax, names: Mapping[str, str]) -> list[Construct]:
    """Return what is not followed, with what only matters in code of a user."""
    usual = constructs(tree, names)
    known = {(item.line, item.text.rpartition(".")[2]) for item in usual}
    more = [*facts(tree.all, names), *moments(tree.all, names)]
    beside = [item for item in more if (item.line, item.text.rpartition(".")[2]) not in known]
    return sorted({*usual, *orders(parsed), *beside}, key=lambda item: (item.line, item))


def _reads_docstrings(kinds: Kinds, own: bool) -> bool:
    """Return True for code that reads a docstring as data, or attributes that it does not name in code of a user."""
    if own and (reads_attributes_unnamed(kinds) or any("__doc__" in text for text, _ in texts(kinds))):
        return True
    by_attribute = any(item.attr in _READS for item in each(kinds, ast.Attribute))
    by_name = any(item.id in _READS[:2] and isinstance(item.ctx, ast.Load) for item in each(kinds, ast.Name))
    return by_attribute or by_name or any(item.value == "__doc__" for item in each(kinds, ast.Constant))


def _declared(item: ast.stmt) -> list[str]:
    """Return the entries of ``__depends__ = ("table.csv", "env:NAME")``."""
    if not isinstance(item, ast.Assign) or "__depends__" not in [getattr(name, "id", "") for name in item.targets]:
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


def _full(ways: set[Import]) -> str:
    """Return the full name of what an import binds, with the dots of a relative import."""
    level, *names = min(ways)
    return "." * level + ".".join(filter(None, names))


def _chained(way: Import) -> bool:
    """Return True for an import of which the attributes may name a module that is followed by source."""
    return bool(way[0]) or _top(way[1]) not in _LARGE


def _top(module: str) -> str:
    return module.partition(".")[0]


def _uses(kinds: Kinds, bound: dict[str, set[Import]]) -> list[Use]:
    """Return each use of an imported name in an expression such as ``a.b.c``, and each use of a whole package."""
    lines: dict[tuple[int, str, str, str], int] = {}
    for name, attributes, line in _chains(kinds):
        for way in bound.get(name, ()):
            if attributes or ".".join(filter(None, way[1:])) in ("neusee", ROOT, "nodes"):
                use = (*way, ".".join(attributes))
                lines[use] = min(line, lines.get(use, line))
    return sorted((*use, line) for use, line in lines.items())


def _chains(kinds: Kinds) -> Iterator[tuple[str, list[str], int]]:
    """Yield the first name, the attributes and the line number of each expression such as ``a.b.c`` in a module."""
    inner: set[int] = set()  # parts of earlier expressions, because an expression comes before its parts
    for item in each(kinds, ast.Attribute, ast.Name):
        if id(item) in inner:
            continue
        here: ast.expr = item
        attributes: list[str] = []
        while isinstance(here, ast.Attribute):
            attributes.append(here.attr)
            inner.add(id(here.value))
            here = here.value
        if isinstance(here, ast.Name) and (attributes or isinstance(here.ctx, ast.Load)):
            yield here.id, attributes[::-1], item.lineno


def _definitions(texts: Iterable[tuple[ast.stmt, str]]) -> dict[str, str]:
    """Return the digest of each top-level definition of a module, by labels such as ``psf()`` or ``class Psf``.

    Definitions with the same label share one digest.
    """
    found: dict[str, list[str]] = defaultdict(list)
    for item, text in texts:
        for label in _labels(item):
            found[label].append(text)
    return {label: digest(parts)[:_SHORT] for label, parts in found.items()}


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
