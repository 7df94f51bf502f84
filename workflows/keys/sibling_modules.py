"""Modules of a user beside those of a node: which of them may change what the node computes?

All files under ``nodes:`` of a recipe are loaded into one process. A file that patches a library changes every result
of the process, also those of neusee's own nodes; one that fills a registry or derives a class changes results of other
own nodes. Such a file joins their keys. A file that changes nothing beyond itself joins no other key.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Literal

from neusee.nodes.own_modules import own_modules
from neusee.workflows.keys.module_look import Look, Whole
from neusee.workflows.keys.module_origin import origin_of
from neusee.workflows.keys.module_owner import is_own
from neusee.workflows.keys.outward_code import Reach, outward_names

Scope = Literal["nothing", "own", "all"]  #: nodes whose results a module may change
_GETTER = re.compile(r"get|current|default|instance|global|regist|shared|root", re.IGNORECASE)
_UNSEEN = ("run", "import")  #: kinds of constructs whose code nobody knows


class Siblings:
    """The own modules of this process, and which of them join the key of a node."""

    def __init__(self, whole_of: Callable[[str], Whole]) -> None:
        self._whole_of = whole_of
        self._scopes: dict[str, Scope] = {}

    def of(self, roots: Sequence[str]) -> list[str]:
        """Return the own modules that may change what the code of ``roots`` computes, in the order of their import.

        Raises `LookupError` for a module that cannot be followed.
        """
        others = own_modules()
        if not others:
            return []
        followed = {name: look for root in roots for name, look in self._whole_of(root).looks.items()}
        mine = _own(followed)
        beside = [name for name in others if name not in followed]
        return [name for name in beside if self._joins(name, mine, any(map(is_own, roots)))]

    def _joins(self, module: str, mine: Mapping[str, Reach], own: bool) -> bool:
        scope = self._scope_of(module)
        if scope == "all" or not own:
            return scope == "all"
        shared = _own(self._whole_of(module).looks).keys() & mine.keys()
        changed = any(mine[name].inward for name in shared)
        return scope == "own" or changed or any(reach.seeks for reach in mine.values())

    def _scope_of(self, module: str) -> Scope:
        if module not in self._scopes:
            self._scopes[module] = _scope(self._whole_of(module).looks)
        return self._scopes[module]


def _scope(looks: Mapping[str, Look]) -> Scope:
    """Return whose results the code of a module and of its helpers may change."""
    reaches = _own(looks).values()
    names = outward_names(reaches)
    names |= {name for reach in reaches for name in reach.unused if _kind(name) == "distribution"}
    summaries = [look.summary for name, look in looks.items() if is_own(name) and look.summary]
    unseen = any(each.kind in _UNSEEN for summary in summaries for each in summary.constructs)
    own = {name for name in names if _is_of_user(name)}
    if unseen or any(_is_shared(name) for name in names - own):
        return "all"
    return "own" if own else "nothing"


def _own(looks: Mapping[str, Look]) -> dict[str, Reach]:
    """Return what the modules of a user reach, by name."""
    return {name: look.summary.reach for name, look in looks.items() if is_own(name) and look.summary}


def _is_of_user(name: str) -> bool:
    """Return True if a full name is that of something in a module of a user."""
    return name.startswith(".") or (_kind(name) in ("source", "folder") and is_own(name.partition(".")[0]))


def _is_shared(name: str) -> bool:
    """Return True for something of a library that others see: not for the result of a call, such as an open file."""
    called, found, _ = name.rpartition("()")
    return not found or _GETTER.search(called.rpartition(".")[2]) is not None


def _kind(name: str) -> str:
    return origin_of(name.partition(".")[0], frozenset()).kind if name.partition(".")[0] else "nowhere"
