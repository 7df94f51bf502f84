"""Settings of the training of a network and a mask, which form the block ``train`` of a recipe."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import Field, model_validator

from neusee.nodes import ParameterError
from neusee.nodes.network_classes import NetworkClass
from neusee.workflows.graph.diagnostics import Diagnostic
from neusee.workflows.recipe.blocks.mask_design_block import MaskSettings, MaskTraining
from neusee.workflows.recipe.blocks.settings_block import (
    Beta,
    GradientNorm,
    LearningRate,
    Number,
    SettingsBlock,
    Share,
    Weight,
    read_block,
)
from neusee.workflows.recipe.text.composition import Composed
from neusee.workflows.recipe.text.named_files import refuse_outside
from neusee.workflows.recipe.text.no_code import is_strange
from neusee.workflows.recipe.text.option_groups import packaged
from neusee.workflows.recipe.text.yaml_values import Value

KEY = "train"  #: key of the block in a recipe
POSED = ("unrolled", "informed")  #: kinds of networks that need what the Wiener filter knows of a picture
_OF_CLASS = ("architecture", "parameters", "multiple")  #: settings of a network class of the user


class Network(SettingsBlock):
    """Settings of the restoration network: its kind, width and options."""

    kind: Literal["fft_mamba", "unet", "nafnet", "unrolled", "informed"] = "fft_mamba"
    width: Annotated[int, Field(ge=2, le=4096)] = 64
    shuffle: Annotated[int, Field(ge=1, le=8)] = 2  #: of fft_mamba: pixels along an axis that are scanned as one
    directions: Literal[2, 4] = 2  #: of fft_mamba, like the next two
    pyramid: bool = False
    frequency: Literal["complex", "amp_phase"] = "complex"
    steps: Annotated[int, Field(ge=1, le=16)] = 2  #: of unrolled: steps of filter and network
    architecture: NetworkClass | None = None  #: a class of the user, in place of a kind and its options
    parameters: dict[str, Any] | None = None  #: arguments of this class
    multiple: Annotated[int, Field(ge=1, le=1024)] | None = None  #: of this class: divisor of the sides of a picture

    @property
    def options(self) -> dict[str, Any]:
        """Return the restoration network's options that differ from the defaults, without the kind and the width."""
        return self.model_dump(exclude={"kind", "width", *_OF_CLASS}, exclude_defaults=True)

    @model_validator(mode="after")
    def _fits(self) -> Network:
        owners = {name: "unrolled" if name == "steps" else "fft_mamba" for name in self.options}
        wrong = {name: owner for name, owner in owners.items() if owner != self.kind}
        if self.architecture is None and wrong:
            owner = next(iter(wrong.values()))
            raise ValueError(f"{', '.join(wrong)}: only the network {owner} has such options, not {self.kind}")
        return self


class Critics(SettingsBlock):
    """Settings of the two critic networks of adversarial training: their width and the momenta of their optimiser."""

    width: Annotated[int, Field(ge=2, le=4096)] = 64
    betas: tuple[Beta, Beta] = (0.0, 0.9)


class Rates(SettingsBlock):
    """Learning rates of a training, which are halved once and then reduced at intervals, down to a minimum."""

    weights: LearningRate = 2e-4
    biases: LearningRate = 4e-4
    mask: LearningRate = 2e-4
    halve: Number = 2000
    every: Number = 1000
    factor: Annotated[float, Field(gt=0, le=1)] = 0.7
    least: Weight = 1e-6

    def share(self, iteration: int) -> float:
        """Return the factor on the learning rates at an iteration of a training stage; the first iteration is 0."""
        if iteration < self.halve:
            return 1.0
        return float(0.5 * self.factor ** ((iteration - self.halve) // self.every))


class Augment(SettingsBlock):
    """Changes of the photographs of a training, which make more scenes of them; held-out pictures are not changed."""

    symmetries: Literal["mirror", "all"] = "mirror"  #: mirror: half of the scenes left to right; all: quarter turns too
    exposure: Annotated[float, Field(ge=0, le=10)] = 0.0  #: stops by which a scene is darker, at most
    colour: Share = 0.0  #: largest change of the saturation of colours
    enlarge: Annotated[float, Field(ge=1, le=8)] = 1.0  #: largest factor of size: what is enlarged is less sharp
    pooled: Literal["none", "turned_mask"] = "none"  #: turned_mask: turn pooled pictures, as behind a turned mask


class Stage(SettingsBlock):
    """Settings of a training stage: duration, batch size and weights of the loss terms; a weight of 0 omits a term."""

    iterations: Annotated[int, Field(ge=0, le=10**9)]
    batch: Number = 8
    lsr: Weight = 0.0
    bsr: Weight = 0.0
    adversarial: Weight = 0.1
    penalty: Weight = 1.0
    reconstruction: Weight = 1.0
    decibels: Weight = 0.0  #: of the PSNR of each picture, with the sign of a loss


class Training(SettingsBlock):
    """Settings of the training of a network and a mask."""

    photographs: Path | None = None
    learn: str | None = "height"  #: step whose mask is trained; None: the mask stays fixed, and stage 1 is skipped
    scene: str = "scene"
    picture: str = "developed[mask]"
    truth: str = "truth"
    psf: str = "psf[mask]"
    light: str = "bsr[mask]"  #: step that returns the background suppression ratio (BSR) by band
    network: Network = Network()
    start: Path | None = None  #: weights, or the folder of a training, with which the network begins; None: drawn
    size: tuple[Number, Number] | None = None
    patch: tuple[Number, Number] | None = None  #: pixels (y, x) of a training patch of an image
    patches: Number = 1  #: number of patches of each image
    pool: Number | None = None  #: images that are reused while the mask is fixed; None: always new images
    keep_pool: bool = True  #: keep the pictures of the pool in the cache, for later trainings
    augment: Augment = Augment()
    cameras: tuple[tuple[str, ...], ...] = ()  #: overrides, each list for one more camera: pictures of each in turn
    mismatch: dict[str, Any] | None = None  #: by path, laws of how the camera differs from what its restorer is told
    critics: Critics = Critics()
    betas: tuple[Beta, Beta] = (0.9, 0.999)
    rates: Rates = Rates()
    laser_free: Share = 0.0
    average: Annotated[float, Field(ge=0, lt=1)] = 0.999
    precision: Literal["float32", "bfloat16", "float64"] = "float32"
    logarithm: bool = True
    reduction: Literal["mean", "sum"] = "mean"  #: of the reconstruction loss over pixels and frequencies
    clip: GradientNorm = 10.0  #: largest gradient norm of a module
    mask: MaskSettings = MaskSettings()  #: settings of the mask design without images, which replaces stage 1
    stages: dict[Annotated[int, Field(ge=1, le=2)], Stage]
    held_out: Annotated[float, Field(gt=0, le=0.5)] | None = 0.1  #: share of the photographs; None: none
    held_out_pictures: Number = 16  #: held-out photographs that a validation restores, at most
    validate_every: Number = 500  #: iterations
    patience: Number | None = None  #: validations without a better state after which stage 2 ends; None: no limit
    keep: Number = 100
    show: Number = 500
    tensorboard: bool = False
    export: tuple[Literal["pt2", "onnx"], ...] = ()  #: files of the trained network for other programs

    @property
    def learnt(self) -> tuple[int, ...]:
        """Return the numbers (1, 2) of the training stages that run."""
        return tuple(sorted(n for n in self.stages if self.learn or n != 1))

    @model_validator(mode="after")
    def _exports(self) -> Training:
        if self.export and self.network.architecture is None and self.network.kind == "fft_mamba":
            text = "export: the scan of fft_mamba is in no graph of torch.export or ONNX"
            raise ValueError(f"{text}: train network.kind: nafnet or unet, or a class of your own")
        return self

    @model_validator(mode="after")
    def _unrolls(self) -> Training:
        kind = self.network.kind
        if self.network.architecture is not None or kind not in POSED:
            return self
        if self.export:
            raise ValueError(f"export: the filter before the network {kind} is in no graph of torch.export or ONNX")
        given = {"learn": self.learn, "size": self.size, "patch": self.patch}
        if self.augment.pooled != "none" and kind == "unrolled":
            given["augment.pooled"] = "none"
        wrong = next((name for name, value in given.items() if value is not None), None)
        if wrong:
            text = f"the network {kind} restores a whole picture behind a fixed mask"
            raise ValueError(f"{wrong}: {text}: write {wrong}: {given[wrong] if wrong == 'augment.pooled' else 'null'}")
        return self

    @model_validator(mode="after")
    def _mixes(self) -> Training:
        if self.cameras and self.learn is not None:
            raise ValueError("cameras: pictures are of several cameras where no mask is trained: write learn: null")
        return self

    @model_validator(mode="after")
    def _validates(self) -> Training:
        if self.patience is not None and self.held_out is None:
            raise ValueError("patience: nothing is held out that could stay without a better state: set held_out")
        return self

    @model_validator(mode="after")
    def _turns_a_pool(self) -> Training:
        if self.augment.pooled != "none" and self.pool is None:
            raise ValueError("augment.pooled: there is no pool to turn: set pool, or write pooled: none")
        return self

    @property
    def design(self) -> MaskTraining:
        """Return the settings of the mask design; it uses the same steps for the height and the PSF as the training."""
        return MaskTraining.model_construct(**dict(self.mask), height=self.learn, psf=self.psf)

    @property
    def dtype(self) -> torch.dtype:
        """Return the dtype of parameters and scenes; bfloat16 is used only inside the network."""
        return torch.float64 if self.precision == "float64" else torch.float32


def read_training(composed: Composed, context: dict[str, Any] | None = None) -> tuple[Composed, Training | None]:
    """Return a recipe without its block ``train``, and the settings from the block; report mistakes as diagnostics.

    ``context`` has the families of nodes in which a network class is found.
    """
    block = composed.root.items.get(KEY)
    if block is None:
        return composed, None
    composed, training = read_block(composed, KEY, Training, _plain(block), context)
    if training and "network" in block.items and (wrong := list(_wrong_network(block.items["network"], training))):
        return composed.with_problems(wrong), None
    missing = list(_missing(block, training)) if training else []
    return (composed.with_problems(missing), None) if missing else (composed, training)


def _missing(block: Value, training: Training) -> Iterator[Diagnostic]:
    """Yield a diagnostic for each path of a training that does not exist."""
    if training.photographs is not None and not training.photographs.is_dir():
        value = block.items["photographs"]
        yield Diagnostic(value.mark, value.name, f"the path {training.photographs} is not a folder of photographs")
    if training.start is not None and not training.start.exists():
        value = block.items["start"]
        yield Diagnostic(value.mark, value.name, f"there is neither a file nor a folder {training.start}")
    for outer, path, key in (
        (block, training.photographs, "photographs"),
        (block, training.start, "start"),
        (block.items.get("mask"), training.mask.start, "start"),
    ):
        given = outer.child(key) if outer else None
        if given is not None and path is not None:
            yield from _outside(path, given)


def _outside(path: Path, value: Value) -> Iterator[Diagnostic]:
    """Yield a diagnostic for a file that is not the stranger's whose recipe names it, also for a link in a folder."""
    links = (each for each in path.rglob("*") if each.is_symlink()) if is_strange() and path.is_dir() else ()
    try:
        for each in (path, *links):
            refuse_outside(each, value.mark)
    except ValueError as error:
        yield Diagnostic(value.mark, value.name, str(error))


def _wrong_network(given: Value, training: Training) -> Iterator[Diagnostic]:
    """Yield a diagnostic for each setting of the packaged networks, and for a class that fails on a small picture."""
    from neusee.nodes.restore import own_network, try_network

    network = training.network
    if network.architecture is None:
        if alone := next((value for name in _OF_CLASS[1:] if (value := given.child(name)) and value.plain), None):
            yield Diagnostic(
                alone.mark, alone.name, "is of a class of your own: name it by architecture: mynet.MyClass"
            )
        return
    for name, value in given.items.items():
        if name not in _OF_CLASS and not Path(value.mark.folder).is_relative_to(packaged()):
            text = f"{name} is of the networks of neusee: write parameters: {{{name}: {value.plain}}} for your class"
            yield Diagnostic(value.mark, value.name, text)
    try:
        net = own_network(network.architecture, network.parameters, network.multiple)
        if not any(one.requires_grad for one in net.parameters()):
            raise ParameterError("architecture", f"{network.architecture} has nothing to train: it has no parameters")
        try_network(net, training.dtype)
    except ParameterError as error:
        value = given.child(error.parameter) or given.items["architecture"]
        yield Diagnostic(value.mark, value.name, str(error))


def _plain(block: Value) -> Any:
    """Return the block ``train`` as plain data, with file paths relative to the folder of their YAML file."""
    plain = block.plain
    for outer, key in ((block, "photographs"), (block, "start"), (block.items.get("mask"), "start")):
        value = outer.items.get(key) if outer else None
        if value is not None and isinstance(value.data, str):
            (plain if outer is block else plain["mask"])[key] = Path(value.mark.folder) / Path(value.data).expanduser()
    return plain
