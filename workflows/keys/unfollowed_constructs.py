"""Constructs of source code whose result no cache key can cover, such as files, clocks and hash
order.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from neusee.workflows.keys.source_syntax import (
    Kinds,
    NameScope,
    Scope,
    Scratch,
    Syntax,
    arguments,
    assigned,
    dotted,
    each,
    last_name,
    read_by,
    text_of,
    texts,
)

# --- unfollowed code ------------------------------------------------------------------------------

# The error for code whose results depend on something that a cache key cannot cover.


class UnfollowedCode(LookupError):
    """The code of a node has no cache key; the message states file, line, reason and fix."""


# --- unfollowed constructs ------------------------------------------------------------------------

# Constructs of source code that read something which no import shows: files, environment variables,
# names computed at run time, a clock.
#
# A digest of code does not cover what these constructs read, so a node declares it with
# ``depends=``. Code below ``if __name__ == "__main__"`` does not count, nor do files that are
# written. A file that is read counts, with two exceptions. The path may come from an argument of
# the function, because the key covers files of parameters. Or it is the path of a temporary file,
# or stands for an object in memory. In addition, the files that code of the user really opens are
# observed.


_CLOCK = "a clock, a process or a machine decides"
_DRAWN = "random numbers without a seed: draw them from a parameter rng"
_RUN = "code that no import names is run"
_BY_NAME = "a module is imported by a name that only a run knows"
_VARIABLE = "an environment variable is read"
_FILE = "a file is read that is no parameter"

_SETTING = "a setting of the process decides"
_DRAWING = (
    *("os.urandom", "secrets", "random", "torch.initial_seed", "torch.seed", "torch.get_rng_state"),
    *("torch.random.get_rng_state", "numpy.random.get_state"),
)
_TIMES = ("time", "perf_counter", "monotonic", "process_time", "thread_time")
_CALENDAR = ("localtime", "gmtime", "strftime", "ctime", "asctime")

#: kind and reason of refused names of Python and of libraries; a name covers all names below it
_NAMES: Mapping[str, tuple[str, str]] = {
    **dict.fromkeys(
        ("os.environ", "os.environb", "os.getenv", "os.getenvb", "os.path.expandvars"),
        ("env", _VARIABLE),
    ),
    **dict.fromkeys(("posix.environ", "nt.environ"), ("env", _VARIABLE)),
    **dict.fromkeys(
        ("importlib.import_module", "__import__", "importlib.__import__", "runpy"),
        ("import", _BY_NAME),
    ),
    **dict.fromkeys(("sys.modules", "importlib.util", "importlib.machinery"), ("import", _BY_NAME)),
    **dict.fromkeys(
        ("pkgutil.iter_modules", "pkgutil.walk_packages", "importlib.metadata"),
        ("import", _BY_NAME),
    ),
    **dict.fromkeys(
        ("exec", "eval", "compile", "ctypes.CDLL", "ctypes.cdll", "types.FunctionType"),
        ("run", _RUN),
    ),
    **dict.fromkeys(
        ("ctypes.PyDLL", "ctypes.pydll", "ctypes.pythonapi", "ctypes.util.find_library"),
        ("run", _RUN),
    ),
    **dict.fromkeys(("numpy.ctypeslib.load_library",), ("run", _RUN)),
    **dict.fromkeys(
        ("subprocess", "os.system", "os.popen", "multiprocessing", "types.CodeType"), ("run", _RUN)
    ),
    **dict.fromkeys(
        ("pickle.load", "pickle.loads", "marshal.loads", "cffi", "torch.utils.cpp_extension"),
        ("run", _RUN),
    ),
    **dict.fromkeys(
        ("torch.ops.load_library", "torch.classes.load_library", "torch.hub"), ("run", _RUN)
    ),
    **dict.fromkeys(
        ("importlib.resources", "pkgutil.get_data", "__file__", "__spec__", "__loader__"),
        ("file", _FILE),
    ),
    **dict.fromkeys(
        ("inspect.getsource", "inspect.getsourcelines", "inspect.getfile", "linecache"),
        ("file", _FILE),
    ),
    **dict.fromkeys(("urllib", "http", "requests", "httpx", "socket", "ftplib"), ("file", _FILE)),
    **dict.fromkeys(("os.getcwd", "pathlib.Path.cwd"), ("file", _FILE)),
    **dict.fromkeys(
        ("pathlib.Path.home", "os.path.expanduser", "sys.path", "sys.argv", "sys.orig_argv"),
        ("state", _CLOCK),
    ),
    **dict.fromkeys(
        ("os.cpu_count", "os.getpid", "os.uname", "platform", "getpass", "uuid"), ("state", _CLOCK)
    ),
    **{f"time.{name}": ("state", _CLOCK) for name in (*_TIMES, *_CALENDAR)},
    **{f"time.{name}_ns": ("state", _CLOCK) for name in _TIMES},
    **{f"datetime.datetime.{name}": ("state", _CLOCK) for name in ("now", "utcnow", "today")},
    **dict.fromkeys(
        ("datetime.date.today", "threading.get_ident", "resource", "tracemalloc"), ("state", _CLOCK)
    ),
    **dict.fromkeys(
        ("locale", "decimal", "numpy.geterr", "numpy.get_printoptions"), ("state", _SETTING)
    ),
    **dict.fromkeys(("sys.flags", "sys.warnoptions", "sys._xoptions"), ("state", _SETTING)),
    **dict.fromkeys(
        ("torch.get_num_threads", "torch.get_num_interop_threads", "psutil"), ("state", _CLOCK)
    ),
    **dict.fromkeys(
        ("torch.cuda.is_available", "torch.cuda.device_count", "torch.cuda.get_device_name"),
        ("state", _CLOCK),
    ),
    **dict.fromkeys(_DRAWING, ("state", _DRAWN)),
}
_BUILTINS = frozenset(
    {"exec", "eval", "compile", "__import__", "__file__", "__spec__", "__loader__"}
)
_METHODS = frozenset(
    {
        "open",
        "read_text",
        "read_bytes",
        "iterdir",
        "glob",
        "rglob",
        "exists",
        "is_file",
        "is_dir",
        "stat",
        "lstat",
    }
)  #: methods of a path that read it
_READERS = re.compile(  #: library functions that read a file
    r"(open|io\.open|codecs\.open|os\.open|glob\.i?glob|os\.(listdir|scandir|walk|stat|lstat|access|readlink)|"
    r"os\.path\.(exists|lexists|isfile|isdir|islink|getsize|getmtime|getctime|samefile)|"
    r"(numpy|torch)\.(load|loadtxt|genfromtxt|fromfile|memmap|from_file)|"
    r"PIL\.Image\.open|safetensors\.safe_open|safetensors\.\w+\.(load_file|safe_open)|h5py\.File|scipy\.io\.loadmat|"
    r"pandas\.read_\w+|.*\.imread|.*\.imopen|gzip\.open|bz2\.open|lzma\.open|zipfile\.ZipFile|tarfile\.open|"
    r"torchvision\.io\.\w+|OpenEXR\.\w*File|fileinput\.\w+)"
)
#: a text that is the name of a data file
_FILE_NAME = re.compile(
    r"[\w./~"
    r" -]*\w\."
    r"(json5?|jsonl|ya?ml|toml|ini|cfg|csv|tsv|txt|dat|bin|np[yz]|mat|h5|hdf5|pt|pth|pkl|pickle|"
    r"safetensors|png|jpe?g|tiff?|exr|bmp|gz|zip|xml|html?|j2|jinja2?|tmpl|cpp|cc|cu|c|hpp?|so|cl|glsl|db|sqlite|"
    r"parquet|fits|spd|tbl)"
)


class Construct(NamedTuple):
    """A construct that cannot be followed: its kind, the name of what it reads (may be empty), its
    text, the reason, and the line.
    """

    kind: str  #: file, env, import, run, state, hash, stamp or source
    name: str
    text: str
    why: str
    line: int


def constructs(tree: Syntax, bound: Mapping[str, str]) -> list[Construct]:
    """Return the constructs of a module that cannot be followed; ``bound`` maps each imported name
    to its full name.
    """
    own_names = _bound_here(tree.all)
    scratch = Scratch(bound, lambda full: _READERS.fullmatch(full) is not None)
    unfollowed = [
        *_named(tree.all, bound, own_names),
        *_read(tree.calls, bound, own_names, scratch),
    ]
    scratch_texts = scratch.texts(tree) if scratch else set[int]()
    unfollowed += _file_names(tree.all, scratch_texts)
    return sorted(set(unfollowed), key=lambda item: (item.line, item))


def literal_import(call: ast.expr, bound: Mapping[str, str]) -> str | None:
    """Return the module in a call such as ``import_module("a.b")``, or None for any other
    expression.
    """
    if not isinstance(call, ast.Call) or not call.args:
        return None
    if dotted(call.func, bound) not in _IMPORTERS:
        return None
    module_argument = call.args[0]
    return (
        module_argument.value
        if isinstance(module_argument, ast.Constant) and isinstance(module_argument.value, str)
        else None
    )


_IMPORTERS = (
    "importlib.import_module",
    "importlib.__import__",
    "__import__",
    "importlib.util.find_spec",
)


def _bound_here(kinds: Kinds) -> set[str]:
    """Return the names that statements and arguments bind. Such a name hides a builtin of the same
    name.
    """
    names = {item.name for item in each(kinds, ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)}
    names |= {item.arg for item in each(kinds, ast.arg)}
    return names | {item.id for item in each(kinds, ast.Name) if not isinstance(item.ctx, ast.Load)}


def _named(kinds: Kinds, bound: Mapping[str, str], own: set[str]) -> Iterator[Construct]:
    """Yield each use of a name such as ``os.environ``, which reads something that no import
    shows.
    """
    ids_accounted = {id(call.func) for call in each(kinds, ast.Call) if literal_import(call, bound)}
    # of a.b.c, only the whole expression counts
    ids_accounted |= {id(use.value) for use in each(kinds, ast.Attribute)}
    variable_names = {id(use): name for use, name in _variables(kinds, bound)}
    for item in each(kinds, ast.Attribute, ast.Name):
        if id(item) in ids_accounted or not isinstance(item.ctx, ast.Load):
            continue
        if not _is_imported_or_builtin(_first_name(item), bound, own):
            continue
        full_name = dotted(item, bound)
        if entry := entry_of(full_name):
            yield Construct(
                entry[0],
                variable_names.get(id(_environ(item)), ""),
                full_name,
                entry[1],
                item.lineno,
            )


def _is_imported_or_builtin(base: str, bound: Mapping[str, str], own: set[str]) -> bool:
    """Return True for an imported name, or for a builtin name that the module does not redefine."""
    return base in bound or (base not in own and base in _BUILTINS)


def entry_of(full: str) -> tuple[str, str] | None:
    """Return kind and reason of the entry in `_NAMES` for a full name such as ``os.environ.get``,
    or None.
    """
    name = full
    while name:
        if name in _NAMES:
            return _NAMES[name]
        name = name.rpartition(".")[0]
    return None


def _first_name(item: ast.expr) -> str:
    """Return the first name of ``a.b.c``, or an empty text."""
    while isinstance(item, ast.Attribute):
        item = item.value
    return item.id if isinstance(item, ast.Name) else ""


def _environ(item: ast.expr) -> ast.expr:
    """Return ``os.environ`` for ``os.environ.get`` and similar, and any other expression
    unchanged.
    """
    if isinstance(item, ast.Attribute) and item.attr in ("get", "__getitem__", "pop"):
        return item.value
    return item


def _variables(kinds: Kinds, bound: Mapping[str, str]) -> Iterator[tuple[ast.expr, str]]:
    """Yield the expression and the name of the variable for each ``os.environ["X"]``,
    ``os.environ.get("X")`` and so on.
    """
    pairs = [(item.value, item.slice) for item in each(kinds, ast.Subscript)]
    pairs += [(_environ(item.func), item.args[0]) for item in each(kinds, ast.Call) if item.args]
    for use, key in pairs:
        # " " stands for a name without an entry
        if (name := _literal(key)) and (entry_of(dotted(use, bound)) or " ")[0] == "env":
            yield use, name


def _read(
    calls: Iterable[tuple[Scope, ast.Call]],
    bound: Mapping[str, str],
    own: set[str],
    scratch: Scratch,
) -> Iterator[Construct]:
    """Yield each call that reads a file, unless its path comes from an argument of a function
    around the call.
    """
    for scope, item in calls:
        path = _path_read(item, bound, own)
        if path is None or _writes(item) or _given(path, scope, frozenset()):
            continue
        if not scratch.holds(path, scope):
            yield Construct("file", _literal(path), ast.unparse(item)[:60], _FILE, item.lineno)


def _path_read(call: ast.Call, bound: Mapping[str, str], own: set[str]) -> ast.expr | None:
    """Return the path of the file that a call reads, or None for a call that reads no file."""
    full_name, is_imported = dotted(call.func, bound), _first_name(call.func) in bound
    if (is_imported or (full_name == "open" and full_name not in own)) and _READERS.fullmatch(
        full_name
    ):
        return read_by(call)
    if is_imported or not isinstance(call.func, ast.Attribute) or call.func.attr not in _METHODS:
        return None
    # a method of a path, such as `path.read_text()`
    return call.func.value


def _writes(call: ast.Call) -> bool:
    """Return True if the mode of a call of ``open`` creates or extends a file."""
    # the mode is the first argument of a method, and the second of `open`
    modes = [*call.args[:2], *(word.value for word in call.keywords if word.arg == "mode")]
    mode_texts = [
        argument.value
        for argument in modes
        if isinstance(argument, ast.Constant) and isinstance(argument.value, str)
    ]
    return any(re.fullmatch(r"[wax][bt+]*", text) for text in mode_texts)


def _literal(path: ast.AST) -> str:
    """Return the text of a literal, or an empty text for anything else."""
    return path.value if isinstance(path, ast.Constant) and isinstance(path.value, str) else ""


def _given(path: ast.expr, scope: Scope, visited: frozenset[str]) -> bool:
    """Return True if a path comes from an argument of a function around it, directly or through
    local names.
    """
    variables = [
        variable
        for variable in ast.walk(path)
        if isinstance(variable, ast.Name) and isinstance(variable.ctx, ast.Load)
    ]
    return any(_name_given(name.id, scope, visited) for name in variables)


def _name_given(name: str, scope: Scope, visited: frozenset[str]) -> bool:
    """Return True if a name is an argument of a function around it, or gets its value from one."""
    if name in visited:
        return False
    for function in reversed(scope):
        if name in arguments(function):
            return True
        values = [value for target, value in assigned(function) if target == name]
        if values:
            return any(_given(value, scope, visited | {name}) for value in values)
    return False


def _file_names(kinds: Kinds, scratch: set[int]) -> Iterator[Construct]:
    """Yield each text that is the name of a data file, unless it occurs in a message.

    ``scratch``: ids of the texts that name a file in a temporary folder; they do not count.
    """
    ids_in_messages = set[int]()
    for item in each(kinds, ast.Raise, ast.JoinedStr):
        ids_in_messages |= {id(part) for part in ast.walk(item)}
    for item in each(kinds, ast.Constant):
        text = _literal(item)
        if _FILE_NAME.fullmatch(text) and id(item) not in ids_in_messages | scratch:
            yield Construct("file", text, repr(text), _FILE, item.lineno)


# --- hash order -----------------------------------------------------------------------------------

# Results that depend on the hash seed of a process: the order of a set of texts, and ``hash()`` of
# a text.
#
# Python draws a new seed for each process unless ``PYTHONHASHSEED`` is set. A set is recognised by
# its form: ``{"a", b}``, ``set(x)``, a union of these, and a name that is one of them. Sets of
# literal numbers do not count, since their order does not depend on the seed.


_WHY = "the hash seed of a process decides"
_ORDERED = frozenset(
    {"list", "tuple", "iter", "enumerate", "zip", "map", "filter", "join", "fromkeys", "fromiter"}
)
#: functions whose result depends on the order not at all, or only within rounding
_UNORDERED = frozenset(
    {
        "sorted",
        "len",
        "min",
        "max",
        "any",
        "all",
        "sum",
        "fsum",
        "prod",
        "set",
        "frozenset",
        "bool",
        "isdisjoint",
    }
)
_OF_SETS = ("union", "intersection", "difference", "symmetric_difference", "copy")
_SCOPES = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda)
_LISTED = (ast.ListComp, ast.DictComp, ast.GeneratorExp)


def orders(tree: ast.Module) -> list[Construct]:
    """Return each place where a module uses the order of a set or a hash value, which differ
    between processes.
    """
    expressions = _hash_ordered(tree, NameScope(tree, None))
    return [
        Construct("hash", "", ast.unparse(item)[:60], _WHY, item.lineno) for item in expressions
    ]


def _hash_ordered(item: ast.AST, scope: NameScope) -> Iterator[ast.expr]:
    """Yield each expression in a part of the tree whose order or value depends on the hash seed."""
    if isinstance(item, _SCOPES):
        scope = NameScope(item, scope)
    yield from (ordered_part for ordered_part in _taken(item) if _is_set(ordered_part, scope))
    if isinstance(item, ast.Call):
        if _hashes(item, scope):
            yield item
        if last_name(item.func) in _UNORDERED:
            for argument in item.args:
                yield from _below(argument, scope)
            # `_below` has searched the arguments
            return
    if not _defines_hash(item):
        for child in ast.iter_child_nodes(item):
            yield from _hash_ordered(child, scope)


def _defines_hash(item: ast.AST) -> bool:
    """Return True for the definition of ``__hash__``, which may call ``hash``."""
    return isinstance(item, ast.FunctionDef) and item.name == "__hash__"


def _hashes(call: ast.Call, scope: NameScope) -> bool:
    """Return True for a call whose value depends on the hash seed."""
    return _is_hash(call, scope) or _pops_of_set(call, scope)


def _pops_of_set(call: ast.Call, scope: NameScope) -> bool:
    """Return True for ``pop()`` of a set, which returns an arbitrary element."""
    if last_name(call.func) != "pop" or call.args:
        return False
    return _of_set(call.func, scope, frozenset())


def _below(argument: ast.expr, scope: NameScope) -> Iterator[ast.expr]:
    """Yield the expressions inside an argument that depend on the hash seed; the order of the
    argument itself does not matter.
    """
    if isinstance(argument, ast.Call) and last_name(argument.func) in _ORDERED:
        for value in argument.args:
            yield from _below(value, scope)
    elif isinstance(argument, _LISTED):
        for operand in _behind_first(argument):
            yield from _hash_ordered(operand, scope)
    else:
        for child in ast.iter_child_nodes(argument):
            yield from _hash_ordered(child, scope)


def _behind_first(listed: ast.ListComp | ast.DictComp | ast.GeneratorExp) -> list[ast.expr]:
    """Return the expressions of a comprehension, except for its first iterable."""
    clause_parts: list[ast.expr] = []
    for clause in listed.generators:
        clause_parts += [clause.target, clause.iter, *clause.ifs]
    clause_parts.remove(listed.generators[0].iter)
    result_parts = [listed.key, listed.value] if isinstance(listed, ast.DictComp) else [listed.elt]
    return [*clause_parts, *result_parts]


def _taken(item: ast.AST) -> list[ast.expr]:
    """Return the expressions whose order affects a statement or an expression."""
    if isinstance(item, ast.For | ast.AsyncFor):
        return [item.iter]
    if isinstance(item, _LISTED):
        return [clause.iter for clause in item.generators]
    if isinstance(item, ast.Starred):
        return [item.value]
    return [*item.args] if isinstance(item, ast.Call) and last_name(item.func) in _ORDERED else []


def _is_hash(call: ast.Call, scope: NameScope) -> bool:
    """Return True for a call of the builtin ``hash``, or of a ``__hash__`` method."""
    if isinstance(call.func, ast.Attribute) and call.func.attr == "__hash__":
        return True
    return (
        isinstance(call.func, ast.Name) and call.func.id == "hash" and scope.holder("hash") is None
    )


def _is_set(item: ast.expr, scope: NameScope, visited: frozenset[str] = frozenset()) -> bool:
    """Return True for an expression that is a set, except for a set of literal numbers."""
    if isinstance(item, ast.Set):
        return not all(map(_is_number, item.elts))
    # union, intersection and differences
    if isinstance(item, ast.BinOp) and isinstance(
        item.op, ast.BitOr | ast.BitAnd | ast.Sub | ast.BitXor
    ):
        return _is_set(item.left, scope, visited) or _is_set(item.right, scope, visited)
    if isinstance(item, ast.Call):
        return _makes_set(item) or (
            last_name(item.func) in _OF_SETS and _of_set(item.func, scope, visited)
        )
    if isinstance(item, ast.Name) and item.id not in visited:
        return _names_set(item.id, scope, visited)
    return isinstance(item, ast.SetComp)


def _is_number(item: ast.expr) -> bool:
    """Return True for a literal number."""
    return isinstance(item, ast.Constant) and isinstance(item.value, int | float)


def _makes_set(call: ast.Call) -> bool:
    """Return True for a call of ``set`` or ``frozenset``, except for a set of a ``range``."""
    if not isinstance(call.func, ast.Name) or call.func.id not in ("set", "frozenset"):
        return False
    argument = call.args[0] if call.args else None
    return not (isinstance(argument, ast.Call) and last_name(argument.func) == "range")


def _names_set(name: str, scope: NameScope, visited: frozenset[str]) -> bool:
    """Return True for a name to which a set is bound."""
    holder = scope.holder(name)
    if holder is None:
        return False
    values = [value for value in holder.values.get(name, []) if value is not None]
    return any(_is_set(value, holder, visited | {name}) for value in values)


def _of_set(function: ast.expr, scope: NameScope, visited: frozenset[str]) -> bool:
    """Return True for a method of a set."""
    return isinstance(function, ast.Attribute) and _is_set(function.value, scope, visited)


# --- facts beside content -------------------------------------------------------------------------

# Facts about a file that no key covers, although it covers the content: time of change,
# permissions, line numbers of code.
#
# The key covers the content of a parameter file, and source without its comments, layout and line
# numbers. Code of the user that reads other facts is recognised by the names it uses, also inside a
# text such as ``attrgetter("st_mtime")``.


_STAMP = "times, rights and marks of a file are not its content"
_SOURCE = "comments and numbers of lines of code are read"
_TIMES_OF_FILES = ("mtime", "ctime", "atime", "birthtime")
_FIELDS = ("mode", "uid", "gid", "ino", "dev", "nlink")
_STAMPS = frozenset(
    {
        *(f"st_{name}_ns" for name in _TIMES_OF_FILES),
        *(f"st_{name}" for name in (*_TIMES_OF_FILES, *_FIELDS)),
        *(f"ST_{name.upper()}" for name in (*_TIMES_OF_FILES, *_FIELDS)),
        *(
            "getmtime",
            "getctime",
            "getatime",
            "samefile",
            "sameopenfile",
            "samestat",
            "getxattr",
            "listxattr",
        ),
        *("mtime", "date_time", "gettarinfo"),
        *("is_symlink", "islink", "readlink", "is_mount", "ismount", "is_junction", "isjunction"),
    }
)
_SOURCES = frozenset(
    {
        *(
            "getsource",
            "getsourcelines",
            "getsourcefile",
            "getcomments",
            "findsource",
            "getframeinfo",
        ),
        *(
            "getouterframes",
            "getinnerframes",
            "f_lineno",
            "tb_lineno",
            "co_firstlineno",
            "co_positions",
            "co_lines",
        ),
        *(
            "co_linetable",
            "co_lnotab",
            "extract_stack",
            "extract_tb",
            "walk_stack",
            "walk_tb",
            "StackSummary",
        ),
        *("findlinestarts", "TracebackException"),
    }
)
_WHY_BESIDE = {
    **dict.fromkeys(_STAMPS, ("stamp", _STAMP)),
    **dict.fromkeys(_SOURCES, ("source", _SOURCE)),
}
#: full names, where the last part alone has another meaning in other packages
_FULL = {
    **dict.fromkeys(("os.access", "grp", "pwd"), ("stamp", _STAMP)),
    **dict.fromkeys(
        ("inspect.stack", "inspect.trace", "tokenize.open", "linecache", "dis"), ("source", _SOURCE)
    ),
}
#: functions that return the status of a file, of which only the size is covered
_STATING = frozenset({"stat", "lstat", "fstat"})
_SIZE = 6  #: index of the size in such a result
_TAKING = frozenset(
    {"tuple", "list", "str", "repr", "hash", "sum", "max", "min", "iter", "map", "zip", "enumerate"}
)


def facts(kinds: Kinds, bound: Mapping[str, str]) -> list[Construct]:
    """Return each use of a fact about a file that is not its content; ``bound`` maps each imported
    name to its full name.
    """
    uses = [*_by_name(kinds, bound), *_by_text(kinds), *_by_place(kinds), *_of_paths(kinds)]
    return [
        Construct(kind_and_reason[0], "", text, kind_and_reason[1], line)
        for text, kind_and_reason, line in uses
    ]


_Found = Iterator[tuple[str, tuple[str, str], int]]


def _by_name(kinds: Kinds, bound: Mapping[str, str]) -> _Found:
    """Yield each use of such a fact by name: the name, kind and reason, and the line."""
    for item in each(kinds, ast.Attribute, ast.Name):
        if not isinstance(item.ctx, ast.Load):
            continue
        full_name, is_imported = dotted(item, bound), _first_name(item) in bound
        last_part = full_name.rpartition(".")[2] if is_imported else ""
        if isinstance(item, ast.Attribute):
            last_part = item.attr
        if last_part in _WHY_BESIDE:
            yield last_part, _WHY_BESIDE[last_part], item.lineno
        elif is_imported and full_name in _FULL:
            yield full_name, _FULL[full_name], item.lineno


def _by_text(kinds: Kinds) -> _Found:
    """Yield each text that is the name of such a fact, or ends with one:
    ``"__code__.co_firstlineno"``.
    """
    for text, line in texts(kinds):
        last_part = text.rpartition(".")[2]
        if last_part in _WHY_BESIDE:
            yield last_part, _WHY_BESIDE[last_part], line


def _by_place(kinds: Kinds) -> _Found:
    """Yield each use of the result of ``os.stat`` as a sequence of numbers."""
    targets: list[ast.expr] = []
    for item in each(kinds, ast.Assign):
        if _is_stat(item.value, frozenset()):
            targets += item.targets
    names_of_stat = frozenset(target.id for target in targets if isinstance(target, ast.Name))
    unpacked_targets = [target for target in targets if isinstance(target, ast.Tuple | ast.List)]
    rows = [*unpacked_targets, *_rows_of_stat(kinds, names_of_stat)]
    yield from (("stat", ("stamp", _STAMP), row.lineno) for row in rows)


def _rows_of_stat(kinds: Kinds, named: frozenset[str]) -> Iterator[ast.expr]:
    """Yield each expression that uses such a result as a sequence: by index, by ``*``, in an
    f-string, or as an argument of a call.
    """
    yield from (item for item in each(kinds, ast.Subscript) if _is_field_of_stat(item, named))
    for item in each(kinds, ast.Starred, ast.FormattedValue):
        if _is_stat(item.value, named):
            yield item
    for call in each(kinds, ast.Call):
        if last_name(call.func) in _TAKING and any(_is_stat(item, named) for item in call.args):
            yield call


def _is_field_of_stat(item: ast.Subscript, named: frozenset[str]) -> bool:
    """Return True for an index expression of such a result, unless the index is that of the
    size.
    """
    is_size = isinstance(item.slice, ast.Constant) and item.slice.value == _SIZE
    return _is_stat(item.value, named) and not is_size


def _is_stat(item: ast.expr, named: frozenset[str]) -> bool:
    """Return True for a call of ``os.stat`` or ``Path.stat``, or for a name that has its result."""
    if isinstance(item, ast.Name):
        return item.id in named
    return isinstance(item, ast.Call) and last_name(item.func) in _STATING


def _of_paths(kinds: Kinds) -> _Found:
    """Yield ``path.owner()`` and ``path.group()`` for arguments annotated as paths; matches of
    regular expressions have a method ``group`` too.
    """
    annotated_arguments = [item for item in each(kinds, ast.arg) if item.annotation is not None]
    path_arguments = {item.arg for item in annotated_arguments if _names_path(item.annotation)}
    owner_calls = [item for item in each(kinds, ast.Attribute) if item.attr in ("owner", "group")]
    for item in owner_calls:
        if isinstance(item.value, ast.Name) and item.value.id in path_arguments:
            yield item.attr, ("stamp", _STAMP), item.lineno


def _names_path(annotation: ast.expr) -> bool:
    """Return True for an annotation that names a path or a data file."""
    text = ast.unparse(annotation)
    return "Path" in text or "DataFile" in text


# --- facts of the moment --------------------------------------------------------------------------

# Facts that differ between moments or machines: clocks, addresses, numbers of threads, processors,
# programs.
#
# Most of them cannot be observed as a system call, and each library has its own names for them. So
# code of the user is searched for the last part of a name, whatever its library:
# ``pandas.Timestamp.now`` as well as ``datetime.now``. ``getattr(time, name)`` is refused too.


_WHY_OF_MOMENT = "a clock, a process or a machine decides"
_LOOKED_UP = "a name that only a run knows is looked up in a module of Python"
_LAST = frozenset(
    {
        *(
            "now",
            "utcnow",
            "today",
            "formatdate",
            "default_timer",
            "Timer",
            "timeit",
            "relativeCreated",
        ),
        *(
            "data_ptr",
            "get_native_id",
            "native_id",
            "sched_getaffinity",
            "process_cpu_count",
            "getpriority",
        ),
        *("getloadavg", "get_terminal_size", "getswitchinterval", "gettempdir", "gettempdirb"),
        *("isEnabledFor", "getEffectiveLevel", "makeLogRecord"),
    }
)
_FULL_NAMES_OF_MOMENT = frozenset(
    {"shutil.which", "os.nice", "os.times", "sys.getrefcount", "sys.getsizeof"}
)
#: modules of Python that provide such facts
_HOLDING = frozenset(
    {
        *(
            "os",
            "posix",
            "nt",
            "time",
            "datetime",
            "sys",
            "platform",
            "socket",
            "threading",
            "resource",
            "shutil",
        ),
        *("locale", "random", "uuid", "secrets", "getpass", "gc"),
    }
)
#: functions that parse a text as a date
_DATES = frozenset({"datetime64", "Timestamp", "to_datetime", "Time", "DatetimeIndex"})
_PRESENT = frozenset({"now", "today"})  #: texts that stand for the present date


def moments(kinds: Kinds, bound: Mapping[str, str]) -> list[Construct]:
    """Return each use of a fact that depends on the moment or the machine; ``bound`` maps each
    imported name to its full name.
    """
    uses = [
        *_moment_by_name(kinds, bound),
        *_by_date(kinds),
        *_looked_up(kinds, bound),
    ]
    return [Construct("state", "", text, reason, line) for text, reason, line in uses]


_MomentFact = Iterator[tuple[str, str, int]]


def _moment_by_name(kinds: Kinds, bound: Mapping[str, str]) -> _MomentFact:
    """Yield each use of such a fact by name: the name, the reason, and the line."""
    for item in each(kinds, ast.Attribute, ast.Name):
        if isinstance(item.ctx, ast.Load) and (isinstance(item, ast.Attribute) or item.id in bound):
            full_name = dotted(item, bound) or last_name(item)
            if full_name.rpartition(".")[2] in _LAST or full_name in _FULL_NAMES_OF_MOMENT:
                yield full_name, _WHY_OF_MOMENT, item.lineno


def _by_date(kinds: Kinds) -> _MomentFact:
    """Yield each call such as ``np.datetime64("now")``."""
    for call in each(kinds, ast.Call):
        if last_name(call.func) in _DATES and any(
            text_of(argument) in _PRESENT for argument in call.args
        ):
            yield ast.unparse(call)[:60], _WHY_OF_MOMENT, call.lineno


def _looked_up(kinds: Kinds, bound: Mapping[str, str]) -> _MomentFact:
    """Yield each refused ``getattr`` of a module of Python, such as ``getattr(os, name)`` or
    ``getattr(os, "envi" + "ron")``, with the reason.
    """
    for call in each(kinds, ast.Call):
        if last_name(call.func) != "getattr" or len(call.args) < 2:
            continue
        module_name, name = dotted(call.args[0], bound), text_of(call.args[1])
        if module_name.partition(".")[0] not in _HOLDING:
            continue
        entry = entry_of(f"{module_name}.{name}") if name else ("state", _LOOKED_UP)
        if entry or name in _LAST:
            reason = entry[1] if entry else _WHY_OF_MOMENT
            yield ast.unparse(call)[:60], reason, call.lineno
