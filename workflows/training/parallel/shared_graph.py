"""What follows the element alone: computed once an iteration, cut off from it, and gradients gather at the cut."""

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
    """What follows the element alone, cut off from it: gradients gather here until `back`."""

    made: Mapping[str, Any]  #: with its history; of what is shared by band, the own bands
    values: Mapping[str, Any]  #: without
    whole: Mapping[str, Any] = field(default_factory=dict)  #: all bands of what is shared, where someone reads them
    shards: Shards | None = None

    @classmethod
    def of(cls, made: Mapping[str, Any], shards: Shards | None = None, whole: Sequence[str] = ()) -> Shared:
        """Cut what was made off from how it was made; all bands of ``whole`` are gathered."""
        leaves = {name: each_tensor(leaf, value) for name, value in made.items()}
        if shards is None or not leaves:
            return cls(made, leaves)
        every = {name: _alike(shards.gathered(name, leaves[name]), leaves[name]) for name in whole}
        return cls(made, leaves, every, shards)

    @property
    def seen(self) -> Mapping[str, Any]:
        """What a step reads that needs all bands."""
        return {**self.values, **self.whole}

    def back(self) -> None:
        """Send what has gathered on to the element."""
        for name, value in self.whole.items():
            for own, whole in zip(tensors_in(self.values[name]), tensors_in(value), strict=True):
                self._to_own(name, own, whole)
        pairs = zip(tensors_in(dict(self.made)), tensors_in(dict(self.values)), strict=True)
        found = [(x, leaf.grad) for x, leaf in pairs if x.requires_grad and leaf.grad is not None]
        if found:
            torch.autograd.backward([x for x, _ in found], [grad for _, grad in found])

    def _to_own(self, name: str, own: Tensor, whole: Tensor) -> None:
        """What all processes ask of the own bands; each takes part, whether it has a picture or not."""
        if not own.requires_grad:
            return
        assert self.shards is not None
        grad = torch.zeros_like(whole) if whole.grad is None else whole.grad
        found = gathered_back(self.shards.mesh, grad, self.shards.axis(name), self.shards.count)
        own.grad = found if own.grad is None else own.grad + found


def leaf(x: Tensor) -> Tensor:
    """The same numbers without their history, where gradients gather."""
    return x.detach().requires_grad_(x.requires_grad)


def _alike(value: Any, like: Any) -> Any:
    """Leaves that learn where those of ``like`` do."""
    for x, y in zip(tensors_in(value), tensors_in(like), strict=True):
        x.requires_grad_(y.requires_grad)
    return value
