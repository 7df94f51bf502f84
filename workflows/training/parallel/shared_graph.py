"""Results that depend on the mask but on no picture, computed once for all pictures of a training iteration."""

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
    """Results that depend on the mask but on no picture, with detached copies that add up gradients of all pictures."""

    made: Mapping[str, Any]  #: results with their autograd graph, at the bands of this process
    values: Mapping[str, Any]  #: detached copies
    whole: Mapping[str, Any] = field(default_factory=dict)  #: copies with all bands
    shards: Shards | None = None

    @classmethod
    def of(cls, made: Mapping[str, Any], shards: Shards | None = None, whole: Sequence[str] = ()) -> Shared:
        """Detach results from the autograd graph, and gather all spectral bands of the results named in ``whole``."""
        leaves: dict[str, Any] = each_tensor(leaf, dict(made))  # two results may be one tensor
        if shards is None or not leaves:
            return cls(made, leaves)
        every = {name: _alike(shards.gathered(name, leaves[name]), leaves[name]) for name in whole}
        return cls(made, leaves, every, shards)

    @property
    def seen(self) -> Mapping[str, Any]:
        """Return the detached copies that later steps read; those in ``whole`` have all spectral bands."""
        return {**self.values, **self.whole}

    def back(self) -> None:
        """Propagate the accumulated gradients from the detached copies to the mask."""
        for name, value in self.whole.items():
            for own, whole in zip(tensors_in(self.values[name]), tensors_in(value), strict=True):
                self._to_own(name, own, whole)
        pairs = zip(tensors_in(dict(self.made)), tensors_in(dict(self.values)), strict=True)
        roots = [(x, leaf.grad) for x, leaf in pairs if x.requires_grad and leaf.grad is not None]
        if roots:
            torch.autograd.backward([x for x, _ in roots], [grad for _, grad in roots])

    def _to_own(self, name: str, own: Tensor, whole: Tensor) -> None:
        """Sum a gradient over all processes, and keep the part for the spectral bands of this process."""
        if not own.requires_grad:
            return
        assert self.shards is not None
        grad = torch.zeros_like(whole) if whole.grad is None else whole.grad
        total = gathered_back(self.shards.mesh, grad, self.shards.axis(name), self.shards.count)
        own.grad = total if own.grad is None else own.grad + total


def leaf(x: Tensor) -> Tensor:
    """Return a detached copy of a tensor, with the same ``requires_grad``."""
    return x.detach().requires_grad_(x.requires_grad)


def _alike(value: Any, like: Any) -> Any:
    """Set ``requires_grad`` of the tensors in ``value`` as in ``like``, and return ``value``."""
    for x, y in zip(tensors_in(value), tensors_in(like), strict=True):
        x.requires_grad_(y.requires_grad)
    return value
