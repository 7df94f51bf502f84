"""Observed call of own code: what it reached beyond its key, less what its author states to decide no result."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from neusee.nodes.own_modules import own_modules
from neusee.workflows.keys.user_code import OwnCode
from neusee.workflows.observation.left_state import is_of_library, watch_state
from neusee.workflows.observation.observed_call import observed
from neusee.workflows.observation.taints import Covered, Taint

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


def _words_of(found: Taint) -> set[str]:
    """Return the words by which an author states that something decides no result."""
    return {found.kind, found.what, Path(found.what).name, found.what.rpartition(".")[2]}
