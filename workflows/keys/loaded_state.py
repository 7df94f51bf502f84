"""State of the process that affects the results of code: the values in loaded modules, and
settings.
"""

from __future__ import annotations

import codecs
import functools
import hashlib
import inspect
import io
import locale
import mmap
import operator
import random
import re
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from enum import Enum
from fractions import Fraction
from pathlib import Path, PurePath
from types import (
    BuiltinFunctionType,
    CellType,
    FunctionType,
    MethodType,
    ModuleType,
    SimpleNamespace,
)
from typing import Any

import numpy as np
import torch
import xxhash
from torch import nn

from neusee.nodes import Node
from neusee.nodes.precision import tf32_setting
from neusee.workflows.keys.cache_key import OWN_USUAL, USUAL, is_own
from neusee.workflows.keys.sealed_files import bytes_of
from neusee.workflows.keys.source_summary import Summary, function_code, read_names, written_only

# --- loaded state ---------------------------------------------------------------------------------

# State of a loaded module: the values of its constants, tables, default arguments and closures, and
# the functions that it names.
#
# The source of a module only describes how its names get their values. A process computes with the
# values themselves: a table that another module filled, a constant or function that was replaced, a
# default argument that was computed at import. Values of classes of other packages count by their
# type alone, also where their own methods fail.


_DISPATCH = getattr(
    functools.singledispatch(str), "__code__", None
)  #: the code of a single-dispatch function, whose closure holds a cache
#: attributes of a class that follow from its source
_SKIPPED = re.compile(r"__\w+__|_abc_\w*|model_\w+|__pydantic\w*")
#: hooks that affect no result: shape, cost, and an example call
_FORETELLING = frozenset({"shape", "work", "example"})
_KINDS: tuple[tuple[str, tuple[type, ...]], ...] = (
    ("text", (str, PurePath)),
    ("object", (Enum,)),
    (
        "plain",
        (
            bool,
            int,
            float,
            complex,
            bytes,
            type(None),
            type(...),
            range,
            slice,
            re.Pattern,
            Fraction,
        ),
    ),
    ("plain", (torch.dtype, torch.device, torch.Size, np.dtype, np.generic)),
    ("plain", (operator.itemgetter, operator.attrgetter, operator.methodcaller)),
    ("builtin", (BuiltinFunctionType,)),
    ("module", (ModuleType,)),
    ("function", (FunctionType,)),
    ("class", (type,)),
    ("array", (torch.Tensor, np.ndarray)),
    (
        "changing",
        (
            torch.Generator,
            np.random.Generator,
            np.random.RandomState,
            random.Random,
            io.IOBase,
            mmap.mmap,
        ),
    ),
    ("table", (Mapping,)),
    ("list", (list, tuple, deque)),
    ("set", (set, frozenset)),
    ("node", (Node,)),
    ("partial", (functools.partial,)),
    ("method", (MethodType,)),
    ("cell", (CellType,)),
    ("property", (property,)),
    ("wrapped", (staticmethod, classmethod, functools.cached_property, functools.partialmethod)),
)  #: the description used for values of each type; any other value is described as an object


class _Hows(dict[type, str]):
    """Name of the description used for the values of each type."""

    def __missing__(self, kind: type) -> str:
        # an iterator changes whenever it is read
        default_kind = "changing" if hasattr(kind, "__next__") else "object"
        self[kind] = next(
            (description for description, kinds in _KINDS if issubclass(kind, kinds)), default_kind
        )
        return self[kind]


_HOW = _Hows()


class LoadedState:
    """The state of a loaded module, as a digest, with the modules of the functions and classes that
    it refers to.
    """

    def __init__(
        self,
        module: ModuleType,
        functions: Collection[str],
        followed: Callable[[str], bool],
        lazy: bool = True,
    ) -> None:
        """Describe the state of a module; unless ``lazy`` is set, omit the values of each
        ``cached_property``, since they follow from the rest.
        """
        #: names of the functions and classes that the values refer to, by module
        self.modules: dict[str, set[str]] = {}
        #: functions of the module whose loaded code differs from its source file
        self.replaced: list[str] = []
        #: reason why a value cannot be covered, such as a generator in it, by the name of the value
        self.changing: dict[str, str] = {}
        self._changes: list[str] = []
        self._holds: dict[int, list[str]] = {}  # changing parts of objects that occur again, by id
        self._name, self._file = module.__name__, getattr(module, "__file__", "") or ""
        self._folder = self._file.rpartition("/")[0] or "."
        self._functions, self._followed, self._lazy = frozenset(functions), followed, lazy
        self._seen: dict[int, int] = {}
        # objects whose id is in _seen, so that no other object gets the same id
        self._kept: list[Any] = []

    def digest(self, values: Mapping[str, Any]) -> str:
        """Return the digest of named values of the module; names such as ``__file__`` do not
        count.
        """
        described_values: list[Any] = []
        for name in sorted(values):
            if name == "__getattr__" or not (name.startswith("__") and name.endswith("__")):
                described_values.append((name, self._shallow(values[name])))
                # `_shallow` noted changing objects inside the value
                if self._changes:
                    self.changing[name] = self._changes[0]
                    self._changes = []
        return xxhash.xxh3_128_hexdigest(repr(described_values).encode(errors="surrogatepass"))

    def _shallow(self, value: Any) -> Any:
        """Return a description of a value as text and tuples, or only its type if its nesting is
        too deep for Python's recursion limit.
        """
        try:
            return self._of(value)
        except RecursionError:
            return self._unread(value, "is nested too deeply")

    def _of(self, value: Any) -> Any:
        """Return a description of a value as text and tuples that are the same in each process; an
        object that occurs again is described by its number.
        """
        if value is None:
            return _NOTHING
        kind = _HOW[type(value)]
        number_of_object, object_id, changes_before = self._seen, id(value), len(self._changes)
        try:
            # short descriptions are repeated
            if kind in _ATOMS:
                return _DESCRIBED[kind](self, value)
            if object_id in number_of_object:
                # its changing parts count for this name too
                self._changes += self._holds.get(object_id, ())
                return "again", number_of_object[object_id]
            number_of_object[object_id] = len(number_of_object)
            # as long as it lives, no other object gets its id
            self._kept.append(value)
            description = _DESCRIBED[kind](self, value)
        except RecursionError:
            raise  # the depth at which it fails depends on the calling functions
        except Exception as error:  # the methods of a class may do anything
            description = self._unread(
                value, f"could not be read ({type(error).__name__}: {error})"
            )
        if len(self._changes) > changes_before:
            # kept for the next occurrence of the object
            self._holds[object_id] = self._changes[changes_before:]
        return description

    def _unread(self, value: Any, why: str) -> str:
        """Return the type of a value whose parts cannot be described; note the value as changing if
        its class is built in or is followed by source.
        """
        kind = type(value)
        if kind.__module__ == "builtins" or self._followed(_home(kind)):
            self._changes.append(f"{kind.__name__}, which {why}")
        return self._typed(value)

    def _plain(self, value: Any) -> Any:
        return type(value).__name__, repr(value)

    def _text(self, value: Any) -> Any:
        return type(value).__name__, self._placed(str(value))

    def _builtin(self, value: Any) -> Any:
        return type(value).__name__, value.__qualname__

    def _module(self, value: Any) -> Any:
        return type(value).__name__, self._noted(value.__name__)

    def _array(self, value: Any) -> Any:
        """Describe a tensor or an array by its type, shape and the digest of its elements."""
        if not isinstance(value, np.ndarray):
            return type(value).__name__, *_array(value)
        base_array = np.ndarray.view(value, np.ndarray)  # a subclass may refuse to be read
        # the bytes of an array of objects are memory addresses
        if base_array.dtype.hasobject:
            return (
                type(value).__name__,
                str(base_array.dtype),
                base_array.shape,
                self._of(base_array.tolist()),
            )
        # the masked elements of an array count too
        mask = np.ma.getmask(value) if isinstance(value, np.ma.MaskedArray) else np.ma.nomask
        return (
            type(value).__name__,
            *_array(base_array),
            *(_array(mask) if isinstance(mask, np.ndarray) else ()),
        )

    def _changing(self, value: Any) -> Any:
        """Note an object that changes while a process runs, such as a generator or a file, and
        return its type.
        """
        self._changes.append(f"{type(value).__name__}, which changes while a process runs")
        return self._typed(value)

    def _table(self, value: Any) -> Any:
        return self._typed(value), self._pairs(list(value.items()))

    def _pairs(self, pairs: Iterable[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
        """Return descriptions of keys and values, in their order."""
        descriptions = []
        for key, item in pairs:
            descriptions.append((self._of(key), self._of(item)))
        return descriptions

    def _list(self, value: Any) -> Any:
        return self._typed(value), [self._of(item) for item in value]

    def _set(self, value: Any) -> Any:
        return self._typed(value), sorted((self._of(item) for item in value), key=repr)

    def _node(self, value: Any) -> Any:
        return "node", self._of(value.fn), [self._of(hook) for hook in _hooks(value)]

    def _partial(self, value: Any) -> Any:
        return "partial", self._of(value.func), self._of(value.args), self._of(value.keywords)

    def _method(self, value: Any) -> Any:
        return "method", self._of(value.__func__), self._of(value.__self__)

    def _cell(self, value: Any) -> Any:
        return self._of(_content(value))

    def _property(self, value: Any) -> Any:
        return "property", self._of(value.fget), self._of(value.fset)

    def _wrapped(self, value: Any) -> Any:
        return type(value).__name__, self._of(
            getattr(value, "__func__", None) or getattr(value, "func", None)
        )

    def _object(self, value: Any) -> Any:
        """Return the description of an object that is no container: its attributes if the source of
        its class is followed, otherwise its type.

        A `torch.nn.Module` always counts by its attributes: other code may have set its weights.
        """
        kind = type(value)
        if kind is SimpleNamespace or issubclass(kind, nn.Module) or self._followed(_home(kind)):
            attributes = [
                (name, attribute)
                for name, attribute in _attributes(value)
                if self._lazy or not _is_lazy(kind, name)
            ]
            return self._typed(value), [
                (name, self._of(attribute)) for name, attribute in attributes
            ]
        wrapped = _wrapped(value, kind)
        return self._typed(value), self._of(wrapped) if callable(wrapped) else ""

    def _function(self, function: FunctionType) -> Any:
        """Return the description of a function: its module and name; for a local function also its
        default arguments and closure.
        """
        module_name, code = str(function.__globals__.get("__name__")), function.__code__
        # described by its implementations, since its closure holds a cache
        if code is _DISPATCH:
            return "singledispatch", self._pairs(_implementations(function))
        is_of_file = self._noted_function(function, module_name)
        # the digest of its own module covers it
        if not is_of_file and _found(module_name, function):
            return "function", module_name, code.co_qualname, "", []
        # a function of another module counts by its byte code, if that module is followed
        code_digest = function_code(code) if not is_of_file and self._followed(module_name) else ""
        defaults_and_closure = (
            function.__defaults__,
            function.__kwdefaults__,
            function.__closure__,
        )
        described = [item and self._of(item) for item in defaults_and_closure]
        if is_of_file and is_own(module_name):
            # a call may have left values in the attributes of a user's function
            described += self._left_in(function)
        return "function", module_name, code.co_qualname, code_digest, described

    def _left_in(self, function: FunctionType) -> list[tuple[str, Any]]:
        """Return the attributes of a function, in which a call may have left values."""
        return [
            (name, self._of(attribute))
            for name, attribute in vars(function).items()
            if name != "__wrapped__"
        ]

    def _noted_function(self, function: FunctionType, home: str) -> bool:
        """Note a function that comes from another module, or whose loaded code differs from its
        file. Return True if the function comes from the file of this module.
        """
        code = function.__code__
        is_of_file = home == self._name and code.co_filename == self._file
        if home != self._name:
            self._noted(home, function.__qualname__)
        if is_of_file and self._functions and function_code(code) not in self._functions:
            self.replaced.append(function.__qualname__)
        return is_of_file

    def _class(self, kind: type) -> Any:
        """Describe a class by its name; a class of this module also by its bases and attributes."""
        name = ("class", self._noted(_home(kind), kind.__qualname__), kind.__qualname__)
        if kind.__module__ != self._name:
            return name
        # the first class in ``__mro__`` is the class itself
        bases = [(base.__module__, base.__qualname__) for base in kind.__mro__[1:]]
        for base in kind.__mro__[1:]:
            self._noted(base.__module__, base.__qualname__)
        class_attributes = [
            (name, attribute)
            for name, attribute in vars(kind).items()
            if not _SKIPPED.fullmatch(name) or _is_method(attribute)
        ]
        return name, bases, [(name, self._of(attribute)) for name, attribute in class_attributes]

    def _typed(self, value: Any) -> str:
        """Return the full name of the type of a value, and note the module of the type."""
        kind = type(value)
        return f"{self._noted(_home(kind), kind.__qualname__)}.{kind.__qualname__}"

    def _noted(self, module: str, name: str = "") -> str:
        """Note a function, a class or (with an empty name) a whole module that the state refers to,
        if the source of its module is followed.
        """
        if module != self._name and self._followed(module):
            self.modules.setdefault(module, set()).add(name.partition(".")[0])
        return module

    def _placed(self, text: str) -> str:
        """Return a text with the folder of the module replaced, so that the text does not depend on
        the place of installation.
        """
        return text.replace(self._folder, "<folder>") if self._folder in text else text


_NOTHING = ("NoneType", "None")
_ATOMS = frozenset({"plain", "text", "builtin", "module"})
#: the method that describes a value, by the name in `_KINDS`
_DESCRIBED: dict[str, Callable[[LoadedState, Any], Any]] = {
    kind: getattr(LoadedState, f"_{kind}") for kind, _ in _KINDS
}


def counted_values(
    module: ModuleType, summary: Summary, free: Collection[str], root: bool
) -> dict[str, Any]:
    """Return the values of a loaded module that its digest includes; for a node's own module, those
    that its nodes use.
    """
    values = {name: value for name, value in vars(module).items() if name not in free}
    node_names = _names_of_nodes(values) if root else []
    if node_names:
        networks = [name for name, value in values.items() if _is_network(value)]
        # "_": statements that run at import
        counted_names = values.keys() & read_names(
            summary.statements, [*node_names, *networks, "_"]
        )
    else:
        # without names that are only written, such as logs
        counted_names = values.keys() - written_only(summary.statements)
    return {name: value for name, value in values.items() if name in counted_names}


def _names_of_nodes(values: Mapping[str, Any]) -> list[str]:
    """Return the names under which a module holds nodes."""
    return [name for name, value in values.items() if issubclass(type(value), Node)]


def without_modules(
    package: str, values: Mapping[str, Any], left_out: Callable[[str], bool]
) -> dict[str, Any]:
    """Return the values of a package without its submodules for which ``left_out`` returns True."""
    own_submodules = {
        name for name, value in values.items() if value is sys.modules.get(f"{package}.{name}")
    }
    return {
        name: value
        for name, value in values.items()
        if name not in own_submodules or not left_out(f"{package}.{name}")
    }


def _hooks(node: Node) -> Iterator[Any]:
    """Yield the hooks of a node that may affect a result, and its alternative forms."""
    for name in node.hooks.__slots__:
        if name not in _FORETELLING:
            yield getattr(node.hooks, name)
    yield from (node.channel_sum_form, node.low_rank_form)


def _array(value: Any) -> tuple[Any, ...]:
    """Return the data type, the shape and the digest of the elements of a tensor or an array."""
    if isinstance(value, torch.Tensor):
        # such tensors have no elements that can be read as a block
        if value.device.type == "meta" or value.layout != torch.strided:
            return str(value.dtype), tuple(value.shape)
        elements = value.detach().cpu().contiguous().reshape(-1)
        element_bytes: Any = b""
        if elements.numel():
            # torch may conjugate or negate a tensor by a flag alone, without new elements
            element_bytes = elements.resolve_conj().resolve_neg().view(torch.uint8).numpy().data
    # booleans, integers, floats and complex numbers
    elif value.flags.c_contiguous and value.dtype.kind in "biufc":
        element_bytes = value.data  # without a copy
    else:
        element_bytes = value.tobytes()
    return str(value.dtype), tuple(value.shape), xxhash.xxh3_128_hexdigest(element_bytes)


def _attributes(value: Any) -> list[tuple[str, Any]]:
    """Return the attributes of an object, from its ``__dict__`` and its slots."""
    slots = set[str]()
    for base in type(value).__mro__:
        slots.update(_slot_names(vars(base).get("__slots__", ())))
    slot_values = {
        slot: getattr(value, slot)
        for slot in sorted(slots)
        if not slot.startswith("__") and hasattr(value, slot)
    }
    return list({**slot_values, **getattr(value, "__dict__", {})}.items())


def _home(kind: type) -> str:
    """Return the name of the module of a class, or an empty text if its ``__module__`` is not a
    text.
    """
    return kind.__module__ if isinstance(kind.__module__, str) else ""


def _is_network(value: Any) -> bool:
    """Return True for a subclass of `torch.nn.Module`."""
    return issubclass(type(value), type) and issubclass(value, nn.Module)


def _is_lazy(kind: type, name: str) -> bool:
    """Return True for an attribute whose value a ``cached_property`` of its class computes."""
    return isinstance(getattr(kind, name, None), functools.cached_property)


def _slot_names(slots: Any) -> tuple[str, ...]:
    """Return the names in ``__slots__``, which may be a single text."""
    return (slots,) if isinstance(slots, str) else tuple(slots)


def _content(cell: CellType) -> Any:
    """Return the value in a cell of a closure, or None for an empty cell."""
    try:
        return cell.cell_contents
    except ValueError:
        return None


def _found(module: str, function: FunctionType) -> bool:
    """Return True if the module holds the function under the function's own name, so that the
    module's source determines it.
    """
    holder: Any = sys.modules.get(module)
    for name in function.__qualname__.split("."):
        holder = getattr(holder, name, None)
    return holder is function


def _is_method(attribute: Any) -> bool:
    return isinstance(attribute, FunctionType | staticmethod | classmethod | property)


def _implementations(function: FunctionType) -> list[tuple[type, Any]]:
    """Return the implementations of a ``singledispatch`` function, sorted by the name of the
    type.
    """
    kinds: Mapping[type, Any] = function.registry  # type: ignore[attr-defined]
    return sorted(kinds.items(), key=lambda item: f"{item[0].__module__}.{item[0].__qualname__}")


def _wrapped(value: Any, kind: type) -> Any:
    """Return the object that ``value`` wraps (``__wrapped__``), or None."""
    # `getattr_static`, since a class with `__getattr__` may answer to any name
    if kind.__module__ == "typing" or inspect.getattr_static(value, "__wrapped__", None) is None:
        return None
    return value.__wrapped__


# --- process settings -----------------------------------------------------------------------------

# Settings of a process that affect the results of any code: the number types of torch, and the code
# of `neusee.workflows`.
#
# The number of threads and deterministic algorithms change results only within rounding and do not
# count.


_SETTING_KINDS, _is_cast = ("cpu", "cuda"), torch.is_autocast_enabled
_HALF = float("0.5")
#: how NumPy prints numbers in a new process
_PRINTED = {
    "precision": 8,
    "threshold": 1000,
    "edgeitems": 3,
    "linewidth": 75,
    "suppress": False,
    "nanstr": "nan",
} | {
    "infstr": "inf",
    "formatter": None,
    "sign": "-",
    "floatmode": "maxprec",
}
_SMALLEST = sys.float_info.min  #: half of it is 0 if the process flushes subnormal numbers to 0

# This call makes torch import what it needs now: a process may later lose the right to read files.
torch.get_default_device()


def settings() -> dict[str, str]:
    """Return the settings of torch and Python that differ from those of a new process."""
    present_settings = {
        "default dtype": str(torch.get_default_dtype()),
        "default device": str(torch.get_default_device()),
        "matmul precision": torch.get_float32_matmul_precision(),
        "TF32": str(tf32_setting()),
        "autocast": (
            ", ".join(
                f"{kind} {torch.get_autocast_dtype(kind)}"
                for kind in _SETTING_KINDS
                if _is_cast(kind)
            )
            or "off"
        ),
        # the product is 0 if subnormal numbers are flushed to 0
        "numbers below 1e-308": "kept" if _SMALLEST * _HALF else "0",
        "assert statements": (
            f"left out by -{'O' * sys.flags.optimize}" if sys.flags.optimize else "run"
        ),
    }
    return {name: value for name, value in present_settings.items() if value != USUAL[name]}


def own_settings(reads_time: bool) -> dict[str, str]:
    """Return the settings that differ from their defaults and that neusee itself ignores, but that
    code of a user may read.

    With ``reads_time`` the code may read the time zone.
    """
    present_settings = {
        "floating-point errors": _errors(),
        "printed numbers": _printing(),
        "encoding of texts": _encoding(),
    }
    present_settings["code at the start of Python"] = _code_at_start()
    if reads_time:
        present_settings["time zone"] = _time_zone()
    return {name: value for name, value in present_settings.items() if value != USUAL[name]}


def _errors() -> str:
    """Return the kinds of floating-point error for which NumPy raises an exception or calls a
    function. Warnings affect no result.
    """
    error_actions = [
        f"{name} {action}"
        for name, action in np.geterr().items()
        if action in ("raise", "call", "log")
    ]
    return ", ".join(error_actions) or OWN_USUAL["floating-point errors"]


def _printing() -> str:
    """Return the options with which NumPy prints numbers, where they differ from those of a new
    process.

    The option ``legacy`` does not count: colour-science sets it, and whether it is loaded affects
    no result.
    """
    print_options: Mapping[str, object] = {**np.get_printoptions()}
    changed_options = [
        f"{name}={print_options[name]}"
        for name, value in _PRINTED.items()
        if print_options.get(name, value) != value
    ]
    return ", ".join(changed_options) or OWN_USUAL["printed numbers"]


def _encoding() -> str:
    """Return the default encoding of text files in this process."""
    return codecs.lookup(locale.getpreferredencoding(False)).name


def _code_at_start() -> str:
    """Return a digest of the modules `sitecustomize` and `usercustomize`, with which a user or an
    administrator changes Python when it starts.
    """
    start_files = [
        getattr(sys.modules.get(name), "__file__", None)
        for name in ("sitecustomize", "usercustomize")
    ]
    file_contents = [
        bytes_of(file) for file in start_files if file is not None and Path(file).is_file()
    ]
    if not file_contents:
        return OWN_USUAL["code at the start of Python"]
    return hashlib.blake2b(b"\0".join(file_contents), digest_size=4).hexdigest()


def _time_zone() -> str:
    """Return the names of the time zone and a digest of its offsets from UTC, sampled once a week
    from 1970 to 2040.
    """
    # s since 1970: up to 2040, week by week
    weeks = range(0, 2_208_988_800, 7 * 86_400)
    offsets = [time.localtime(week).tm_gmtoff for week in weeks]
    if not any(offsets):
        return OWN_USUAL["time zone"]
    return (
        f"{'/'.join(time.tzname)}"
        f" {hashlib.blake2b(repr(offsets).encode(), digest_size=4).hexdigest()}"
    )


@functools.cache
def workflows_digest() -> str:
    """Return the digest of all source files of `neusee.workflows`, used for a node that imports any
    of them.
    """
    folder = Path(__file__).parents[1]
    hasher = hashlib.blake2b(digest_size=16)
    for path in sorted(folder.rglob("*.py")):
        hasher.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return hasher.hexdigest()
