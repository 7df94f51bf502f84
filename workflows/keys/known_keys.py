"""Cache keys of recipes that follow one another, such as the points of a sweep: most steps keep the key they had."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from neusee.workflows.graph.step_shapes import has_path
from neusee.workflows.keys.cache_key import Key, device_kind, key_of

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Step
    from neusee.workflows.keys.code_digest import Code


class _Known(NamedTuple):
    """The newest key of a step, with all that the key depends on."""

    step: Step
    beside: tuple[Any, ...]  #: seed, kind of the device and keys of the inputs
    key: Key
    origin: dict[str, Any]


class KnownKeys:
    """The newest cache key of each step; a key is computed again only if something that it depends on has changed.

    The code of nodes counts as it is in ``code``, and files are read again each time.
    """

    def __init__(self, code: Code) -> None:
        self.code = code
        self._newest: dict[str, _Known] = {}

    def of(self, step: Step, keys: Mapping[str, Key], seed: int, device: str) -> tuple[Key, dict[str, Any]]:
        """Return the cache key of ``step`` and the data from which the key is computed, as `key_of` does."""
        beside = (seed, device_kind(device), *(keys[name] for name in step.sources))
        known = self._newest.get(step.name)
        if known is not None and known.beside == beside and _is_same(step, known.step):
            return known.key, known.origin
        key, origin = key_of(step, keys, seed, self.code, device)
        if known is not None and known.key == key:
            key = known.key  # the same object, which saves memory where many points keep their keys
        if not has_path(step.params):
            self._newest[step.name] = _Known(step, beside, key, origin)
        return key, origin


def _is_same(step: Step, other: Step) -> bool:
    """Return True if two steps of one name have the same node, inputs and parameters, to the sign of each zero."""
    if step is other:
        return True
    same = step.node is other.node and step.wires == other.wires and step.cached == other.cached
    same = same and step.params.keys() == other.params.keys()
    return same and all(_is_equal(value, other.params[name]) for name, value in step.params.items())


def _is_equal(one: Any, other: Any) -> bool:
    """Return True for the same object, and for numbers and words that are equal and written alike."""
    if one is other:
        return True
    return type(one) is type(other) and isinstance(one, float | int | str) and repr(one) == repr(other)
