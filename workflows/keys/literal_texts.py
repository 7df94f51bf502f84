"""Texts that an expression of literals gives, such as ``"__do" + "c__"``, and names that only a run knows."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator

from neusee.workflows.keys.scopes_of_names import last_name
from neusee.workflows.keys.syntax_pass import Kinds, each

_NAMING = frozenset({"getattr", "attrgetter", "getattr_static"})  #: functions that are given the name of an attribute
_ALL = frozenset({"vars", "getmembers", "getmembers_static"})  #: functions that give all attributes of an object
_HOLDING = frozenset({"__dict__", "__getattribute__"})


def texts(kinds: Kinds) -> Iterator[tuple[str, int]]:
    """Yield each text of a module with its line, also one that is put together of literals."""
    for item in each(kinds, ast.Constant, ast.BinOp, ast.JoinedStr, ast.Call):
        if text := text_of(item):
            yield text, item.lineno


def text_of(item: ast.expr) -> str | None:
    """Return the text of an expression of literals, or None for any other expression."""
    if isinstance(item, ast.Constant):
        return item.value if isinstance(item.value, str) else None
    if isinstance(item, ast.BinOp) and isinstance(item.op, ast.Add):
        return _joined([item.left, item.right])
    if isinstance(item, ast.JoinedStr):
        return _joined([each.value if isinstance(each, ast.FormattedValue) else each for each in item.values])
    if isinstance(item, ast.Call) and isinstance(item.func, ast.Attribute) and item.func.attr == "join" and item.args:
        between, parts = text_of(item.func.value), item.args[0]
        return _joined(parts.elts, between) if isinstance(parts, ast.List | ast.Tuple) else None
    return None


def reads_attributes_unnamed(kinds: Kinds) -> bool:
    """Return True for code that reads attributes whose names it does not spell out, perhaps ``__doc__``."""
    if any(item.attr in _HOLDING for item in each(kinds, ast.Attribute)):
        return True
    for call in each(kinds, ast.Call):
        name = last_name(call.func)
        names = call.args[1:2] if name != "attrgetter" else call.args
        if (name in _ALL and call.args) or (name in _NAMING and any(text_of(each) is None for each in names)):
            return True
    return False


def _joined(parts: Iterable[ast.expr], between: str | None = "") -> str | None:
    found = [text_of(part) for part in parts]
    known = [text for text in found if text is not None]
    return between.join(known) if between is not None and len(known) == len(found) else None
