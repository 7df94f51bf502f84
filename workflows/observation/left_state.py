"""What a step leaves in modules: another step may read it there, although no wire joins the two.

The state of the user's modules is compared before and after a step, by what the keys count of it; so are the modules
and classes of libraries that the code may change, and the settings of the process.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FunctionType, MappingProxyType, ModuleType
from typing import Any

from neusee.nodes.own_modules import own_modules
from neusee.workflows.keys.loaded_source import source_of
from neusee.workflows.keys.loaded_state import LoadedState
from neusee.workflows.keys.module_origin import module_path
from neusee.workflows.keys.process_settings import own_settings, settings
from neusee.workflows.keys.user_code import OwnCode
from neusee.workflows.observation.lazy_constants import is_lazy_constant
from neusee.workflows.observation.taints import Taint, taint

_UNLIKE = (bool, int, float, complex, str, bytes, type(None))  #: types whose equal values are alike
_SYSTEM = "sys"  #: the module in which Python itself leaves much
_Told = Callable[[], list[Taint]]
_ABSENT = object()


def watch_state(own: OwnCode) -> _Told:
    """Note what own modules and changed libraries hold; return what tells what has changed since then."""
    modules, others, now = _of_modules(own), _of_others(own), _settings()

    def told() -> list[Taint]:
        names = [*_changed_modules(own, modules), *_changed_others(own, others)]
        later = _settings()
        names += [f"a setting of the process, {name}" for name in now | later if now.get(name) != later.get(name)]
        return [taint("memory", name) for name in dict.fromkeys(names)]

    return told


def is_of_library(found: Taint, own: OwnCode) -> bool:
    """Return True for something that a step left outside of its own modules, where code of any module may read it."""
    return found.kind == "memory" and not any(found.what.startswith(f"{module}.") for module in own.modules)


def _of_modules(own: OwnCode) -> dict[str, dict[str, str]]:
    """Return a digest of each value of the user's modules, by module and name; empty for None."""
    found = {name: module for name in own.modules if isinstance(module := sys.modules.get(name), ModuleType)}
    return {name: _digests(module, own) for name, module in found.items()}


def _digests(module: ModuleType, own: OwnCode) -> dict[str, str]:
    values = {name: value for name, value in vars(module).copy().items() if not name.startswith("__")}
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
    """Return True for a function that holds numbers and words alone, and is compared in little time."""
    if function.__kwdefaults__ or function.__closure__ or vars(function):
        return False
    return all(type(part) in _UNLIKE for part in function.__defaults__ or ())


def _changed_modules(own: OwnCode, before: dict[str, dict[str, str]]) -> Iterator[str]:
    """Yield the full names of what changed in own modules, but for constants that are made at the first call."""
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
    """Return True for a log: its module only writes to it, and no other module of the user has it."""
    if f"{module}.{name}" not in own.unread:
        return False
    home = sys.modules[module]
    value = getattr(home, name, None)
    others = [sys.modules[each] for each in {*own_modules(), *own.modules} - {module} if each in sys.modules]
    return not any(part is value or part is home for each in others for part in vars(each).values())


def _is_lazy(module: str, name: str) -> bool:
    path = module_path(module)
    if path is None:
        return False
    return is_lazy_constant(ast.parse(source_of(module, Path(path))[0]), name)


def _of_others(own: OwnCode) -> dict[str, dict[str, Any]]:
    """Return the attributes of the modules, classes and objects of libraries that own code may change."""
    names = [name for name in own.changed if "()" not in name and not name.startswith(".")]
    found = {name: _attributes(value) for name in names if (value := _found(name)) is not None}
    for name in names:
        place, _, last = name.rpartition(".")
        parts = getattr(_found(place), "__dict__", {}) if place else {}
        found.setdefault(place, {last: parts[last]} if last in parts else {})
    return found


def _found(name: str) -> Any:
    """Return what has a full name, or None for a name that nothing has."""
    parts = name.split(".")
    most = next((n for n in range(len(parts), 0, -1) if ".".join(parts[:n]) in sys.modules), 0)
    if not most or parts[0] == _SYSTEM:
        return None
    found: Any = sys.modules[".".join(parts[:most])]
    for part in parts[most:]:
        found = getattr(found, "__dict__", {}).get(part)
    return found


def _attributes(value: Any) -> dict[str, Any]:
    """Return the attributes of an object, or a digest of one that is a list, a dict or an array.

    The entries of a dict in an attribute of an object count too: a table of a library is often a class around one.
    """
    names = getattr(value, "__dict__", None)
    if isinstance(names, dict | MappingProxyType):
        found = {name: part for name, part in names.copy().items() if not name.startswith("__")}
        tables = [] if isinstance(value, ModuleType | type) else [n for n, part in found.items() if type(part) is dict]
        for table in tables:
            found |= {f"{table}[{key!r}]": entry for key, entry in found[table].items() if isinstance(key, str)}
        return found
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
    """Return True for a function or a class of the package itself, which it imports when it is first asked for."""
    return str(getattr(value, "__module__", "")).partition(".")[0] == place.partition(".")[0]


def _is_alike(one: Any, other: Any) -> bool:
    return one is other or (type(one) is type(other) and type(one) in _UNLIKE and one == other)


def _settings() -> dict[str, str]:
    """Return the settings of the process that keys have."""
    return settings() | own_settings(reads_time=False)
