"""The numbered training pictures: scene, laser, camera and noise, and their stored pool."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neusee.nodes import restore
from neusee.nodes.resampling import resize
from neusee.nodes.scene import Change, Photographs, symmetry
from neusee.nodes.values import FilterFacts, WienerProblem
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.node_call import place
from neusee.workflows.graph.errors import nearest
from neusee.workflows.graph.recipe_graph import TOLD, Recipe, Step, dependents, needed
from neusee.workflows.keys.cache_key import device_kind, digest, is_private, key_of
from neusee.workflows.keys.code_digest import Code, engine
from neusee.workflows.recipe.blocks.train_block import KEY, POSED, Training
from neusee.workflows.recipe.uncertain_inputs import Inputs
from neusee.workflows.store.result_store import Store, compute_once
from neusee.workflows.store.serialization import each_tensor, tensors_in
from neusee.workflows.tolerance.cheaper_steps import with_substitutions
from neusee.workflows.training.camera_mismatch import CameraMismatch
from neusee.workflows.training.process_mesh import ALONE, Mesh, MeshError

# --- training recipe ------------------------------------------------------------------------------

# What a training asks of a recipe: steps that exist, a scene of stated size, and float64 where it
# is wanted.


def in_precision(recipe: Recipe, dtype: torch.dtype) -> Recipe:
    """Return the recipe with steps in float64 if ``dtype`` is float64: steps with a choice of
    precision are double.
    """
    if dtype != torch.float64:
        return recipe
    steps = {
        name: _precise(step) if "precision" in step.params else step
        for name, step in recipe.steps.items()
    }
    return replace(recipe, steps=steps)


def _precise(step: Step) -> Step:
    return replace(step, params={**step.params, "precision": "double"})


def require_steps(recipe: Recipe, block: str, names: Sequence[str]) -> None:
    """Raise ValueError unless the recipe has all steps ``names``, which the settings block
    ``block`` names.
    """
    for name in names:
        if name not in recipe.steps:
            raise ValueError(
                f"{block}: the recipe has no step {name}; {nearest(name, recipe.steps)}"
            )


def frame_of(recipe: Recipe, scene: str) -> tuple[int, int]:
    """Return the sides of the scene in pixels (y, x); raise ValueError if the step ``scene``
    does not state them.
    """
    shape = recipe.steps[scene].params.get("shape")
    if shape is None:
        raise ValueError(
            f"train: the step {scene} has no shape: set {scene}.shape in pixels, such as [96, 96]"
        )
    return shape[0], shape[1]


# --- posed pictures -------------------------------------------------------------------------------

# Training pictures of a network that needs what the Wiener filter knows: the filter is solved once
# for each picture.
#
# The networks `unrolled` and `informed` need the PSF, the glare, the clipped pixels and the noise
# of a picture. The recipe gives them to the step of the filter, whose result `train.picture`
# converts to colours. In the training the node of this step is `restore.wiener_problem` or
# `restore.filter_facts`, with the same inputs, so that the answer of the filter is the input of the
# network.


Posed = WienerProblem | FilterFacts
#: nothing, or what the filter poses and knows, and the colour matrix
Given = tuple[()] | tuple[Posed, Tensor]
_FILTERS = ("restore.wiener", "restore.unrolled", "restore.informed")
_KNOWN: dict[str, Any] = {"unrolled": restore.wiener_problem, "informed": restore.filter_facts}
_PARAMETERS = ("balance", "doubt", "least_doubt", "read_noise")


@dataclass(frozen=True)
class PosedPictures:
    """The steps of a recipe that pose the problem of a picture, and that compute the colour
    matrix.
    """

    filter: str
    matrix: str
    kind: str = "unrolled"  #: of the network

    @classmethod
    def of(cls, recipe: Recipe, settings: Training) -> PosedPictures | None:
        """Return the steps of a training of such a network, or None for every other network.

        Raises ValueError if the picture of the training is not that of the Wiener filter.
        """
        kind = settings.network.kind
        if settings.network.architecture is not None or kind not in POSED:
            return None
        picture_step = recipe.steps[settings.picture]
        channels, matrix = (str(picture_step.wires.get(name)) for name in ("channels", "matrix"))
        if (
            picture_step.node.path != "restore.colour"
            or recipe.steps[channels].node.path not in _FILTERS
        ):
            setting = recipe.config.settings.get(f"{KEY}.picture")
            problem = (
                f"{settings.picture} is {picture_step.node.path}, and the network {kind}"
                f" starts from the Wiener filter: use restore: wiener and {KEY}.picture: restored"
            )
            raise ValueError(
                f"{setting.source if setting else recipe.name}   {KEY}.picture   {problem}"
            )
        return cls(channels, matrix, kind)

    @property
    def steps(self) -> tuple[str, str]:
        """Return the steps from which `read` makes the input of the network."""
        return (self.filter, self.matrix)

    def within(self, recipe: Recipe) -> Recipe:
        """Return the recipe whose filter poses the problem and solves it."""
        step = recipe.steps[self.filter]
        params = {name: value for name, value in step.params.items() if name in _PARAMETERS}
        posing_step = replace(step, node=_KNOWN[self.kind], params=params)
        return replace(recipe, steps={**recipe.steps, self.filter: posing_step})

    def read(self, values: Mapping[str, Any], dtype: torch.dtype) -> tuple[Tensor, Given]:
        """Return the picture of the filter (3, y, x), and what the network needs beside it in the
        given precision.

        The filter solves small pictures in float64; the steps of a training take half the time in
        float32.
        """
        posed, matrix = values[self.filter], values[self.matrix]
        picture: Tensor = restore.colour(posed.answer * posed.scale + posed.mean, matrix)
        return picture, (posed._make(tensor.to(dtype) for tensor in posed), matrix.to(dtype))


def tensors_of(beside: Given) -> dict[str, Tensor]:
    """Return the tensors by name of what a network needs beside a picture."""
    if not beside:
        return {}
    posed, matrix = beside
    return {**{f"given.{name}": x for name, x in posed._asdict().items()}, "given.matrix": matrix}


def given_of(tensors: Mapping[str, Tensor]) -> Given:
    """Return what a network needs beside a picture, from its tensors by name."""
    if "given.matrix" not in tensors:
        return ()
    kind = FilterFacts if "given.maps" in tensors else WienerProblem
    return (
        kind(**{name: tensors[f"given.{name}"] for name in kind._fields}),
        tensors["given.matrix"],
    )


def turned(beside: Given, seed: tuple[int, ...]) -> Given:
    """Turn the maps that a network sees beside a picture, as `scene.symmetry` turns the picture
    with the same seed.
    """
    filter_facts = beside[0] if beside else None
    if not beside or not isinstance(filter_facts, FilterFacts):
        return beside
    maps = {
        name: symmetry(getattr(filter_facts, name), seed)
        for name in ("answer", "deviation", "maps")
    }
    return filter_facts._replace(**maps), beside[1]


# --- stored pool ----------------------------------------------------------------------------------

# Simulated training pictures in the store, so that a later training with the same pictures begins
# at once.
#
# The key of a picture is made of the keys of its steps with the values that were drawn for it, of
# the scene itself and of the noise. So a picture of another optics, sensor, laser, distribution or
# code has another key.


_ABOUT = {"step": "training picture"}
_CODE = ("training.training_pictures", "training.training_pictures")


class StoredPool:
    """The pictures of a pool behind a fixed mask, each in the store under a key of its own."""

    def __init__(
        self, recipe: Recipe, settings: Training, outputs: Sequence[str], store: Store, device: str
    ) -> None:
        self.recipe, self.settings, self.store, self.device = recipe, settings, store, device
        self._outputs = tuple(outputs)
        self._order = [name for name in needed(recipe, self._outputs) if name != settings.scene]
        self._code = Code(store.code_memo)
        self._resize = self._code.digest("neusee.nodes.resampling")
        #: pictures that came from the store, and pictures that were simulated
        self.read, self.computed = 0, 0

    def picture(
        self,
        scene: Tensor,
        drawn: Mapping[str, Any],
        noise: int,
        compute: Callable[[], dict[str, Tensor]],
    ) -> dict[str, Tensor]:
        """Return the tensors of a picture from the store, or compute and store them before the
        next picture.
        """
        key = self._key(scene, drawn, noise)
        computed: list[bool] = []

        def simulated() -> dict[str, Tensor]:
            computed.append(True)
            return compute()

        tensors: dict[str, Tensor] = (
            simulated()
            if is_private(key)
            else compute_once(self.store, key, dict, simulated, _ABOUT)
        )
        # `compute_once` calls the function only if the store lacks the key
        self.computed, self.read = self.computed + bool(computed), self.read + (not computed)
        return {name: x.to(self.device) for name, x in tensors.items()}

    def _key(self, scene: Tensor, changed: Mapping[str, Any], noise: int) -> str:
        """Return the key of a picture, from all that decides it.

        That is the scene, the changed parameters, the noise seed and how the picture is cut. A step
        that reads something private gives a private key, which is not stored.
        """
        settings, recipe = self.settings, self.recipe
        scene_pixels = scene.detach().cpu().contiguous()
        key_of_step = {settings.scene: hashlib.sha256(scene_pixels.numpy().tobytes()).hexdigest()}
        changed_params: dict[str, dict[str, Any]] = {}
        for reader, value in changed.items():
            step_name, _, param = reader.rpartition(".")
            changed_params.setdefault(step_name, {})[param] = value
        # the keys of all steps with the drawn parameters, as a run has them
        for name in self._order:
            step = recipe.steps[name]
            step = replace(step, params={**step.params, **changed_params.get(name, {})})
            key_of_step[name], _ = key_of(
                step, key_of_step, recipe.seed, self._code, place(step, self.device)
            )
        output_keys = [key_of_step[name] for name in self._outputs]
        if private_key := next(filter(is_private, output_keys), None):
            return private_key
        # what is done with the picture after the camera
        cut_settings = [
            settings.size,
            settings.patch,
            settings.patches,
            settings.precision,
            self._resize,
        ]
        surroundings = [
            list(scene_pixels.shape),
            noise,
            recipe.tolerance,
            recipe.exact,
            recipe.estimates,
            device_kind(self.device),
        ]
        return digest("training picture", engine(*_CODE), output_keys, cut_settings, surroundings)


# --- training pictures ----------------------------------------------------------------------------

# The numbered training pictures, each with its own scene, laser, sensor parameters and noise.
#
# Steps that depend neither on the mask nor on a drawn value are computed once, steps that depend
# only on the mask once in each iteration, and steps that depend on a scene, a drawn value or noise
# once for each picture. Gradients of steps that depend only on the mask are summed over all
# pictures, so that one picture is in memory at a time.


#: the node of a laser, and the parameter that is 0 without a laser
_LASER = ("optics.laser_irradiance", "strength")
# noise seeds and picture numbers lie below this
_SEEDS = 2**31
#: in place of the number of a stage: the pictures of held-out photographs, the same in both stages
HELD_OUT = 3


@dataclass(frozen=True)
class Sample:
    """One training picture and the true picture, or patches of both."""

    picture: Tensor  #: (n, 3, y, x), the developed picture of the camera
    truth: Tensor  #: (n, 3, y, x), the true picture
    #: (band,), the fraction of the light of the scene that the mask keeps; empty where no loss
    #: reads it
    light: Tensor
    drawn: Mapping[str, Any]  #: the values that were sampled for the picture
    given: Given = ()  #: what the network needs beside the picture

    @property
    def tensors(self) -> dict[str, Tensor]:
        """Return picture, true picture, light, and what the network needs beside the picture, by
        name.
        """
        return {
            "picture": self.picture,
            "truth": self.truth,
            "light": self.light,
            **tensors_of(self.given),
        }

    @classmethod
    def of(cls, tensors: Mapping[str, Tensor], drawn: Mapping[str, Any]) -> Sample:
        """Return the training picture whose tensors `tensors` named."""
        return cls(tensors["picture"], tensors["truth"], tensors["light"], drawn, given_of(tensors))


@dataclass(frozen=True)
class Shared:
    """Results that depend on the mask but on no picture, with detached copies that add up
    gradients of all pictures.
    """

    made: Mapping[str, Any]  #: results with their autograd graph
    values: Mapping[str, Any]  #: detached copies, which later steps read

    @classmethod
    def of(cls, made: Mapping[str, Any]) -> Shared:
        """Detach results from the autograd graph."""
        return cls(made, each_tensor(_leaf, dict(made)))  # two results may be one tensor

    def back(self) -> None:
        """Propagate the accumulated gradients from the detached copies to the mask."""
        results_and_leaves = zip(
            tensors_in(dict(self.made)), tensors_in(dict(self.values)), strict=True
        )
        graph_ends = [
            (x, leaf.grad)
            for x, leaf in results_and_leaves
            if x.requires_grad and leaf.grad is not None
        ]
        if graph_ends:
            torch.autograd.backward([x for x, _ in graph_ends], [grad for _, grad in graph_ends])


def _leaf(x: Tensor) -> Tensor:
    """Return a detached copy of a tensor, with the same ``requires_grad``."""
    return x.detach().requires_grad_(x.requires_grad)


@dataclass(frozen=True)
class PictureSource:
    """From what the pictures of a training are computed, and where."""

    photographs: Photographs
    store: Store
    device: str = "cpu"
    mesh: Mesh = ALONE
    held_out: Sequence[Path] = ()  #: photographs that only the validation sees


class TrainingStream:
    """The training pictures of a recipe, behind a mask that is trained or behind the fixed mask
    of ``frozen``.
    """

    repeats = 1  #: pictures of each held-out photograph

    def __init__(
        self,
        recipe: Recipe,
        settings: Training,
        source: PictureSource,
        frozen: Recipe | None = None,
    ) -> None:
        learn = None if frozen else settings.learn
        learnt_steps = {learn} if learn else set[str]()
        self.settings, self.seed = settings, recipe.seed
        self.photographs, self.held_out = source.photographs, source.held_out
        self.device, self.mesh = source.device, source.mesh
        self._pool = settings.pool if frozen else None
        self._kept: dict[tuple[int, int], Sample] = {}
        outputs: tuple[str, ...] = (settings.picture, settings.truth, settings.light, settings.psf)
        require_steps(recipe, "train", (*outputs, settings.scene, *learnt_steps))
        self._inputs = _uncertain_inputs(recipe, outputs)
        self._mismatch = CameraMismatch.of(recipe, settings)
        self.shape = frame_of(recipe, settings.scene)
        # what the restorer is told of the camera
        believed = in_precision(frozen or recipe, settings.dtype)
        self._posed = PosedPictures.of(recipe, settings)
        if self._posed:
            believed = self._posed.within(believed)
        self._made = self._outputs(2 if frozen else 1)
        # the camera that takes the pictures may differ from it
        recipe, self.psf = self._mismatch.camera(believed, self._made, settings.psf)
        outputs = (*self._made, self.psf)
        recipe = with_substitutions(replace(recipe, estimates=False), outputs, learnt_steps)
        order = needed(recipe, outputs)
        self._stored = self._stored_pool(recipe, source.store)
        self._lasers = _parameters_of_lasers(recipe, order)
        self._readers = self._read(believed, order)
        # steps that draw noise for each picture, and all steps that change with each picture
        noise_steps, picture_steps = self._changing(recipe, order)
        steps_behind_mask = dependents(recipe, learnt_steps, order)
        read_by_pictures = _sources(recipe, picture_steps) | {self.psf}
        # steps behind the mask that no picture changes but that the steps of pictures read
        shared_outputs = [
            name for name in order if name in (steps_behind_mask - picture_steps) & read_by_pictures
        ]
        self._divide(recipe, learn, shared_outputs, noise_steps, source.store)

    def _stored_pool(self, recipe: Recipe, store: Store) -> StoredPool | None:
        """Return the pictures of a pool in the store, or None if there is no pool to keep."""
        if not self._pool or not self.settings.keep_pool:
            return None
        return StoredPool(recipe, self.settings, self._made, store, self.device)

    def _changing(self, recipe: Recipe, order: Sequence[str]) -> tuple[set[str], set[str]]:
        """Return the steps that draw noise for each picture, and all steps that change with each
        picture.
        """
        # random effects in the PSF, such as dirt, are constant
        psf_steps = set(needed(recipe, [self.psf]))
        noise_steps = {
            name for name in order if recipe.steps[name].node.random and name not in psf_steps
        }
        drawn_steps = {self.settings.scene, *(name.rpartition(".")[0] for name in self._readers)}
        picture_steps = dependents(recipe, noise_steps | drawn_steps, order)
        if self.psf in picture_steps:
            raise ValueError(
                f"train.psf: {self.settings.psf} changes with each picture: name a step with a"
                " constant PSF"
            )
        return noise_steps, picture_steps

    def _outputs(self, number: int) -> tuple[str, ...]:
        """Return the steps that make a picture of a stage: what a network sees, the truth, light
        if a loss reads it.
        """
        stage = self.settings.stages.get(number)
        light = (self.settings.light,) if stage is not None and stage.bsr else ()
        input_steps = self._posed.steps if self._posed else (self.settings.picture,)
        return (*input_steps, self.settings.truth, *light)

    def _read(self, believed: Recipe, order: Sequence[str]) -> dict[str, Any]:
        """Return the parameters that change with each picture, with the values that the recipe
        states.

        What is drawn for the camera is told to the restorer too, but for the differences of
        ``train.mismatch``.
        """
        drawn_names = dict.fromkeys(
            [*(self._inputs.readers if self._inputs else ()), *self._lasers]
        )
        believed_names, step_names = [TOLD + name for name in drawn_names], set(order)
        changing = [
            name
            for name in (*drawn_names, *believed_names, *self._mismatch.moved)
            if name.rpartition(".")[0] in step_names
        ]
        return {name: _parameter(believed, name.removeprefix(TOLD)) for name in changing}

    def _divide(
        self,
        recipe: Recipe,
        learn: str | None,
        border: list[str],
        noise: set[str],
        store: Store,
    ) -> None:
        """Divide the recipe into steps that depend on the mask alone, up to ``border``, and
        steps for each picture.
        """
        options: dict[str, Any] = {"store": store, "device": self.device}
        self.shared = as_function(recipe, learn, outputs=border, **options) if learn else None
        free_inputs = [*border, self.settings.scene, *self._readers]
        self._simulate = as_function(
            recipe, *free_inputs, outputs=self._made, redraw=noise, **options
        )

    @property
    def pool_counts(self) -> dict[str, int]:
        """Return how many pictures of the pool this process read from the store, and how many it
        simulated.
        """
        return (
            {"from_store": self._stored.read, "simulated": self._stored.computed}
            if self._stored
            else {}
        )

    def begin(self, height: Tensor) -> Shared:
        """Compute the steps that depend on the mask alone, once for all pictures of a training
        iteration.
        """
        results = self.shared({str(self.settings.learn): height}) if self.shared else {}
        return Shared.of(results)

    def batch(
        self, shared: Shared, stage: int, first: int, count: int
    ) -> Iterator[tuple[int, Sample]]:
        """Yield index and picture for each picture of a training batch that this process simulates.

        The batch has ``count`` pictures and begins with the picture number ``first``.
        """
        for i in range(self.mesh.rank, count, self.mesh.size):
            sample = self(shared.values, stage, first + i)
            yield i, self.turned(sample, stage, first + i)

    def __call__(self, shared: Mapping[str, Any], stage: int, number: int) -> Sample:
        """Return the training picture with the given number, which does not depend on order or
        process.
        """
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
        """Turn a pooled picture and the true picture together, each time otherwise: as behind a
        mask that is turned.
        """
        if self._pool is None or stage == HELD_OUT or self.settings.augment.pooled == "none":
            return sample
        # the last number keeps apart the random streams of a picture: 1 values, 2 patches, 3 scene,
        # 4 turn
        seed = (self.seed, stage, number, 4)
        picture, truth = symmetry(sample.picture, seed), symmetry(sample.truth, seed)
        return replace(sample, picture=picture, truth=truth, given=turned(sample.given, seed))

    def _scene(self, stage: int, number: int) -> Tensor:
        """Return the scene of a picture (3, y, x), with the changes of ``train.augment``."""
        if stage == HELD_OUT:
            return Photographs((self.held_out[number],)).crop(
                self.shape, self.seed, (stage, number)
            )
        augment = self.settings.augment
        change = Change.drawn(
            (self.seed, stage, number, 3),
            augment.symmetries == "all",
            augment.exposure,
            augment.colour,
            augment.enlarge,
        )
        return change.of(
            self.photographs.crop(change.frame(self.shape), self.seed, (stage, number)), self.shape
        )

    def _alone(self, shared: Mapping[str, Any], stage: int, number: int) -> Sample:
        """Return the picture with this number, from the store where it may be there."""
        theta, noise, drawn_values = self._drawn(stage, number)
        values = {**shared, **theta}
        free_values = {name: values[name] for name in self._simulate.free}

        def simulated() -> Sample:
            return self._sample(self._simulate(free_values, noise), drawn_values)

        if self._stored is None or stage == HELD_OUT:
            return simulated()
        changed_values = {name: theta[name] for name in self._readers}
        tensors = self._stored.picture(
            theta[self.settings.scene], changed_values, noise, lambda: simulated().tensors
        )
        return Sample.of(tensors, drawn_values)

    def _drawn(self, stage: int, number: int) -> tuple[dict[str, Any], int, dict[str, Any]]:
        """Sample the random inputs of a training picture; return the inputs, the noise seed, and
        all values by name.
        """
        rng = np.random.default_rng((self.seed, stage, number, 1))
        # by step and parameter, the values of the recipe to begin with; by name, what is drawn
        theta, drawn_values = dict(self._readers), dict[str, Any]()
        if self._inputs is not None:
            values = self._inputs.at(rng.standard_normal((1, len(self._inputs.names))))[0]
            drawn_values = dict(zip(self._inputs.names, map(float, values), strict=True))
            theta |= self._inputs.theta(drawn_values)
        # the restorer is told the drawn values, before the camera differs from them
        theta |= {name: theta[name.removeprefix(TOLD)] for name in theta if name.startswith(TOLD)}
        differences = self._mismatch.drawn((self.seed, stage, number))
        theta |= self._mismatch.truth(theta, differences)
        drawn_values |= {f"mismatch {path}": value for path, value in differences.items()}
        if rng.random() < self.settings.laser_free:
            theta |= dict.fromkeys(self._lasers, 0.0)
            drawn_values["laser"] = "none"
        theta |= {
            self.settings.scene: self._scene(stage, number).to(self.device, self.settings.dtype)
        }
        noise_seed = int(rng.integers(_SEEDS))
        return theta, noise_seed, {**drawn_values, "noise": noise_seed, "number": number}

    def _sample(self, values: Mapping[str, Any], drawn: Mapping[str, Any]) -> Sample:
        """Resize a training picture and the true picture to ``train.size``, and cut both into
        patches.

        Antialiased `kornia.geometry.transform.resize` lets stripes alias: at 2/3 of the size the
        finest stripes keep a contrast of 0.69 with kornia, and of 0.09 with `resize`.
        """
        light = values.get(self.settings.light, torch.zeros(0))
        dtype = self.settings.dtype
        picture, network_inputs = (
            self._posed.read(values, dtype) if self._posed else (values[self.settings.picture], ())
        )
        picture_and_truth = [x.to(dtype) for x in (picture, values[self.settings.truth])]
        if self.settings.size is not None:
            picture_and_truth = [
                resize(picture, *self.settings.size) for picture in picture_and_truth
            ]
        picture, truth = self._patches(torch.stack(picture_and_truth), drawn["noise"])
        return Sample(picture, truth, light, drawn, network_inputs)

    def _patches(self, both: Tensor, seed: int) -> Tensor:
        """Cut patches from a training picture and the true picture at the same positions, as a
        tensor (2, n, 3, y, x).

        A slice gives the same pixels as `kornia.geometry.transform.crop_by_indices` in a tenth of
        the time.
        """
        if self.settings.patch is None:
            return both[:, None]
        size, patch = (both.shape[-2], both.shape[-1]), self.settings.patch
        if any(side < patch_side for side, patch_side in zip(size, patch, strict=True)):
            raise ValueError(
                f"train.patch: {list(patch)} is larger than the picture {list(size)}: set a smaller"
                " patch"
            )
        rng = np.random.default_rng((seed, 2))
        count = self.settings.patches
        corners = [
            [int(rng.integers(h - w + 1)) for h, w in zip(size, patch, strict=True)]
            for _ in range(count)
        ]
        # axis 1 counts the patches, axis 0 has picture and truth
        return torch.stack([both[..., y : y + patch[0], x : x + patch[1]] for y, x in corners], 1)


def _uncertain_inputs(recipe: Recipe, outputs: Sequence[str]) -> Inputs | None:
    """Return the uncertain inputs of a recipe, or None for a recipe without any."""
    if recipe.uncertain and recipe.uncertain.names:
        return Inputs.of(recipe, outputs)
    return None


def _parameters_of_lasers(recipe: Recipe, order: Sequence[str]) -> list[str]:
    """Return the parameter of each laser that changes with each picture."""
    lasers = [name for name in order if recipe.steps[name].node.path == _LASER[0]]
    return [f"{name}.{_LASER[1]}" for name in lasers]


def _parameter(recipe: Recipe, name: str) -> Any:
    """Return the value of a parameter, from a name such as ``psf[mask].angle``."""
    step, _, param = name.rpartition(".")
    return recipe.steps[step].params[param]


def _sources(recipe: Recipe, readers: Iterable[str]) -> set[str]:
    """Return the steps whose results the readers read."""
    return set(chain.from_iterable(recipe.steps[reader].sources for reader in readers))


# --- several cameras ------------------------------------------------------------------------------

# Training pictures of several cameras in turn, so that one network learns to restore the pictures
# of all of them.


class SeveralCameras:
    """The pictures of a training with the camera of its recipe and with each of ``train.cameras``.

    The picture with the number n, or its number n in the pool, is of camera n modulo their count. A
    held-out photograph is seen by every camera.
    """

    shared = None  #: no mask is trained, so that no result depends on one

    def __init__(self, recipe: Recipe, settings: Training, source: PictureSource) -> None:
        recipes = (recipe, *recipe.cameras)
        self.repeats, self._pool = len(recipes), settings.pool
        # each held-out photograph once for each camera
        repeated_photographs: list[Path] = []
        for path in source.held_out:
            repeated_photographs += [path] * len(recipes)
        source_of_each = replace(source, held_out=repeated_photographs)
        self._streams = [
            TrainingStream(camera, settings, source_of_each, frozen=camera) for camera in recipes
        ]
        self.psf = self._streams[0].psf

    @property
    def pool_counts(self) -> dict[str, int]:
        """Return how many pictures of the pool came from the store, and how many were simulated."""
        counts = [stream.pool_counts for stream in self._streams]
        return {
            name: sum(counts_of_camera[name] for counts_of_camera in counts) for name in counts[0]
        }

    def begin(self, height: Any) -> Shared:
        """Return no results: none depends on a mask that is trained."""
        return Shared.of({})

    def batch(
        self, shared: Shared, stage: int, first: int, count: int
    ) -> Iterator[tuple[int, Sample]]:
        """Yield index and picture of each of the ``count`` pictures of a batch, from the picture
        number ``first``.
        """
        for i in range(count):
            number = first + i
            number_in_pool = number % self._pool if self._pool and stage != HELD_OUT else number
            stream = self._streams[number_in_pool % self.repeats]
            yield i, stream.turned(stream(shared.values, stage, number), stage, number)


Samples = TrainingStream | SeveralCameras


def samples_of(
    recipe: Recipe, settings: Training, source: PictureSource, frozen: Recipe | None
) -> Samples:
    """Return the pictures of a training, of one camera or of several in turn."""
    if frozen is not None and frozen.cameras:
        return SeveralCameras(frozen, settings, source)
    return TrainingStream(recipe, settings, source, frozen)


def require_alone(recipe: Recipe, mesh: Mesh) -> None:
    """Raise an error for a training with several cameras in several processes."""
    if recipe.cameras and mesh.size > 1:
        raise MeshError(
            f"{KEY}.cameras: a training with several cameras runs in a single process, without"
            " torchrun"
        )
