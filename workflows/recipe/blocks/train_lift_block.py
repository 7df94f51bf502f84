"""Settings of the block ``train_lift`` of a recipe: the training of a network that estimates spectra from RGB."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field

from neusee.workflows.recipe.blocks.mask_design_block import half_cosine
from neusee.workflows.recipe.blocks.settings_block import (
    Beta,
    GradientNorm,
    LearningRate,
    Number,
    SettingsBlock,
    Weight,
    read_block,
)
from neusee.workflows.recipe.text.composition import Composed

KEY = "train_lift"  #: key of the block in a recipe


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
    warmup: Annotated[int, Field(ge=0, le=10**9)] = 200  #: iterations in which the rate rises evenly
    floor: Annotated[float, Field(gt=0, le=1)] = 0.02
    clip: GradientNorm = 10.0  #: largest norm of the gradient of all weights
    ema_decay: Beta = 0.998  #: of the moving average of the weights; 0: no average
    validation_batches: Number = 32  #: number of pictures with which the network is validated at the end
    keep: Number = 100
    show: Number = 1000

    def rate_at(self, iteration: int) -> float:
        """Return the learning rate at an iteration: a linear warm-up, then half a cosine from `rate` to `min_rate`."""
        least, rising = min(self.min_rate, self.rate), min(1.0, (iteration + 1) / max(self.warmup, 1))
        return rising * (least + (self.rate - least) * half_cosine(math.pi * iteration / self.iterations))


def read_lift_training(composed: Composed) -> tuple[Composed, LiftTraining | None]:
    """Return a recipe without its block ``train_lift``, and the settings from the block; report mistakes."""
    block = composed.root.items.get(KEY)
    return (composed, None) if block is None else read_block(composed, KEY, LiftTraining, block.plain)
