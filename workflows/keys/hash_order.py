"""Results that the hash seed of a process decides: the order of a set of texts, and ``hash()`` of one.

Python draws the seed anew for each process unless ``PYTHONHASHSEED`` gives it. A set is seen by its form: ``{"a", b}``,
``set(x)``, a union of these, and a name that is one of them. Sets of numbers have one order.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator

from neusee.workflows.keys.scopes_of_names import Scope, last_name
from neusee.workflows.keys.unfollowed_constructs import Construct

_WHY = "the hash seed of a process decides"
_ORDERED = frozenset({"list", "tuple", "iter", "enumerate", "zip", "map", "filter", "join", "fromkeys", "fromiter"})
#: functions to which the order is nothing, or no more than rounding
_UNORDERED = frozenset(
    {"sorted", "len", "min", "max", "any", "all", "sum", "fsum", "prod", "set", "frozenset", "bool", "isdisjoint"}
)
_SETS = ("set", "frozenset", "AbstractSet", "Set", "MutableSet")
_OF_SETS = ("union", "intersection", "difference", "symmetric_difference", "copy")
_SCOPES = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda)
_LISTED = (ast.ListComp, ast.DictComp, ast.GeneratorExp)


def orders(tree: ast.Module) -> list[Construct]:
    """Return each place where a module takes the order of a set, or a hash, that differs between processes."""
    found = _found(tree, Scope(tree, None))
    return [Construct("hash", "", ast.unparse(item)[:60], _WHY, item.lineno) for item in found]


def _found(item: ast.AST, scope: Scope) -> Iterator[ast.expr]:
    if isinstance(item, _SCOPES):
        scope = Scope(item, scope)
    yield from (each for each in _taken(item, scope) if _is_set(each, scope))
    if isinstance(item, ast.Call):
        if _is_hash(item, scope) or (
            last_name(item.func) == "pop" and not item.args and _of_set(item.func, scope, frozenset())
        ):
            yield item
        if last_name(item.func) in _UNORDERED:
            yield from (each for argument in item.args for each in _below(argument, scope))
            return
    if not (isinstance(item, ast.FunctionDef) and item.name == "__hash__"):
        for child in ast.iter_child_nodes(item):
            yield from _found(child, scope)


def _below(argument: ast.expr, scope: Scope) -> Iterator[ast.expr]:
    """Yield what is found inside of an argument whose own order is nothing."""
    if isinstance(argument, ast.Call) and last_name(argument.func) in _ORDERED:
        for part in argument.args:
            yield from _below(part, scope)
    elif isinstance(argument, _LISTED):
        first = argument.generators[0].iter
        inner = [each for part in argument.generators for each in (part.target, part.iter, *part.ifs)]
        values = [argument.key, argument.value] if isinstance(argument, ast.DictComp) else [argument.elt]
        yield from (each for part in (*inner, *values) if part is not first for each in _found(part, scope))
    else:
        for child in ast.iter_child_nodes(argument):
            yield from _found(child, scope)


def _taken(item: ast.AST, scope: Scope) -> list[ast.expr]:
    """Return the expressions whose order a statement or an expression takes."""
    if isinstance(item, ast.For | ast.AsyncFor):
        return [item.iter]
    if isinstance(item, _LISTED):
        return [part.iter for part in item.generators]
    if isinstance(item, ast.Starred):
        return [item.value]
    return [*item.args] if isinstance(item, ast.Call) and last_name(item.func) in _ORDERED else []


def _is_hash(call: ast.Call, scope: Scope) -> bool:
    """Return True for a call of the builtin ``hash``, or of the method behind it."""
    if isinstance(call.func, ast.Attribute) and call.func.attr == "__hash__":
        return True
    return isinstance(call.func, ast.Name) and call.func.id == "hash" and scope.holder("hash") is None


def _is_set(item: ast.expr, scope: Scope, seen: frozenset[str] = frozenset()) -> bool:
    """Return True for an expression that is a set, and not one of numbers."""
    if isinstance(item, ast.Set):
        return not all(isinstance(each, ast.Constant) and isinstance(each.value, int | float) for each in item.elts)
    if isinstance(item, ast.BinOp) and isinstance(item.op, ast.BitOr | ast.BitAnd | ast.Sub | ast.BitXor):
        return _is_set(item.left, scope, seen) or _is_set(item.right, scope, seen)
    if isinstance(item, ast.Call):
        made = isinstance(item.func, ast.Name) and item.func.id in ("set", "frozenset")
        ranged = bool(item.args) and isinstance(item.args[0], ast.Call) and last_name(item.args[0].func) == "range"
        return (made and not ranged) or (last_name(item.func) in _OF_SETS and _of_set(item.func, scope, seen))
    if isinstance(item, ast.Name) and item.id not in seen:
        holder = scope.holder(item.id)
        values = holder.values.get(item.id, []) if holder is not None else []
        return holder is not None and any(
            value is not None and _is_set(value, holder, seen | {item.id}) for value in values
        )
    return isinstance(item, ast.SetComp)


def _of_set(function: ast.expr, scope: Scope, seen: frozenset[str]) -> bool:
    return isinstance(function, ast.Attribute) and _is_set(function.value, scope, seen)
