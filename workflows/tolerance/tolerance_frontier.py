"""Tolerance frontier: the steps held to the tolerance, at the outputs and before nodes without an error bound."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from neusee.workflows.graph.recipe_graph import Recipe, Step


def border(recipe: Recipe, order: Iterable[str], wanted: Iterable[str]) -> list[str]:
    """Return the steps held to the tolerance: inexact ones that are wanted or feed a node without an error bound."""
    off, found = set[str](), dict[str, None]()
    for name in order:
        step = recipe.steps[name]
        reads = [source for source in step.sources if source in off]
        if reads and not _bounds_its_error(step):
            found |= dict.fromkeys(reads)
        elif reads or step.node.hooks.approximation_error is not None or step.node.hooks.skip_bound is not None:
            off.add(name)
    return [*found, *(name for name in wanted if name in off and name not in found)]


def unbounded(recipe: Recipe, order: Sequence[str]) -> frozenset[str]:
    """Return the steps whose errors reach a node that does not bound its error."""
    found = set[str]()
    for name in reversed(order):
        if name in found or not _bounds_its_error(recipe.steps[name]):
            found.update(recipe.steps[name].sources)
    return frozenset(found)


def _bounds_its_error(step: Step) -> bool:
    return step.node.hooks.propagate_error is not None or step.node.hooks.approximation_error is not None
