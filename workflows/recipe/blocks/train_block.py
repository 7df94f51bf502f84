"""How a recipe is learnt: its ``train`` block, read and checked where it stands."""

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

KEY = "train"  #: of a recipe
GRID = ("samples", "pitch", "diameter", "aperture")  #: parameters of every height map

Weight = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Beta = Annotated[float, Field(ge=0, lt=1)]
Number = Annotated[int, Field(ge=1)]


class _Block(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Network(_Block):
    """Which network restores, and how wide it is."""

    kind: Literal["fft_mamba", "unet", "nafnet"] = "fft_mamba"
    width: Annotated[int, Field(ge=2)] = 64
    shuffle: Annotated[int, Field(ge=1, le=8)] = 2  #: of fft_mamba: pixels along an axis that are scanned as one
    directions: Literal[2, 4] = 2  #: of fft_mamba, as the next two
    pyramid: bool = False
    frequency: Literal["complex", "amp_phase"] = "complex"

    @property
    def options(self) -> dict[str, Any]:
        """What is not as usual, beside kind and width."""
        return self.model_dump(exclude={"kind", "width"}, exclude_defaults=True)

    @model_validator(mode="after")
    def _fits(self) -> Network:
        if self.options and self.kind != "fft_mamba":
            raise ValueError(f"{', '.join(self.options)}: of fft_mamba alone, not of {self.kind}")
        return self


class Critics(_Block):
    """The two critics and their momenta."""

    width: Annotated[int, Field(ge=2)] = 64
    betas: tuple[Beta, Beta] = (0.0, 0.9)


class Rates(_Block):
    """Learning rates and how they fall: halved once, then by a factor at a time, and never below the least."""

    weights: Annotated[float, Field(gt=0)] = 2e-4
    biases: Annotated[float, Field(gt=0)] = 4e-4
    mask: Annotated[float, Field(gt=0)] = 2e-4
    halve: Number = 2000
    every: Number = 1000
    factor: Annotated[float, Field(gt=0, le=1)] = 0.7
    least: Weight = 1e-6

    def share(self, iteration: int) -> float:
        """By what a rate is multiplied at an iteration of a stage, counted from 0."""
        if iteration < self.halve:
            return 1.0
        return float(0.5 * self.factor ** ((iteration - self.halve) // self.every))


class Stage(_Block):
    """How long, over how many pictures at a time, and for what; a weight of 0 leaves a term out."""

    iterations: Annotated[int, Field(ge=0)]
    batch: Number = 8
    lsr: Weight = 0.0
    bsr: Weight = 0.0
    adversarial: Weight = 0.1
    penalty: Weight = 1.0
    reconstruction: Weight = 1.0


class Training(_Block):
    """A recipe's ``train`` block."""

    photographs: Path | None = None
    learn: str | None = "height"  #: None: the recipe's own element stays, and stage 1 falls away
    scene: str = "scene"
    picture: str = "developed[mask]"
    truth: str = "truth"
    psf: str = "psf[mask]"
    light: str = "bsr[mask]"  #: step that gives the light kept, by band
    network: Network = Network()
    size: tuple[Number, Number] | None = None
    patch: tuple[Number, Number] | None = None  #: pixels (y, x) that are cut out of a picture to learn from
    patches: Number = 1  #: of each picture
    pool: Number | None = None  #: pictures that come again and again where the element is still; None: always new ones
    critics: Critics = Critics()
    betas: tuple[Beta, Beta] = (0.9, 0.999)
    rates: Rates = Rates()
    laser_free: Share = 0.0
    average: Annotated[float, Field(ge=0, lt=1)] = 0.999
    precision: Literal["float32", "bfloat16", "float64"] = "float32"
    logarithm: bool = True
    mask: MaskSettings = MaskSettings()  #: the element without images, in place of stage 1
    stages: dict[Annotated[int, Field(ge=1, le=2)], Stage]
    keep: Number = 100
    show: Number = 500
    tensorboard: bool = False

    @property
    def learnt(self) -> tuple[int, ...]:
        """The stages there are."""
        return tuple(sorted(n for n in self.stages if self.learn or n != 1))

    @property
    def design(self) -> MaskTraining:
        """How the element is designed without images: on the steps that the stages learn from too."""
        return MaskTraining.model_construct(**dict(self.mask), height=self.learn, psf=self.psf)

    @property
    def dtype(self) -> torch.dtype:
        """Of what learns and of the scenes; bfloat16 is for what a network computes, not for what it is."""
        return torch.float64 if self.precision == "float64" else torch.float32


def read_training(composed: Composed) -> tuple[Composed, Training | None]:
    """The recipe without its ``train`` block, and the block; what is wrong with it becomes a problem of the recipe."""
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
    """The block with the path of a relief to start from relative to the file that names it."""
    plain, mask = block.plain, block.items.get("mask")
    start = mask.items.get("start") if mask else None
    if start is None or not isinstance(start.plain, str):
        return plain
    path = Path(start.mark.folder) / Path(start.plain).expanduser()
    return {**plain, "mask": {**plain["mask"], "start": path}}


def _with_folder(composed: Composed, block: Value, found: Training) -> tuple[Composed, Training | None]:
    """A relative folder of photographs is relative to the file that names it."""
    if found.photographs is None:
        return composed, found
    mark = block.items["photographs"].mark
    path = Path(mark.folder) / found.photographs.expanduser()
    if not path.is_dir():
        problem = Diagnostic(mark, f"{KEY}.photographs", f"{path} is no folder")
        return composed.with_problems([problem]), None
    return composed, found.model_copy(update={"photographs": path})


def _problem(block: Value, error: Any) -> Diagnostic:
    """Where it stands, as far as what pydantic names is there, and what to write."""
    at, path = block, [KEY]
    for key in error["loc"]:
        below = {str(k): v for k, v in at.items.items()}
        if str(key) in below:
            at = below[str(key)]
            path.append(str(key))
    mark: Location = at.key if error["type"] == "extra_forbidden" else at.mark
    text = str(error["msg"])
    if error["type"] == "extra_forbidden":
        unknown = f"is not known here; {nearest(path[-1], _fields(error['loc'][:-1]))}"
        text = instead(".".join(path)) or unknown
    elif now := instead(f"{'.'.join(path)}={error['input']}"):
        text = f"{error['input']} {now}"
    elif error["type"] == "missing":
        text = f"lacks {error['loc'][-1]}"
    return Diagnostic(mark, ".".join(path), text)


def _fields(where: tuple[int | str, ...]) -> list[str]:
    blocks: dict[str, type[BaseModel]] = {"network": Network, "critics": Critics, "rates": Rates, "stages": Stage,
                                          "mask": MaskSettings, "mask.weights": Weights}  # fmt: skip
    name = ".".join(map(str, where if where[:1] == ("mask",) else where[:1]))
    return list((blocks[name] if where else Training).model_fields)
