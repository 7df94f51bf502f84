"""Observed call of own code: what it reached beyond its key, less what its author states to decide no result."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from neusee.workflows.keys.user_code import OwnCode
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
    "unknown": "could not be watched:",
}


def call_observed(function: Callable[[], T], own: OwnCode) -> tuple[T, list[Taint]]:
    """Return the value of a function of own code, and what it reached that its key does not cover."""
    covered = Covered(frozenset(map(Path, own.files)), own.followed.__contains__)
    value, found = observed(function, covered)
    return value, [taint for taint in found if not own.free & {taint.kind, taint.what, Path(taint.what).name}]
