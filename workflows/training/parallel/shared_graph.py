"""Results that depend on the mask alone: computed once an iteration, and detached so that gradients gather there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from neusee.workflows.store.serialization import each_tensor, tensors_in
from neusee.workflows.training.parallel.band_shards import Shards
from neusee.workflows.training.parallel.collectives import gathered_back


@dataclass(frozen=True)
class Shared:
    """Results that depend on the mask alone, and their detached copies, where gradients gather until `back`."""

    made: Mapping[str, Any]  #: the results with their graph; of shared steps, the bands of this process
    values: Mapping[str, Any]  #: the detached copies
    whole: Mapping[str, Any] = field(default_factory=dict)  #: all bands, of shared steps that are read whole
    shards: Shards | None = None

    @classmethod
    def of(cls, made: Mapping[str, Any], shards: Shards | None = None, whole: Sequence[str] = ()) -> Shared:
        """Detach results from their graph, and gather all bands of ``whole``."""
        leaves = {name: each_tensor(leaf, value) for name, value in made.items()}
        if shards is None or not leaves:
            return cls(made, leaves)
        every = {name: _alike(shards.gathered(name, leaves[name]), leaves[name]) for name in whole}
        return cls(made, leaves, every, shards)

    @property
    def seen(self) -> Mapping[str, Any]:
        """Return the copies that a step reads which needs all bands."""
        return {**self.values, **self.whole}

    def back(self) -> None:
        """Send the gathered gradients on to the mask."""
        for name, value in self.whole.items():
            for own, whole in zip(tensors_in(self.values[name]), tensors_in(value), strict=True):
                self._to_own(name, own, whole)
        pairs = zip(tensors_in(dict(self.made)), tensors_in(dict(self.values)), strict=True)
        found = [(x, leaf.grad) for x, leaf in pairs if x.requires_grad and leaf.grad is not None]
        if found:
            torch.autograd.backward([x for x, _ in found], [grad for _, grad in found])

    def _to_own(self, name: str, own: Tensor, whole: Tensor) -> None:
        """Add what all processes gathered at the bands of this process; processes without a picture take part."""
        if not own.requires_grad:
            return
        assert self.shards is not None
        grad = torch.zeros_like(whole) if whole.grad is None else whole.grad
        found = gathered_back(self.shards.mesh, grad, self.shards.axis(name), self.shards.count)
        own.grad = found if own.grad is None else own.grad + found


def leaf(x: Tensor) -> Tensor:
    """Return a detached copy at which gradients gather."""
    return x.detach().requires_grad_(x.requires_grad)


def _alike(value: Any, like: Any) -> Any:
    """Let the tensors of ``value`` require gradients where those of ``like`` do."""
    for x, y in zip(tensors_in(value), tensors_in(like), strict=True):
        x.requires_grad_(y.requires_grad)
    return value
