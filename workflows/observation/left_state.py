"""What a step leaves in modules, where another step may read it although no wire joins them."""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from types import FunctionType, MappingProxyType, ModuleType
from typing import Any, NamedTuple

from neusee.nodes.own_modules import own_modules
from neusee.workflows.keys.loaded_state import LoadedState, own_settings, settings
from neusee.workflows.keys.module_digest import source_of
from neusee.workflows.keys.module_origin import module_path
from neusee.workflows.keys.user_code import OwnCode
from neusee.workflows.observation.taints import Taint, taint

# --- lazy constants -------------------------------------------------------------------------------

# Names of a module that a function fills at its first call, with a value that no argument decides.
#
# ``global TABLE`` and ``TABLE = build()`` leave something in the module, but each step would leave
# the same. Where an argument may decide the value, or whether it is set, the name tells one step
# what another one was given.


_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
_ENDS = (ast.Return, ast.Raise)


class _Place(NamedTuple):
    """A statement in functions, with what decides whether it runs."""

    item: ast.AST
    decides: list[ast.expr]  #: the conditions around it
    local: set[str]  #: arguments and other local names of the functions around it
    shared: set[str]  #: names that the functions declare as global


def is_lazy_constant(tree: ast.Module, name: str) -> bool:
    """Return True if functions of a module set a name, and no argument of a function decides the
    value.
    """
    places = list(_places(tree, [], set(), set()))
    stores = [place for place in places if name in place.shared and name in _targets(place.item)]
    return bool(stores) and all(_is_free(store, places) for store in stores)


def _is_free(store: _Place, places: list[_Place]) -> bool:
    """Return True if no local name decides what a statement sets, or whether it is reached."""
    if not isinstance(store.item, ast.Assign | ast.AnnAssign) or store.item.value is None:
        return False
    ends = [
        place for place in places if isinstance(place.item, _ENDS) and place.local == store.local
    ]
    earlier = [end for end in ends if _line(end.item) < _line(store.item)]
    before = [*chain.from_iterable(end.decides for end in earlier)]
    return not any(
        _names(expression) & store.local
        for expression in [store.item.value, *store.decides, *before]
    )


def _places(
    item: ast.AST, decides: list[ast.expr], local: set[str], shared: set[str]
) -> Iterator[_Place]:
    """Yield the statements below a part of a syntax tree that stand in functions."""
    for child in ast.iter_child_nodes(item):
        inner, names, declared = decides, local, shared
        if isinstance(child, _FUNCTIONS):
            statements = [part for part in ast.walk(child) if isinstance(part, ast.Global)]
            declared = shared.union(*(statement.names for statement in statements))
            names = local | _locals(child) - declared
        elif isinstance(child, ast.If | ast.While | ast.IfExp):
            inner = [*decides, child.test]
        elif isinstance(child, ast.For | ast.AsyncFor):
            inner = [*decides, child.iter]
        if isinstance(child, ast.stmt) and not isinstance(child, _FUNCTIONS):
            yield _Place(child, inner, names, declared)
        yield from _places(child, inner, names, declared)


def _locals(function: ast.AST) -> set[str]:
    """Return the arguments of a function and the names that it sets."""
    arguments = {argument.arg for argument in ast.walk(function) if isinstance(argument, ast.arg)}
    return arguments | _stored(function)


def _targets(item: ast.AST) -> set[str]:
    """Return the names that a statement itself sets, not those that statements in it set."""
    if isinstance(item, ast.For | ast.AsyncFor):
        return _stored(item.target)
    if isinstance(item, ast.With | ast.AsyncWith):
        names = [context.optional_vars for context in item.items if context.optional_vars]
        return set[str]().union(*map(_stored, names))
    return (
        set()
        if isinstance(item, ast.ClassDef) or hasattr(item, "body") or hasattr(item, "cases")
        else _stored(item)
    )


def _stored(item: ast.AST) -> set[str]:
    return {
        name.id
        for name in ast.walk(item)
        if isinstance(name, ast.Name) and not isinstance(name.ctx, ast.Load)
    }


def _names(item: ast.AST) -> set[str]:
    return {name.id for name in ast.walk(item) if isinstance(name, ast.Name)}


def _line(item: ast.AST) -> int:
    return int(getattr(item, "lineno", 0))


# --- left state -----------------------------------------------------------------------------------

# What a step leaves in modules: another step may read it there, although no wire joins the two.
#
# The state of the user's modules is compared before and after a step, by what the keys count of it;
# so are the modules and classes of libraries that the code may change, and the settings of the
# process.


_UNLIKE = (bool, int, float, complex, str, bytes, type(None))  #: types whose equal values are alike
_SYSTEM = "sys"  #: the module in which Python itself leaves much
_Told = Callable[[], list[Taint]]
_ABSENT = object()


def watch_state(own: OwnCode) -> _Told:
    """Note what own modules and changed libraries hold; return what tells what has changed since
    then.
    """
    modules, others, now = _of_modules(own), _of_others(own), _settings()

    def told() -> list[Taint]:
        names = [*_changed_modules(own, modules), *_changed_others(own, others)]
        later = _settings()
        names += [
            f"a setting of the process, {name}"
            for name in now | later
            if now.get(name) != later.get(name)
        ]
        return [taint("memory", name) for name in dict.fromkeys(names)]

    return told


def is_of_library(left: Taint, own: OwnCode) -> bool:
    """Return True for something that a step left outside of its own modules, where code of any
    module may read it.
    """
    return left.kind == "memory" and not any(
        left.what.startswith(f"{module}.") for module in own.modules
    )


def _of_modules(own: OwnCode) -> dict[str, dict[str, str]]:
    """Return a digest of each value of the user's modules, by module and name; empty for None."""
    modules = {name: sys.modules.get(name) for name in own.modules}
    return {
        name: _digests(module, own)
        for name, module in modules.items()
        if isinstance(module, ModuleType)
    }


def _digests(module: ModuleType, own: OwnCode) -> dict[str, str]:
    values = {
        name: value for name, value in vars(module).copy().items() if not name.startswith("__")
    }
    return {name: _digest(module, name, value, own) for name, value in values.items()}


def _digest(module: ModuleType, name: str, value: Any, own: OwnCode) -> str:
    if value is None:
        return ""
    kind = type(value)  # an object may state another class, or raise if it is asked for it
    if issubclass(kind, ModuleType):
        return "module"
    if kind in _UNLIKE:
        return f"{kind.__name__} {value!r}"
    if kind is FunctionType and _is_usual(value):
        return f"function {id(value.__code__)} {value.__defaults__!r}"
    return LoadedState(module, (), own.modules.__contains__, lazy=False).digest({name: value})


def _is_usual(function: FunctionType) -> bool:
    """Return True for a function that holds numbers and words alone, and is compared in little
    time.
    """
    if function.__kwdefaults__ or function.__closure__ or vars(function):
        return False
    return all(type(default) in _UNLIKE for default in function.__defaults__ or ())


def _changed_modules(own: OwnCode, before: dict[str, dict[str, str]]) -> Iterator[str]:
    """Yield the full names of what changed in own modules, but for constants that are made at
    the first call.
    """
    for module, now in _of_modules(own).items():
        then = before.get(module, now)
        for name in dict.fromkeys([*then, *now]):
            new, old = now.get(name), then.get(name)
            if new == old or new == "module" or _is_unread(own, module, name):
                continue
            if not old and new and _is_lazy(module, name):
                continue
            yield f"{module}.{name}"


def _is_unread(own: OwnCode, module: str, name: str) -> bool:
    """Return True for a log: its module only writes to it, and no other module of the user has
    it.
    """
    if f"{module}.{name}" not in own.unread:
        return False
    home = sys.modules[module]
    value = getattr(home, name, None)
    others = [
        sys.modules[other]
        for other in {*own_modules(), *own.modules} - {module}
        if other in sys.modules
    ]
    attributes = chain.from_iterable(vars(other).values() for other in others)
    return not any(attribute is value or attribute is home for attribute in attributes)


def _is_lazy(module: str, name: str) -> bool:
    path = module_path(module)
    if path is None:
        return False
    return is_lazy_constant(ast.parse(source_of(module, Path(path))[0]), name)


def _of_others(own: OwnCode) -> dict[str, dict[str, Any]]:
    """Return the attributes of the modules, classes and objects of libraries that own code may
    change.
    """
    names = [name for name in own.changed if "()" not in name and not name.startswith(".")]
    values = {name: _found(name) for name in names}
    attributes = {name: _attributes(value) for name, value in values.items() if value is not None}
    for name in names:
        place, _, last = name.rpartition(".")
        parts = getattr(_found(place), "__dict__", {}) if place else {}
        attribute = {last: parts[last]} if last in parts else {}
        attributes.setdefault(place, attribute)
    return attributes


def _found(name: str) -> Any:
    """Return what has a full name, or None for a name that nothing has."""
    parts = name.split(".")
    depth = next((n for n in range(len(parts), 0, -1) if ".".join(parts[:n]) in sys.modules), 0)
    if not depth or parts[0] == _SYSTEM:
        return None
    value: Any = sys.modules[".".join(parts[:depth])]
    for attribute in parts[depth:]:
        value = getattr(value, "__dict__", {}).get(attribute)
    return value


def _attributes(value: Any) -> dict[str, Any]:
    """Return the attributes of an object, or a digest of one that is a list, a dict or an array.

    The entries of a dict in an attribute of an object count too: a table of a library is often a
    class around one.
    """
    names = getattr(value, "__dict__", None)
    if isinstance(names, dict | MappingProxyType):
        attributes = {
            name: attribute for name, attribute in names.copy().items() if not name.startswith("__")
        }
        tables = (
            []
            if isinstance(value, ModuleType | type)
            else [n for n, attribute in attributes.items() if type(attribute) is dict]
        )
        for table in tables:
            attributes |= {
                f"{table}[{key!r}]": entry
                for key, entry in attributes[table].items()
                if isinstance(key, str)
            }
        return attributes
    return {"": LoadedState(sys, (), lambda _: False).digest({"value": value})}


def _changed_others(own: OwnCode, before: dict[str, dict[str, Any]]) -> Iterator[str]:
    for place, now in _of_others(own).items():
        then = before.get(place, now)
        for name in dict.fromkeys([*then, *now]):
            new, old = now.get(name, _ABSENT), then.get(name, _ABSENT)
            lazy = old is _ABSENT and _is_of_package(new, place)
            if not (isinstance(new, ModuleType) or lazy or _is_alike(new, old)):
                yield f"{place}.{name}".rstrip(".")


def _is_of_package(value: Any, place: str) -> bool:
    """Return True for a function or a class of the package itself, which it imports when it is
    first asked for.
    """
    return str(getattr(value, "__module__", "")).partition(".")[0] == place.partition(".")[0]


def _is_alike(value: Any, other: Any) -> bool:
    return value is other or (
        type(value) is type(other) and type(value) in _UNLIKE and value == other
    )


def _settings() -> dict[str, str]:
    """Return the settings of the process that keys have."""
    return settings() | own_settings(reads_time=False)
