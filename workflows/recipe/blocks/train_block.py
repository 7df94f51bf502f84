"""Settings of trainings: the blocks train, train.mask and train_lift of a recipe."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import torch
from pydantic import Field, model_validator

from neusee.nodes import ParameterError
from neusee.nodes.doe import Material
from neusee.nodes.losses import (
    ContrastFloor,
    ContrastVariance,
    HighestFrequency,
    NoiseVariance,
    OneBandShare,
    PeakLimit,
    SceneLight,
)
from neusee.nodes.own_modules import NetworkClass
from neusee.nodes.restore import own_network, try_network
from neusee.nodes.units import (
    Angle,
    Count,
    DataFile,
    Depth,
    Electrons,
    Layers,
    Length,
    PupilPitch,
    Slope,
    Wavelength,
    Waves,
)
from neusee.workflows.graph.errors import Diagnostic, nearest
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
from neusee.workflows.recipe.text.recipe_files import is_strange, packaged, refuse_outside
from neusee.workflows.recipe.text.yaml_values import Value

# --- mask design block ----------------------------------------------------------------------------

# Settings of the mask design, which optimises the point spread function of a mask without images.


Kind = Literal[
    "pixelwise",
    "recipe_mask",
    "zernike",
    "polynomial",
    "streak",
    "rings",
    "unet",
    "five_half_rings",
]
#: default learning rate of each kind of mask
_RATE = {
    "pixelwise": 0.05,
    "recipe_mask": 4e-3,
    "zernike": 0.1,
    "polynomial": 0.02,
    "streak": 0.02,
    "rings": 0.1,
    "unet": 2e-3,
    "five_half_rings": 1.0,
}


def half_cosine(angle: float) -> float:
    """Return the factor (1 + cos(angle)) / 2 on a learning rate, which falls from 1 at 0 to 0 at
    the angle pi.
    """
    return 0.5 * (1 + math.cos(angle))


class Weights(SettingsBlock):
    """Weights of the terms in the loss of the mask design; each term is a mean over the spectral
    bands.
    """

    lsr: Weight = 1.0  #: `losses.suppression_loss`
    #: `losses.background_loss` of a point on the axis: the light that left the field
    bsr: Weight = 1.0
    contrast: Weight = 0.0  #: `losses.contrast`
    #: `losses.wiener` of all bands together: the error that remains after a Wiener filter
    wiener: Weight = 0.0
    #: `losses.filtered_error` behind the filter that keeps the peak at `limit`
    filtered_error: Weight = 0.0
    information: Weight = 0.0  #: `losses.information` behind the same filter, in bits per frequency

    @model_validator(mode="after")
    def _some(self) -> Weights:
        """Refuse a loss whose every weight is 0."""
        if not any(getattr(self, name) for name in type(self).model_fields):
            names = " or ".join(
                [", ".join([*type(self).model_fields][:-1]), [*type(self).model_fields][-1]]
            )
            raise ValueError(f"every weight of the loss is 0: set {names} to a number above 0")
        return self

    @property
    def protected(self) -> bool:
        """Return True if the loss has a term for the picture behind the filter that keeps the peak
        at `limit`.
        """
        return bool(self.filtered_error or self.information)

    @property
    def coloured(self) -> bool:
        """Return True if a term of the loss depends on the light of the scene and the responses
        of the channels.
        """
        return bool(self.wiener or self.protected)


class MaskSettings(SettingsBlock):
    """Settings of the mask design in the recipe key ``train.mask``: the kind of mask, the loss
    and the duration.
    """

    #: `recipe_mask`: all samples of the recipe's own height map, from its formula or file
    kind: Kind = "pixelwise"
    iterations: Count = 300  #: iterations of Adam, or generations for five_half_rings
    learning_rate: LearningRate | None = None  #: None: the default for the kind
    #: `step`: halved at each fifth of the iterations
    schedule: Literal["cosine", "step"] = "cosine"
    weights: Weights = Weights(bsr=4.0, contrast=1.0)
    #: exponent of the norm that replaces the peak
    power: Annotated[float, Field(ge=8, le=64)] = 16.0
    log: bool = True  #: whether the loss uses the logarithm of the LSR of each band
    #: mean LSR below which the loss does not fall further
    enough: Annotated[float, Field(gt=0, le=1)] | None = None
    floor: ContrastFloor = 1e-4  #: contrast below which the loss hardly falls
    #: cycles per pixel: higher frequencies do not affect the loss
    up_to: HighestFrequency | None = None
    noise_share: NoiseVariance = 1e-3  #: of `losses.wiener`: noise variance over signal variance
    #: of `losses.wiener`: fraction of the variance that belongs to one band alone
    colour: OneBandShare = 1.0
    #: largest LSR behind mask and grey filter, for filtered_error and information
    limit: PeakLimit | None = None
    #: mean of the scene behind the clear lens, in each pixel, for these two terms
    light: SceneLight = 30.0
    read_noise: Electrons = 10.5
    veil: Electrons = 0.0  #: even light of a laser behind the clear lens
    contrast_variance: ContrastVariance = 0.1  #: of the scene, relative
    #: standard deviation of the defocus, drawn at each iteration
    defocus_spread: Annotated[Waves, Field(ge=0)] = 0.0
    #: the same for a shift of all wavelengths together
    wavelength_spread: Annotated[Length, Field(ge=0, le=1e-6)] = 0.0
    #: the same for the direction of the laser, on each axis
    direction_spread: Annotated[Angle, Field(ge=0)] = 0.0
    learn_stop: bool = False  #: the diameter of `doe.shade` is learnt with the mask
    bands: Count | None = 7  #: number of bands of the recipe in one iteration; None: all bands
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    starts: Count = 1  #: independent starts; the result is the best mask on all bands
    #: recipe values that differ during training, such as a coarser pupil
    at: dict[str, Any] = Field(default={})
    save_every: Count = 50  #: iterations between two saved states

    # parameters of the kinds of mask
    max_height: Depth = 5 * 1e-6  #: pixelwise, unet; equal to `5 um` to the last bit
    grid: Count = 270  #: pixelwise, unet: samples along an axis
    #: pixelwise: feature size of the initial mask, in diameters
    scale: Annotated[float, Field(gt=0, le=1)] = 0.04
    #: pixelwise: a height map to start from, such as one of another kind
    start: DataFile | None = None
    width: Layers = 16  #: unet: channels of its first layer
    modes: Count = 100  #: zernike: number of polynomials, from Noll's number 4 on
    waves: Annotated[float, Field(gt=0, le=1e5)] = (
        5.0  #: zernike, polynomial, streak: root mean square of the initial mask
    )
    degree: Annotated[int, Field(ge=2, le=30)] = 8  #: polynomial, streak: greatest degree
    rings: Count = 40  #: rings: annuli of equal area
    sided: bool = True  #: rings: heights are odd about the axis, like half-rings
    noise: Annotated[float, Field(ge=0, le=1e5)] = (
        1.0  #: rings: random part of each slope of the initial mask, in waves
    )
    #: five_half_rings: least and greatest slope, in waves at the rim
    slopes: tuple[Slope, Slope] = (4.0, 48.0)
    population: Annotated[int, Field(ge=5, le=10**6)] = 70  #: five_half_rings
    polish: Annotated[int, Field(ge=0, le=10**9)] = (
        300  #: five_half_rings: masks tried by descent from the best, on all bands
    )
    wavelength: Wavelength = 550e-9  #: reference wavelength of heights in waves
    material: Material = "fused silica"  #: material of heights in waves
    #: smallest feature (`doe.smooth`); the recipe sets depth and levels
    feature: PupilPitch | None = None

    plain: str = "psf[plain]"  #: the step of the lens without a mask
    #: of `losses.wiener`, `losses.filtered_error` and `losses.information`
    illuminant: str = "illuminant"
    responses: str = "responses"

    @model_validator(mode="after")
    def _rising(self) -> Self:
        """Refuse settings that contradict each other: slopes, a peak limit and a learnt stop."""
        if not self.slopes[0] < self.slopes[1]:
            raise ValueError(f"slopes = {self.slopes}: write the smaller slope first")
        if self.limit is not None and not self.weights.protected:
            text = (
                "set weights.filtered_error or weights.information, or remove limit; for"
                " weights.lsr the limit is `enough`"
            )
            raise ValueError(f"limit = {self.limit:g} affects no term of the loss: {text}")
        if self.learn_stop and not self.weights.protected:
            text = (
                "only weights.filtered_error and weights.information include the cost of a stop:"
                " set one of the two weights, or remove learn_stop"
            )
            raise ValueError(f"learn_stop = true: {text}")
        if self.learn_stop and self.kind == "five_half_rings":
            raise ValueError(
                "learn_stop = true: a mask of the kind five_half_rings has no gradient: choose"
                " another kind, or remove learn_stop"
            )
        return self

    @property
    def rate(self) -> float:
        """Return the learning rate that the recipe sets, or the default rate for the kind of
        mask.
        """
        return _RATE[self.kind] if self.learning_rate is None else self.learning_rate


class MaskTraining(MaskSettings):
    """Settings of the mask design, and the names of the recipe steps that the design uses."""

    height: str = "height"  #: the step whose height map is designed
    psf: str = "psf[mask]"


class DesignError(ValueError):
    """Error for settings with which no mask can be designed; the message names the setting and
    the fix.
    """


def need_steps(recipe_steps: Any, settings: MaskTraining) -> None:
    """Raise `DesignError` if a setting names a step that the recipe does not have."""
    for setting in (
        "height",
        "psf",
        "plain",
        *(("illuminant", "responses") if settings.weights.coloured else ()),
    ):
        name = getattr(settings, setting)
        if name not in recipe_steps:
            raise DesignError(
                f"{setting}: the recipe has no step {name!r}; {nearest(name, recipe_steps)}"
            )


def state_file(out: Path, recipe: str, key: str) -> Path:
    """Return the path of the file with the state of an unfinished mask design; other runs do not
    delete the file.
    """
    return out / f".{recipe}_mask_{key[:16]}.state"


# --- train block ----------------------------------------------------------------------------------

# Settings of the training of a network and a mask, which form the block ``train`` of a recipe.


KEY = "train"  #: key of the block in a recipe
#: kinds of networks whose input includes the quantities that the Wiener filter uses
POSED = ("unrolled", "informed")
_OF_CLASS = ("architecture", "parameters", "multiple")  #: settings of a network class of the user


class Network(SettingsBlock):
    """Settings of the restoration network: its kind, width and options."""

    kind: Literal["fft_mamba", "unet", "nafnet", "unrolled", "informed"] = "fft_mamba"
    width: Annotated[int, Field(ge=2, le=4096)] = 64
    #: of fft_mamba: pixels along an axis that are scanned as one
    shuffle: Annotated[int, Field(ge=1, le=8)] = 2
    steps: Annotated[int, Field(ge=1, le=16)] = 2  #: of unrolled: steps of filter and network
    #: a class of the user, in place of a kind and its options
    architecture: NetworkClass | None = None
    parameters: dict[str, Any] | None = None  #: arguments of this class
    #: of this class: number by which the sides of a picture must be divisible
    multiple: Annotated[int, Field(ge=1, le=1024)] | None = None

    @property
    def options(self) -> dict[str, Any]:
        """Return the restoration network's options that differ from the defaults, without the
        kind and the width.
        """
        return self.model_dump(exclude={"kind", "width", *_OF_CLASS}, exclude_defaults=True)

    @model_validator(mode="after")
    def _fits(self) -> Network:
        """Refuse options that belong to another kind of network."""
        network_of_option = {
            name: "unrolled" if name == "steps" else "fft_mamba" for name in self.options
        }
        misplaced = {name: owner for name, owner in network_of_option.items() if owner != self.kind}
        if self.architecture is None and misplaced:
            owner = next(iter(misplaced.values()))
            raise ValueError(
                f"{', '.join(misplaced)}: these options belong to the network {owner}, not to"
                f" {self.kind}"
            )
        return self


class Critics(SettingsBlock):
    """Settings of the two critic networks of adversarial training: their width and the momenta
    of their optimiser.
    """

    width: Annotated[int, Field(ge=2, le=4096)] = 64
    betas: tuple[Beta, Beta] = (0.0, 0.9)


class Rates(SettingsBlock):
    """Learning rates of a training, which are halved once and then reduced at intervals, down to
    a minimum.
    """

    weights: LearningRate = 2e-4
    biases: LearningRate = 4e-4
    mask: LearningRate = 2e-4
    halve: Number = 2000
    every: Number = 1000
    factor: Annotated[float, Field(gt=0, le=1)] = 0.7
    least: Weight = 1e-6

    def share(self, iteration: int) -> float:
        """Return the factor on the learning rates at an iteration of a training stage; the first
        iteration is 0.
        """
        if iteration < self.halve:
            return 1.0
        return float(0.5 * self.factor ** ((iteration - self.halve) // self.every))


class Augment(SettingsBlock):
    """Augmentation of the photographs of a training by random changes; held-out pictures are not
    changed.
    """

    #: mirror: half of the scenes left to right; all: quarter turns too
    symmetries: Literal["mirror", "all"] = "mirror"
    #: largest darkening of a scene, in stops
    exposure: Annotated[float, Field(ge=0, le=10)] = 0.0
    colour: Share = 0.0  #: largest change of the saturation of colours
    #: largest magnification; an enlarged scene is less sharp
    enlarge: Annotated[float, Field(ge=1, le=8)] = 1.0
    #: turned_mask: turn pooled pictures, as behind a turned mask
    pooled: Literal["none", "turned_mask"] = "none"


class Stage(SettingsBlock):
    """Settings of a training stage: duration, batch size and weights of the loss terms; a weight
    of 0 omits a term.
    """

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
    #: step whose mask is trained; None: the mask stays fixed, and stage 1 is skipped
    learn: str | None = "height"
    scene: str = "scene"
    picture: str = "developed[mask]"
    truth: str = "truth"
    psf: str = "psf[mask]"
    light: str = "bsr[mask]"  #: step that returns the background suppression ratio (BSR) by band
    network: Network = Network()
    #: weights, or the folder of a training, with which the network begins; None: drawn
    start: Path | None = None
    size: tuple[Number, Number] | None = None
    patch: tuple[Number, Number] | None = None  #: pixels (y, x) of a training patch of an image
    patches: Number = 1  #: number of patches of each image
    #: images that are reused while the mask is fixed; None: always new images
    pool: Number | None = None
    keep_pool: bool = True  #: keep the pictures of the pool in the cache, for later trainings
    augment: Augment = Augment()
    #: lists of overrides, one for each further camera; the cameras take pictures in turn
    cameras: tuple[tuple[str, ...], ...] = ()
    #: by path: distribution of the difference between the camera and what its restorer assumes
    mismatch: dict[str, Any] | None = None
    critics: Critics = Critics()
    betas: tuple[Beta, Beta] = (0.9, 0.999)
    rates: Rates = Rates()
    laser_free: Share = 0.0
    average: Annotated[float, Field(ge=0, lt=1)] = 0.999
    precision: Literal["float32", "bfloat16", "float64"] = "float32"
    logarithm: bool = True
    #: of the reconstruction loss over pixels and frequencies
    reduction: Literal["mean", "sum"] = "mean"
    clip: GradientNorm = 10.0  #: largest gradient norm of a module
    #: settings of the mask design without images, which replaces stage 1
    mask: MaskSettings = MaskSettings()
    stages: dict[Annotated[int, Field(ge=1, le=2)], Stage]
    #: part of the photographs that is kept for validation; None: no photographs
    held_out: Annotated[float, Field(gt=0, le=0.5)] | None = 0.1
    held_out_pictures: Number = 16  #: largest number of held-out photographs in a validation
    validate_every: Number = 500  #: iterations
    #: validations without a better state after which stage 2 ends; None: no limit
    patience: Number | None = None
    keep: Number = 100
    show: Number = 500
    tensorboard: bool = False
    #: files of the trained network for other programs
    export: tuple[Literal["pt2", "onnx"], ...] = ()

    @property
    def learnt(self) -> tuple[int, ...]:
        """Return the numbers (1, 2) of the training stages that run."""
        return tuple(sorted(n for n in self.stages if self.learn or n != 1))

    @model_validator(mode="after")
    def _exports(self) -> Training:
        if self.export and self.network.architecture is None and self.network.kind == "fft_mamba":
            text = (
                "export: torch.export and ONNX cannot represent the scan of the network fft_mamba"
            )
            raise ValueError(f"{text}: choose network.kind: nafnet or unet, or a class of your own")
        return self

    @model_validator(mode="after")
    def _unrolls(self) -> Training:
        """Refuse settings that a network behind a Wiener filter cannot have.

        Such a network restores whole pictures behind a fixed mask.
        """
        kind = self.network.kind
        if self.network.architecture is not None or kind not in POSED:
            return self
        if self.export:
            raise ValueError(
                "export: torch.export and ONNX cannot represent the filter before the network"
                f" {kind}"
            )
        not_for_both = {"learn": self.learn, "size": self.size, "patch": self.patch}
        if self.augment.pooled != "none" and kind == "unrolled":
            not_for_both["augment.pooled"] = "none"
        first_wrong = next(
            (name for name, value in not_for_both.items() if value is not None), None
        )
        if first_wrong:
            text = f"the network {kind} restores a whole picture behind a fixed mask"
            raise ValueError(
                f"{first_wrong}: {text}: write {first_wrong}:"
                f" {not_for_both[first_wrong] if first_wrong == 'augment.pooled' else 'null'}"
            )
        return self

    @model_validator(mode="after")
    def _mixes(self) -> Training:
        """Refuse further cameras together with a mask that is trained."""
        if self.cameras and self.learn is not None:
            raise ValueError(
                "cameras: several cameras need a mask that is not trained: write learn: null"
            )
        return self

    @model_validator(mode="after")
    def _validates(self) -> Training:
        if self.patience is not None and self.held_out is None:
            raise ValueError(
                "patience: without held-out pictures no improvement can be measured: set held_out"
            )
        return self

    @model_validator(mode="after")
    def _turns_a_pool(self) -> Training:
        if self.augment.pooled != "none" and self.pool is None:
            raise ValueError(
                "augment.pooled: there is no pool whose pictures could be turned: set pool, or"
                " write pooled: none"
            )
        return self

    @property
    def design(self) -> MaskTraining:
        """Return the settings of the mask design; it uses the same steps for the height and the
        PSF as the training.
        """
        return MaskTraining.model_construct(**dict(self.mask), height=self.learn, psf=self.psf)

    @property
    def dtype(self) -> torch.dtype:
        """Return the dtype of parameters and scenes; bfloat16 is used only inside the network."""
        return torch.float64 if self.precision == "float64" else torch.float32


def read_training(
    composed: Composed, context: dict[str, Any] | None = None
) -> tuple[Composed, Training | None]:
    """Return a recipe without its block ``train``, and the settings from the block; report mistakes
    as diagnostics.

    ``context`` has the families of nodes in which a network class is found.
    """
    block = composed.root.items.get(KEY)
    if block is None:
        return composed, None
    composed, training = read_block(composed, KEY, Training, _plain(block), context)
    if (
        training
        and "network" in block.items
        and (network_mistakes := list(_wrong_network(block.items["network"], training)))
    ):
        return composed.with_problems(network_mistakes), None
    missing = list(_missing(block, training)) if training else []
    return (composed.with_problems(missing), None) if missing else (composed, training)


def _missing(block: Value, training: Training) -> Iterator[Diagnostic]:
    """Yield a diagnostic for each path of a training that does not exist."""
    if training.photographs is not None and not training.photographs.is_dir():
        value = block.items["photographs"]
        yield Diagnostic(
            value.mark,
            value.name,
            f"the path {training.photographs} is not a folder of photographs",
        )
    if training.start is not None and not training.start.exists():
        value = block.items["start"]
        yield Diagnostic(
            value.mark, value.name, f"there is neither a file nor a folder {training.start}"
        )
    for block_of_path, path, key in (
        (block, training.photographs, "photographs"),
        (block, training.start, "start"),
        (block.items.get("mask"), training.mask.start, "start"),
    ):
        path_value = block_of_path.child(key) if block_of_path else None
        if path_value is not None and path is not None:
            yield from _outside(path, path_value)


def _outside(path: Path, value: Value) -> Iterator[Diagnostic]:
    """Yield a diagnostic for a path, or for a link in a folder, to a file that an untrusted recipe
    may not read.
    """
    links = (
        (link for link in path.rglob("*") if link.is_symlink())
        if is_strange() and path.is_dir()
        else ()
    )
    try:
        for inner in (path, *links):
            refuse_outside(inner, value.mark)
    except ValueError as error:
        yield Diagnostic(value.mark, value.name, str(error))


def _wrong_network(block: Value, training: Training) -> Iterator[Diagnostic]:
    """Yield a diagnostic for each misplaced setting of the packaged networks, and for a network
    class of the user that fails on a small picture.
    """
    network = training.network
    if network.architecture is None:
        yield from _without_class(block)
        return
    yield from _of_packaged_networks(block)
    try:
        net = own_network(network.architecture, network.parameters, network.multiple)
        if not any(parameter.requires_grad for parameter in net.parameters()):
            raise ParameterError(
                "architecture",
                f"{network.architecture} has no parameters, so training would change nothing:"
                " choose a class with parameters",
            )
        try_network(net, training.dtype)
    except ParameterError as error:
        value = block.child(error.parameter) or block.items["architecture"]
        yield Diagnostic(value.mark, value.name, str(error))


def _without_class(block: Value) -> Iterator[Diagnostic]:
    """Yield a diagnostic for the first setting that needs a network class of the user, if the
    recipe names no class.
    """
    for name in _OF_CLASS[1:]:
        value = block.child(name)
        if value and value.plain:
            message = (
                "is a setting for a network class of your own: add architecture: mynet.MyClass"
            )
            yield Diagnostic(value.mark, value.name, message)
            return


def _of_packaged_networks(block: Value) -> Iterator[Diagnostic]:
    """Yield a diagnostic for each setting of the packaged networks that is written beside a network
    class of the user.
    """
    for name, value in block.items.items():
        if name not in _OF_CLASS and not Path(value.mark.folder).is_relative_to(packaged()):
            text = (
                f"{name} is a setting of the networks of neusee: for your own class write"
                f" parameters: {{{name}: {value.plain}}}"
            )
            yield Diagnostic(value.mark, value.name, text)


def _plain(block: Value) -> Any:
    """Return the block ``train`` as plain data, with file paths relative to the folder of their
    YAML file.
    """
    plain = block.plain
    for block_of_path, key in (
        (block, "photographs"),
        (block, "start"),
        (block.items.get("mask"), "start"),
    ):
        value = block_of_path.items.get(key) if block_of_path else None
        if value is not None and isinstance(value.data, str):
            (plain if block_of_path is block else plain["mask"])[key] = (
                Path(value.mark.folder) / Path(value.data).expanduser()
            )
    return plain


# --- train lift block -----------------------------------------------------------------------------

# Settings of the block ``train_lift`` of a recipe: the training of a network that estimates spectra
# from RGB.


LIFT_KEY = "train_lift"  #: key of the block in a recipe


class LiftTraining(SettingsBlock):
    """Settings of the training of a network that estimates spectra from RGB."""

    measured: str = "measured"
    picture: str = "picture"
    cube: str = "cube"
    start: Literal["linear", "random"] = "linear"
    iterations: Number
    batch: Number = 4
    rate: LearningRate = 4e-4
    min_rate: Weight = 1e-6
    betas: tuple[Beta, Beta] = (0.9, 0.999)
    #: iterations in which the rate rises evenly
    warmup: Annotated[int, Field(ge=0, le=10**9)] = 200
    floor: Annotated[float, Field(gt=0, le=1)] = 0.02
    clip: GradientNorm = 10.0  #: largest norm of the gradient of all weights
    ema_decay: Beta = 0.998  #: of the moving average of the weights; 0: no average
    #: number of pictures with which the network is validated at the end
    validation_batches: Number = 32
    keep: Number = 100
    show: Number = 1000

    def rate_at(self, iteration: int) -> float:
        """Return the learning rate at an iteration: a linear warm-up, then half a cosine from
        `rate` to `min_rate`.
        """
        least_rate, warmup_share = (
            min(self.min_rate, self.rate),
            min(1.0, (iteration + 1) / max(self.warmup, 1)),
        )
        return warmup_share * (
            least_rate
            + (self.rate - least_rate) * half_cosine(math.pi * iteration / self.iterations)
        )


def read_lift_training(composed: Composed) -> tuple[Composed, LiftTraining | None]:
    """Return a recipe without its block ``train_lift``, and the settings from the block; report
    mistakes.
    """
    block = composed.root.items.get(LIFT_KEY)
    return (
        (composed, None)
        if block is None
        else read_block(composed, LIFT_KEY, LiftTraining, block.plain)
    )
