"""Names of a module that a function fills at its first call, with a value that no argument decides.

``global TABLE`` and ``TABLE = build()`` leave something in the module, but each step would leave the same. Where an
argument may decide the value, or whether it is set, the name tells one step what another one was given.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from typing import NamedTuple

_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
_ENDS = (ast.Return, ast.Raise)


class _Place(NamedTuple):
    """A statement in functions, with what decides whether it runs."""

    item: ast.AST
    decides: list[ast.expr]  #: the conditions around it
    local: set[str]  #: arguments and other local names of the functions around it
    shared: set[str]  #: names that the functions declare as global


def is_lazy_constant(tree: ast.Module, name: str) -> bool:
    """Return True if functions of a module set a name, and no argument of a function decides the value."""
    places = list(_places(tree, [], set(), set()))
    stores = [place for place in places if name in place.shared and name in _targets(place.item)]
    return bool(stores) and all(_is_free(store, places) for store in stores)


def _is_free(store: _Place, places: list[_Place]) -> bool:
    """Return True if no local name decides what a statement sets, or whether it is reached."""
    if not isinstance(store.item, ast.Assign | ast.AnnAssign) or store.item.value is None:
        return False
    ends = [place for place in places if isinstance(place.item, _ENDS) and place.local == store.local]
    before = [each for end in ends if _line(end.item) < _line(store.item) for each in end.decides]
    return not any(_names(each) & store.local for each in [store.item.value, *store.decides, *before])


def _places(item: ast.AST, decides: list[ast.expr], local: set[str], shared: set[str]) -> Iterator[_Place]:
    """Yield the statements below a part of a syntax tree that stand in functions."""
    for child in ast.iter_child_nodes(item):
        inner, names, given = decides, local, shared
        if isinstance(child, _FUNCTIONS):
            given = shared | {name for each in ast.walk(child) if isinstance(each, ast.Global) for name in each.names}
            names = local | _locals(child) - given
        elif isinstance(child, ast.If | ast.While | ast.IfExp):
            inner = [*decides, child.test]
        elif isinstance(child, ast.For | ast.AsyncFor):
            inner = [*decides, child.iter]
        if isinstance(child, ast.stmt) and not isinstance(child, _FUNCTIONS):
            yield _Place(child, inner, names, given)
        yield from _places(child, inner, names, given)


def _locals(function: ast.AST) -> set[str]:
    """Return the arguments of a function and the names that it sets."""
    arguments = {each.arg for each in ast.walk(function) if isinstance(each, ast.arg)}
    return arguments | _stored(function)


def _targets(item: ast.AST) -> set[str]:
    """Return the names that a statement itself sets, not those that statements in it set."""
    if isinstance(item, ast.For | ast.AsyncFor):
        return _stored(item.target)
    if isinstance(item, ast.With | ast.AsyncWith):
        return {name for part in item.items if part.optional_vars for name in _stored(part.optional_vars)}
    return set() if isinstance(item, ast.ClassDef) or hasattr(item, "body") or hasattr(item, "cases") else _stored(item)


def _stored(item: ast.AST) -> set[str]:
    return {each.id for each in ast.walk(item) if isinstance(each, ast.Name) and not isinstance(each.ctx, ast.Load)}


def _names(item: ast.AST) -> set[str]:
    return {each.id for each in ast.walk(item) if isinstance(each, ast.Name)}


def _line(item: ast.AST) -> int:
    return int(getattr(item, "lineno", 0))
