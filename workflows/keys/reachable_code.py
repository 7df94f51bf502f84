"""Statements of a module that a node may run: what the module runs at import, and what the names in use refer to."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import NamedTuple

from neusee.workflows.keys.syntax_pass import Block, Kinds, each

_QUIET = ("node", "pytest", "hypothesis", "functools", "staticmethod", "dataclass", "torch.no_grad")
_WRITERS = frozenset({"append", "add", "extend", "update", "insert", "appendleft", "clear"})
_DEFINITION = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)


class Statement(NamedTuple):
    """A statement at the top level of a module."""

    first: int
    last: int  #: lines
    binds: list[str]  #: names; empty for a statement that is run for its effect
    refers: list[str]  #: names that it reads, at any depth
    writes: list[str]  #: names whose object it changes, as in ``log.append(x)``


def statements(blocks: Iterable[Block]) -> list[Statement]:
    """Return the statements at the top level of a module."""
    return [_statement(block.item, block.kinds) for block in blocks]


def reached(parts: Sequence[Statement], names: Collection[str] | None) -> Iterator[range]:
    """Yield the lines of the statements that the use of some names, or None for all names, may run."""
    if names is None or "*" in names:
        yield from (range(part.first, part.last + 1) for part in parts)
        return
    wanted, seen = set(names), set[int]()
    while True:
        new = [n for n, part in enumerate(parts) if n not in seen and (not part.binds or wanted & {*part.binds})]
        if not new:
            return
        for n in new:
            seen.add(n)
            wanted |= {*parts[n].refers}
            yield range(parts[n].first, parts[n].last + 1)


def read_names(parts: Sequence[Statement], names: Collection[str]) -> set[str]:
    """Return the names that the statements read which the use of some names, or of all if none is given, may run."""
    wanted = set(names) or {name for part in parts for name in part.binds}
    while True:
        run = [part for part in parts if not part.binds or wanted & {*part.binds}]
        more = wanted | {name for part in run for name in part.refers}
        if more == wanted:
            return wanted
        wanted = more


def written_only(parts: Sequence[Statement]) -> set[str]:
    """Return the names whose objects a module changes and that none of its code reads, such as a log."""
    return {name for part in parts for name in part.writes} - {name for part in parts for name in part.refers}


def _statement(item: ast.stmt, kinds: Kinds) -> Statement:
    marks = item.decorator_list if isinstance(item, _DEFINITION) else []
    first = min([item.lineno, *(mark.lineno for mark in marks)])
    written = {id(part) for part in _noted(kinds)}
    loads = [part for part in each(kinds, ast.Name) if isinstance(part.ctx, ast.Load)]
    refers = {part.id for part in loads if id(part) not in written}
    writes = {part.id for part in loads if id(part) in written}
    return Statement(first, item.end_lineno or item.lineno, sorted(_binds(item)), sorted(refers), sorted(writes))


def _noted(kinds: Kinds) -> Iterator[ast.AST]:
    """Yield the name in ``name.append(x)`` and ``name[i] = x``, which write to an object and do not read it."""
    for item in each(kinds, ast.Expr):
        called = item.value.func if isinstance(item.value, ast.Call) else None
        if isinstance(called, ast.Attribute) and called.attr in _WRITERS:
            yield called.value
    for item in each(kinds, ast.Assign):
        yield from (target.value for target in item.targets if isinstance(target, ast.Subscript))


def _binds(item: ast.stmt) -> Iterable[str]:
    """Return the names that a statement defines; none if the statement also does something else."""
    if isinstance(item, _DEFINITION):
        quiet = all(ast.unparse(mark).startswith(_QUIET) for mark in item.decorator_list)
        return {item.name} if quiet else set()
    targets = item.targets if isinstance(item, ast.Assign) else [getattr(item, "target", None)]
    names = {target.id for target in targets if isinstance(target, ast.Name)}
    return names if len(names) == len(targets) else set()
