"""Settings of the mask design, which optimises the point spread function of a mask without images."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

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
from neusee.workflows.graph.diagnostics import nearest
from neusee.workflows.recipe.blocks.settings_block import LearningRate, SettingsBlock, Weight

Kind = Literal["pixelwise", "recipe_mask", "zernike", "polynomial", "streak", "rings", "unet", "five_half_rings"]
_RATE = {"pixelwise": 0.05, "recipe_mask": 4e-3, "zernike": 0.1, "polynomial": 0.02, "streak": 0.02, "rings": 0.1,
         "unet": 2e-3, "five_half_rings": 1.0}  # fmt: skip


def half_cosine(angle: float) -> float:
    """Return the factor (1 + cos(angle)) / 2 on a learning rate, which falls from 1 at 0 to 0 at the angle pi."""
    return 0.5 * (1 + math.cos(angle))


class Weights(SettingsBlock):
    """Weights of the terms in the loss of the mask design; each term is a mean over the spectral bands."""

    lsr: Weight = 1.0  #: `losses.suppression_loss`
    bsr: Weight = 1.0  #: `losses.background_loss` of a point on the axis: the light that left the field
    contrast: Weight = 0.0  #: `losses.contrast`
    wiener: Weight = 0.0  #: `losses.wiener` of all bands together: the error that remains after a Wiener filter
    filtered_error: Weight = 0.0  #: `losses.filtered_error` behind the filter that keeps the peak at `limit`
    information: Weight = 0.0  #: `losses.information` behind the same filter, in bits per frequency

    @model_validator(mode="after")
    def _some(self) -> Weights:
        if not any(getattr(self, name) for name in type(self).model_fields):
            names = " or ".join([", ".join([*type(self).model_fields][:-1]), [*type(self).model_fields][-1]])
            raise ValueError(f"every weight of the loss is 0: set {names} to a number above 0")
        return self

    @property
    def protected(self) -> bool:
        """Return True if a term of the loss is that of a picture behind a peak limit."""
        return bool(self.filtered_error or self.information)

    @property
    def coloured(self) -> bool:
        """Return True if a term of the loss depends on the light of the scene and the responses of the channels."""
        return bool(self.wiener or self.protected)


class MaskSettings(SettingsBlock):
    """Settings of the mask design in the recipe key ``train.mask``: the kind of mask, the loss and the duration."""

    kind: Kind = "pixelwise"  #: `recipe_mask`: all samples of the recipe's own height map, from its formula or file
    iterations: Count = 300  #: iterations of Adam, or generations for five_half_rings
    learning_rate: LearningRate | None = None  #: None: the default for the kind
    schedule: Literal["cosine", "step"] = "cosine"  #: `step`: halved at each fifth of the iterations
    weights: Weights = Weights(bsr=4.0, contrast=1.0)
    power: Annotated[float, Field(ge=8, le=64)] = 16.0  #: exponent of the norm that replaces the peak
    log: bool = True  #: whether the loss uses the logarithm of the LSR of each band
    enough: Annotated[float, Field(gt=0, le=1)] | None = None  #: mean LSR below which the loss does not fall further
    floor: ContrastFloor = 1e-4  #: contrast below which the loss hardly falls
    up_to: HighestFrequency | None = None  #: cycles per pixel: higher frequencies do not affect the loss
    noise_share: NoiseVariance = 1e-3  #: of `losses.wiener`: noise variance over signal variance
    colour: OneBandShare = 1.0  #: of `losses.wiener`: fraction of the variance that belongs to one band alone
    limit: PeakLimit | None = None  #: largest LSR behind mask and grey filter, for filtered_error and information
    light: SceneLight = 30.0  #: mean of the scene behind the clear lens, in each pixel, for these two terms
    read_noise: Electrons = 10.5
    veil: Electrons = 0.0  #: even light of a laser behind the clear lens
    contrast_variance: ContrastVariance = 0.1  #: of the scene, relative
    defocus_spread: Annotated[Waves, Field(ge=0)] = 0.0  #: standard deviation of the defocus, drawn at each iteration
    wavelength_spread: Annotated[Length, Field(ge=0, le=1e-6)] = 0.0  #: the same of all wavelengths together
    direction_spread: Annotated[Angle, Field(ge=0)] = 0.0  #: the same of the direction of the laser, on each axis
    learn_stop: bool = False  #: the diameter of `doe.shade` is learnt with the mask
    bands: Count | None = 7  #: number of bands of the recipe in one iteration; None: all bands
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    starts: Count = 1  #: independent starts; the result is the best mask on all bands
    at: dict[str, Any] = Field(default={})  #: recipe values that differ during training, such as a coarser pupil
    save_every: Count = 50  #: iterations between two saved states

    # parameters of the kinds of mask
    max_height: Depth = 5 * 1e-6  #: pixelwise, unet; equal to `5 um` to the last bit
    grid: Count = 270  #: pixelwise, unet: samples along an axis
    scale: Annotated[float, Field(gt=0, le=1)] = 0.04  #: pixelwise: feature size of the initial mask, in diameters
    start: DataFile | None = None  #: pixelwise: a height map to start from, such as one of another kind
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
    slopes: tuple[Slope, Slope] = (4.0, 48.0)  #: five_half_rings: least and greatest slope, in waves at the rim
    population: Annotated[int, Field(ge=5, le=10**6)] = 70  #: five_half_rings
    polish: Annotated[int, Field(ge=0, le=10**9)] = (
        300  #: five_half_rings: masks tried by descent from the best, on all bands
    )
    wavelength: Wavelength = 550e-9  #: reference wavelength of heights in waves
    material: Material = "fused silica"  #: material of heights in waves
    feature: PupilPitch | None = None  #: smallest feature (`doe.smooth`); the recipe sets depth and levels

    plain: str = "psf[plain]"  #: the step of the lens without a mask
    illuminant: str = "illuminant"  #: of `losses.wiener`, `losses.filtered_error` and `losses.information`
    responses: str = "responses"

    @model_validator(mode="after")
    def _rising(self) -> Self:
        if not self.slopes[0] < self.slopes[1]:
            raise ValueError(f"slopes = {self.slopes}: give the smaller slope first")
        if self.limit is not None and not self.weights.protected:
            text = "set weights.filtered_error or weights.information, or remove limit; of weights.lsr, `enough` is it"
            raise ValueError(f"limit = {self.limit:g} acts on no term of the loss: {text}")
        if self.learn_stop and not self.weights.protected:
            text = "only weights.filtered_error and weights.information know what a stop costs: set one, or remove it"
            raise ValueError(f"learn_stop = true: {text}")
        if self.learn_stop and self.kind == "five_half_rings":
            raise ValueError(
                "learn_stop = true: kind five_half_rings has no gradient: choose another kind, or remove it"
            )
        return self

    @property
    def rate(self) -> float:
        """Return the learning rate that the recipe sets, or the default rate for the kind of mask."""
        return _RATE[self.kind] if self.learning_rate is None else self.learning_rate


class MaskTraining(MaskSettings):
    """Settings of the mask design, and the names of the recipe steps that the design uses."""

    height: str = "height"  #: the step whose height map is designed
    psf: str = "psf[mask]"


class DesignError(ValueError):
    """Error for settings with which no mask can be designed; the message names the setting and the fix."""


def need_steps(recipe_steps: Any, settings: MaskTraining) -> None:
    """Raise `DesignError` if a setting names a step that the recipe does not have."""
    for setting in ("height", "psf", "plain", *(("illuminant", "responses") if settings.weights.coloured else ())):
        name = getattr(settings, setting)
        if name not in recipe_steps:
            raise DesignError(f"{setting}: the recipe has no step {name!r}; {nearest(name, recipe_steps)}")


def state_file(out: Path, recipe: str, key: str) -> Path:
    """Return the path of the file with the state of an unfinished mask design; other runs do not delete the file."""
    return out / f".{recipe}_mask_{key[:16]}.state"
