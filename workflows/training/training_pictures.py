"""The numbered training pictures, each with its own scene, laser, sensor parameters and noise.

Steps that depend neither on the mask nor on a drawn value are computed once, steps that depend only on the mask once
in each iteration, and steps that depend on a scene, a drawn value or noise once for each picture. Gradients of steps
that depend only on the mask are summed over all pictures, so that one picture is in memory at a time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neusee.nodes.bicubic_resize import resize
from neusee.nodes.scene import Change, Photographs, symmetry
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.graph.recipe_graph import Recipe, dependents, needed
from neusee.workflows.graph.told_copies import TOLD
from neusee.workflows.recipe.blocks.train_block import Training
from neusee.workflows.recipe.distributions.uncertain_inputs import Inputs
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import with_substitutions
from neusee.workflows.training.camera_mismatch import CameraMismatch
from neusee.workflows.training.parallel.band_shards import Shards
from neusee.workflows.training.parallel.picture_rounds import Pictures
from neusee.workflows.training.parallel.process_mesh import ALONE, Mesh
from neusee.workflows.training.parallel.shared_graph import Shared
from neusee.workflows.training.posed_pictures import Given, PosedPictures, given_of, tensors_of, turned
from neusee.workflows.training.stored_pool import StoredPool
from neusee.workflows.training.training_recipe import frame_of, in_precision, require_steps

_LASER = ("optics.laser_irradiance", "strength")  #: the node of a laser, and the parameter that is 0 without a laser
_SEEDS = 2**31
HELD_OUT = 3  #: in place of the number of a stage: the pictures of held-out photographs, the same in both stages


@dataclass(frozen=True)
class Sample:
    """One training picture and the true picture, or patches of both."""

    picture: Tensor  #: (n, 3, y, x), the developed picture of the camera
    truth: Tensor  #: (n, 3, y, x), the true picture
    light: Tensor  #: (band,), the fraction of the light of the scene that the mask keeps; empty where no loss reads it
    drawn: Mapping[str, Any]  #: the values that were sampled for the picture
    given: Given = ()  #: what the network needs beside the picture

    @property
    def tensors(self) -> dict[str, Tensor]:
        """Return picture, true picture, light, and what the network needs beside the picture, by name."""
        return {"picture": self.picture, "truth": self.truth, "light": self.light, **tensors_of(self.given)}

    @classmethod
    def of(cls, tensors: Mapping[str, Tensor], drawn: Mapping[str, Any]) -> Sample:
        """Return the training picture whose tensors `tensors` named."""
        return cls(tensors["picture"], tensors["truth"], tensors["light"], drawn, given_of(tensors))


_NOTHING = Sample(torch.zeros(0), torch.zeros(0), torch.zeros(0), {})  #: of a process without a picture in a round


class TrainingStream:
    """The training pictures of a recipe, behind a mask that is trained or behind the fixed mask of ``frozen``."""

    repeats = 1  #: pictures of each held-out photograph

    def __init__(
        self,
        recipe: Recipe,
        settings: Training,
        photographs: Photographs,
        store: Store,
        device: str,
        frozen: Recipe | None = None,
        mesh: Mesh = ALONE,
        held_out: Sequence[Path] = (),
    ) -> None:
        learn = None if frozen else settings.learn
        self.settings, self.photographs, self.device = settings, photographs, device
        self.seed, self.mesh, self.held_out = recipe.seed, mesh, held_out
        self._pool = settings.pool if frozen else None
        self._kept: dict[tuple[int, int], Sample] = {}
        self._rounds: dict[tuple[int, ...], Sample] = {}  #: by stage and numbers, of processes that divide the bands
        outputs: tuple[str, ...] = (settings.picture, settings.truth, settings.light, settings.psf)
        require_steps(recipe, "train", (*outputs, settings.scene, *([learn] if learn else [])))
        self._inputs = Inputs.of(recipe, outputs) if recipe.uncertain and recipe.uncertain.names else None
        self._mismatch = CameraMismatch.of(recipe, settings)
        self.shape = frame_of(recipe, settings.scene)
        believed = in_precision(frozen or recipe, settings.dtype)
        self._posed = PosedPictures.of(recipe, settings)
        believed = self._posed.within(believed) if self._posed else believed
        self._made = self._outputs(2 if frozen else 1)
        recipe, self.psf = self._mismatch.camera(believed, self._made, settings.psf)
        outputs = (*self._made, self.psf)
        recipe = with_substitutions(replace(recipe, estimates=False), outputs, {learn} if learn else ())
        order = needed(recipe, outputs)
        keeps = self._pool and settings.keep_pool
        self._stored = StoredPool(recipe, settings, self._made, store, device) if keeps else None
        self._lasers = [f"{n}.{_LASER[1]}" for n in order if recipe.steps[n].node.path == _LASER[0]]
        self._readers = self._read(believed, order)
        noise, drawn = self._changing(recipe, order)
        learnt = dependents(recipe, {learn} if learn else (), order)
        self.shards = Shards.of(recipe, self.psf, outputs, drawn | learnt, store, mesh)
        drawn |= self.shards.behind
        read = _sources(recipe, drawn) | {self.psf}
        self._divide(recipe, learn, [n for n in order if n in (learnt - drawn) & read], drawn, noise, store)

    def _changing(self, recipe: Recipe, order: Sequence[str]) -> tuple[set[str], set[str]]:
        """Return the steps that draw noise for each picture, and all steps that change with each picture."""
        fixed = set(needed(recipe, [self.psf]))  # random effects in the PSF, such as dirt, are constant
        noise = {name for name in order if recipe.steps[name].node.random and name not in fixed}
        read = {self.settings.scene, *(name.rpartition(".")[0] for name in self._readers)}
        drawn = dependents(recipe, noise | read, order)
        if self.psf in drawn:
            raise ValueError(
                f"train.psf: {self.settings.psf} changes with each picture: name a step with a constant PSF"
            )
        return noise, drawn

    def _outputs(self, number: int) -> tuple[str, ...]:
        """Return the steps that make a picture of a stage: what a network sees, the truth, light if a loss reads it."""
        stage = self.settings.stages.get(number)
        light = (self.settings.light,) if stage is not None and stage.bsr else ()
        seen = self._posed.steps if self._posed else (self.settings.picture,)
        return (*seen, self.settings.truth, *light)

    def _read(self, believed: Recipe, order: Sequence[str]) -> dict[str, Any]:
        """Return the parameters that change with each picture, with the values that the recipe states.

        What is drawn for the camera is told to the restorer too, but for the differences of ``train.mismatch``.
        """
        drawn = dict.fromkeys([*(self._inputs.readers if self._inputs else ()), *self._lasers])
        told, steps = [TOLD + name for name in drawn], set(order)
        each = [name for name in (*drawn, *told, *self._mismatch.moved) if name.rpartition(".")[0] in steps]
        return {name: _given(believed, name.removeprefix(TOLD)) for name in each}

    def _divide(
        self, recipe: Recipe, learn: str | None, border: list[str], drawn: set[str], noise: set[str], store: Store
    ) -> None:
        """Divide the recipe into steps that depend on the mask alone, up to ``border``, and steps for each picture."""
        settings = self.settings
        ways: dict[str, Any] = {"store": store, "device": self.device}
        read = self.shards.steps & _sources(recipe, drawn - self.shards.steps)
        self._whole = [name for name in border if name in read]
        caller = self.shards.call
        self.shared = as_function(recipe, learn, outputs=border, caller=caller, **ways) if learn else None
        free = [*border, settings.scene, *self._readers]
        self._each = Pictures(recipe, free, self._made, noise, self.shards, ways)
        if self._each.by_band:
            self._stored = None  # a picture that several processes compute stays in memory

    @property
    def pool_counts(self) -> dict[str, int]:
        """Return how many pictures of the pool this process read from the store, and how many it simulated."""
        return {"from_store": self._stored.read, "simulated": self._stored.computed} if self._stored else {}

    def begin(self, height: Tensor) -> Shared:
        """Compute the steps that depend on the mask alone, once for all pictures of a training iteration."""
        results = self.shared({str(self.settings.learn): height}) if self.shared else {}
        return Shared.of(results, self.shards, self._whole)

    def counted(self, name: str, here: int) -> tuple[int, int]:
        """Return the total number of spectral bands of a result, and the number of processes that compute each band."""
        by_band = name in self.shards.steps
        return (self.shards.count, self.mesh.data) if by_band else (here, self.mesh.size)

    def batch(self, shared: Shared, stage: int, first: int, count: int) -> Iterator[tuple[int, Sample]]:
        """Yield index and picture for each picture of a training batch that this process completes.

        The batch has ``count`` pictures and begins with the picture number ``first``.

        The caller must exhaust the iterator, because gradients return to all processes that computed a part.
        """
        group = range(self.mesh.row, count, self.mesh.data)
        for begin in range(0, len(group), self.mesh.band):
            together = group[begin : begin + self.mesh.band]
            mine = together[self.mesh.column] if self.mesh.column < len(together) else None
            if not self._each.by_band:
                if mine is not None:
                    yield mine, self.turned(self(shared.seen, stage, first + mine), stage, first + mine)
                continue
            key = (stage, *(self._number(stage, first + i) for i in together))
            if key in self._rounds:  # in the memory of all processes, or of none
                if mine is not None:
                    yield mine, self.turned(self._rounds[key], stage, first + mine)
                continue
            begun = {i: self._drawn(stage, number) for i, number in zip(together, key[1:], strict=True)}
            parts = {i: (theta, noise) for i, (theta, noise, _) in begun.items()}
            with self._each.together(shared, parts, mine) as values:
                sample = _NOTHING if mine is None else self._sample(values, begun[mine][2])
                if mine is not None:
                    yield mine, self.turned(sample, stage, first + mine)
            if self._pool is not None and stage != HELD_OUT:
                self._rounds[key] = sample

    def __call__(self, shared: Mapping[str, Any], stage: int, number: int) -> Sample:
        """Return the training picture with the given number, which does not depend on order or process."""
        number = self._number(stage, number)
        if self._pool is None or stage == HELD_OUT:
            return self._alone(shared, stage, number)
        if (stage, number) not in self._kept:
            self._kept[stage, number] = self._alone(shared, stage, number)
        return self._kept[stage, number]

    def _number(self, stage: int, number: int) -> int:
        """Return the number of a picture within its pool; held-out pictures have no pool."""
        return number % (self._pool or _SEEDS) if stage != HELD_OUT else number

    def turned(self, sample: Sample, stage: int, number: int) -> Sample:
        """Turn a pooled picture and the true picture together, each time otherwise: as behind a mask that is turned."""
        if self._pool is None or stage == HELD_OUT or self.settings.augment.pooled == "none":
            return sample
        seed = (self.seed, stage, number, 4)
        picture, truth = symmetry(sample.picture, seed), symmetry(sample.truth, seed)
        return replace(sample, picture=picture, truth=truth, given=turned(sample.given, seed))

    def _scene(self, stage: int, number: int) -> Tensor:
        """Return the scene of a picture (3, y, x), with the changes of ``train.augment``."""
        if stage == HELD_OUT:
            return Photographs((self.held_out[number],)).crop(self.shape, self.seed, (stage, number))
        how = self.settings.augment
        much = how.exposure, how.colour, how.enlarge
        change = Change.drawn((self.seed, stage, number, 3), how.symmetries == "all", *much)
        return change.of(self.photographs.crop(change.frame(self.shape), self.seed, (stage, number)), self.shape)

    def _alone(self, shared: Mapping[str, Any], stage: int, number: int) -> Sample:
        theta, noise, drawn = self._drawn(stage, number)

        def simulated() -> Sample:
            return self._sample(self._each.alone({**shared, **theta}, noise), drawn)

        if self._stored is None or stage == HELD_OUT:
            return simulated()
        given = {name: theta[name] for name in self._readers}
        kept = self._stored.picture(theta[self.settings.scene], given, noise, lambda: simulated().tensors)
        return Sample.of(kept, drawn)

    def _drawn(self, stage: int, number: int) -> tuple[dict[str, Any], int, dict[str, Any]]:
        """Sample the random inputs of a training picture; return the inputs, the noise seed, and all values by name."""
        rng = np.random.default_rng((self.seed, stage, number, 1))
        theta, drawn = dict(self._readers), dict[str, Any]()
        if self._inputs is not None:
            values = self._inputs.at(rng.standard_normal((1, len(self._inputs.names))))[0]
            drawn = dict(zip(self._inputs.names, map(float, values), strict=True))
            theta |= self._inputs.theta(drawn)
        theta |= {name: theta[name.removeprefix(TOLD)] for name in theta if name.startswith(TOLD)}
        differences = self._mismatch.drawn((self.seed, stage, number))
        theta |= self._mismatch.truth(theta, differences)
        drawn |= {f"mismatch {path}": value for path, value in differences.items()}
        if rng.random() < self.settings.laser_free:
            theta |= dict.fromkeys(self._lasers, 0.0)
            drawn["laser"] = "none"
        theta |= {self.settings.scene: self._scene(stage, number).to(self.device, self.settings.dtype)}
        noise = int(rng.integers(_SEEDS))
        return theta, noise, {**drawn, "noise": noise, "number": number}

    def _sample(self, values: Mapping[str, Any], drawn: Mapping[str, Any]) -> Sample:
        """Resize a training picture and the true picture to ``train.size``, and cut both into patches.

        Antialiased `kornia.geometry.transform.resize` lets stripes alias: at 2/3 of the size the finest stripes keep a
        contrast of 0.69 with kornia, and of 0.09 with `resize`.
        """
        light = values.get(self.settings.light, torch.zeros(0))
        dtype = self.settings.dtype
        picture, given = self._posed.read(values, dtype) if self._posed else (values[self.settings.picture], ())
        both = [x.to(dtype) for x in (picture, values[self.settings.truth])]
        if self.settings.size is not None:
            both = [resize(picture, *self.settings.size) for picture in both]
        picture, truth = self._patches(torch.stack(both), drawn["noise"])
        return Sample(picture, truth, light, drawn, given)

    def _patches(self, both: Tensor, seed: int) -> Tensor:
        """Cut patches from a training picture and the true picture at the same positions, as a tensor (2, n, 3, y, x).

        A slice gives the same pixels as `kornia.geometry.transform.crop_by_indices` in a tenth of the time.
        """
        if self.settings.patch is None:
            return both[:, None]
        size, patch = (both.shape[-2], both.shape[-1]), self.settings.patch
        if any(have < want for have, want in zip(size, patch, strict=True)):
            raise ValueError(f"train.patch: {list(patch)} is larger than the picture {list(size)}: set a smaller patch")
        rng = np.random.default_rng((seed, 2))
        count = self.settings.patches
        places = [[int(rng.integers(h - w + 1)) for h, w in zip(size, patch, strict=True)] for _ in range(count)]
        return torch.stack([both[..., y : y + patch[0], x : x + patch[1]] for y, x in places], 1)


def _given(recipe: Recipe, name: str) -> Any:
    step, _, param = name.rpartition(".")
    return recipe.steps[step].params[param]


def _sources(recipe: Recipe, readers: Iterable[str]) -> set[str]:
    return {source for reader in readers for source in recipe.steps[reader].sources}
