"""Files that a function makes for itself: in a folder of `tempfile`, under a name that it drew, or in memory."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping

from neusee.workflows.keys.local_names import arguments, assigned, dotted, read_by
from neusee.workflows.keys.syntax_pass import Scope, Syntax

_MADE = frozenset(
    {
        *("io.BytesIO", "io.StringIO"),
        *(f"tempfile.{name}" for name in ("TemporaryDirectory", "NamedTemporaryFile", "TemporaryFile", "mkdtemp")),
        *("tempfile.mkstemp", "tempfile.SpooledTemporaryFile"),
    }
)
#: functions that give a path or an open file of what they get first
_THROUGH = frozenset(
    {
        *("str", "os.fspath", "os.fsencode", "os.path.join", "os.path.abspath", "os.path.realpath", "os.fdopen"),
        *("pathlib.Path", "pathlib.PurePath", "contextlib.closing", "io.TextIOWrapper", "io.BufferedReader"),
        *("enter_context", "gzip.GzipFile", "iter", "sorted", "list", "next", "enumerate"),
    }
)


class Scratch:
    """What in a module is a path of a temporary file, or a file in memory; false if nothing makes one."""

    def __init__(self, bound: Mapping[str, str], reads: Callable[[str], bool]) -> None:
        """Tell by the full names of imported names; ``reads`` says whether a function opens a file."""
        self._bound, self._reads = bound, reads
        self._makes = any(name.partition(".")[0] in ("io", "tempfile") for name in bound.values())

    def __bool__(self) -> bool:
        return self._makes

    def holds(self, item: ast.expr, scope: Scope) -> bool:
        """Return True if an expression can be nothing but such a path or file."""
        return self._makes and self._is_made(item, scope, frozenset())

    def texts(self, tree: Syntax) -> set[int]:
        """Return the ids of the texts that name a file in a temporary folder, or in an archive in memory."""
        joins = [item.right for scope, item in tree.joins if self.holds(item.left, scope)]
        calls = [(scope, call) for scope, call in tree.calls if self._is_below_made(call, scope)]
        return {id(part) for part in [*joins, *(part for _, call in calls for part in call.args)]}

    def _is_below_made(self, call: ast.Call, scope: Scope) -> bool:
        """Return True for a call that joins words to a temporary path, and for a method of an object in memory."""
        if isinstance(call.func, ast.Attribute) and self.holds(call.func.value, scope):
            return True
        joins = dotted(call.func, self._bound) in _THROUGH
        return joins and bool(call.args) and self.holds(call.args[0], scope)

    def _is_made(self, item: ast.expr, scope: Scope, seen: frozenset[str]) -> bool:
        if isinstance(item, ast.Attribute | ast.Subscript | ast.Starred | ast.NamedExpr):
            return self._is_made(item.value, scope, seen)
        if isinstance(item, ast.BinOp):
            return self._is_made(item.left, scope, seen)
        if isinstance(item, ast.JoinedStr):
            first = item.values[0] if item.values else item
            return isinstance(first, ast.FormattedValue) and self._is_made(first.value, scope, seen)
        if isinstance(item, ast.Call):
            return self._is_made_by(item, scope, seen)
        return isinstance(item, ast.Name) and self._is_name_made(item.id, scope, seen)

    def _is_made_by(self, call: ast.Call, scope: Scope, seen: frozenset[str]) -> bool:
        full = dotted(call.func, self._bound)
        last = call.func.attr if isinstance(call.func, ast.Attribute) else ""
        if full in _MADE:
            return True
        if full in _THROUGH or last in _THROUGH or self._reads(full):
            first = read_by(call)
            return first is not None and self._is_made(first, scope, seen)
        return bool(last) and self._is_made(call.func, scope, seen)

    def _is_name_made(self, name: str, scope: Scope, seen: frozenset[str]) -> bool:
        """Return True if all that gives a local name its value is made."""
        if name in seen:
            return True  # a path that is lengthened
        for depth in range(len(scope), 0, -1):
            function = scope[depth - 1]
            if name in arguments(function):
                return False
            values = [value for target, value in assigned(function) if target == name]
            if values:
                return all(self._is_made(value, scope[:depth], seen | {name}) for value in values)
        return False
