"""Code that changes, or looks for, what lies outside of its own module: patches, registries, subclasses, settings.

A key follows imports. Code beside them, in another file of the same recipe, may change what the followed code computes:
it sets an attribute of a module or a class, fills a registry, or derives a class. Such code is found here by its
form, and in doubt it is found: a call whose value nobody uses is there to change something.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Mapping
from typing import NamedTuple

from neusee.workflows.keys.scopes_of_names import Scope, last_name, roots

#: packages whose functions change nothing that they are not given, except those with a name that says so
CALM = frozenset(
    {
        *("torch", "numpy", "scipy", "math", "cmath", "functools", "itertools", "operator", "collections", "typing"),
        *("dataclasses", "enum", "abc", "contextlib", "re", "json", "copy", "statistics", "fractions", "numbers"),
        *("types", "pathlib", "typing_extensions", "pydantic", "neusee", "__future__", "builtins", "string", "os"),
        *("datetime", "textwrap", "struct", "heapq", "bisect", "inspect", "traceback", "kornia", "einops", "triton"),
    }
)
#: functions that decide no result, or a setting that each key has by its value
_QUIET = (
    *("warnings.warn", "warnings.catch_warnings", "logging", "print", "sys.path", "time.sleep", "matplotlib.use"),
    *("torch.manual_seed", "torch.set_num_threads", "torch.set_num_interop_threads", "torch.set_default_dtype"),
    *("torch.set_default_device", "torch.set_float32_matmul_precision", "torch.set_flush_denormal"),
    *("torch.use_deterministic_algorithms", "ctypes.Structure", "ctypes.Union"),
)
_QUIET_DECORATORS = (
    *("functools", "dataclasses", "contextlib", "typing", "abc", "enum", "typing_extensions", "pydantic", "types"),
    *("torch.no_grad", "torch.inference_mode", "torch.enable_grad", "torch.jit", "torch.compile", "numba", "triton"),
    *("torch.autograd.function", "pytest", "warnings"),
)
_HOOK = re.compile(r"reference|preflight|check|\w+_bound|skip_\w+|\w+_error|propagate_\w+|band_invariant|\w+_range")
_SETTER = re.compile(
    r"(un|de)?register|(set|reset|enable|disable|patch|install|configure|use|seed|inject|override|add|define|impl)"
    r"(_|[A-Z])|(set|reset|patch|install|configure|use|seed|inject|override|define|impl)$|seterr|setattr|load_library|"
    r"putenv|unsetenv|chdir|umask"
)
_CHANGER = re.compile(r"(append|extend|insert|clear|pop|popitem|remove|discard|setdefault|update)$")
#: methods that change their object, in packages that are not calm
_MUTATOR = re.compile(
    r"(add|push|train|eval|half|double|float|to|apply|load_state_dict|requires_grad|sort|reverse|fill|put|itemset|"
    r"resize|start|step|send|write)$|.*[^_]_$"
)
_SEEKS = frozenset({"__subclasses__", "_getframe", "currentframe", "get_objects", "get_referrers", "registered_nodes"})
_DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda)


class Reach(NamedTuple):
    """What the code of a module changes or looks for beyond itself."""

    outward: list[str]  #: full names of what it changes in other modules; an empty one is unknown
    passed: list[str]  #: names of other modules that it gives to functions, which may change their arguments
    unused: list[str]  #: modules that it imports and does not name: for what their import does
    inward: bool  #: True if its functions change what its own module holds
    changes_arguments: bool
    seeks: bool  #: True if it looks for classes and objects that no import names


NOWHERE = Reach([], [], [], False, False, False)


def reach_of(tree: ast.Module, bound: Mapping[str, str]) -> Reach:
    """Return what a module reaches; ``bound`` has the full name of each imported name, relative ones with a dot."""
    found = _Pass(bound)
    found.visit_all(tree.body, Scope(tree, None))
    unused = {full for name, full in bound.items() if name not in found.named and not is_calm(full)}
    return Reach(
        sorted(found.outward), sorted(found.passed), sorted(unused), found.inward, found.changes_arguments, found.seeks
    )


def outward_names(reaches: Collection[Reach]) -> set[str]:
    """Return the full names of what code may change in other modules, also by functions that it calls."""
    names = {name for reach in reaches for name in reach.outward}
    passed = any(reach.changes_arguments for reach in reaches)
    return names | {name for reach in reaches for name in reach.passed if passed}


class _Pass:
    """One pass over the code of a module."""

    def __init__(self, bound: Mapping[str, str]) -> None:
        self._bound = bound
        self.outward, self.passed, self.named = set[str](), set[str](), set[str]()
        self.inward = self.changes_arguments = self.seeks = False

    def visit_all(self, items: list[ast.stmt], scope: Scope) -> None:
        for item in items:
            self._visit(item, scope)

    def _visit(self, item: ast.AST, scope: Scope) -> None:
        if isinstance(item, _DEFINITIONS):
            self._definition(item, scope)
            scope = Scope(item, scope)
        elif isinstance(item, ast.Call):
            self._call(item, scope, bare=False)
        elif isinstance(item, ast.Expr) and isinstance(item.value, ast.Call):
            self._call(item.value, scope, bare=True)
        elif isinstance(item, ast.Global):
            self.inward = True
        elif isinstance(item, ast.Attribute | ast.Name | ast.Subscript):
            self._name(item, scope)
        for child in ast.iter_child_nodes(item):
            self._visit(child, scope)

    # --- stores -------------------------------------------------------------------------------------------------------

    def _name(self, item: ast.Attribute | ast.Name | ast.Subscript, scope: Scope) -> None:
        """Note a name or an attribute, and what it is a part of where it is set or deleted."""
        self.seeks |= last_name(item) in _SEEKS
        if isinstance(item, ast.Name):
            self.named.add(item.id)
        elif not isinstance(item.ctx, ast.Load):
            self._changed(item, scope)

    def _changed(self, item: ast.expr, scope: Scope) -> None:
        """Note that a part of an object, ``item``, is set or deleted."""
        for root in roots(item, scope, self._bound):
            if root.kind == "import":
                self.outward.add(root.name)
            elif root.kind == "argument":
                self.changes_arguments = True
            else:
                self.inward |= root.kind == "class" or not scope.is_module

    # --- calls --------------------------------------------------------------------------------------------------------

    def _call(self, call: ast.Call, scope: Scope, bare: bool) -> None:
        last = last_name(call.func)
        if last in ("setattr", "delattr", "__setattr__", "__delattr__"):
            for argument in call.args[:1]:
                self._changed(argument, scope)
        for root in roots(call.func, scope, self._bound):
            if root.kind == "import":
                self._imported_call(call, root.name, scope, bare)
            elif isinstance(call.func, ast.Name):
                self.passed |= self._given(call, scope)
            elif root.kind in ("own", "class") and not scope.is_module:
                self.inward |= bare or _changes(last)

    def _imported_call(self, call: ast.Call, full: str, scope: Scope, bare: bool) -> None:
        """Note the call of a function of another module, if it may change something."""
        last = last_name(call.func)
        name, given = full if last in full.split(".") else f"{full}.{last}", self._given(call, scope)
        if _is_quiet(name, call):
            return
        if not is_calm(full):
            self.passed |= given
            if bare or _changes(last):
                self.outward.add(name)
            return
        named = bool(_SETTER.match(last) or _CHANGER.match(last))
        if (bare and named) or name.startswith("torch.library."):
            self.outward.add(name)
        if bare or last.endswith("_"):
            self.outward |= {each for each in given if not is_calm(each)}

    def _given(self, call: ast.Call, scope: Scope) -> set[str]:
        """Return the names of what other modules hold and a call is given, not of what their functions return."""
        given = [
            each for each in [*call.args, *(word.value for word in call.keywords)] if not isinstance(each, ast.Call)
        ]
        return {name for each in given for name in self._imports(each, scope) if "()" not in name}

    def _imports(self, item: ast.expr, scope: Scope) -> set[str]:
        return {root.name for root in roots(item, scope, self._bound) if root.kind == "import"}

    # --- definitions --------------------------------------------------------------------------------------------------

    def _definition(self, item: ast.AST, scope: Scope) -> None:
        """Note the decorators and base classes that another module has: both may register what is defined."""
        for mark in getattr(item, "decorator_list", ()):
            found = self._imports(mark.func if isinstance(mark, ast.Call) else mark, scope)
            self.outward |= {name for name in found if not _is_quiet_decorator(name)}
        if isinstance(item, ast.ClassDef):
            for base in [*item.bases, *(word.value for word in item.keywords)]:
                found = self._imports(base, scope)
                self.outward |= {name for name in found if not is_calm(name) and not _starts(name, _QUIET)}


def is_calm(name: str) -> bool:
    """Return True for a name of a package whose functions change nothing that they are not given."""
    return name.partition(".")[0] in CALM


def _changes(method: str) -> bool:
    """Return True for the name of a method that changes its object."""
    return any(words.match(method) for words in (_SETTER, _CHANGER, _MUTATOR))


def _is_quiet_decorator(name: str) -> bool:
    """Return True for a decorator that registers nothing; a hook of a node of neusee changes that node."""
    if name.startswith("neusee."):
        return not _HOOK.fullmatch(name.rpartition(".")[2])
    return _starts(name, _QUIET_DECORATORS)


def _is_quiet(name: str, call: ast.Call) -> bool:
    """Return True for a function that decides no result, such as one that ignores warnings."""
    if name in ("warnings.filterwarnings", "warnings.simplefilter"):
        first = call.args[0] if call.args else None
        return isinstance(first, ast.Constant) and first.value in ("ignore", "once", "default")
    return _starts(name, _QUIET)


def _starts(name: str, entries: tuple[str, ...]) -> bool:
    return any(f"{name}.".startswith(f"{entry}.") for entry in entries)
