"""Facts that no key covers although it covers the file: when it was changed, who may read it, where code stands.

The key has the content of a parameter file, and source without its comments, layout and line numbers. Own code that
reads what lies beside these is found by the names it uses, also in a text such as ``attrgetter("st_mtime")``.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping

from neusee.workflows.keys.literal_texts import texts
from neusee.workflows.keys.local_names import dotted
from neusee.workflows.keys.scopes_of_names import last_name
from neusee.workflows.keys.syntax_pass import Kinds, each
from neusee.workflows.keys.unfollowed_constructs import Construct

_STAMP = "times, rights and marks of a file are not its content"
_SOURCE = "comments and numbers of lines of code are read"
_TIMES = ("mtime", "ctime", "atime", "birthtime")
_FIELDS = ("mode", "uid", "gid", "ino", "dev", "nlink")
_STAMPS = frozenset(
    {
        *(f"st_{name}{unit}" for name in _TIMES for unit in ("", "_ns")),
        *(f"st_{name}" for name in _FIELDS),
        *(f"ST_{name.upper()}" for name in (*_TIMES, *_FIELDS)),
        *("getmtime", "getctime", "getatime", "samefile", "sameopenfile", "samestat", "getxattr", "listxattr"),
        *("mtime", "date_time", "gettarinfo"),
        *("is_symlink", "islink", "readlink", "is_mount", "ismount", "is_junction", "isjunction"),
    }
)
_SOURCES = frozenset(
    {
        *("getsource", "getsourcelines", "getsourcefile", "getcomments", "findsource", "getframeinfo"),
        *("getouterframes", "getinnerframes", "f_lineno", "tb_lineno", "co_firstlineno", "co_positions", "co_lines"),
        *("co_linetable", "co_lnotab", "extract_stack", "extract_tb", "walk_stack", "walk_tb", "StackSummary"),
        *("findlinestarts", "TracebackException"),
    }
)
_WHY = {**dict.fromkeys(_STAMPS, ("stamp", _STAMP)), **dict.fromkeys(_SOURCES, ("source", _SOURCE))}
#: names that mean something else in other packages, in full
_FULL = {
    **dict.fromkeys(("os.access", "grp", "pwd"), ("stamp", _STAMP)),
    **dict.fromkeys(("inspect.stack", "inspect.trace", "tokenize.open", "linecache", "dis"), ("source", _SOURCE)),
}
_STATING = frozenset({"stat", "lstat", "fstat"})  #: functions whose result has the size of a file, and more
_SIZE = 6  #: place of the size in such a result
_TAKING = frozenset({"tuple", "list", "str", "repr", "hash", "sum", "max", "min", "iter", "map", "zip", "enumerate"})


def facts(kinds: Kinds, bound: Mapping[str, str]) -> list[Construct]:
    """Return each use of a fact beside the content of a file; ``bound`` has the full name of each imported name."""
    found = [*_by_name(kinds, bound), *_by_text(kinds), *_by_place(kinds), *_of_paths(kinds)]
    return [Construct(why[0], "", text, why[1], line) for text, why, line in found]


_Found = Iterator[tuple[str, tuple[str, str], int]]


def _by_name(kinds: Kinds, bound: Mapping[str, str]) -> _Found:
    for item in each(kinds, ast.Attribute, ast.Name):
        if isinstance(item.ctx, ast.Load):
            full = dotted(item, bound)
            last = item.attr if isinstance(item, ast.Attribute) else full.rpartition(".")[2] if item.id in bound else ""
            why = _WHY.get(last) or (_FULL.get(full) if _is_imported(item, bound) else None)
            if why is not None:
                yield last if last in _WHY else full, why, item.lineno


def _is_imported(item: ast.expr, bound: Mapping[str, str]) -> bool:
    while isinstance(item, ast.Attribute):
        item = item.value
    return isinstance(item, ast.Name) and item.id in bound


def _by_text(kinds: Kinds) -> _Found:
    """Yield each text that is such a name, or ends with one: ``"__code__.co_firstlineno"``."""
    for text, line in texts(kinds):
        last = text.rpartition(".")[2]
        if last in _WHY:
            yield last, _WHY[last], line


def _by_place(kinds: Kinds) -> _Found:
    """Yield each use of the result of ``os.stat`` as a row of numbers."""
    assigned = [item for item in each(kinds, ast.Assign) if _is_stat(item.value, frozenset())]
    named = frozenset(target.id for item in assigned for target in item.targets if isinstance(target, ast.Name))
    rows = [target for item in assigned for target in item.targets if isinstance(target, ast.Tuple | ast.List)]
    rows += [
        item
        for item in each(kinds, ast.Subscript)
        if _is_stat(item.value, named) and not (isinstance(item.slice, ast.Constant) and item.slice.value == _SIZE)
    ]
    rows += [item for item in each(kinds, ast.Starred, ast.FormattedValue) if _is_stat(item.value, named)]
    calls = [call for call in each(kinds, ast.Call) if last_name(call.func) in _TAKING]
    rows += [call for call in calls if any(_is_stat(argument, named) for argument in call.args)]
    yield from (("stat", ("stamp", _STAMP), row.lineno) for row in rows)


def _is_stat(item: ast.expr, named: frozenset[str]) -> bool:
    """Return True for a call of ``os.stat`` or ``Path.stat``, or for a name that has its result."""
    if isinstance(item, ast.Name):
        return item.id in named
    return isinstance(item, ast.Call) and last_name(item.func) in _STATING


def _of_paths(kinds: Kinds) -> _Found:
    """Yield ``path.owner()`` and ``path.group()`` of arguments that are paths; a match of a pattern has groups too."""
    annotated = [item for item in each(kinds, ast.arg) if item.annotation is not None]
    paths = {
        item.arg for item in annotated if any(word in ast.unparse(item.annotation) for word in ("Path", "DataFile"))
    }
    for item in each(kinds, ast.Attribute):
        if item.attr in ("owner", "group") and isinstance(item.value, ast.Name) and item.value.id in paths:
            yield item.attr, ("stamp", _STAMP), item.lineno
