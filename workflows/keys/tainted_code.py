"""Own code that was seen to reach what its key does not cover: its results hold for this process alone.

What a module has read stays with it, in a memo or in a variable, where no later call can be seen to read it again.
Therefore a taint stays until the process ends, for all code that uses one of the tainted modules.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from neusee.workflows.keys.loaded_source import edited_since

_taints: dict[str, tuple[Any, ...]] = {}  #: by module, what it reached: `observation.taints.Taint`
_held_back: set[str] = set()  #: modules whose taint the run may not know yet, since it looks at results one by one


def hold_back(modules: Iterable[str]) -> None:
    """Let no result of own modules be stored from now on: one of their steps was just seen to reach too much."""
    _held_back.update(modules)


def may_be_stored(modules: Iterable[str]) -> bool:
    """Return True if no step that was seen to reach too much has ended while one of these modules computed."""
    return _held_back.isdisjoint(modules)


def taint_code(modules: Iterable[str], taints: tuple[Any, ...]) -> bool:
    """Mark own modules as code whose results no other process may use; return True if one was not marked before."""
    new = [module for module in modules if module not in _taints]
    _taints.update(dict.fromkeys(new, taints))
    return bool(new)


def taints_of(modules: Iterable[str]) -> tuple[Any, ...]:
    """Return what modules have reached in this process although their keys do not cover it."""
    return tuple(dict.fromkeys(taint for module in modules for taint in _taints.get(module, ())))


def holds_here_alone(module: str) -> bool:
    """Return True if no other process may use what a module computes: its file was edited, or it is tainted."""
    return edited_since(module) or module in _taints
