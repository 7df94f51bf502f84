"""How a mask is designed: the settings of the stage that learns from no images."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from neusee.nodes.doe import Material
from neusee.nodes.losses import ContrastFloor, HighestFrequency, NoiseVariance, OneBandShare
from neusee.nodes.units import Count, DataFile, PositiveLength, Wavelength

Weight = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Kind = Literal["pixelwise", "recipe_mask", "zernike", "rings", "unet", "five_half_rings"]
_RATE = {"pixelwise": 0.05, "recipe_mask": 4e-3, "zernike": 0.1, "rings": 0.1, "unet": 2e-3, "five_half_rings": 1.0}


class Weights(BaseModel):
    """How much each term counts, all of them means over the bands."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    lsr: Weight = 1.0  #: `losses.suppression_loss`
    bsr: Weight = 1.0  #: `losses.background_loss` of a point on the axis: the light that left the field
    contrast: Weight = 0.0  #: `losses.contrast`
    wiener: Weight = 0.0  #: `losses.wiener`, of all bands at once: what a Wiener filter does not bring back

    @model_validator(mode="after")
    def _some(self) -> Weights:
        if not (self.lsr or self.bsr or self.contrast or self.wiener):
            raise ValueError("every weight is 0: nothing to learn")
        return self


class MaskSettings(BaseModel):
    """What is learnt, on what terms, and for how long: ``train.mask`` of a recipe."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Kind = "pixelwise"  #: `recipe_mask`: every sample of the recipe's own height map, from its formula or file on
    iterations: Count = 300  #: of Adam; of five_half_rings, generations
    learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None  #: None: what suits the kind
    schedule: Literal["cosine", "step"] = "cosine"  #: `step`: halved at each fifth of the iterations
    weights: Weights = Weights(bsr=4.0, contrast=1.0)
    power: Annotated[float, Field(ge=8, le=64)] = 16.0  #: of the norm that stands for the peak
    log: bool = True  #: each band by the logarithm of its LSR
    enough: Annotated[float, Field(gt=0, le=1)] | None = None  #: LSR below which, in the mean, no less is asked for
    floor: ContrastFloor = 1e-4  #: contrast below which little is won
    up_to: HighestFrequency | None = None  #: cycles a pixel: what is finer does not count
    noise_share: NoiseVariance = 1e-3  #: of `losses.wiener`, of the variance
    colour: OneBandShare = 1.0  #: of `losses.wiener`: share of the variance that is of one band
    bands: Count | None = 7  #: of the recipe's, at a time; None: all of them
    seed: int = 0
    starts: Count = 1  #: independent ones, of which the best on all bands is kept
    at: dict[str, Any] = {}  #: values of the recipe that are other while learning, such as a coarser pupil
    save_every: Count = 50  #: iterations

    # what the kinds are made of
    max_height: PositiveLength = 5 * 1e-6  #: pixelwise, unet; to the last bit what `5 um` is
    grid: Count = 270  #: pixelwise, unet: places along an axis
    scale: Annotated[float, Field(gt=0, le=1)] = 0.04  #: pixelwise: features of the start, in diameters
    start: DataFile | None = None  #: pixelwise: a relief to start from, such as that of another kind
    width: Count = 16  #: unet: channels of its first layer
    modes: Count = 100  #: zernike: polynomials, from Noll's number 4 on
    waves: Annotated[float, Field(gt=0)] = 5.0  #: zernike: root mean square of the start
    rings: Count = 40  #: rings: annuli of equal area
    sided: bool = True  #: rings: odd about the axis, as half-rings are
    noise: Annotated[float, Field(ge=0)] = 1.0  #: rings: chance on each slope of the start, in waves
    slopes: tuple[float, float] = (4.0, 48.0)  #: five_half_rings: least and greatest, in waves at the rim
    population: Annotated[int, Field(ge=5)] = 70  #: five_half_rings
    polish: Annotated[int, Field(ge=0)] = 300  #: five_half_rings: masks tried downhill from the best, on all bands
    wavelength: Wavelength = 550e-9  #: that waves are counted in
    material: Material = "fused silica"  #: and of what
    feature: PositiveLength | None = None  #: least that can be made, `doe.smooth`; depth and levels are the recipe's

    plain: str = "psf[plain]"  #: the step of the lens without a mask
    illuminant: str = "illuminant"  #: of `losses.wiener`
    responses: str = "responses"

    @model_validator(mode="after")
    def _rising(self) -> Self:
        if not self.slopes[0] < self.slopes[1]:
            raise ValueError(f"slopes {self.slopes}: give the least first")
        return self

    @property
    def rate(self) -> float:
        """The learning rate, or what suits the kind: logits 0.05, near a formula 4e-3, waves 0.1, weights 2e-3."""
        return _RATE[self.kind] if self.learning_rate is None else self.learning_rate


class MaskTraining(MaskSettings):
    """The same with the steps that it is learnt on."""

    height: str = "height"  #: the step that is replaced
    psf: str = "psf[mask]"


class DesignError(ValueError):
    """A mask that cannot be designed as asked; says where, and what to change."""


def need_steps(recipe_steps: Any, how: MaskTraining) -> None:
    """Refuse a step that is not there, with the setting that names it."""
    from neusee.workflows.graph.diagnostics import nearest

    asked = ["height", "psf", "plain", *(["illuminant", "responses"] if how.weights.wiener else [])]
    for setting, name in ((setting, getattr(how, setting)) for setting in asked):
        if name not in recipe_steps:
            raise DesignError(f"{setting}: the recipe has no step {name!r}; {nearest(name, recipe_steps)}")


def state_file(out: Path, recipe: str, key: str) -> Path:
    """Where an unfinished design is kept; it has no suffix that a half-written run has, so no run sweeps it away."""
    return out / f".{recipe}_mask_{key[:16]}.state"
