"""State that a step leaves in modules, where another step may read it although no input connects
the two.
"""

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

# Names of a module that a function sets at its first call, to a value that depends on no argument.
#
# ``global TABLE`` and ``TABLE = build()`` leave a value in the module, but each step would leave
# the same value. If the value, or whether it is set, may depend on an argument, the name passes
# information from one step to another.


_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
_ENDS = (ast.Return, ast.Raise)


class _Place(NamedTuple):
    """A statement inside functions, with the conditions that decide whether it runs."""

    item: ast.AST
    decides: list[ast.expr]  #: the conditions and loops around it
    local: set[str]  #: arguments and other local names of the functions around it
    shared: set[str]  #: names that the functions declare as global


def is_lazy_constant(tree: ast.Module, name: str) -> bool:
    """Return True if functions of a module set a name, and its value depends on no argument or
    local name.
    """
    statements = list(_places(tree, [], set(), set()))
    assignments = [
        statement
        for statement in statements
        if name in statement.shared and name in _targets(statement.item)
    ]
    return bool(assignments) and all(_is_free(store, statements) for store in assignments)


def _is_free(store: _Place, places: list[_Place]) -> bool:
    """Return True if no local name affects the value that a statement sets, or whether the
    statement runs.
    """
    if not isinstance(store.item, ast.Assign | ast.AnnAssign) or store.item.value is None:
        return False
    exits = [
        statement
        for statement in places
        if isinstance(statement.item, _ENDS) and statement.local == store.local
    ]
    # an earlier return or raise decides whether the assignment is reached
    earlier = [end for end in exits if _line(end.item) < _line(store.item)]
    conditions_before = [*chain.from_iterable(end.decides for end in earlier)]
    return not any(
        _names(expression) & store.local
        for expression in [store.item.value, *store.decides, *conditions_before]
    )


def _places(
    item: ast.AST, decides: list[ast.expr], local: set[str], shared: set[str]
) -> Iterator[_Place]:
    """Yield the statements inside functions, below a part of a syntax tree."""
    for child in ast.iter_child_nodes(item):
        conditions, local_names, global_names = decides, local, shared
        if isinstance(child, _FUNCTIONS):
            global_statements = [part for part in ast.walk(child) if isinstance(part, ast.Global)]
            global_names = shared.union(*(statement.names for statement in global_statements))
            # a name that is declared global is not local
            local_names = local | _locals(child) - global_names
        elif isinstance(child, ast.If | ast.While | ast.IfExp):
            conditions = [*decides, child.test]
        elif isinstance(child, ast.For | ast.AsyncFor):
            conditions = [*decides, child.iter]
        if isinstance(child, ast.stmt) and not isinstance(child, _FUNCTIONS):
            yield _Place(child, conditions, local_names, global_names)
        yield from _places(child, conditions, local_names, global_names)


def _locals(function: ast.AST) -> set[str]:
    """Return the arguments of a function and the names that it sets."""
    arguments = {argument.arg for argument in ast.walk(function) if isinstance(argument, ast.arg)}
    return arguments | _stored(function)


def _targets(item: ast.AST) -> set[str]:
    """Return the names that a statement itself sets, without the statements in its body."""
    if isinstance(item, ast.For | ast.AsyncFor):
        return _stored(item.target)
    if isinstance(item, ast.With | ast.AsyncWith):
        targets = [context.optional_vars for context in item.items if context.optional_vars]
        return set[str]().union(*map(_stored, targets))
    return (
        set()
        # statements in a body are listed by themselves
        if isinstance(item, ast.ClassDef) or hasattr(item, "body") or hasattr(item, "cases")
        else _stored(item)
    )


def _stored(item: ast.AST) -> set[str]:
    """Return the names that are set or deleted in a part of a syntax tree."""
    return {
        name.id
        for name in ast.walk(item)
        if isinstance(name, ast.Name) and not isinstance(name.ctx, ast.Load)
    }


def _names(item: ast.AST) -> set[str]:
    """Return all names in a part of a syntax tree."""
    return {name.id for name in ast.walk(item) if isinstance(name, ast.Name)}


def _line(item: ast.AST) -> int:
    """Return the line of a part of a syntax tree, or 0."""
    return int(getattr(item, "lineno", 0))


# --- left state -----------------------------------------------------------------------------------

# State that a step leaves in modules: another step may read it there, although no input connects
# the two.
#
# The state of the user's modules is compared before and after a step, as far as keys cover it. So
# are the modules and classes of libraries that the code may change, and the settings of the
# process.


#: types whose values are compared by ``==``
_COMPARED_BY_VALUE = (bool, int, float, complex, str, bytes, type(None))
_SYSTEM = "sys"  #: the module that Python itself changes often; it is not compared
_Told = Callable[[], list[Taint]]
_ABSENT = object()


def watch_state(own: OwnCode) -> _Told:
    """Note the state of the user's modules and of libraries that they may change; return a function
    that returns a taint for each later change.
    """
    # digests and attributes before the step
    modules, of_libraries, settings_before = _of_modules(own), _of_others(own), _settings()

    def told() -> list[Taint]:
        names = [*_changed_modules(own, modules), *_changed_others(own, of_libraries)]
        settings_after = _settings()
        names += [
            f"a setting of the process, {name}"
            for name in settings_before | settings_after
            if settings_before.get(name) != settings_after.get(name)
        ]
        return [taint("memory", name) for name in dict.fromkeys(names)]

    return told


def is_of_library(left: Taint, own: OwnCode) -> bool:
    """Return True if the change is in memory outside of the modules of the user's node, where
    code of any module may read it.
    """
    return left.kind == "memory" and not any(
        left.what.startswith(f"{module}.") for module in own.modules
    )


def _of_modules(own: OwnCode) -> dict[str, dict[str, str]]:
    """Return a digest of each value of the user's modules, by module and name; the digest of None
    is empty.
    """
    modules = {name: sys.modules.get(name) for name in own.modules}
    return {
        name: _digests(module, own)
        for name, module in modules.items()
        if isinstance(module, ModuleType)
    }


def _digests(module: ModuleType, own: OwnCode) -> dict[str, str]:
    """Return a digest of each value of a module, by name."""
    values = {
        name: value for name, value in vars(module).copy().items() if not name.startswith("__")
    }
    return {name: _digest(module, name, value, own) for name, value in values.items()}


def _digest(module: ModuleType, name: str, value: Any, own: OwnCode) -> str:
    """Return a text that changes whenever a value of a module changes; empty for None."""
    if value is None:
        return ""
    kind = type(value)  # `type` and not `__class__`, which an object may define itself
    if issubclass(kind, ModuleType):
        return "module"
    if kind in _COMPARED_BY_VALUE:
        return f"{kind.__name__} {value!r}"
    # a fast description, which suits most functions
    if kind is FunctionType and _is_usual(value):
        return f"function {id(value.__code__)} {value.__defaults__!r}"
    return LoadedState(module, (), own.modules.__contains__, lazy=False).digest({name: value})


def _is_usual(function: FunctionType) -> bool:
    """Return True for a function whose only state is default arguments that are numbers or
    texts.
    """
    if function.__kwdefaults__ or function.__closure__ or vars(function):
        return False
    return all(type(default) in _COMPARED_BY_VALUE for default in function.__defaults__ or ())


def _changed_modules(own: OwnCode, before: dict[str, dict[str, str]]) -> Iterator[str]:
    """Yield the full names of values of the user's modules that changed, except for constants that
    are set at the first call.
    """
    for module, digests_now in _of_modules(own).items():
        digests_before = before.get(module, digests_now)
        for name in dict.fromkeys([*digests_before, *digests_now]):
            digest_now, digest_before = digests_now.get(name), digests_before.get(name)
            # an imported module is no change
            if (
                digest_now == digest_before
                or digest_now == "module"
                or _is_unread(own, module, name)
            ):
                continue
            # a constant that is set at the first call
            if not digest_before and digest_now and _is_lazy(module, name):
                continue
            yield f"{module}.{name}"


def _is_unread(own: OwnCode, module: str, name: str) -> bool:
    """Return True for a log: its module only writes to it, and no other module of the user refers
    to it.
    """
    if f"{module}.{name}" not in own.unread:
        return False
    own_module = sys.modules[module]
    value = getattr(own_module, name, None)
    other_modules = [
        sys.modules[other_name]
        for other_name in {*own_modules(), *own.modules} - {module}
        if other_name in sys.modules
    ]
    attributes = chain.from_iterable(vars(other_name).values() for other_name in other_modules)
    # no other module refers to the log or to its module
    return not any(attribute is value or attribute is own_module for attribute in attributes)


def _is_lazy(module: str, name: str) -> bool:
    """Return True if functions of a module assign a name of the module, and the assigned value
    depends on none of their arguments.
    """
    path = module_path(module)
    if path is None:
        return False
    return is_lazy_constant(ast.parse(source_of(module, Path(path))[0]), name)


def _of_others(own: OwnCode) -> dict[str, dict[str, Any]]:
    """Return the attributes of the modules, classes and objects of libraries that code of the user
    may change.
    """
    # without results of calls and relative names
    names = [name for name in own.changed if "()" not in name and not name.startswith(".")]
    values = {name: _found(name) for name in names}
    attributes = {name: _attributes(value) for name, value in values.items() if value is not None}
    for name in names:
        holder, _, attribute_name = name.rpartition(".")
        attributes_of_holder = getattr(_found(holder), "__dict__", {}) if holder else {}
        attribute = (
            {attribute_name: attributes_of_holder[attribute_name]}
            if attribute_name in attributes_of_holder
            else {}
        )
        attributes.setdefault(holder, attribute)
    return attributes


def _found(name: str) -> Any:
    """Return the object with a full name, or None if there is none."""
    name_parts = name.split(".")
    # number of leading parts of the name that form a loaded module
    module_depth = next(
        (
            count
            for count in range(len(name_parts), 0, -1)
            if ".".join(name_parts[:count]) in sys.modules
        ),
        0,
    )
    if not module_depth or name_parts[0] == _SYSTEM:
        return None
    value: Any = sys.modules[".".join(name_parts[:module_depth])]
    for attribute in name_parts[module_depth:]:
        value = getattr(value, "__dict__", {}).get(attribute)
    return value


def _attributes(value: Any) -> dict[str, Any]:
    """Return the attributes of an object; for an object without attributes, such as a list, a
    digest of it.

    The entries of a dict in an attribute count too: a table of a library is often a
    class around one.
    """
    # missing for objects such as a list, for which a digest is returned
    attribute_dict = getattr(value, "__dict__", None)
    if isinstance(attribute_dict, dict | MappingProxyType):
        attributes = {
            name: attribute
            for name, attribute in attribute_dict.copy().items()
            if not name.startswith("__")
        }
        # entries of dicts in modules and classes do not count
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
    """Yield the full names of values of libraries that changed, except for late imports of a
    package by itself.
    """
    for holder, attributes_now in _of_others(own).items():
        attributes_before = before.get(holder, attributes_now)
        for name in dict.fromkeys([*attributes_before, *attributes_now]):
            value_now, value_before = (
                attributes_now.get(name, _ABSENT),
                attributes_before.get(name, _ABSENT),
            )
            is_late_import = value_before is _ABSENT and _is_of_package(value_now, holder)
            if not (
                isinstance(value_now, ModuleType)
                or is_late_import
                or _is_alike(value_now, value_before)
            ):
                yield f"{holder}.{name}".rstrip(".")


def _is_of_package(value: Any, place: str) -> bool:
    """Return True for a function or class that comes from the package that holds it; packages
    import such parts when they are first used.
    """
    return str(getattr(value, "__module__", "")).partition(".")[0] == place.partition(".")[0]


def _is_alike(value: Any, other: Any) -> bool:
    """Return True for the same object, or for equal numbers and texts of one type."""
    return value is other or (
        type(value) is type(other) and type(value) in _COMPARED_BY_VALUE and value == other
    )


def _settings() -> dict[str, str]:
    """Return the settings of the process that keys cover."""
    return settings() | own_settings(reads_time=False)
