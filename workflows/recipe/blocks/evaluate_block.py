"""Settings of an evaluation: lasers, scenes and pipelines, and the errors in what the restorer
is told.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from neusee.nodes.units import Length, Waves
from neusee.workflows.recipe.blocks.settings_block import Number, SettingsBlock, read_block
from neusee.workflows.recipe.text.composition import Composed

KEY = "evaluate"  #: key of the block in a recipe


class Mismatch(SettingsBlock):
    """Errors in what a restorer is told, each tried by itself; 0 or false leaves an error out."""

    pixels: Annotated[float, Field(ge=0, le=100)] = 0.5  #: of the place of the laser, along y and x
    wavelength: Annotated[Length, Field(ge=0, le=100e-9)] = 2e-9  #: of the laser
    defocus: Waves = 0.1  #: of the lens, for scene and laser, peak to valley at 550 nm
    dirt: bool = True  #: whether the dirt of the window is not told
    #: null: the largest of the evaluation
    strength: Annotated[float, Field(gt=0, le=1e18)] | None = None
    scenes: Number = 5  #: the first scenes with a laser


class EvaluateSettings(SettingsBlock):
    """Settings of `neusee evaluate` in the recipe key ``evaluate``."""

    mismatch: Mismatch | None = Mismatch()  #: null: the restorer is always told the truth
    #: drawn: the first laser of the recipe, its wavelength by its law
    lasers: Literal["in turn", "drawn"] = "in turn"
    scenes: Number | Literal["all"] = 20  #: all: every photograph of the folder once
    pipelines: str = "flat+none, five_half_rings+wiener"
    reference: str = ""  #: of these pipelines; empty: the first
    #: peak of a laser behind each pipeline
    equal_protection: Annotated[float, Field(gt=0, lt=1)] | None = None
    by: Literal["best", "filter", "stop"] = "best"
    #: true: the pipelines as they are are evaluated too, beside those of equal protection
    beside: bool = False
    #: changes of the recipe for the figure with the lasers, such as sensor.c1=0.2
    figure: tuple[str, ...] = ()


def read_evaluate(composed: Composed) -> tuple[Composed, EvaluateSettings | None]:
    """Return a recipe without its block ``evaluate``, and the settings from the block; report
    mistakes.
    """
    block = composed.root.items.get(KEY)
    return (
        (composed, None)
        if block is None
        else read_block(composed, KEY, EvaluateSettings, block.plain)
    )
