"""The results that depend on the mask alone, which all pictures of an iteration share."""

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
    """Results that depend on the mask alone, and detached copies at which the gradients of all pictures add up."""

    made: Mapping[str, Any]  #: results with their graph, at the bands of this process
    values: Mapping[str, Any]  #: detached copies
    whole: Mapping[str, Any] = field(default_factory=dict)  #: copies with all bands
    shards: Shards | None = None

    @classmethod
    def of(cls, made: Mapping[str, Any], shards: Shards | None = None, whole: Sequence[str] = ()) -> Shared:
        """Detach results from their graph, and gather all bands of the steps ``whole``."""
        leaves = {name: each_tensor(leaf, value) for name, value in made.items()}
        if shards is None or not leaves:
            return cls(made, leaves)
        every = {name: _alike(shards.gathered(name, leaves[name]), leaves[name]) for name in whole}
        return cls(made, leaves, every, shards)

    @property
    def seen(self) -> Mapping[str, Any]:
        """Return the detached copies, with all bands of results that later steps read whole."""
        return {**self.values, **self.whole}

    def back(self) -> None:
        """Propagate the summed gradients from the copies to the mask."""
        for name, value in self.whole.items():
            for own, whole in zip(tensors_in(self.values[name]), tensors_in(value), strict=True):
                self._to_own(name, own, whole)
        pairs = zip(tensors_in(dict(self.made)), tensors_in(dict(self.values)), strict=True)
        roots = [(x, leaf.grad) for x, leaf in pairs if x.requires_grad and leaf.grad is not None]
        if roots:
            torch.autograd.backward([x for x, _ in roots], [grad for _, grad in roots])

    def _to_own(self, name: str, own: Tensor, whole: Tensor) -> None:
        """Add the gradients of all processes to the bands of this process; a process without a picture adds zeros."""
        if not own.requires_grad:
            return
        assert self.shards is not None
        grad = torch.zeros_like(whole) if whole.grad is None else whole.grad
        total = gathered_back(self.shards.mesh, grad, self.shards.axis(name), self.shards.count)
        own.grad = total if own.grad is None else own.grad + total


def leaf(x: Tensor) -> Tensor:
    """Return a detached copy of a tensor, which requires gradients if the tensor requires gradients."""
    return x.detach().requires_grad_(x.requires_grad)


def _alike(value: Any, like: Any) -> Any:
    """Make the tensors of ``value`` require gradients where the tensors of ``like`` do, and return ``value``."""
    for x, y in zip(tensors_in(value), tensors_in(like), strict=True):
        x.requires_grad_(y.requires_grad)
    return value
