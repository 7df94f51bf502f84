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

# Requirements of a training on its recipe: existing steps, a scene of known size, and float64 if
# requested.


def in_precision(recipe: Recipe, dtype: torch.dtype) -> Recipe:
    """Return the recipe with ``precision: double`` in all steps that have this parameter, if
    ``dtype`` is float64.
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
    ``block`` refers to.
    """
    for name in names:
        if name not in recipe.steps:
            raise ValueError(
                f"{block}: the recipe has no step {name}; {nearest(name, recipe.steps)}"
            )


def frame_of(recipe: Recipe, scene: str) -> tuple[int, int]:
    """Return the size of the scene in pixels (y, x); raise ValueError if the step ``scene`` has no
    shape.
    """
    shape = recipe.steps[scene].params.get("shape")
    if shape is None:
        raise ValueError(
            f"train: the step {scene} has no shape: set {scene}.shape in pixels, such as [96, 96]"
        )
    return shape[0], shape[1]


# --- posed pictures -------------------------------------------------------------------------------

# Training pictures of a network that needs the data of the Wiener filter: the filter is solved once
# for each picture.
#
# The networks `unrolled` and `informed` need the PSF, the glare, the clipped pixels and the noise
# of a picture. The recipe gives them to the step of the filter, whose result `train.picture`
# converts to colours. In the training the node of this step is `restore.wiener_problem` or
# `restore.filter_facts`, with the same inputs, so that the answer of the filter is the input of the
# network.


Posed = WienerProblem | FilterFacts
#: empty, or the filter's problem or data, and the colour matrix
Given = tuple[()] | tuple[Posed, Tensor]
_FILTERS = ("restore.wiener", "restore.unrolled", "restore.informed")
_KNOWN: dict[str, Any] = {"unrolled": restore.wiener_problem, "informed": restore.filter_facts}
_PARAMETERS = ("balance", "doubt", "least_doubt", "read_noise")


@dataclass(frozen=True)
class PosedPictures:
    """The recipe steps that set up the filter problem of a picture, and that compute the colour
    matrix.
    """

    filter: str
    matrix: str
    kind: str = "unrolled"  #: kind of the network

    @classmethod
    def of(cls, recipe: Recipe, settings: Training) -> PosedPictures | None:
        """Return these steps for a training of such a network, or None for every other network.

        Raises ValueError if the training picture is not the result of the Wiener filter.
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
        """Return the steps from which `read` builds the input of the network."""
        return (self.filter, self.matrix)

    def within(self, recipe: Recipe) -> Recipe:
        """Return the recipe with the filter's node replaced by one that also returns the filter
        problem.
        """
        step = recipe.steps[self.filter]
        params = {name: value for name, value in step.params.items() if name in _PARAMETERS}
        posing_step = replace(step, node=_KNOWN[self.kind], params=params)
        return replace(recipe, steps={**recipe.steps, self.filter: posing_step})

    def read(self, values: Mapping[str, Any], dtype: torch.dtype) -> tuple[Tensor, Given]:
        """Return the filtered picture (3, y, x), and the further inputs of the network in the given
        precision.

        The filter solves small pictures in float64; the training steps take half the time in
        float32.
        """
        posed, matrix = values[self.filter], values[self.matrix]
        picture: Tensor = restore.colour(posed.answer * posed.scale + posed.mean, matrix)
        return picture, (posed._make(tensor.to(dtype) for tensor in posed), matrix.to(dtype))


def tensors_of(beside: Given) -> dict[str, Tensor]:
    """Return the further inputs of a network as tensors by name."""
    if not beside:
        return {}
    posed, matrix = beside
    return {**{f"given.{name}": x for name, x in posed._asdict().items()}, "given.matrix": matrix}


def given_of(tensors: Mapping[str, Tensor]) -> Given:
    """Return the further inputs of a network from their tensors by name."""
    if "given.matrix" not in tensors:
        return ()
    kind = FilterFacts if "given.maps" in tensors else WienerProblem
    return (
        kind(**{name: tensors[f"given.{name}"] for name in kind._fields}),
        tensors["given.matrix"],
    )


def turned(beside: Given, seed: tuple[int, ...]) -> Given:
    """Transform the maps that a network gets in addition to a picture, as `scene.symmetry`
    transforms the picture with the same seed.
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

# Simulated training pictures in the store, so that a later training with the same pictures starts
# at once.
#
# The key of a picture combines the keys of its steps with the drawn values, the scene and the noise
# seed. A change of optics, sensor, laser, distribution or code therefore changes the key.


_ABOUT = {"step": "training picture"}
_CODE = ("training.training_pictures", "training.training_pictures")


class StoredPool:
    """The pictures of a pool behind a fixed mask, each stored under its own key."""

    def __init__(
        self, recipe: Recipe, settings: Training, outputs: Sequence[str], store: Store, device: str
    ) -> None:
        self.recipe, self.settings, self.store, self.device = recipe, settings, store, device
        self._outputs = tuple(outputs)
        self._order = [name for name in needed(recipe, self._outputs) if name != settings.scene]
        self._code = Code(store.code_memo)
        self._resize = self._code.digest("neusee.nodes.resampling")
        #: number of pictures read from the store, and of pictures simulated
        self.read, self.computed = 0, 0

    def picture(
        self,
        scene: Tensor,
        drawn: Mapping[str, Any],
        noise: int,
        compute: Callable[[], dict[str, Tensor]],
    ) -> dict[str, Tensor]:
        """Return the tensors of a picture from the store, or compute and store them now."""
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
        """Return the key of a picture, from everything that determines it.

        These are the scene, the changed parameters, the noise seed and the cropping. A step that
        reads something private gives a private key, which is not stored.
        """
        settings, recipe = self.settings, self.recipe
        scene_pixels = scene.detach().cpu().contiguous()
        key_of_step = {settings.scene: hashlib.sha256(scene_pixels.numpy().tobytes()).hexdigest()}
        changed_params: dict[str, dict[str, Any]] = {}
        for reader, value in changed.items():
            step_name, _, param = reader.rpartition(".")
            changed_params.setdefault(step_name, {})[param] = value
        # keys of all steps with the drawn parameters, as in a run
        for name in self._order:
            step = recipe.steps[name]
            step = replace(step, params={**step.params, **changed_params.get(name, {})})
            key_of_step[name], _ = key_of(
                step, key_of_step, recipe.seed, self._code, place(step, self.device)
            )
        output_keys = [key_of_step[name] for name in self._outputs]
        if private_key := next(filter(is_private, output_keys), None):
            return private_key
        # processing of the picture after the camera
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


#: node of a laser, and its parameter that is set to 0 for no laser
_LASER = ("optics.laser_irradiance", "strength")
# noise seeds and picture numbers lie below this
_SEEDS = 2**31
#: stage number of held-out photographs, whose pictures are the same in both stages
HELD_OUT = 3


@dataclass(frozen=True)
class Sample:
    """One training picture with the true picture, or patches of both."""

    picture: Tensor  #: (n, 3, y, x), the developed picture of the camera
    truth: Tensor  #: (n, 3, y, x), the true picture
    #: (band,), fraction of the scene's light that the mask keeps; empty if no loss reads it
    light: Tensor
    drawn: Mapping[str, Any]  #: the values that were sampled for the picture
    given: Given = ()  #: further inputs of the network

    @property
    def tensors(self) -> dict[str, Tensor]:
        """Return picture, true picture, light, and the further inputs of the network, by name."""
        return {
            "picture": self.picture,
            "truth": self.truth,
            "light": self.light,
            **tensors_of(self.given),
        }

    @classmethod
    def of(cls, tensors: Mapping[str, Tensor], drawn: Mapping[str, Any]) -> Sample:
        """Return the training picture from its ``tensors`` by name."""
        return cls(tensors["picture"], tensors["truth"], tensors["light"], drawn, given_of(tensors))


@dataclass(frozen=True)
class Shared:
    """Results that depend on the mask but on no picture, with detached copies that accumulate the
    gradients of all pictures.
    """

    made: Mapping[str, Any]  #: results with their autograd graph
    values: Mapping[str, Any]  #: detached copies, which later steps read

    @classmethod
    def of(cls, made: Mapping[str, Any]) -> Shared:
        """Detach results from their autograd graph."""
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
    """The photographs, store and device from which the pictures of a training are computed."""

    photographs: Photographs
    store: Store
    device: str = "cpu"
    mesh: Mesh = ALONE
    held_out: Sequence[Path] = ()  #: photographs only for the validation


class TrainingStream:
    """The training pictures of a recipe, behind a trainable mask or behind the fixed mask of
    ``frozen``.
    """

    repeats = 1  #: number of pictures of each held-out photograph

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
        # the camera as the restorer assumes it
        believed = in_precision(frozen or recipe, settings.dtype)
        self._posed = PosedPictures.of(recipe, settings)
        if self._posed:
            believed = self._posed.within(believed)
        self._made = self._outputs(2 if frozen else 1)
        # the actual camera may differ from the assumed one
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
        # results that depend on the mask only, and that steps for each picture read
        shared_outputs = [
            name for name in order if name in (steps_behind_mask - picture_steps) & read_by_pictures
        ]
        self._divide(recipe, learn, shared_outputs, noise_steps, source.store)

    def _stored_pool(self, recipe: Recipe, store: Store) -> StoredPool | None:
        """Return the stored pool of pictures, or None if no pool is to be stored."""
        if not self._pool or not self.settings.keep_pool:
            return None
        return StoredPool(recipe, self.settings, self._made, store, self.device)

    def _changing(self, recipe: Recipe, order: Sequence[str]) -> tuple[set[str], set[str]]:
        """Return the steps that draw noise for each picture, and all steps that differ between
        pictures.
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
        """Return the steps that a picture of a stage needs: network input, true picture, and the
        light if a loss reads it.
        """
        stage = self.settings.stages.get(number)
        light = (self.settings.light,) if stage is not None and stage.bsr else ()
        input_steps = self._posed.steps if self._posed else (self.settings.picture,)
        return (*input_steps, self.settings.truth, *light)

    def _read(self, believed: Recipe, order: Sequence[str]) -> dict[str, Any]:
        """Return the parameters that differ between pictures, with their values in the recipe.

        The restorer is given the values drawn for the camera, except the differences of
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
        """Split the recipe into steps that depend on the mask alone, with the results ``border``,
        and steps for each picture.
        """
        options: dict[str, Any] = {"store": store, "device": self.device}
        self.shared = as_function(recipe, learn, outputs=border, **options) if learn else None
        free_inputs = [*border, self.settings.scene, *self._readers]
        self._simulate = as_function(
            recipe, *free_inputs, outputs=self._made, redraw=noise, **options
        )

    @property
    def pool_counts(self) -> dict[str, int]:
        """Return the numbers of pool pictures that this process read from the store and
        simulated.
        """
        return (
            {"from_store": self._stored.read, "simulated": self._stored.computed}
            if self._stored
            else {}
        )

    def begin(self, height: Tensor) -> Shared:
        """Compute the steps that depend on the mask alone, once per training iteration."""
        results = self.shared({str(self.settings.learn): height}) if self.shared else {}
        return Shared.of(results)

    def batch(
        self, shared: Shared, stage: int, first: int, count: int
    ) -> Iterator[tuple[int, Sample]]:
        """Yield index and picture for each picture of a batch that this process simulates.

        The batch has ``count`` pictures, starting with picture number ``first``.
        """
        for i in range(self.mesh.rank, count, self.mesh.size):
            sample = self(shared.values, stage, first + i)
            yield i, self.turned(sample, stage, first + i)

    def __call__(self, shared: Mapping[str, Any], stage: int, number: int) -> Sample:
        """Return the training picture with the given number, independent of order and process."""
        number = self._number(stage, number)
        if self._pool is None or stage == HELD_OUT:
            return self._alone(shared, stage, number)
        if (stage, number) not in self._kept:
            self._kept[stage, number] = self._alone(shared, stage, number)
        return self._kept[stage, number]

    def _number(self, stage: int, number: int) -> int:
        """Return the number of a picture within its pool; unchanged for held-out pictures."""
        return number % (self._pool or _SEEDS) if stage != HELD_OUT else number

    def turned(self, sample: Sample, stage: int, number: int) -> Sample:
        """Transform a pooled picture and the true picture by a random symmetry, as if the mask were
        turned; each time another one.
        """
        if self._pool is None or stage == HELD_OUT or self.settings.augment.pooled == "none":
            return sample
        # the last number separates the random streams of a picture: 1 values, 2 patches, 3 scene, 4
        # turn
        seed = (self.seed, stage, number, 4)
        picture, truth = symmetry(sample.picture, seed), symmetry(sample.truth, seed)
        return replace(sample, picture=picture, truth=truth, given=turned(sample.given, seed))

    def _scene(self, stage: int, number: int) -> Tensor:
        """Return the scene of a picture (3, y, x), with the random changes of ``train.augment``."""
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
        """Return the picture with this number, from the store if possible."""
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
        """Draw the random inputs of a training picture; return the inputs, the noise seed, and all
        values by name.
        """
        rng = np.random.default_rng((self.seed, stage, number, 1))
        # start from the recipe's values by step and parameter; ``drawn_values`` are the drawn ones
        # by name
        theta, drawn_values = dict(self._readers), dict[str, Any]()
        if self._inputs is not None:
            values = self._inputs.at(rng.standard_normal((1, len(self._inputs.names))))[0]
            drawn_values = dict(zip(self._inputs.names, map(float, values), strict=True))
            theta |= self._inputs.theta(drawn_values)
        # the restorer gets the drawn values, before the camera deviates from them
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
        """Resize a training picture and the true picture to ``train.size``, and cut patches from
        both.

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
        """Cut patches from a training picture and the true picture at the same positions; return a
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
        # axis 0: picture and truth; axis 1: patches
        return torch.stack([both[..., y : y + patch[0], x : x + patch[1]] for y, x in corners], 1)


def _uncertain_inputs(recipe: Recipe, outputs: Sequence[str]) -> Inputs | None:
    """Return the uncertain inputs of a recipe, or None if it has none."""
    if recipe.uncertain and recipe.uncertain.names:
        return Inputs.of(recipe, outputs)
    return None


def _parameters_of_lasers(recipe: Recipe, order: Sequence[str]) -> list[str]:
    """Return the strength parameter of each laser, which differs between pictures."""
    lasers = [name for name in order if recipe.steps[name].node.path == _LASER[0]]
    return [f"{name}.{_LASER[1]}" for name in lasers]


def _parameter(recipe: Recipe, name: str) -> Any:
    """Return the value of a parameter with a name such as ``psf[mask].angle``."""
    step, _, param = name.rpartition(".")
    return recipe.steps[step].params[param]


def _sources(recipe: Recipe, readers: Iterable[str]) -> set[str]:
    """Return the steps whose results the steps ``readers`` read."""
    return set(chain.from_iterable(recipe.steps[reader].sources for reader in readers))


# --- several cameras ------------------------------------------------------------------------------

# Training pictures of several cameras in turn, so that one network learns to restore all of them.


class SeveralCameras:
    """The training pictures of the recipe's camera and of each camera in ``train.cameras``.

    Picture n (its number within the pool) is taken by camera n modulo the number of cameras. A
    held-out photograph is taken by every camera.
    """

    shared = None  #: None: no mask is trained

    def __init__(self, recipe: Recipe, settings: Training, source: PictureSource) -> None:
        recipes = (recipe, *recipe.cameras)
        self.repeats, self._pool = len(recipes), settings.pool
        # repeat each held-out photograph for each camera
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
        """Return the numbers of pool pictures read from the store and simulated."""
        counts = [stream.pool_counts for stream in self._streams]
        return {
            name: sum(counts_of_camera[name] for counts_of_camera in counts) for name in counts[0]
        }

    def begin(self, height: Any) -> Shared:
        """Return no shared results, because no mask is trained."""
        return Shared.of({})

    def batch(
        self, shared: Shared, stage: int, first: int, count: int
    ) -> Iterator[tuple[int, Sample]]:
        """Yield index and picture for the ``count`` pictures of a batch, starting with picture
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
    """Return the pictures of a training, from one camera or from several in turn."""
    if frozen is not None and frozen.cameras:
        return SeveralCameras(frozen, settings, source)
    return TrainingStream(recipe, settings, source, frozen)


def require_alone(recipe: Recipe, mesh: Mesh) -> None:
    """Raise `MeshError` for a training with several cameras in several processes."""
    if recipe.cameras and mesh.size > 1:
        raise MeshError(
            f"{KEY}.cameras: a training with several cameras runs in a single process, without"
            " torchrun"
        )
