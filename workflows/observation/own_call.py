"""Observed call of own code: what it reached beyond its key, less what its author states to decide no result."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import TypeVar

from neusee.nodes.own_modules import own_modules
from neusee.workflows.keys.loaded_source import say_once
from neusee.workflows.keys.user_code import OwnCode
from neusee.workflows.observation.hidden_variables import Asked
from neusee.workflows.observation.left_state import is_of_library, watch_state
from neusee.workflows.observation.observed_call import observed
from neusee.workflows.observation.taints import Covered, Taint, taint

T = TypeVar("T")
#: what a taint does, in words before what it reached
WORDS = {
    "file": "reads",
    "folder": "lists",
    "write": "makes, removes or adds to",
    "attribute": "reads extended attributes of",
    "process": "starts",
    "network": "asks",
    "random": "draws from",
    "import": "imports",
    "memory": "leaves, where other steps may read it,",
    "variable": "reads the environment variable",
    "unknown": "could not be watched:",
}


def call_observed(function: Callable[[], T], own: OwnCode) -> tuple[T, list[Taint]]:
    """Return the value of a function of own code, and what it reached that its key does not cover."""
    covered = Covered(frozenset(map(Path, own.files)), own.followed.__contains__)
    value, found = observed(function, covered, lambda: watch_state(own))
    return value, [taint for taint in found if not own.free & _words_of(taint)]


def tainted_modules(own: OwnCode, taints: Iterable[Taint]) -> frozenset[str]:
    """Return the modules of the user that may have what a step reached: all, if a library or a setting has it."""
    return own.modules.union(own_modules()) if any(is_of_library(each, own) for each in taints) else own.modules


def undeclared(own: OwnCode, asked: Asked) -> list[Taint]:
    """Return a taint for each variable of the environment that own code read and its key does not have."""
    taints = [taint("variable", name) for name in asked.of_own_code]
    return [each for each in taints if not own.free & _words_of(each)]


def say_lost(module: str, left: Iterable[Taint]) -> None:
    """Say what own code changed in a process of its own, where no other step finds it."""
    for each in left:
        text = f"{module} changes {each.what}, and no other step finds the change, since its steps compute in processes"
        say_once(module, f"{text} of their own: {each.fix.partition(', or')[0]}")


def say_hidden(module: str, asked: Asked, free: Collection[str] = ()) -> None:
    """Say which variables of the environment are set, and are not found by libraries that own code calls."""
    names = [name for name in asked.of_libraries if name not in free]
    if names:
        text = f"libraries that {module} uses do not find {', '.join(names)} of the environment, which no cache key has"
        say_once(module, f'{text}; if it decides a result, declare it, depends=["env:{names[0]}"]')


def _words_of(found: Taint) -> set[str]:
    """Return the words by which an author states that something decides no result."""
    return {found.kind, found.what, Path(found.what).name, found.what.rpartition(".")[2]}
