"""Blocks of settings in a recipe: their base class, the types of their values, a reader that
reports mistakes, and the smallest block, `evaluate`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import BaseModel, Field, ValidationError

from neusee.nodes.parameters import ParameterModel
from neusee.nodes.units import Length, Waves
from neusee.workflows.graph.errors import Diagnostic, nearest
from neusee.workflows.recipe.text.composition import Composed
from neusee.workflows.recipe.text.field_errors import message_of
from neusee.workflows.recipe.text.other_spellings import instead
from neusee.workflows.recipe.text.yaml_values import Value

Weight = Annotated[float, Field(ge=0, le=1e9)]
Share = Annotated[float, Field(ge=0, le=1)]
Beta = Annotated[float, Field(ge=0, lt=1)]
Number = Annotated[int, Field(ge=1, le=10**9)]
LearningRate = Annotated[float, Field(gt=0, le=1e3)]
GradientNorm = Annotated[float, Field(gt=0, le=1e12)] | None  #: None: no limit


class SettingsBlock(ParameterModel):
    """Base class of a block of settings in a recipe; an unknown key in the block is a mistake."""


Settings = TypeVar("Settings", bound=BaseModel)


def read_block(
    composed: Composed,
    key: str,
    model: type[Settings],
    plain: Any,
    context: dict[str, Any] | None = None,
) -> tuple[Composed, Settings | None]:
    """Return a recipe without its block ``key``, and the validated settings from that block.

    ``plain`` is the plain data of the block. ``context`` gives the models of the settings data of
    the recipe, such as its families of nodes. For a mistake in the block, the returned recipe has a
    further diagnostic and the settings are None.
    """
    block, without_block = composed.root.items[key], composed.without(key)
    try:
        return without_block, model.model_validate(plain, context=context)
    except ValidationError as error:
        return without_block.with_problems(
            located(block, model, details) for details in error.errors()
        ), None


def located(block: Value, model: type[BaseModel], error: Any) -> Diagnostic:
    """Return the diagnostic for a pydantic error, with the location of the innermost value that
    the error names.
    """
    value = block
    for key in error["loc"]:
        # keys that are no part of the recipe, such as names of types, are skipped
        value = value.child(key) or value
    text = message_of(error, value)
    if error["type"] == "extra_forbidden":
        names = _fields(model, error["loc"])
        return Diagnostic(
            value.key,
            value.name,
            instead(value.name) or f"unknown; {nearest(error['loc'][-1], names)}",
        )
    if renaming := instead(f"{value.name}={error['input']}"):
        text = f"{error['input']} {renaming}"
    elif error["type"] == "missing":
        text = f"needs {error['loc'][-1]}"
    return Diagnostic(value.mark, value.name, text)


def _fields(model: type[BaseModel], path: Sequence[int | str]) -> list[str]:
    """Return the names of the settings that a block of a recipe allows below a path of keys."""
    for key in path:
        if key in model.model_fields:
            annotation: Any = model.model_fields[str(key)].annotation
            model = next(
                (
                    model_class
                    # the model inside of an optional or a mapping
                    for model_class in get_args(annotation)
                    if hasattr(model_class, "model_fields")
                ),
                annotation,
            )
    return list(model.model_fields)


# --- the block `evaluate`: errors of the parameters that the restorer assumes ---------------------

KEY = "evaluate"  #: key of the block in a recipe


class Mismatch(SettingsBlock):
    """Errors of the parameters that a restorer assumes, each tested alone; 0 or false omits an
    error.
    """

    pixels: Annotated[float, Field(ge=0, le=100)] = 0.5  #: of the laser's position, along y and x
    wavelength: Annotated[Length, Field(ge=0, le=100e-9)] = 2e-9  #: of the laser
    defocus: Waves = 0.1  #: of the lens, for scene and laser, peak to valley at 550 nm
    dirt: bool = True  #: whether the restorer does not know of the dirt on the window
    #: of the laser; null: the largest strength of the evaluation
    strength: Annotated[float, Field(gt=0, le=1e18)] | None = None
    scenes: Number = 5  #: the first scenes with a laser


class EvaluateSettings(SettingsBlock):
    """Settings of `neusee evaluate` in the recipe key ``evaluate``."""

    mismatch: Mismatch | None = Mismatch()  #: null: the restorer always assumes the true values
    #: drawn: the first laser of the recipe, its wavelength by its law
    lasers: Literal["in turn", "drawn"] = "in turn"
    scenes: Number | Literal["all"] = 20  #: all: every photograph of the folder once
    pipelines: str = "flat+none, five_half_rings+wiener"
    reference: str = ""  #: of these pipelines; empty: the first
    #: peak of a laser behind each pipeline
    equal_protection: Annotated[float, Field(gt=0, lt=1)] | None = None
    by: Literal["best", "filter", "stop"] = "best"
    #: true: the unchanged pipelines are evaluated too, beside those of equal protection
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
