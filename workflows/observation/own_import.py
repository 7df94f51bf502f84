"""Observed import of own modules: what they read while they are imported stays in them, and no later call shows it."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from neusee.workflows.keys.declared_dependencies import FREE
from neusee.workflows.keys.loaded_source import say_once
from neusee.workflows.keys.module_origin import origin_of
from neusee.workflows.keys.regular_file import bytes_of
from neusee.workflows.keys.tainted_code import taint_code
from neusee.workflows.observation.hidden_variables import Asked, hidden_while_importing
from neusee.workflows.observation.observed_call import observed_import
from neusee.workflows.observation.own_call import WORDS, say_hidden
from neusee.workflows.observation.step_thread import is_alone
from neusee.workflows.observation.taints import Covered, Taint, taint

_VARIABLE = re.compile(rb"[\"']env:(\w+)[\"']")  #: as a module declares a variable of the environment


def import_observed(name: str) -> ModuleType:
    """Import a module of a user; taint it, and those that it imports, by what they reach meanwhile.

    What a module declares in ``__depends__`` is no taint. A module that is loaded already is not observed again.
    """
    if name in sys.modules:
        return sys.modules[name]
    before = set(sys.modules)
    load = functools.partial(importlib.import_module, name)
    with _hidden(name) as asked:
        module, found = observed_import(load, Covered(frozenset(), lambda _: True))
    say_hidden(name, asked)
    found += tuple(taint("variable", each) for each in asked.of_own_code)
    new = [each for each in sys.modules if each not in before and origin_of(each, frozenset()).kind == "source"]
    taints = tuple(each for each in found if not _is_declared(each, new))
    if taints:
        taint_code(new, taints)
        for each in taints:
            reached = f"{WORDS[each.kind]} {each.what} when it is imported, which no cache key covers"
            say_once(
                name, f"{name} {reached}: the results of its nodes are not stored; to have them stored, {each.fix}"
            )
    return module


def _is_declared(found: Taint, modules: Iterable[str]) -> bool:
    return any(declares(module, found) for module in modules)


@contextmanager
def _hidden(name: str) -> Iterator[Asked]:
    """Hide variables of the environment from the libraries that a module imports, but not beside foreign threads."""
    if not is_alone():
        yield Asked()
        return
    with hidden_while_importing(_declared_variables(name)) as asked:
        yield asked


def _declared_variables(name: str) -> frozenset[str]:
    """Return the variables that a module, or one beside or below it, declares; it is not imported yet."""
    spec = importlib.util.find_spec(name)
    if spec is None or not spec.has_location or spec.origin is None:
        return frozenset()
    folder = Path(spec.origin).parent
    sources = folder.rglob("*.py") if spec.submodule_search_locations else folder.glob("*.py")
    names = set[str]()
    for source in sources:
        if source.is_file():
            names.update(each.decode() for each in _VARIABLE.findall(bytes_of(source)))
    return frozenset(names)


def declares(module: str, taint: Taint) -> bool:
    """Return True if the ``__depends__`` of a module has what was reached."""
    loaded = sys.modules[module]
    entries = [entry for entry in getattr(loaded, "__depends__", ()) if isinstance(entry, str)]
    free = {entry.removeprefix(FREE) for entry in entries if entry.startswith(FREE)}
    if free & {taint.kind, taint.what, Path(taint.what).name}:
        return True
    return any(path == Path(taint.what) or path in Path(taint.what).parents for path in _beside(loaded, entries))


def _beside(module: ModuleType, entries: list[str]) -> Iterator[Path]:
    """Yield the files and folders that a module declares beside itself."""
    file = getattr(module, "__file__", None)
    if file is not None:
        yield from (Path(file).resolve().parent / entry for entry in entries)
