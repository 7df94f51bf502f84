"""Syntax of a source file: its statements, what its names stand for, its texts and its temporary
files.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Literal, NamedTuple

# --- syntax pass ----------------------------------------------------------------------------------

# One pass over the syntax tree of a source file collects everything that a summary of the file
# needs.
#
# The text of a tree has the same content as `ast.dump`: kinds, names and constants in order, but
# without docstrings and positions.


_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
_DOCUMENTED = frozenset({ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef})
#: fields that follow from others, or that have no meaning for a run
_UNSEEN = frozenset({"ctx", "kind", "type_comment", "type_ignores"})
_NOT_RUN = {
    "TYPE_CHECKING": "TYPE_CHECKING",
    "typing": "typing.TYPE_CHECKING",
    "__name__": "__name__ == '__main__'",
}  #: tests of blocks that a run skips, by their first name

Scope = tuple[ast.AST, ...]  #: the functions around an expression, the outermost first
Kinds = dict[type, list[Any]]  #: parts of a tree by their type, each before its own parts


class Block(NamedTuple):
    """A top-level statement of a module that a process runs, with the parts of its syntax tree."""

    item: ast.stmt
    kinds: Kinds


class Syntax:
    """The texts of the statements of a module, its docstrings, and the parts of its syntax tree
    that a process runs.

    Blocks for type checkers only, and for a file that is run as a program, have texts but no
    parts.
    """

    def __init__(self, tree: ast.Module) -> None:
        self.texts: list[tuple[ast.stmt, str]] = []  #: statements at the top level with their texts
        self.documents: list[tuple[int, int, str]] = []  #: the place and the text of each docstring
        #: calls that a process runs, with the functions around them
        self.calls: list[tuple[Scope, ast.Call]] = []
        #: binary operations, such as sums and joined paths, with the functions around them
        self.joins: list[tuple[Scope, ast.BinOp]] = []
        self.blocks: list[Block] = []
        self.all: Kinds = defaultdict(list)  #: the parts of every block
        self.not_run: Kinds = defaultdict(list)
        self._words: list[str] = []  # words of the text of the present statement
        self._kinds: Kinds = self.all  # the dict to which parts are added now
        for item in self._without_docstring(tree):
            self._top(item)
        for block in self.blocks:
            for kind, nodes in block.kinds.items():
                self.all[kind] += nodes

    def _top(self, item: ast.stmt) -> None:
        """Add a top-level statement: its text, and the blocks in it that a process runs."""
        self._words = []
        if isinstance(item, ast.If) and _is_not_run(item.test):
            self._words.append("If")
            self._visit_quietly(item.test)
            self._visit_quietly(*item.body)
            # as for any `if`: the number of statements, and then the statements
            self._words.append(f"[{len(item.orelse)}")
            for statement in item.orelse:
                self._block(statement)
            if not item.orelse:
                # an empty block, so that each statement has one
                self.blocks.append(Block(ast.copy_location(ast.Pass(), item), {}))
        else:
            self._block(item)
        self.texts.append((item, " ".join(self._words)))

    def _block(self, item: ast.stmt) -> None:
        """Add a statement that a process runs, with its parts by their types."""
        self._kinds = defaultdict(list)
        self._visit(item, ())
        self.blocks.append(Block(item, self._kinds))

    def _visit(self, item: ast.AST, scope: Scope) -> None:
        """Add a part of the tree, and then its own parts."""
        kind = type(item)
        name, fields = _SHAPES.get(kind) or _shape(kind)
        self._words.append(name)
        self._kinds[kind].append(item)
        if kind is ast.If and _is_not_run(item.test):  # type: ignore[attr-defined]
            return self._visit_else(item, scope)  # type: ignore[arg-type]
        scope = self._scope_inside(item, scope)
        for field in fields:
            value = getattr(item, field)
            children = self._listed(item, field, value) if type(value) is list else [value]
            for child in children:
                # parts without fields, such as operators, are written as words
                if isinstance(child, ast.AST) and child._fields:
                    self._visit(child, scope)
                else:
                    self._words.append(_word(child))
        return None

    def _scope_inside(self, item: ast.AST, scope: Scope) -> Scope:
        """Note a call or a binary operation with the functions around it; return the functions
        around its parts.
        """
        kind = type(item)
        if kind is ast.Call:
            self.calls.append((scope, item))  # type: ignore[arg-type]
        elif kind is ast.BinOp:
            self.joins.append((scope, item))  # type: ignore[arg-type]
        return (*scope, item) if kind in _FUNCTIONS else scope

    def _listed(self, item: ast.AST, field: str, values: list[Any]) -> list[Any]:
        """Add the number of values in a field as a word, and return the values without a
        docstring.
        """
        if field == "body" and type(item) in _DOCUMENTED:
            values = self._without_docstring(item)
        self._words.append(f"[{len(values)}")
        return values

    def _visit_else(self, item: ast.If, scope: Scope) -> None:
        """Add an `if` whose body no process runs: the body by its text alone, the `else` branch
        with its parts.
        """
        self._kinds[ast.If].pop()
        self._visit_quietly(item.test)
        self._visit_quietly(*item.body)
        self._words.append(f"[{len(item.orelse)}")
        for statement in item.orelse:
            self._visit(statement, scope)

    def _visit_quietly(self, *items: ast.AST) -> None:
        """Add the text of items that no process runs."""
        kinds_before, call_count, join_count = self._kinds, len(self.calls), len(self.joins)
        self._kinds = self.not_run
        self._words.append(f"[{len(items)}")
        for item in items:
            self._visit(item, ())
        self._kinds = kinds_before
        # drop the calls and joins that were added meanwhile
        del self.calls[call_count:], self.joins[join_count:]

    def _without_docstring(self, item: Any) -> list[ast.stmt]:
        """Return the statements of a definition or a module without its docstring; note the
        docstring.
        """
        body: list[ast.stmt] = item.body
        first_statement = body[0] if body else None
        if (
            isinstance(first_statement, ast.Expr)
            and isinstance(first_statement.value, ast.Constant)
            and isinstance(first_statement.value.value, str)
        ):
            self.documents.append((len(self.texts), len(self._words), first_statement.value.value))
            return body[1:]
        return body


def _word(value: Any) -> str:
    """Return the word for a constant, or for a part of the tree without parts of its own."""
    return type(value).__name__ if isinstance(value, ast.AST) else repr(value)


def each(kinds: Kinds, *types: type) -> Iterator[Any]:
    """Yield the parts of the given types, in the order of the types."""
    for kind in types:
        yield from kinds.get(kind, ())


def _is_not_run(test: ast.expr) -> bool:
    """Return True for the test of a block for type checkers, or of a block that runs only if the
    file is run as a program.
    """
    first_part = test
    if isinstance(test, ast.Compare):
        first_part = test.left
    elif isinstance(test, ast.Attribute):
        first_part = test.value
    return (
        isinstance(first_part, ast.Name)
        and first_part.id in _NOT_RUN
        and ast.unparse(test) in _NOT_RUN.values()
    )


_SHAPES: dict[type, tuple[str, tuple[str, ...]]] = {}  #: name and fields of each kind of part


def _shape(kind: type[ast.AST]) -> tuple[str, tuple[str, ...]]:
    """Return the name of a kind of part, and the names of its fields that count."""
    return _SHAPES.setdefault(
        kind, (kind.__name__, tuple(field for field in kind._fields if field not in _UNSEEN))
    )


# --- scopes of names ------------------------------------------------------------------------------

# What a name in a function or a module stands for: an import, an argument, an object of the module,
# or a new object.
#
# A name that is assigned stands for everything that the expressions on the right side are parts of.

_INNER = (*_FUNCTIONS, ast.ClassDef)
_SELF, _CLASS = frozenset({"self", "ctx"}), frozenset({"cls", "mcs", "metacls"})
#: functions that return a part of their argument
_THROUGH = ("getattr", "vars", "iter", "reversed", "enumerate", "zip", "list", "tuple")
#: packages whose functions return new objects
_NEW = frozenset(
    {
        "torch",
        "numpy",
        "scipy",
        "math",
        "copy",
        "json",
        "neusee",
        "collections",
        "functools",
        "itertools",
    }
)


class Root(NamedTuple):
    """What the first name of an expression stands for: an import, an object of the module, an
    argument, or a class.
    """

    kind: Literal["import", "own", "argument", "class"]
    #: full name of an import, with the attributes that follow; ``()`` stands for the result of a
    #: call
    name: str


class NameScope:
    """The names that a module, a class or a function binds."""

    def __init__(self, item: ast.AST, above: NameScope | None) -> None:
        self.above = above
        self.is_module = above is None
        self.arguments = arguments(item)
        # the values assigned to each name; None for an import or a definition
        self.values: dict[str, list[ast.expr | None]] = defaultdict(list)
        body = getattr(item, "body", [])
        statements = body if isinstance(body, list) else [body]
        for statement in _inside(statements):
            for target, value in _bindings(statement):
                self.values[target].append(value)

    def holder(self, name: str) -> NameScope | None:
        """Return the innermost scope that binds a name, or None."""
        scope: NameScope | None = self
        while scope is not None and name not in scope.arguments and name not in scope.values:
            scope = scope.above
        return scope


def roots(
    item: ast.expr,
    scope: NameScope,
    bound: Mapping[str, str],
    visited: frozenset[str] = frozenset(),
) -> list[Root]:
    """Return the objects that an expression may be part of; an empty list for a new object."""
    attributes: list[str] = []
    while isinstance(item, ast.Attribute | ast.Subscript | ast.Starred):
        if isinstance(item, ast.Attribute):
            attributes.append(item.attr)
        item = item.value
    if isinstance(item, ast.Call):
        return _of_call(item, scope, bound, visited)
    if not isinstance(item, ast.Name):
        return _of_all(_parts(item), scope, bound, visited)
    # a name that is assigned from itself ends the search
    if item.id in visited:
        return []
    # the class of an object is shared with other objects
    if "__class__" in attributes:
        return [Root("class", item.id)]
    return [
        Root(root.kind, ".".join([root.name, *reversed(attributes)]))
        if root.kind == "import"
        else root
        for root in _of_name(item.id, scope, bound, visited | {item.id})
    ]


def _of_all(
    items: Iterable[ast.expr], scope: NameScope, bound: Mapping[str, str], visited: frozenset[str]
) -> list[Root]:
    """Return the objects that any of some expressions may be part of."""
    origins: list[Root] = []
    for item in items:
        origins += roots(item, scope, bound, visited)
    return origins


def last_name(item: ast.expr) -> str:
    """Return the last word of an expression such as ``a.b.c``."""
    if isinstance(item, ast.Attribute):
        return item.attr
    return item.id if isinstance(item, ast.Name) else ""


def _of_name(
    name: str, scope: NameScope, bound: Mapping[str, str], visited: frozenset[str]
) -> list[Root]:
    """Return the objects that a name in a scope may stand for, traced through the values assigned
    to it.
    """
    import_roots = [Root("import", bound[name])] if name in bound else []
    holder = scope.holder(name)
    if holder is None or (holder.is_module and name in bound):
        return import_roots
    if name in holder.arguments:
        return _of_argument(name)
    values = [value for value in holder.values[name] if value is not None]
    origins = _of_all(values, holder, bound, visited)
    if None in holder.values[name]:  # an import inside of a function
        origins += import_roots
    return [*origins, Root("own", name)] if holder.is_module else origins


def _of_argument(name: str) -> list[Root]:
    """Return what an argument stands for. ``self`` gives an empty list, since the caller made that
    object.
    """
    if name in _SELF:
        return []
    return [Root("class", name)] if name in _CLASS else [Root("argument", name)]


def _of_call(
    call: ast.Call, scope: NameScope, bound: Mapping[str, str], visited: frozenset[str]
) -> list[Root]:
    """Return the objects that the result of a call may be part of, such as the object whose method
    is called; an empty list for a new object.
    """
    name = last_name(call.func)
    if isinstance(call.func, ast.Name):
        # the result is part of an argument
        if name in _THROUGH:
            return _of_all(call.args, scope, bound, visited)
        if name in _GIVEN:
            return [_GIVEN[name]]
    origins = roots(call.func, scope, bound, visited)
    # a call of a class, or of a copying method, makes a new object
    if name[:1].isupper() or name in _COPYING:
        return []
    library_names = [root.name.removesuffix("()") for root in origins if _is_of_library(root)]
    return [Root("import", f"{name}()") for name in library_names]


#: objects that the result of a builtin function is part of
_GIVEN = {"globals": Root("own", "globals"), "type": Root("class", "type")}
#: functions and methods whose result is a new object
_COPYING = ("copy", "clone", "deepcopy", "detach", "tolist", "item")


def _is_of_library(root: Root) -> bool:
    """Return True for an object of a package whose functions may return shared objects."""
    return root.kind == "import" and root.name.partition(".")[0] not in _NEW


def _parts(item: ast.expr) -> list[ast.expr]:
    """Return the expressions of which a value may be one or may consist, such as those of a list or
    of ``a if b else c``.
    """
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
    """Yield the parts of a body, but not the parts of inner functions and classes."""
    items_left = list(items)
    while items_left:
        item = items_left.pop()
        yield item
        if not isinstance(item, _INNER):
            items_left.extend(ast.iter_child_nodes(item))


def _bindings(item: ast.AST) -> Iterator[tuple[str, ast.expr | None]]:
    """Yield each name that a statement binds, with its value; None for an import or a
    definition.
    """
    if isinstance(item, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        yield item.name, None
    elif isinstance(item, ast.Import | ast.ImportFrom):
        yield from ((alias.asname or alias.name.partition(".")[0], None) for alias in item.names)
    for target, value in _assigned(item):
        if isinstance(item, _LOOPS) and value is not None:
            value = ast.Starred(value)  # the name gets an element of the value
        for name in _stored_names(target):
            yield name, value


def _stored_names(target: ast.expr) -> list[str]:
    """Return the names that a target of an assignment sets."""
    names = [child for child in ast.walk(target) if isinstance(child, ast.Name)]
    return [name.id for name in names if isinstance(name.ctx, ast.Store)]


_LOOPS = (ast.For, ast.AsyncFor, ast.comprehension)


def _assigned(item: ast.AST) -> Iterator[tuple[ast.expr, ast.expr | None]]:
    """Yield each target that a statement assigns to, with the expression of its value."""
    if isinstance(item, ast.Assign):
        yield from ((target, item.value) for target in item.targets)
    elif isinstance(item, ast.AnnAssign | ast.AugAssign | ast.NamedExpr):
        yield item.target, item.value
    elif isinstance(item, _LOOPS):
        yield item.target, item.iter
    elif isinstance(item, ast.withitem) and item.optional_vars is not None:
        yield item.optional_vars, item.context_expr


# --- local names ----------------------------------------------------------------------------------

# Names in a function: the full name of an expression, and the expressions that give a local name
# its value.


def dotted(item: ast.expr, bound: Mapping[str, str]) -> str:
    """Return the full name of an expression such as ``np.random.rand``, or an empty text for any
    other expression.
    """
    attributes: list[str] = []
    while isinstance(item, ast.Attribute):
        attributes.append(item.attr)
        item = item.value
    if not isinstance(item, ast.Name):
        return ""
    # collected from the last to the first
    return ".".join([bound.get(item.id, item.id), *reversed(attributes)]).removeprefix("builtins.")


def arguments(function: ast.AST) -> set[str]:
    parameters = getattr(function, "args", None)
    if parameters is None:
        return set()
    return {argument.arg for argument in ast.walk(parameters) if isinstance(argument, ast.arg)}


def assigned(function: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    """Yield each local name of a function with an expression that is assigned to it."""
    for item in ast.walk(function):
        for target, value in _assigned(item):
            names = [child.id for child in ast.walk(target) if isinstance(child, ast.Name)]
            if value is not None:
                yield from ((name, value) for name in names)


def read_by(call: ast.Call) -> ast.expr | None:
    """Return the expression of what a library function reads: an open file, or the first
    argument.
    """
    file_arguments = [word.value for word in call.keywords if word.arg in ("fileobj", "fp")]
    return next(iter([*file_arguments, *call.args, *(word.value for word in call.keywords)]), None)


# --- literal texts --------------------------------------------------------------------------------

# Texts that consist of literals, such as ``"__do" + "c__"``, and attribute names that are known
# only at run time.


#: functions that take the name of an attribute as an argument
_NAMING = frozenset({"getattr", "attrgetter", "getattr_static"})
#: functions that return all attributes of an object
_ALL = frozenset({"vars", "getmembers", "getmembers_static"})
_HOLDING = frozenset({"__dict__", "__getattribute__"})


def texts(kinds: Kinds) -> Iterator[tuple[str, int]]:
    """Yield each text of a module with its line, including texts that are joined from literals."""
    for item in each(kinds, ast.Constant, ast.BinOp, ast.JoinedStr, ast.Call):
        if text := text_of(item):
            yield text, item.lineno


def text_of(item: ast.expr) -> str | None:
    """Return the text of an expression that consists of literals, or None for any other
    expression.
    """
    if isinstance(item, ast.Constant):
        return item.value if isinstance(item.value, str) else None
    if isinstance(item, ast.BinOp) and isinstance(item.op, ast.Add):
        return _joined([item.left, item.right])
    if isinstance(item, ast.JoinedStr):
        return _joined(map(_without_format, item.values))
    if isinstance(item, ast.Call) and isinstance(item.func, ast.Attribute):
        return _text_of_join(item, item.func)
    return None


def _without_format(piece: ast.expr) -> ast.expr:
    """Return the expression in the braces of an f-string, or the text beside them."""
    return piece.value if isinstance(piece, ast.FormattedValue) else piece


def _text_of_join(call: ast.Call, method: ast.Attribute) -> str | None:
    """Return the text of ``", ".join(["a", "b"])``, or None for another call."""
    if method.attr != "join" or not call.args:
        return None
    separator, sequence = text_of(method.value), call.args[0]
    return _joined(sequence.elts, separator) if isinstance(sequence, ast.List | ast.Tuple) else None


def reads_attributes_unnamed(kinds: Kinds) -> bool:
    """Return True for code that reads attributes without spelling out their names, so perhaps
    ``__doc__``.
    """
    if any(item.attr in _HOLDING for item in each(kinds, ast.Attribute)):
        return True
    for call in each(kinds, ast.Call):
        name = last_name(call.func)
        # getattr(object, name), attrgetter(name, ...)
        name_arguments = call.args[1:2] if name != "attrgetter" else call.args
        if (name in _ALL and call.args) or (
            name in _NAMING and any(text_of(argument) is None for argument in name_arguments)
        ):
            return True
    return False


def _joined(parts: Iterable[ast.expr], between: str | None = "") -> str | None:
    """Return the joined texts of some expressions, or None if any of them does not consist of
    literals.
    """
    values = [text_of(piece) for piece in parts]
    literals = [text for text in values if text is not None]
    return between.join(literals) if between is not None and len(literals) == len(values) else None


# --- scratch files --------------------------------------------------------------------------------

# Files that a function makes for itself: in a folder of `tempfile`, under a random name, or in
# memory.


_MADE = frozenset(
    {
        *("io.BytesIO", "io.StringIO"),
        *(
            f"tempfile.{name}"
            for name in ("TemporaryDirectory", "NamedTemporaryFile", "TemporaryFile", "mkdtemp")
        ),
        *("tempfile.mkstemp", "tempfile.SpooledTemporaryFile"),
    }
)
#: functions that turn their first argument into a path or an open file
_THROUGH_FILES = frozenset(
    {
        *(
            "str",
            "os.fspath",
            "os.fsencode",
            "os.path.join",
            "os.path.abspath",
            "os.path.realpath",
            "os.fdopen",
        ),
        *(
            "pathlib.Path",
            "pathlib.PurePath",
            "contextlib.closing",
            "io.TextIOWrapper",
            "io.BufferedReader",
        ),
        *("enter_context", "gzip.GzipFile", "iter", "sorted", "list", "next", "enumerate"),
    }
)


class Scratch:
    """The expressions in a module that stand for a temporary file or a file in memory; false if the
    module makes no such file.
    """

    def __init__(self, bound: Mapping[str, str], reads: Callable[[str], bool]) -> None:
        """Use the full names of imported names; ``reads`` returns True for a function that opens a
        file.
        """
        self._bound, self._reads = bound, reads
        self._makes = any(name.partition(".")[0] in ("io", "tempfile") for name in bound.values())

    def __bool__(self) -> bool:
        return self._makes

    def holds(self, item: ast.expr, scope: Scope) -> bool:
        """Return True if an expression can only stand for a temporary file or a file in memory."""
        return self._makes and self._is_made(item, scope, frozenset())

    def texts(self, tree: Syntax) -> set[int]:
        """Return the ids of the texts that name a file in a temporary folder or in an archive in
        memory.
        """
        names_in_scratch = [
            item.right for scope, item in tree.joins if self.holds(item.left, scope)
        ]
        for scope, call in tree.calls:
            if self._is_below_made(call, scope):
                names_in_scratch += call.args
        return set(map(id, names_in_scratch))

    def _is_below_made(self, call: ast.Call, scope: Scope) -> bool:
        """Return True for a call that joins words to a temporary path, or that calls a method of a
        file in memory.
        """
        if isinstance(call.func, ast.Attribute) and self.holds(call.func.value, scope):
            return True
        is_through = dotted(call.func, self._bound) in _THROUGH_FILES
        return is_through and bool(call.args) and self.holds(call.args[0], scope)

    def _is_made(self, item: ast.expr, scope: Scope, visited: frozenset[str]) -> bool:
        """Return True if an expression stands for a temporary file or a file in memory, or is made
        only from one.
        """
        if isinstance(item, ast.Attribute | ast.Subscript | ast.Starred | ast.NamedExpr):
            return self._is_made(item.value, scope, visited)
        if isinstance(item, ast.BinOp):
            return self._is_made(item.left, scope, visited)
        if isinstance(item, ast.JoinedStr):
            first_piece = item.values[0] if item.values else item
            return isinstance(first_piece, ast.FormattedValue) and self._is_made(
                first_piece.value, scope, visited
            )
        if isinstance(item, ast.Call):
            return self._is_made_by(item, scope, visited)
        return isinstance(item, ast.Name) and self._is_name_made(item.id, scope, visited)

    def _is_made_by(self, call: ast.Call, scope: Scope, visited: frozenset[str]) -> bool:
        """Return True for a call that makes a temporary file or a file in memory, or that turns one
        into a path or an open file.
        """
        full_name = dotted(call.func, self._bound)
        method = call.func.attr if isinstance(call.func, ast.Attribute) else ""
        if full_name in _MADE:
            return True
        if full_name in _THROUGH_FILES or method in _THROUGH_FILES or self._reads(full_name):
            first_argument = read_by(call)
            return first_argument is not None and self._is_made(first_argument, scope, visited)
        # a method of a temporary path or file
        return bool(method) and self._is_made(call.func, scope, visited)

    def _is_name_made(self, name: str, scope: Scope, visited: frozenset[str]) -> bool:
        """Return True if all values of a local name are temporary files or files in memory."""
        if name in visited:
            return True  # a name assigned from itself, such as a path that grows
        # from the innermost function to the outermost
        for depth in range(len(scope), 0, -1):
            function = scope[depth - 1]
            if name in arguments(function):
                return False
            values = [value for target, value in assigned(function) if target == name]
            if values:
                return all(
                    self._is_made(value, scope[:depth], visited | {name}) for value in values
                )
        return False
