"""Imports in an observed call: which reads belong to an installed package, and which to a module of the user.

Python searches folders and reads byte code, and packages read their own tables: none of this is an input. The body of
a module of the user is watched like the step itself. Two functions of importlib tell both apart; a Python without them
counts every import as the step's own reading.
"""

from __future__ import annotations

import _imp
import builtins
import importlib
import os
from collections.abc import Callable
from typing import Any

from neusee.workflows.observation.covered_paths import is_installed
from neusee.workflows.observation.python_watch import watch_here

_BOOTSTRAP: Any = importlib._bootstrap
_SEARCH, _EXECUTE = "_find_and_load", "_call_with_frames_removed"
_NATIVE = {getattr(_imp, name, None) for name in ("create_dynamic", "exec_dynamic")} - {None}


class WatchedImports:
    """The two functions of importlib, wrapped while a call is observed."""

    def __init__(self) -> None:
        self._before = {name: getattr(_BOOTSTRAP, name, None) for name in (_SEARCH, _EXECUTE)}

    def __enter__(self) -> None:
        for name, wrap in ((_SEARCH, _searching), (_EXECUTE, _executing)):
            function = self._before[name]
            if function is not None:
                setattr(_BOOTSTRAP, name, wrap(function))

    def __exit__(self, *_: object) -> None:
        for name, function in self._before.items():
            if function is not None:
                setattr(_BOOTSTRAP, name, function)


def _searching(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the search for a module, with a thread that is trusted meanwhile."""

    def search(name: str, import_: Callable[..., Any]) -> Any:
        watch = watch_here()
        if watch is None:
            return function(name, import_)
        before = watch.trust(True)
        try:
            return function(name, import_)
        finally:
            if not before:
                watch.kept.note()
            watch.trust(before)

    return search


def _executing(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the execution of a module, with a thread that is not trusted if the module is one of the user."""

    def execute(called: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        watch = watch_here()
        module = _module(called, arguments) if watch is not None else None
        if watch is None or module is None:
            return function(called, *arguments, **named)
        watch.bodies[module[0]] = module[1]
        before = watch.trust(False)
        try:
            return function(called, *arguments, **named)
        finally:
            watch.trust(before)

    return execute


def _module(called: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[str, str] | None:
    """Return name and file of the module of the user that a call executes, or None."""
    if called is builtins.exec:
        name, file = arguments[1].get("__name__"), arguments[1].get("__file__")
    elif called in _NATIVE:
        spec = getattr(arguments[0], "__spec__", arguments[0])
        name, file = getattr(spec, "name", None), getattr(spec, "origin", None)
    else:
        return None
    path = os.path.realpath(file) if file else ""
    return (str(name), path) if path and not is_installed(path) else None
