"""What a name in a function or a module stands for: an import, an argument, something of the module, or a new object.

A name that is assigned stands for all that the expressions on the right side are parts of.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import Literal, NamedTuple

_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
_INNER = (*_FUNCTIONS, ast.ClassDef)
_SELF, _CLASS = frozenset({"self", "ctx"}), frozenset({"cls", "mcs", "metacls"})
_THROUGH = ("getattr", "vars", "iter", "reversed", "enumerate", "zip", "list", "tuple")  #: give a part of what they get
#: packages whose functions return new objects
_NEW = frozenset({"torch", "numpy", "scipy", "math", "copy", "json", "neusee", "collections", "functools", "itertools"})


class Root(NamedTuple):
    """What the first name of an expression stands for."""

    kind: Literal["import", "own", "argument", "class"]
    name: str  #: full name of an import, with the attributes that follow; ``()`` stands for the result of a call


class Scope:
    """The names that a module, a class or a function binds."""

    def __init__(self, item: ast.AST, above: Scope | None) -> None:
        self.above = above
        self.is_module = above is None
        inner = getattr(item, "args", None) if isinstance(item, _FUNCTIONS) else None
        self.arguments = {part.arg for part in ast.walk(inner) if isinstance(part, ast.arg)} if inner else set[str]()
        self.values: dict[str, list[ast.expr | None]] = defaultdict(list)
        body = getattr(item, "body", [])
        for part in _inside(body if isinstance(body, list) else [body]):
            for target, value in _bindings(part):
                self.values[target].append(value)

    def holder(self, name: str) -> Scope | None:
        """Return the scope that binds a name, the innermost first."""
        here: Scope | None = self
        while here is not None and name not in here.arguments and name not in here.values:
            here = here.above
        return here


def roots(item: ast.expr, scope: Scope, bound: Mapping[str, str], seen: frozenset[str] = frozenset()) -> list[Root]:
    """Return what an expression is part of; nothing for a new object."""
    attributes: list[str] = []
    while isinstance(item, ast.Attribute | ast.Subscript | ast.Starred):
        if isinstance(item, ast.Attribute):
            attributes.append(item.attr)
        item = item.value
    if isinstance(item, ast.Call):
        return _of_call(item, scope, bound, seen)
    if not isinstance(item, ast.Name):
        inner = _parts(item)
        return [root for part in inner for root in roots(part, scope, bound, seen)]
    if item.id in seen:
        return []
    if "__class__" in attributes:
        return [Root("class", item.id)]
    return [
        Root(root.kind, ".".join([root.name, *reversed(attributes)])) if root.kind == "import" else root
        for root in _of_name(item.id, scope, bound, seen | {item.id})
    ]


def last_name(item: ast.expr) -> str:
    """Return the last word of an expression such as ``a.b.c``."""
    return item.attr if isinstance(item, ast.Attribute) else item.id if isinstance(item, ast.Name) else ""


def _of_name(name: str, scope: Scope, bound: Mapping[str, str], seen: frozenset[str]) -> list[Root]:
    holder = scope.holder(name)
    if holder is None or (holder.is_module and name in bound):
        return [Root("import", bound[name])] if name in bound else []
    if name in holder.arguments:
        kind: Literal["class", "argument"] = "class" if name in _CLASS else "argument"
        return [] if name in _SELF else [Root(kind, name)]
    values = [value for value in holder.values[name] if value is not None]
    found = [root for value in values for root in roots(value, holder, bound, seen)]
    if name in bound and None in holder.values[name]:  # an import inside of a function
        found.append(Root("import", bound[name]))
    return [*found, Root("own", name)] if holder.is_module else found


def _of_call(call: ast.Call, scope: Scope, bound: Mapping[str, str], seen: frozenset[str]) -> list[Root]:
    """Return what the result of a call may be part of: of the object whose method it is, unless it is a new object."""
    name = last_name(call.func)
    if isinstance(call.func, ast.Name) and name in _THROUGH:
        return [root for argument in call.args for root in roots(argument, scope, bound, seen)]
    if isinstance(call.func, ast.Name) and name in ("globals", "type"):
        return [Root("own" if name == "globals" else "class", name)]
    found = roots(call.func, scope, bound, seen)
    new = name[:1].isupper() or name in ("copy", "clone", "deepcopy", "detach", "tolist", "item")
    old = [] if new else [root for root in found if root.kind == "import" and root.name.partition(".")[0] not in _NEW]
    return [Root("import", root.name if root.name.endswith("()") else f"{root.name}()") for root in old]


def _parts(item: ast.expr) -> list[ast.expr]:
    """Return the expressions of which a value may be one, such as those of a list or of ``a if b else c``."""
    if isinstance(item, ast.Tuple | ast.List | ast.Set):
        return item.elts
    if isinstance(item, ast.IfExp):
        return [item.body, item.orelse]
    if isinstance(item, ast.BoolOp):
        return item.values
    if isinstance(item, ast.Dict):
        return item.values
    return [item.value] if isinstance(item, ast.NamedExpr | ast.Await) else []


def _inside(items: list[ast.AST]) -> Iterator[ast.AST]:
    """Yield the parts of a body, without those inside of inner functions and classes."""
    todo = list(items)
    while todo:
        item = todo.pop()
        yield item
        if not isinstance(item, _INNER):
            todo.extend(ast.iter_child_nodes(item))


def _bindings(item: ast.AST) -> Iterator[tuple[str, ast.expr | None]]:
    """Yield each name that a statement binds, with the value; None for an import and a definition."""
    if isinstance(item, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        yield item.name, None
    elif isinstance(item, ast.Import | ast.ImportFrom):
        yield from ((alias.asname or alias.name.partition(".")[0], None) for alias in item.names)
    for target, value in _assigned(item):
        for part in ast.walk(target):
            if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store):
                yield part.id, value


def _assigned(item: ast.AST) -> Iterator[tuple[ast.expr, ast.expr | None]]:
    if isinstance(item, ast.Assign):
        yield from ((target, item.value) for target in item.targets)
    elif isinstance(item, ast.AnnAssign | ast.AugAssign | ast.NamedExpr):
        yield item.target, item.value
    elif isinstance(item, ast.For | ast.AsyncFor | ast.comprehension):
        yield item.target, ast.Starred(item.iter)  # one of its parts
    elif isinstance(item, ast.withitem) and item.optional_vars is not None:
        yield item.optional_vars, item.context_expr
