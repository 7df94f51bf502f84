"""Memory of a step graph for the points of a sweep: a step is checked again only if a value that it reads has changed.

Values of a recipe are never changed in place, and an override rebuilds the values along its path alone. So a value that
is the same object at two points is equal at both, with all that it holds. Steps that read files are always checked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sized
from dataclasses import dataclass, field

from neusee.workflows.graph.final_values import Setting
from neusee.workflows.graph.step_shapes import has_path
from neusee.workflows.recipe.known_before_run import CheckedStep, KnownForm
from neusee.workflows.recipe.parameters import Checker
from neusee.workflows.recipe.text.references import References
from neusee.workflows.recipe.text.yaml_values import Value, Where


@dataclass(frozen=True, slots=True, eq=False)
class BoundStep:
    """A step without mistakes, and the values that its references read; None for a path without a value."""

    checked: CheckedStep
    reads: Mapping[str | int, Mapping[Where, Value | None]]  #: by block of the recipe
    blocks: Mapping[str | int, Value | None]  #: each of these blocks, which has not changed if it is the same object
    used: frozenset[Where]
    offered: frozenset[Where]

    @classmethod
    def of(cls, checked: CheckedStep, reads: Mapping[Where, Value | None], root: Value) -> BoundStep:
        """Remember a step and what it ``reads`` in the recipe ``root``, by path."""
        by_block: dict[str | int, dict[Where, Value | None]] = {}
        for path, value in reads.items():
            by_block.setdefault(path[0], {})[path] = value
        blocks = {name: root.child(name) for name in by_block}
        used = frozenset(value.path for value in reads.values() if value is not None)
        return cls(checked, by_block, blocks, used, frozenset(path for path, value in reads.items() if value is None))

    def holds(self, root: Value) -> bool:
        """Return True if each value that the step read is still the same object."""
        return all(
            root.child(name) is block or all(root.below(path) is value for path, value in self.reads[name].items())
            for name, block in self.blocks.items()
        )


@dataclass(eq=False)
class GraphMemory:
    """What earlier checks of one step graph found: steps, forms of results, and final values by block."""

    bound: dict[str, BoundStep] = field(default_factory=dict)
    forms: dict[str, KnownForm] = field(default_factory=dict)
    sources: list[tuple[tuple[str, ...], ...]] = field(default_factory=list)  #: of graphs without a cycle
    settings: dict[Where, tuple[Value, dict[str, Setting]]] = field(default_factory=dict)  #: by path of the block

    def find(self, name: str, references: References) -> CheckedStep | None:
        """Return the step ``name`` as it was checked before, or None if a value that it reads has changed."""
        known = self.bound.get(name)
        if known is None or not known.holds(references.root):
            return None
        references.offered |= known.offered
        references.used |= known.used
        return known.checked


class Attempt:
    """The check of one step, which is remembered if it made no mistake, gave no note and reads no file."""

    def __init__(self, references: References, checker: Checker) -> None:
        self._references, self._checker = references, checker
        self._first, self._before = len(references.trace), self._state()

    def remember(self, name: str, checked: CheckedStep, memory: GraphMemory | None) -> None:
        """Let later checks of the same graph find the step."""
        if memory is None or has_path(checked.step.params) or self._checker.own or self._state() != self._before:
            return
        reads = dict(self._references.trace[self._first :])
        memory.bound[name] = BoundStep.of(checked, reads, self._references.root)

    def _state(self) -> tuple[int, ...]:
        references, checker = self._references, self._checker
        told: tuple[Sized, ...] = (references.diagnostics, references.lacking, references.notes)
        lists = (*told, checker.diagnostics, checker.notes)
        return tuple(len(each) for each in lists)
