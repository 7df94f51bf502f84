"""Own code that was seen to reach what its key does not cover: its results hold for this process alone.

What a module has read stays with it, in a memo or in a variable, where no later call can be seen to read it again.
Therefore a taint stays until the process ends, for all code that uses one of the tainted modules.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, NamedTuple

from neusee.workflows.keys.loaded_source import edited_since

Reached = Literal["file", "folder", "process", "network", "random", "import", "unknown"]


class Taint(NamedTuple):
    """What a call of own code reached although its key does not cover it."""

    kind: Reached
    what: str  #: path, command, address or generator
    text: str  #: what was done, as "reads table.csv"
    fix: str  #: what to write in the code or in the recipe


_taints: dict[str, tuple[Taint, ...]] = {}  #: by module


def taint_code(modules: Iterable[str], taints: tuple[Taint, ...]) -> bool:
    """Mark own modules as code whose results no other process may use; return True if one was not marked before."""
    new = [module for module in modules if module not in _taints]
    _taints.update(dict.fromkeys(new, taints))
    return bool(new)


def taints_of(modules: Iterable[str]) -> tuple[Taint, ...]:
    """Return what modules have reached in this process although their keys do not cover it."""
    return tuple(dict.fromkeys(taint for module in modules for taint in _taints.get(module, ())))


def holds_here_alone(module: str) -> bool:
    """Return True if no other process may use what a module computes: its file was edited, or it is tainted."""
    return edited_since(module) or module in _taints
