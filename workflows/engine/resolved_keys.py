"""The cache keys of the steps of a recipe, as determined by `resolve_keys.resolve`; this module
does not import torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from neusee.workflows.keys.cache_key import Key

if TYPE_CHECKING:
    from neusee.workflows.tolerance.skip_decision import SkipDecision


@dataclass(frozen=True, slots=True)
class Resolved:
    """Cache keys of steps, the parts of each key, and the decisions on the steps that may be
    left out.
    """

    keys: dict[str, Key] = field(default_factory=dict)
    origins: dict[Key, Mapping[str, Any]] = field(default_factory=dict)
    #: the first step of each key that is not left out
    makers: dict[Key, str] = field(default_factory=dict)
    #: decision on each step that may be left out; None if statistics are missing
    verdicts: dict[str, SkipDecision | None] = field(default_factory=dict)

    def left_out(self, name: str) -> bool | None:
        """Return True if a step is left out, False if it runs, and None if only the values of
        its inputs can decide.
        """
        verdict = self.verdicts.get(name)
        return (
            None
            if verdict is None and name in self.verdicts
            else verdict is not None and verdict.left_out
        )

    def stands_for(self, name: str) -> str:
        """Return ``name``, or if the step ``name`` is left out, the name of the upstream step
        that is used instead.
        """
        while (verdict := self.verdicts.get(name)) is not None and verdict.left_out:
            name = verdict.instead
        return name
