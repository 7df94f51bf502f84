"""One pass over the syntax tree of a source file, which finds all that a summary of the file needs.

The text of a tree says the same as `ast.dump`: kinds, names and constants in order, without docstrings and positions.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from typing import Any, NamedTuple

_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
_DOCUMENTED = frozenset({ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef})
_UNSEEN = frozenset({"ctx", "kind", "type_comment", "type_ignores"})  #: fields that other fields decide, or nothing
_NOT_RUN = {
    "TYPE_CHECKING": "TYPE_CHECKING",
    "typing": "typing.TYPE_CHECKING",
    "__name__": "__name__ == '__main__'",
}  #: tests of blocks that no process runs, by their first name

Scope = tuple[ast.AST, ...]  #: the functions around an expression, the outermost first
Kinds = dict[type, list[Any]]  #: parts of a tree by their type, each before its own parts


class Block(NamedTuple):
    """A statement at the top level of a module that a process runs, with its parts."""

    item: ast.stmt
    kinds: Kinds


class Syntax:
    """The texts of the statements of a module, its docstrings, and its parts that a process runs.

    Blocks for type checkers alone, and for a file that is run as a program, have texts and no parts.
    """

    def __init__(self, tree: ast.Module) -> None:
        self.texts: list[tuple[ast.stmt, str]] = []  #: statements at the top level with their texts
        self.documents: list[tuple[int, int, str]] = []  #: the place and the text of each docstring
        self.calls: list[tuple[Scope, ast.Call]] = []  #: calls that a process runs, with the functions around them
        self.joins: list[tuple[Scope, ast.BinOp]] = []  #: sums, paths that are put together, and so on, likewise
        self.blocks: list[Block] = []
        self.all: Kinds = defaultdict(list)  #: the parts of every block
        self.not_run: Kinds = defaultdict(list)
        self._words: list[str] = []
        self._kinds: Kinds = self.all
        for item in self._without_docstring(tree):
            self._top(item)
        for block in self.blocks:
            for kind, found in block.kinds.items():
                self.all[kind] += found

    def _top(self, item: ast.stmt) -> None:
        """Add a statement at the top level: its text, and its blocks that a process runs."""
        self._words = []
        if isinstance(item, ast.If) and _is_not_run(item.test):
            self._words.append("If")
            self._visit_quietly(item.test)
            self._visit_quietly(*item.body)
            self._words.append(f"[{len(item.orelse)}")
            for part in item.orelse:
                self._block(part)
            if not item.orelse:
                self.blocks.append(Block(ast.copy_location(ast.Pass(), item), {}))
        else:
            self._block(item)
        self.texts.append((item, " ".join(self._words)))

    def _block(self, item: ast.stmt) -> None:
        self._kinds = defaultdict(list)
        self._visit(item, ())
        self.blocks.append(Block(item, self._kinds))

    def _visit(self, item: ast.AST, scope: Scope) -> None:
        """Add a part of the tree, and then its own parts."""
        kind = type(item)
        name, fields = _SHAPES.get(kind) or _shape(kind)
        words = self._words
        words.append(name)
        self._kinds[kind].append(item)
        if kind is ast.Call:
            self.calls.append((scope, item))  # type: ignore[arg-type]
        elif kind is ast.BinOp:
            self.joins.append((scope, item))  # type: ignore[arg-type]
        elif kind in _FUNCTIONS:
            scope = (*scope, item)
        elif kind is ast.If and _is_not_run(item.test):  # type: ignore[attr-defined]
            return self._visit_else(item, scope)  # type: ignore[arg-type]
        for field in fields:
            value = getattr(item, field)
            if isinstance(value, ast.AST):
                if value._fields:
                    self._visit(value, scope)
                else:
                    words.append(type(value).__name__)
            elif type(value) is list:
                if field == "body" and kind in _DOCUMENTED:
                    value = self._without_docstring(item)
                words.append(f"[{len(value)}")
                for part in value:
                    if isinstance(part, ast.AST):
                        self._visit(part, scope)
                    else:
                        words.append(repr(part))
            else:
                words.append(repr(value))

    def _visit_else(self, item: ast.If, scope: Scope) -> None:
        """Add a branch that no process runs by its text alone, and the other branch with its parts."""
        self._kinds[ast.If].pop()
        self._visit_quietly(item.test)
        self._visit_quietly(*item.body)
        self._words.append(f"[{len(item.orelse)}")
        for part in item.orelse:
            self._visit(part, scope)

    def _visit_quietly(self, *items: ast.AST) -> None:
        """Add the text of items that no process runs."""
        kinds, calls, joins = self._kinds, len(self.calls), len(self.joins)
        self._kinds = self.not_run
        self._words.append(f"[{len(items)}")
        for item in items:
            self._visit(item, ())
        self._kinds = kinds
        del self.calls[calls:], self.joins[joins:]

    def _without_docstring(self, item: Any) -> list[ast.stmt]:
        """Return the statements of a definition or a module without its docstring, which is noted."""
        body: list[ast.stmt] = item.body
        first = body[0] if body else None
        if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str):
            self.documents.append((len(self.texts), len(self._words), first.value.value))
            return body[1:]
        return body


def each(kinds: Kinds, *wanted: type) -> Iterator[Any]:
    """Yield the parts of the given types, those of the first type first."""
    for kind in wanted:
        yield from kinds.get(kind, ())


def _is_not_run(test: ast.expr) -> bool:
    """Return True for the test of a block for type checkers, or of a file that is run as a program."""
    first = test.left if isinstance(test, ast.Compare) else test.value if isinstance(test, ast.Attribute) else test
    return isinstance(first, ast.Name) and first.id in _NOT_RUN and ast.unparse(test) in _NOT_RUN.values()


_SHAPES: dict[type, tuple[str, tuple[str, ...]]] = {}  #: name and fields of each kind of part


def _shape(kind: type[ast.AST]) -> tuple[str, tuple[str, ...]]:
    return _SHAPES.setdefault(kind, (kind.__name__, tuple(field for field in kind._fields if field not in _UNSEEN)))
