"""Lift training block of a recipe: the settings under ``train_lift`` for a lift from RGB to spectra."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from neusee.workflows.graph.diagnostics import Diagnostic, nearest
from neusee.workflows.recipe.blocks.mask_design_block import half_cosine
from neusee.workflows.recipe.text.composition import Composed
from neusee.workflows.recipe.text.renamed_keys import instead
from neusee.workflows.recipe.text.yaml_values import Value

KEY = "train_lift"  #: key of the block in a recipe

Beta = Annotated[float, Field(ge=0, lt=1)]
Number = Annotated[int, Field(ge=1)]


class LiftTraining(BaseModel):
    """Settings of a recipe's ``train_lift`` block."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    measured: str = "measured"
    picture: str = "picture"
    cube: str = "cube"
    start: Literal["linear", "random"] = "linear"
    iterations: Number
    batch: Number = 4
    rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 4e-4
    min_rate: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1e-6
    betas: tuple[Beta, Beta] = (0.9, 0.999)
    warmup: Annotated[int, Field(ge=0)] = 200  #: iterations in which the rate rises evenly
    floor: Annotated[float, Field(gt=0, le=1)] = 0.02
    ema_decay: Beta = 0.998  #: of the moving average of the weights; 0: no average
    validation_batches: Number = 32  #: pictures on which the network is judged at the end
    keep: Number = 100
    show: Number = 1000

    def rate_at(self, iteration: int) -> float:
        """Return the rate of an iteration from 0: linear warm-up, then half a cosine from `rate` to `min_rate`."""
        least, rising = min(self.min_rate, self.rate), min(1.0, (iteration + 1) / max(self.warmup, 1))
        return rising * (least + (self.rate - least) * half_cosine(math.pi * iteration / self.iterations))


def read_lift_training(composed: Composed) -> tuple[Composed, LiftTraining | None]:
    """Return the recipe without its ``train_lift`` block, and the block; mistakes become diagnostics of the recipe."""
    block = composed.root.items.get(KEY)
    if block is None:
        return composed, None
    composed = composed.without(KEY)
    try:
        return composed, LiftTraining.model_validate(block.plain)
    except ValidationError as error:
        return composed.with_problems(_problem(block, each) for each in error.errors()), None


def _problem(block: Value, error: Any) -> Diagnostic:
    """Return a diagnostic at the innermost location that pydantic names, with the fix."""
    names = [str(key) for key in error["loc"]]
    below = {str(key): value for key, value in block.items.items()}
    at = below.get(names[0], block) if names else block
    path = ".".join([KEY, *names[: at is not block]])
    if error["type"] == "extra_forbidden":
        return Diagnostic(at.key, path, instead(path) or f"unknown; {nearest(names[0], LiftTraining.model_fields)}")
    if error["type"] == "missing":
        return Diagnostic(at.mark, path, f"needs {names[-1]}")
    return Diagnostic(at.mark, path, str(error["msg"]))
