"""Constructs of source code that read what no import shows: files, environment variables, names at run time, a clock.

A digest of code does not cover what these constructs read, so a node declares it with ``depends=``. Code below
``if __name__ == "__main__"`` and files that are written do not count. A file counts unless its path comes from an
argument of the function that reads it, because the file of a parameter is part of the key, or is that of a temporary
file or of an object in memory: what own code really opens is observed.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from neusee.workflows.keys.local_names import arguments, assigned, dotted, read_by
from neusee.workflows.keys.scratch_files import Scratch
from neusee.workflows.keys.syntax_pass import Kinds, Scope, Syntax, each

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

#: What the names of Python and of libraries do, by their first parts.
_NAMES: Mapping[str, tuple[str, str]] = {
    **dict.fromkeys(("os.environ", "os.environb", "os.getenv", "os.getenvb", "os.path.expandvars"), ("env", _VARIABLE)),
    **dict.fromkeys(("posix.environ", "nt.environ"), ("env", _VARIABLE)),
    **dict.fromkeys(("importlib.import_module", "__import__", "importlib.__import__", "runpy"), ("import", _BY_NAME)),
    **dict.fromkeys(("sys.modules", "importlib.util", "importlib.machinery"), ("import", _BY_NAME)),
    **dict.fromkeys(("pkgutil.iter_modules", "pkgutil.walk_packages", "importlib.metadata"), ("import", _BY_NAME)),
    **dict.fromkeys(("exec", "eval", "compile", "ctypes.CDLL", "ctypes.cdll", "types.FunctionType"), ("run", _RUN)),
    **dict.fromkeys(("ctypes.PyDLL", "ctypes.pydll", "ctypes.pythonapi", "ctypes.util.find_library"), ("run", _RUN)),
    **dict.fromkeys(("numpy.ctypeslib.load_library",), ("run", _RUN)),
    **dict.fromkeys(("subprocess", "os.system", "os.popen", "multiprocessing", "types.CodeType"), ("run", _RUN)),
    **dict.fromkeys(
        ("pickle.load", "pickle.loads", "marshal.loads", "cffi", "torch.utils.cpp_extension"), ("run", _RUN)
    ),
    **dict.fromkeys(("torch.ops.load_library", "torch.classes.load_library", "torch.hub"), ("run", _RUN)),
    **dict.fromkeys(("importlib.resources", "pkgutil.get_data", "__file__", "__spec__", "__loader__"), ("file", _FILE)),
    **dict.fromkeys(("inspect.getsource", "inspect.getsourcelines", "inspect.getfile", "linecache"), ("file", _FILE)),
    **dict.fromkeys(("urllib", "http", "requests", "httpx", "socket", "ftplib"), ("file", _FILE)),
    **dict.fromkeys(("os.getcwd", "pathlib.Path.cwd"), ("file", _FILE)),
    **dict.fromkeys(
        ("pathlib.Path.home", "os.path.expanduser", "sys.path", "sys.argv", "sys.orig_argv"), ("state", _CLOCK)
    ),
    **dict.fromkeys(("os.cpu_count", "os.getpid", "os.uname", "platform", "getpass", "uuid"), ("state", _CLOCK)),
    **{f"time.{name}{unit}": ("state", _CLOCK) for name in _TIMES for unit in ("", "_ns")},
    **{f"time.{name}": ("state", _CLOCK) for name in ("localtime", "gmtime", "strftime", "ctime", "asctime")},
    **{f"datetime.datetime.{name}": ("state", _CLOCK) for name in ("now", "utcnow", "today")},
    **dict.fromkeys(("datetime.date.today", "threading.get_ident", "resource", "tracemalloc"), ("state", _CLOCK)),
    **dict.fromkeys(("locale", "decimal", "numpy.geterr", "numpy.get_printoptions"), ("state", _SETTING)),
    **dict.fromkeys(("sys.flags", "sys.warnoptions", "sys._xoptions"), ("state", _SETTING)),
    **dict.fromkeys(("torch.get_num_threads", "torch.get_num_interop_threads", "psutil"), ("state", _CLOCK)),
    **dict.fromkeys(
        ("torch.cuda.is_available", "torch.cuda.device_count", "torch.cuda.get_device_name"), ("state", _CLOCK)
    ),
    **dict.fromkeys(_DRAWING, ("state", _DRAWN)),
}
_BUILTINS = frozenset({"exec", "eval", "compile", "__import__", "__file__", "__spec__", "__loader__"})
_METHODS = frozenset(
    {"open", "read_text", "read_bytes", "iterdir", "glob", "rglob", "exists", "is_file", "is_dir", "stat", "lstat"}
)  #: of a path
_READERS = re.compile(  #: functions of libraries that read a file
    r"(open|io\.open|codecs\.open|os\.open|glob\.i?glob|os\.(listdir|scandir|walk|stat|lstat|access|readlink)|"
    r"os\.path\.(exists|lexists|isfile|isdir|islink|getsize|getmtime|getctime|samefile)|"
    r"(numpy|torch)\.(load|loadtxt|genfromtxt|fromfile|memmap|from_file)|"
    r"PIL\.Image\.open|safetensors\.safe_open|safetensors\.\w+\.(load_file|safe_open)|h5py\.File|scipy\.io\.loadmat|"
    r"pandas\.read_\w+|.*\.imread|.*\.imopen|gzip\.open|bz2\.open|lzma\.open|zipfile\.ZipFile|tarfile\.open|"
    r"torchvision\.io\.\w+|OpenEXR\.\w*File|fileinput\.\w+)"
)
#: a text that is the name of a file of data
_FILE_NAME = re.compile(
    r"[\w./~ -]*\w\.(json5?|jsonl|ya?ml|toml|ini|cfg|csv|tsv|txt|dat|bin|np[yz]|mat|h5|hdf5|pt|pth|pkl|pickle|"
    r"safetensors|png|jpe?g|tiff?|exr|bmp|gz|zip|xml|html?|j2|jinja2?|tmpl|cpp|cc|cu|c|hpp?|so|cl|glsl|db|sqlite|"
    r"parquet|fits|spd|tbl)"
)


class Construct(NamedTuple):
    """A construct that is not followed: its kind, what it names (or nothing), its text, the reason, and the line."""

    kind: str  #: file, env, import, run, state, hash, stamp or source
    name: str
    text: str
    why: str
    line: int


def constructs(tree: Syntax, bound: Mapping[str, str]) -> list[Construct]:
    """Return each construct of a module that is not followed; ``bound`` has the full name of each imported name."""
    own = _bound_here(tree.all)
    scratch = Scratch(bound, lambda full: _READERS.fullmatch(full) is not None)
    found = [*_named(tree.all, bound, own), *_read(tree.calls, bound, own, scratch)]
    found += _file_names(tree.all, scratch.texts(tree) if scratch else set())
    return sorted(set(found), key=lambda item: (item.line, item))


def literal_import(call: ast.expr, bound: Mapping[str, str]) -> str | None:
    """Return the module in a call such as ``import_module("a.b")``, or None for any other expression."""
    if not isinstance(call, ast.Call) or not call.args or dotted(call.func, bound) not in _IMPORTERS:
        return None
    first = call.args[0]
    return first.value if isinstance(first, ast.Constant) and isinstance(first.value, str) else None


_IMPORTERS = ("importlib.import_module", "importlib.__import__", "__import__", "importlib.util.find_spec")


def _bound_here(kinds: Kinds) -> set[str]:
    """Return the names that statements and arguments bind, so that they hide a builtin of the same name."""
    found = {item.name for item in each(kinds, ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)}
    found |= {item.arg for item in each(kinds, ast.arg)}
    return found | {item.id for item in each(kinds, ast.Name) if not isinstance(item.ctx, ast.Load)}


def _named(kinds: Kinds, bound: Mapping[str, str], own: set[str]) -> Iterator[Construct]:
    """Yield each use of a name that reads what no import shows, such as ``os.environ``."""
    known = {id(call.func) for call in each(kinds, ast.Call) if literal_import(call, bound)}
    known |= {id(use.value) for use in each(kinds, ast.Attribute)}
    names = {id(use): name for use, name in _variables(kinds, bound)}
    for item in each(kinds, ast.Attribute, ast.Name):
        if id(item) in known or not isinstance(item.ctx, ast.Load):
            continue
        base = _first_name(item)
        if base not in bound and (base in own or base not in _BUILTINS):
            continue
        full = dotted(item, bound)
        if entry := entry_of(full):
            yield Construct(entry[0], names.get(id(_environ(item)), ""), full, entry[1], item.lineno)


def entry_of(full: str) -> tuple[str, str] | None:
    """Return what a full name such as ``os.environ.get`` does, or None for any other name."""
    parts = full.split(".")
    return next((_NAMES[name] for n in range(len(parts), 0, -1) if (name := ".".join(parts[:n])) in _NAMES), None)


def _first_name(item: ast.expr) -> str:
    while isinstance(item, ast.Attribute):
        item = item.value
    return item.id if isinstance(item, ast.Name) else ""


def _environ(item: ast.expr) -> ast.expr:
    return item.value if isinstance(item, ast.Attribute) and item.attr in ("get", "__getitem__", "pop") else item


def _variables(kinds: Kinds, bound: Mapping[str, str]) -> Iterator[tuple[ast.expr, str]]:
    """Yield the expression and the variable of each ``os.environ["X"]``, ``os.environ.get("X")`` and so on."""
    pairs = [(item.value, item.slice) for item in each(kinds, ast.Subscript)]
    pairs += [(_environ(item.func), item.args[0]) for item in each(kinds, ast.Call) if item.args]
    for use, key in pairs:
        if (name := _literal(key)) and (entry_of(dotted(use, bound)) or " ")[0] == "env":
            yield use, name


def _read(
    calls: Iterable[tuple[Scope, ast.Call]], bound: Mapping[str, str], own: set[str], scratch: Scratch
) -> Iterator[Construct]:
    """Yield each call that reads a file whose path does not come from an argument of the function around it."""
    for scope, item in calls:
        full = dotted(item.func, bound)
        method = isinstance(item.func, ast.Attribute) and item.func.attr in _METHODS
        known = _first_name(item.func) in bound or (full == "open" and full not in own)
        if known and _READERS.fullmatch(full):
            path = read_by(item)
        elif method and isinstance(item.func, ast.Attribute) and _first_name(item.func) not in bound:
            path = item.func.value
        else:
            continue
        if path is None or _writes(item) or _given(path, scope, frozenset()):
            continue
        if not scratch.holds(path, scope):
            yield Construct("file", _literal(path), ast.unparse(item)[:60], _FILE, item.lineno)


def _writes(call: ast.Call) -> bool:
    """Return True if the mode of a call of ``open`` creates or extends a file."""
    modes = [*call.args[:2], *(word.value for word in call.keywords if word.arg == "mode")]
    texts = [m.value for m in modes if isinstance(m, ast.Constant) and isinstance(m.value, str)]
    return any(re.fullmatch(r"[wax][bt+]*", text) for text in texts)


def _literal(path: ast.AST) -> str:
    """Return the text of a literal, or an empty text for anything else."""
    return path.value if isinstance(path, ast.Constant) and isinstance(path.value, str) else ""


def _given(path: ast.expr, scope: Scope, seen: frozenset[str]) -> bool:
    """Return True if a path comes from an argument of a function around it, through any local names."""
    names = [part for part in ast.walk(path) if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Load)]
    return any(_name_given(name.id, scope, seen) for name in names)


def _name_given(name: str, scope: Scope, seen: frozenset[str]) -> bool:
    if name in seen:
        return False
    for function in reversed(scope):
        if name in arguments(function):
            return True
        values = [value for target, value in assigned(function) if target == name]
        if values:
            return any(_given(value, scope, seen | {name}) for value in values)
    return False


def _file_names(kinds: Kinds, scratch: set[int]) -> Iterator[Construct]:
    """Yield each text that is the name of a file of data, where it may become a path: in a call or as a constant.

    ``scratch`` are the texts, by id, that name a file in a temporary folder.
    """
    spoken = {id(part) for item in each(kinds, ast.Raise, ast.JoinedStr) for part in ast.walk(item)}
    for item in each(kinds, ast.Constant):
        if _FILE_NAME.fullmatch(text := _literal(item)) and id(item) not in spoken | scratch:
            yield Construct("file", text, repr(text), _FILE, item.lineno)
