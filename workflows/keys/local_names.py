"""Names in a function: what an expression is called in full, and what gives a local name its value."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping


def dotted(item: ast.expr, bound: Mapping[str, str]) -> str:
    """Return the full name of an expression such as ``np.random.rand``, or an empty text for any other expression."""
    parts: list[str] = []
    while isinstance(item, ast.Attribute):
        parts.append(item.attr)
        item = item.value
    if not isinstance(item, ast.Name):
        return ""
    return ".".join([bound.get(item.id, item.id), *reversed(parts)]).removeprefix("builtins.")


def arguments(function: ast.AST) -> set[str]:
    inner = getattr(function, "args", None)
    return {part.arg for part in ast.walk(inner) if isinstance(part, ast.arg)} if inner is not None else set()


def assigned(function: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    """Yield each local name of a function with an expression that gives it its value."""
    for item in ast.walk(function):
        if isinstance(item, ast.Assign):
            pairs: Iterable[tuple[ast.AST, ast.expr | None]] = [(target, item.value) for target in item.targets]
        elif isinstance(item, ast.AnnAssign | ast.AugAssign | ast.NamedExpr):
            pairs = [(item.target, item.value)]
        elif isinstance(item, ast.For | ast.AsyncFor | ast.comprehension):
            pairs = [(item.target, item.iter)]
        elif isinstance(item, ast.withitem):
            pairs = [(item.optional_vars, item.context_expr)] if item.optional_vars else []
        else:
            continue
        for target, value in pairs:
            if value is not None:
                yield from ((part.id, value) for part in ast.walk(target) if isinstance(part, ast.Name))


def read_by(call: ast.Call) -> ast.expr | None:
    """Return what a function of a library reads: an open file, or the first argument."""
    files = [word.value for word in call.keywords if word.arg in ("fileobj", "fp")]
    return next(iter([*files, *call.args, *(word.value for word in call.keywords)]), None)
