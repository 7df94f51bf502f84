"""Computation of training pictures by several processes, where each process computes some of the spectral bands.

Every process computes its bands of every picture. Then the process that owns a picture receives all bands, or sums over
the bands, and computes all later steps. Gradients return to all processes.
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
    """The steps for each training picture: first steps divided by spectral band among processes, later steps in one."""

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
        if self.by_band:
            first = _used(recipe, free, self._cut)
            self._start = as_function(recipe, *first, outputs=self._cut, redraw=redraw, caller=shards.call, **run)

    def alone(self, theta: Theta, seed: int) -> dict[str, Any]:
        """Compute a training picture in this process alone, and return the outputs of the recipe."""
        return self._end(_only(theta, self._end.free), seed)

    @property
    def by_band(self) -> bool:
        """Return True if the spectral bands of each training picture are divided among the processes."""
        return bool(self._cut)

    @contextmanager
    def together(
        self, shared: Shared, drawn: Mapping[int, tuple[Theta, int]], mine: int | None
    ) -> Iterator[dict[str, Any]]:
        """Compute this process's spectral bands of all pictures, and yield the outputs of the picture ``mine``, if any.

        When the ``with`` block ends, the gradients return to the processes that sent the bands.
        """
        start = self._start
        begun = [start(_only({**shared.values, **theta}, start.free), seed) for theta, seed in drawn.values()]
        cut = _Cut(begun, self._cut, self.shards)
        if mine is None:
            yield {}
        else:
            theta, seed = drawn[mine]
            yield self.alone({**shared.seen, **theta, **cut.values}, seed)
        cut.back()


class _Cut:
    """The intermediate results of several training pictures, sent to the process that completes each picture."""

    def __init__(self, begun: Sequence[Mapping[str, Any]], names: Sequence[str], shards: Shards) -> None:
        self._sent: list[tuple[Port, tuple[Tensor, ...], Tensor]] = []  #: exchange, sent tensors, received tensor
        self.values: dict[str, Any] = {}
        for name in names:
            parts = [shards.sent(name, one[name]) for one in begun]
            leaves = []
            for port, each in zip(shards.ports(name, parts[0]), zip(*parts, strict=True), strict=True):
                leaves.append(port.there(each).requires_grad_(each[0].requires_grad))
                self._sent.append((port, each, leaves[-1]))
            self.values[name] = shards.received(name, begun[0][name], leaves)

    def back(self) -> None:
        """Send the gradients of each picture back to the processes that computed the spectral bands of the picture.

        A process without a picture sends zeros.
        """
        roots: list[Tensor] = []
        grads: list[Tensor] = []
        for port, sent, leaf in self._sent:
            if leaf.requires_grad:
                each = port.back(torch.zeros_like(leaf) if leaf.grad is None else leaf.grad)
                roots += sent
                grads += each[: len(sent)]
        if roots:
            torch.autograd.backward(roots, grads)


def _live(recipe: Recipe, given: Sequence[str], outputs: Sequence[str]) -> list[str]:
    sources = {name: () if name in given else step.sources for name, step in recipe.steps.items()}
    return in_order(sources, outputs)


def _used(recipe: Recipe, free: Sequence[str], outputs: Sequence[str]) -> list[str]:
    """Return the steps and parameters from the list ``free`` on which an output of the recipe depends."""
    live = set(_live(recipe, free, outputs))
    return [name for name in free if (name if name in recipe.steps else name.rpartition(".")[0]) in live]


def _only(theta: Theta, free: Sequence[str]) -> dict[str, Any]:
    return {name: theta[name] for name in free}
