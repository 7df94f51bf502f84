"""The pictures from which a recipe learns: by number, each with its own scene, laser, sensor and noise.

The steps of a recipe fall into three parts. Steps that neither learn nor are drawn are computed once. Steps that
depend on the mask alone are computed once an iteration. Steps that follow a scene, a draw or a random step are computed
for each picture. Between the second and the third part the gradient waits until all pictures are done, so that one
picture is held at a time. Of several processes each has its own pictures, and along a band axis its own bands.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neusee.nodes.scene import Photographs
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.recipe.blocks.train_block import Training
from neusee.workflows.recipe.distributions.uncertain_inputs import Inputs
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import with_substitutions
from neusee.workflows.training.parallel.band_shards import Shards
from neusee.workflows.training.parallel.picture_rounds import Pictures
from neusee.workflows.training.parallel.process_mesh import ALONE, Mesh
from neusee.workflows.training.parallel.shared_graph import Shared

_LASER = ("optics.laser_irradiance", "strength")  #: of a step, what is 0 where there is no laser
_SEEDS = 2**31


@dataclass(frozen=True)
class Sample:
    """One picture, or patches of the picture."""

    picture: Tensor  #: (n, 3, y, x), of the camera, developed
    truth: Tensor  #: (n, 3, y, x)
    light: Tensor  #: (band,), the share of the scene's light that the mask keeps
    drawn: Mapping[str, Any]  #: the values that were drawn for it


class TrainingStream:
    """The stream of pictures of a recipe whose mask learns, or of the same recipe ``frozen``."""

    def __init__(
        self,
        recipe: Recipe,
        settings: Training,
        photographs: Photographs,
        store: Store,
        device: str,
        frozen: Recipe | None = None,
        mesh: Mesh = ALONE,
    ) -> None:
        learn = None if frozen else settings.learn
        self.settings, self.photographs, self.device = settings, photographs, device
        self.seed, self.mesh = recipe.seed, mesh
        self._pool = settings.pool if frozen else None
        self._kept: dict[tuple[int, int], Sample] = {}
        wanted = (settings.picture, settings.truth, settings.light, settings.psf)
        _present(recipe, (*wanted, settings.scene, *([learn] if learn else [])))
        self._inputs = Inputs.of(recipe, wanted) if recipe.uncertain and recipe.uncertain.names else None
        self.shape = _frame(recipe, settings.scene)
        recipe = with_substitutions(frozen or recipe, wanted, {learn} if learn else ())
        order = needed(recipe, wanted)
        self._lasers = [f"{n}.{_LASER[1]}" for n in order if recipe.steps[n].node.path == _LASER[0]]
        readers = dict.fromkeys([*(self._inputs.readers if self._inputs else ()), *self._lasers])
        self._readers = {name: _given(recipe, name) for name in readers}
        fixed = set(needed(recipe, [settings.psf]))  # a window that is dirty stays as it is
        noise = {name for name in order if recipe.steps[name].node.random and name not in fixed}
        drawn = _behind(recipe, order, noise | {settings.scene, *(name.rpartition(".")[0] for name in readers)})
        learnt = _behind(recipe, order, {learn} if learn else set())
        if settings.psf in drawn:
            raise ValueError(f"{settings.psf} changes with each picture: learn its suppression from a PSF that stays")
        self.shards = Shards.of(recipe, settings.psf, wanted, drawn | learnt, store, mesh)
        drawn |= self.shards.behind
        border = _read_by_pictures(recipe, order, learnt - drawn, drawn, settings.psf)
        self._divide(recipe, learn, noise, drawn, border, store)

    def _divide(
        self, recipe: Recipe, learn: str | None, noise: set[str], drawn: set[str], border: list[str], store: Store
    ) -> None:
        """Divide the recipe: steps up to ``border`` that depend on the mask alone, and steps of each picture."""
        ways: dict[str, Any] = {"store": store, "device": self.device}
        settings = self.settings
        within = [*border, settings.scene, *self._readers]
        outputs = [settings.picture, settings.truth, settings.light]
        shared = {**ways, "caller": self.shards.call}
        self.shared = as_function(recipe, learn, outputs=border, **shared) if learn else None
        read = {source for reader in drawn - self.shards.steps for source in recipe.steps[reader].sources}
        self._whole = [name for name in border if name in self.shards.steps & read]
        self._each = Pictures(recipe, within, outputs, noise, self.shards, ways)

    def begin(self, height: Tensor) -> Shared:
        """Compute what depends on the mask alone, for all pictures of an iteration."""
        made = self.shared({str(self.settings.learn): height}) if self.shared else {}
        return Shared.of(made, self.shards, self._whole)

    def counted(self, name: str, here: int) -> tuple[int, int]:
        """Return the bands of a result in all processes, and the number of processes that have each band."""
        by_band = name in self.shards.steps
        return (self.shards.count, self.mesh.data) if by_band else (here, self.mesh.size)

    def batch(self, shared: Shared, stage: int, first: int, count: int) -> Iterator[tuple[int, Sample]]:
        """Return this process's pictures among ``count`` from number ``first`` on, each with its place.

        The caller reads every picture, for the gradients of a picture return to all processes that had a share.
        """
        group = range(self.mesh.row, count, self.mesh.data)
        for begin in range(0, len(group), self.mesh.band):
            together = group[begin : begin + self.mesh.band]
            mine = together[self.mesh.column] if self.mesh.column < len(together) else None
            if self._pool is not None and not self._each.by_band:  # nobody else has a share in it
                if mine is not None:
                    yield mine, self(shared.seen, stage, first + mine)
                continue
            begun = {
                i: self._drawn(stage, (first + i) % (self._pool or _SEEDS))
                for i in together
                if i == mine or self._each.by_band
            }
            parts = {i: (theta, noise) for i, (theta, noise, _) in begun.items()}
            with self._each.together(shared, parts, mine) as found:
                if mine is not None:
                    yield mine, self._sample(found, begun[mine][2])

    def __call__(self, shared: Mapping[str, Any], stage: int, number: int) -> Sample:
        """Return the picture of a number, which depends neither on the order nor on the process."""
        if self._pool is None:
            return self._alone(shared, stage, number)
        number %= self._pool
        if (stage, number) not in self._kept:
            self._kept[stage, number] = self._alone(shared, stage, number)
        return self._kept[stage, number]

    def _alone(self, shared: Mapping[str, Any], stage: int, number: int) -> Sample:
        theta, noise, drawn = self._drawn(stage, number)
        return self._sample(self._each.alone({**shared, **theta}, noise), drawn)

    def _drawn(self, stage: int, number: int) -> tuple[dict[str, Any], int, dict[str, Any]]:
        """Return the inputs of a picture, the seed of its noise, and all values that were drawn."""
        rng = np.random.default_rng((self.seed, stage, number, 1))
        theta, drawn = dict(self._readers), dict[str, Any]()
        if self._inputs is not None:
            values = self._inputs.at(rng.standard_normal((1, len(self._inputs.names))))[0]
            drawn = dict(zip(self._inputs.names, map(float, values), strict=True))
            theta |= self._inputs.theta(drawn)
        if rng.random() < self.settings.laser_free:
            theta |= dict.fromkeys(self._lasers, 0.0)
            drawn["laser"] = "none"
        scene = self.photographs.crop(self.shape, self.seed, (stage, number))
        theta |= {self.settings.scene: scene.to(self.device, self.settings.dtype)}
        noise = int(rng.integers(_SEEDS))
        return theta, noise, {**drawn, "noise": noise, "number": number}

    def _sample(self, found: Mapping[str, Any], drawn: Mapping[str, Any]) -> Sample:
        picture, truth = (found[name].to(self.settings.dtype) for name in (self.settings.picture, self.settings.truth))
        if self.settings.size is not None:
            picture, truth = _resized(picture, self.settings.size), _resized(truth, self.settings.size)
        picture, truth = self._patches(torch.stack([picture, truth]), drawn["noise"])
        return Sample(picture, truth, found[self.settings.light], drawn)

    def _patches(self, both: Tensor, seed: int) -> Tensor:
        """Cut patches at the same places of a picture and its truth: (2, 3, y, x) -> (2, n, 3, y, x)."""
        if self.settings.patch is None:
            return both[:, None]
        size, patch = (both.shape[-2], both.shape[-1]), self.settings.patch
        if any(have < want for have, want in zip(size, patch, strict=True)):
            raise ValueError(f"train.patch: {list(patch)} is larger than the picture, {list(size)}")
        rng = np.random.default_rng((seed, 2))
        count = self.settings.patches
        places = [[int(rng.integers(h - w + 1)) for h, w in zip(size, patch, strict=True)] for _ in range(count)]
        return torch.stack([both[..., y : y + patch[0], x : x + patch[1]] for y, x in places], 1)


def _resized(picture: Tensor, size: Sequence[int]) -> Tensor:
    from neusee.nodes.bicubic_resize import resize

    return resize(picture, *size)


def _present(recipe: Recipe, names: Sequence[str]) -> None:
    from neusee.workflows.graph.diagnostics import nearest

    for name in names:
        if name not in recipe.steps:
            raise ValueError(f"train: the recipe has no step {name}; {nearest(name, recipe.steps)}")


def _frame(recipe: Recipe, scene: str) -> tuple[int, int]:
    shape = recipe.steps[scene].params.get("shape")
    if shape is None:
        raise ValueError(f"train: {scene} has no shape: give the size of the piece of a photograph")
    return shape[0], shape[1]


def _given(recipe: Recipe, name: str) -> Any:
    step, _, param = name.rpartition(".")
    return recipe.steps[step].params[param]


def _read_by_pictures(recipe: Recipe, order: Sequence[str], made: set[str], drawn: set[str], psf: str) -> list[str]:
    """Return the steps of ``made`` that a picture reads, and the PSF."""
    read = {source for reader in drawn for source in recipe.steps[reader].sources}
    return [name for name in order if name in made and (name == psf or name in read)]


def _behind(recipe: Recipe, order: Sequence[str], first: set[str]) -> set[str]:
    """Return the steps ``first`` and the steps that follow them."""
    found = set(first)
    for name in order:
        if not found.isdisjoint(recipe.steps[name].sources):
            found.add(name)
    return found
