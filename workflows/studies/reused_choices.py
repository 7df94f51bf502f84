"""Choices of bands that a study makes once and not for each draw.

How many bands an image needs depends on the camera responses only up to a common factor, because
its errors are relative to the brightest pixel. So a draw of a quantum efficiency or a transmission
needs no new choice, and no new PSFs of the chosen bands. A choice is made anew for responses of
another shape.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from neusee.nodes import optics
from neusee.workflows.engine.node_call import call
from neusee.workflows.graph.recipe_graph import Recipe, Step

#: the nodes whose results do not change when this input is multiplied by a factor, but for rounding
_WITHOUT_FACTOR = {optics.few_bands.path: "rows", optics.few_bands_checked.path: "rows"}
_ROUNDING = 1e-5  #: relative difference of two inputs that count as proportional


@dataclass(frozen=True)
class _Made:
    """A result, and the inputs from which it was computed."""

    inputs: Sequence[Any]
    result: Any


class ReusedChoices:
    """Computes the steps of draw after draw; choices of bands, and what depends on them alone, are
    reused where they stay the same.
    """

    def __init__(self, recipe: Recipe, live: Iterable[str], free: Collection[str]) -> None:
        """Find the steps to reuse among the ``live`` steps, which are in running order; ``free``
        has the parameters that change.
        """
        self._steps = _steps_of_choices(recipe, list(live), free)
        self._made: dict[str, _Made] = {}

    @property
    def is_waiting(self) -> bool:
        """Return True if there are choices to reuse, and none has been made."""
        return bool(self._steps) and not self._made

    def __call__(
        self, step: Step, inputs: Sequence[Any], params: Mapping[str, Any], seed: int, device: str
    ) -> Any:
        """Compute a step, or return the result of an earlier draw."""
        if step.name not in self._steps:
            return call(step, inputs, params, seed, device)
        made = self._made.get(step.name)
        if made is None or not serves(step, made.inputs, inputs):
            made = _Made(list(inputs), call(step, inputs, params, seed, device))
            self._made[step.name] = made
        return made.result


def _steps_of_choices(recipe: Recipe, live: Sequence[str], free: Collection[str]) -> set[str]:
    """Return the live steps that choose bands, and those that depend on such steps alone."""
    with_free_values = {name.rpartition(".")[0] for name in free}
    steps = set[str]()
    for name in live:
        step = recipe.steps[name]
        live_sources = set(step.sources).intersection(live)
        depends_on_choices = bool(live_sources) and live_sources <= steps
        is_choice = step.node.path in _WITHOUT_FACTOR
        if (is_choice or depends_on_choices) and name not in with_free_values:
            steps.add(name)
    return steps


def serves(step: Step, before: Sequence[Any], now: Sequence[Any]) -> bool:
    """Return True if a step has the same result for two lists of inputs: identical ones, but for a
    factor of one of them.
    """
    scaled_input = _WITHOUT_FACTOR.get(step.node.path)
    pairs = zip(step.node.inputs, before, now, strict=True)
    return all(
        old is new or (name == scaled_input and _proportional(old, new)) for name, old, new in pairs
    )


def _proportional(x: Tensor, y: Tensor) -> bool:
    """Return True if ``y`` is ``x`` times a positive factor, but for rounding."""
    if x.shape != y.shape or not x.numel():
        return False
    place = int(x.abs().argmax())
    largest, other = float(x.reshape(-1)[place]), float(y.reshape(-1)[place])
    if not largest * other > 0:
        return False
    difference = float((y.double() / other - x.double() / largest).abs().max())
    return difference <= _ROUNDING
