"""Training block of a recipe: the settings under ``train``, read and checked with their locations."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from neusee.workflows.graph.diagnostics import Diagnostic, Location, nearest
from neusee.workflows.recipe.blocks.mask_design_block import MaskSettings, MaskTraining, Weights
from neusee.workflows.recipe.text.composition import Composed
from neusee.workflows.recipe.text.renamed_keys import instead
from neusee.workflows.recipe.text.yaml_values import Value

KEY = "train"  #: key of the block in a recipe

Weight = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Beta = Annotated[float, Field(ge=0, lt=1)]
Number = Annotated[int, Field(ge=1)]


class _Block(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Network(_Block):
    """Restoration network: its kind, width and options."""

    kind: Literal["fft_mamba", "unet", "nafnet"] = "fft_mamba"
    width: Annotated[int, Field(ge=2)] = 64
    shuffle: Annotated[int, Field(ge=1, le=8)] = 2  #: of fft_mamba: pixels along an axis that are scanned as one
    directions: Literal[2, 4] = 2  #: of fft_mamba, like the next two
    pyramid: bool = False
    frequency: Literal["complex", "amp_phase"] = "complex"

    @property
    def options(self) -> dict[str, Any]:
        """Return the options that differ from their defaults, without kind and width."""
        return self.model_dump(exclude={"kind", "width"}, exclude_defaults=True)

    @model_validator(mode="after")
    def _fits(self) -> Network:
        if self.options and self.kind != "fft_mamba":
            raise ValueError(f"{', '.join(self.options)}: only fft_mamba has this option, not {self.kind}")
        return self


class Critics(_Block):
    """Width and momenta of the two critics."""

    width: Annotated[int, Field(ge=2)] = 64
    betas: tuple[Beta, Beta] = (0.0, 0.9)


class Rates(_Block):
    """Learning rates and their decay: halved once, then multiplied by a factor at intervals, down to a minimum."""

    weights: Annotated[float, Field(gt=0)] = 2e-4
    biases: Annotated[float, Field(gt=0)] = 4e-4
    mask: Annotated[float, Field(gt=0)] = 2e-4
    halve: Number = 2000
    every: Number = 1000
    factor: Annotated[float, Field(gt=0, le=1)] = 0.7
    least: Weight = 1e-6

    def share(self, iteration: int) -> float:
        """Return the factor on the learning rate at an iteration of a stage, counted from 0."""
        if iteration < self.halve:
            return 1.0
        return float(0.5 * self.factor ** ((iteration - self.halve) // self.every))


class Stage(_Block):
    """Duration, batch size and loss weights of a stage; a weight of 0 leaves a term out."""

    iterations: Annotated[int, Field(ge=0)]
    batch: Number = 8
    lsr: Weight = 0.0
    bsr: Weight = 0.0
    adversarial: Weight = 0.1
    penalty: Weight = 1.0
    reconstruction: Weight = 1.0


class Training(_Block):
    """Settings of a recipe's ``train`` block."""

    photographs: Path | None = None
    learn: str | None = "height"  #: None: the recipe's own mask stays fixed, and stage 1 is skipped
    scene: str = "scene"
    picture: str = "developed[mask]"
    truth: str = "truth"
    psf: str = "psf[mask]"
    light: str = "bsr[mask]"  #: step that gives the fraction of light kept, by band
    network: Network = Network()
    size: tuple[Number, Number] | None = None
    patch: tuple[Number, Number] | None = None  #: pixels (y, x) of a training patch of an image
    patches: Number = 1  #: number of patches of each image
    pool: Number | None = None  #: images that are reused while the mask is fixed; None: always new images
    critics: Critics = Critics()
    betas: tuple[Beta, Beta] = (0.9, 0.999)
    rates: Rates = Rates()
    laser_free: Share = 0.0
    average: Annotated[float, Field(ge=0, lt=1)] = 0.999
    precision: Literal["float32", "bfloat16", "float64"] = "float32"
    logarithm: bool = True
    mask: MaskSettings = MaskSettings()  #: the mask without images, in place of stage 1
    stages: dict[Annotated[int, Field(ge=1, le=2)], Stage]
    keep: Number = 100
    show: Number = 500
    tensorboard: bool = False

    @property
    def learnt(self) -> tuple[int, ...]:
        """Return the numbers of the stages to train."""
        return tuple(sorted(n for n in self.stages if self.learn or n != 1))

    @property
    def design(self) -> MaskTraining:
        """Return the settings of the mask design without images, on the steps that the stages train on."""
        return MaskTraining.model_construct(**dict(self.mask), height=self.learn, psf=self.psf)

    @property
    def dtype(self) -> torch.dtype:
        """Return the dtype of parameters and scenes; bfloat16 applies only inside the network."""
        return torch.float64 if self.precision == "float64" else torch.float32


def read_training(composed: Composed) -> tuple[Composed, Training | None]:
    """Return the recipe without its ``train`` block, and the block; mistakes become diagnostics of the recipe."""
    block = composed.root.items.get(KEY)
    if block is None:
        return composed, None
    composed = composed.without(KEY)
    try:
        found = Training.model_validate(_placed(block))
    except ValidationError as error:
        return composed.with_problems(_problem(block, each) for each in error.errors()), None
    return _with_folder(composed, block, found)


def _placed(block: Value) -> Any:
    """Return the block with the path of a start height map relative to the file that names the path."""
    plain, mask = block.plain, block.items.get("mask")
    start = mask.items.get("start") if mask else None
    if start is None or not isinstance(start.plain, str):
        return plain
    path = Path(start.mark.folder) / Path(start.plain).expanduser()
    return {**plain, "mask": {**plain["mask"], "start": path}}


def _with_folder(composed: Composed, block: Value, found: Training) -> tuple[Composed, Training | None]:
    """Return the block with its folder of photographs relative to the file that names the folder."""
    if found.photographs is None:
        return composed, found
    mark = block.items["photographs"].mark
    path = Path(mark.folder) / found.photographs.expanduser()
    if not path.is_dir():
        problem = Diagnostic(mark, f"{KEY}.photographs", f"{path} is not a folder")
        return composed.with_problems([problem]), None
    return composed, found.model_copy(update={"photographs": path})


def _problem(block: Value, error: Any) -> Diagnostic:
    """Return a diagnostic at the innermost location that pydantic names, with the fix."""
    at, path = block, [KEY]
    for key in error["loc"]:
        below = {str(k): v for k, v in at.items.items()}
        if str(key) in below:
            at = below[str(key)]
            path.append(str(key))
    mark: Location = at.key if error["type"] == "extra_forbidden" else at.mark
    text = str(error["msg"])
    if error["type"] == "extra_forbidden":
        unknown = f"unknown; {nearest(path[-1], _fields(error['loc'][:-1]))}"
        text = instead(".".join(path)) or unknown
    elif now := instead(f"{'.'.join(path)}={error['input']}"):
        text = f"{error['input']} {now}"
    elif error["type"] == "missing":
        text = f"needs {error['loc'][-1]}"
    return Diagnostic(mark, ".".join(path), text)


def _fields(where: tuple[int | str, ...]) -> list[str]:
    blocks: dict[str, type[BaseModel]] = {"network": Network, "critics": Critics, "rates": Rates, "stages": Stage,
                                          "mask": MaskSettings, "mask.weights": Weights}  # fmt: skip
    name = ".".join(map(str, where if where[:1] == ("mask",) else where[:1]))
    return list((blocks[name] if where else Training).model_fields)
