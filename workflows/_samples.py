"""What a recipe is learnt from: pictures by number, each with its own scene, laser, sensor and noise.

A recipe falls into three: what neither learns nor is drawn is computed once; what follows the element alone is
computed once an iteration; what follows a scene, a draw or a random step is computed for each picture. Between the
second and the third the gradient waits until all pictures are done, so that no more than one of them is held.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neusee.workflows._codec import each_tensor, tensors_in
from neusee.workflows._economy import economised
from neusee.workflows._function import as_function
from neusee.workflows._graph import Recipe, needed
from neusee.workflows._inputs import Inputs
from neusee.workflows._photographs import Photographs
from neusee.workflows._store import Store
from neusee.workflows._training import Training

_LASER = ("optics.spot", "strength")  #: of a step, what is 0 where there is no laser
_SEEDS = 2**31


@dataclass(frozen=True)
class Sample:
    """One picture, or patches of it."""

    picture: Tensor  #: (n, 3, y, x) what the camera gives, developed
    truth: Tensor  #: (n, 3, y, x)
    light: Tensor  #: (band,) share of the scene's light that the element keeps
    drawn: Mapping[str, Any]  #: what it was made with


@dataclass(frozen=True)
class Shared:
    """What follows the element alone, cut off from it: gradients gather here until `back`."""

    made: Mapping[str, Any]  #: with its history
    values: Mapping[str, Any]  #: without

    @classmethod
    def of(cls, made: Mapping[str, Any]) -> Shared:
        """Cut what was made off from how it was made."""
        leaves = {name: each_tensor(_leaf, value) for name, value in made.items()}
        return cls(made, leaves)

    def back(self) -> None:
        """Send what has gathered on to the element."""
        pairs = zip(tensors_in(dict(self.made)), tensors_in(dict(self.values)), strict=True)
        found = [(x, leaf.grad) for x, leaf in pairs if x.requires_grad and leaf.grad is not None]
        if found:
            torch.autograd.backward([x for x, _ in found], [grad for _, grad in found])


def _leaf(x: Tensor) -> Tensor:
    return x.detach().requires_grad_(x.requires_grad)


class Samples:
    """Draws pictures through a recipe whose element learns, or through the same recipe ``frozen``."""

    def __init__(
        self,
        recipe: Recipe,
        how: Training,
        photographs: Photographs,
        store: Store,
        device: str,
        frozen: Recipe | None = None,
    ) -> None:
        learn = None if frozen else how.learn
        self.how, self.photographs, self.device, self.seed = how, photographs, device, recipe.seed
        self._pool = how.pool if frozen else None
        self._kept: dict[tuple[int, int], Sample] = {}
        wanted = (how.picture, how.truth, how.light, how.psf)
        _present(recipe, (*wanted, how.scene, *([learn] if learn else [])))
        self._inputs = Inputs.of(recipe, wanted) if recipe.uncertain and recipe.uncertain.names else None
        self.shape = _frame(recipe, how.scene)
        recipe = economised(frozen or recipe, wanted, {learn} if learn else ())
        order = needed(recipe, wanted)
        self._lasers = [f"{n}.{_LASER[1]}" for n in order if recipe.steps[n].node.path == _LASER[0]]
        readers = dict.fromkeys([*(self._inputs.readers if self._inputs else ()), *self._lasers])
        self._readers = {name: _given(recipe, name) for name in readers}
        fixed = set(needed(recipe, [how.psf]))  # a window that is dirty stays as it is
        noise = {name for name in order if recipe.steps[name].node.random and name not in fixed}
        drawn = _behind(recipe, order, noise | {how.scene, *(name.rpartition(".")[0] for name in readers)})
        learnt = _behind(recipe, order, {learn} if learn else set())
        if how.psf in drawn:
            raise ValueError(f"{how.psf} is drawn anew with each picture: its suppression cannot be learnt from")
        border = [
            name
            for name in order
            if name in learnt - drawn
            and (name == how.psf or any(name in recipe.steps[reader].sources for reader in drawn))
        ]
        within = [*border, how.scene, *self._readers]
        outputs = [how.picture, how.truth, how.light]
        self.shared = as_function(recipe, learn, outputs=border, store=store, device=device) if learn else None
        self._each = as_function(recipe, *within, outputs=outputs, store=store, device=device, redraw=noise)

    def __call__(self, shared: Mapping[str, Any], stage: int, number: int) -> Sample:
        """The picture of this number: the same whoever asks, and in whatever order."""
        if self._pool is None:
            return self._made(shared, stage, number)
        number %= self._pool
        if (stage, number) not in self._kept:
            self._kept[stage, number] = self._made(shared, stage, number)
        return self._kept[stage, number]

    def _made(self, shared: Mapping[str, Any], stage: int, number: int) -> Sample:
        seed = (self.seed, stage, number)
        rng = np.random.default_rng((*seed, 1))
        theta, drawn = dict(self._readers), dict[str, Any]()
        if self._inputs is not None:
            values = self._inputs.at(rng.standard_normal((1, len(self._inputs.names))))[0]
            drawn = dict(zip(self._inputs.names, map(float, values), strict=True))
            theta |= self._inputs.theta(drawn)
        if rng.random() < self.how.laser_free:
            theta |= dict.fromkeys(self._lasers, 0.0)
            drawn["laser"] = "none"
        theta |= {
            **shared,
            self.how.scene: self.photographs.crop(self.shape, self.seed, (stage, number)).to(self.device),
        }
        noise = int(rng.integers(_SEEDS))
        found = self._each(theta, seed=noise)
        picture, truth = found[self.how.picture], found[self.how.truth]
        if self.how.size is not None:
            picture, truth = _resized(picture, self.how.size), _resized(truth, self.how.size)
        picture, truth = self._patches(torch.stack([picture, truth]), rng)
        return Sample(picture, truth, found[self.how.light], {**drawn, "noise": noise, "number": number})

    def _patches(self, both: Tensor, rng: np.random.Generator) -> Tensor:
        """(2, 3, y, x) -> (2, n, 3, y, x): the same places of a picture and of its truth, or all of it."""
        if self.how.patch is None:
            return both[:, None]
        size, patch = (both.shape[-2], both.shape[-1]), self.how.patch
        if any(have < want for have, want in zip(size, patch, strict=True)):
            raise ValueError(f"train.patch: {list(patch)} is larger than the picture, {list(size)}")
        places = [
            [int(rng.integers(h - w + 1)) for h, w in zip(size, patch, strict=True)] for _ in range(self.how.patches)
        ]
        return torch.stack([both[..., y : y + patch[0], x : x + patch[1]] for y, x in places], 1)


def _resized(picture: Tensor, size: Sequence[int]) -> Tensor:
    from neusee.nodes._bicubic import resize

    return resize(picture, *size)


def _present(recipe: Recipe, names: Sequence[str]) -> None:
    from neusee.workflows._marks import nearest

    for name in names:
        if name not in recipe.steps:
            raise ValueError(f"train: the recipe has no step {name}; {nearest(name, recipe.steps)}")


def _frame(recipe: Recipe, scene: str) -> tuple[int, int]:
    shape = recipe.steps[scene].params.get("shape")
    if shape is None:
        raise ValueError(f"train: {scene} has no shape: say how large a piece of a photograph shall be")
    return shape[0], shape[1]


def _given(recipe: Recipe, name: str) -> Any:
    step, _, param = name.rpartition(".")
    return recipe.steps[step].params[param]


def _behind(recipe: Recipe, order: Sequence[str], first: set[str]) -> set[str]:
    """``first`` and the steps that follow."""
    found = set(first)
    for name in order:
        if not found.isdisjoint(recipe.steps[name].sources):
            found.add(name)
    return found
