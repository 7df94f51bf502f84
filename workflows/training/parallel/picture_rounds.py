"""Pictures of processes that share bands: each process begins every picture of a round, and finishes its own.

Every process computes its bands of every picture of the round. Then the bands, or sums over them, are sent to the
process that owns the picture, and this process computes all later steps. Gradients return to all processes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from neusee.workflows.engine.differentiable_function import Theta, as_function
from neusee.workflows.graph.recipe_graph import Recipe, in_order
from neusee.workflows.training.parallel.band_shards import Port, Shards
from neusee.workflows.training.parallel.shared_graph import Shared


class Pictures:
    """The part of a recipe that is computed for each picture: in one piece, or cut where bands come together."""

    def __init__(
        self,
        recipe: Recipe,
        free: Sequence[str],
        outputs: Sequence[str],
        redraw: Collection[str],
        shards: Shards,
        run: Mapping[str, Any],
    ) -> None:
        self.shards = shards
        inner = shards.steps.difference(free)
        read = {s for n in _live(recipe, free, outputs) if n not in shards.steps for s in recipe.steps[n].sources}
        self._cut = sorted(inner & (read | set(outputs)))
        within = _used(recipe, [*free, *self._cut], outputs) if self._cut else free
        self._end = as_function(recipe, *within, outputs=outputs, redraw=redraw, **run)
        self._start = None
        if self._cut:
            first = _used(recipe, free, self._cut)
            ways = {**run, "caller": shards.call}
            self._start = as_function(recipe, *first, outputs=self._cut, redraw=redraw, **ways)

    def alone(self, theta: Theta, seed: int) -> dict[str, Any]:
        """Compute a picture without other processes."""
        return self._end(_only(theta, self._end.free), seed)

    @property
    def by_band(self) -> bool:
        """Return True if processes that share bands begin each other's pictures."""
        return self._start is not None

    @contextmanager
    def together(
        self, shared: Shared, drawn: Mapping[int, tuple[Theta, int]], mine: int | None
    ) -> Iterator[dict[str, Any]]:
        """Begin all pictures of a round and finish picture ``mine``; None: begin the pictures of others only.

        When the block ends, the gradients return to the processes that sent the bands.
        """
        if self._start is None:
            yield self._finished(shared, drawn, mine, {})
            return
        start = self._start
        begun = [start(_only({**shared.values, **theta}, start.free), seed) for theta, seed in drawn.values()]
        cut = _Cut(begun, self._cut, self.shards)
        yield self._finished(shared, drawn, mine, cut.values)
        cut.back()

    def _finished(
        self, shared: Shared, drawn: Mapping[int, tuple[Theta, int]], mine: int | None, cut: Theta
    ) -> dict[str, Any]:
        if mine is None:
            return {}
        theta, seed = drawn[mine]
        return self.alone({**shared.seen, **theta, **cut}, seed)


class _Cut:
    """The point at which the pictures of a round are sent to their processes."""

    def __init__(self, begun: Sequence[Mapping[str, Any]], names: Sequence[str], shards: Shards) -> None:
        self._sent: list[list[Tensor]] = []  #: the tensors that are sent, each for all pictures
        self._ports: list[Port] = []
        self._leaves: list[Tensor] = []
        self.values: dict[str, Any] = {}
        for name in names:
            parts = [shards.sent(name, one[name]) for one in begun]
            ports = shards.ports(name, parts[0])
            sent = [list(each) for each in zip(*parts, strict=True)]
            leaves = [
                port.there(each).requires_grad_(each[0].requires_grad) for port, each in zip(ports, sent, strict=True)
            ]
            self.values[name] = shards.received(name, begun[0][name], leaves)
            self._sent, self._ports, self._leaves = self._sent + sent, self._ports + ports, self._leaves + leaves

    def back(self) -> None:
        """Return each gradient to the processes that had a share; a process without a picture sends zeros."""
        roots: list[Tensor] = []
        grads: list[Tensor] = []
        for sent, port, leaf in zip(self._sent, self._ports, self._leaves, strict=True):
            if leaf.requires_grad:
                found = port.back(torch.zeros_like(leaf) if leaf.grad is None else leaf.grad)
                roots += sent
                grads += found[: len(sent)]
        if roots:
            torch.autograd.backward(roots, grads)


def _live(recipe: Recipe, given: Sequence[str], wanted: Sequence[str]) -> list[str]:
    sources = {name: () if name in given else step.sources for name, step in recipe.steps.items()}
    return in_order(sources, wanted)


def _used(recipe: Recipe, free: Sequence[str], wanted: Sequence[str]) -> list[str]:
    """Return the free steps and parameters that reach a wanted step."""
    live = set(_live(recipe, free, wanted))
    return [name for name in free if (name if name in recipe.steps else name.rpartition(".")[0]) in live]


def _only(theta: Theta, free: Sequence[str]) -> dict[str, Any]:
    return {name: theta[name] for name in free}
