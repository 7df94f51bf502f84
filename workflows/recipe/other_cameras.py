"""The other cameras of a training: the same recipe, each time with other overrides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from neusee.workflows.graph.diagnostics import Diagnostic, Location, RecipeError
from neusee.workflows.graph.final_values import Config, changes
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.text.composition import Composed
from neusee.workflows.recipe.text.overrides import Override, read_override
from neusee.workflows.recipe.text.yaml_values import Value

_TRAIN, _CAMERAS = "train", "train.cameras"


def with_cameras(recipe: Recipe, composed: Composed, made: Callable[[Sequence[Override]], Recipe]) -> Recipe:
    """Return a recipe with the recipes of `train.cameras`, which ``made`` loads with the overrides of each.

    The final values state each camera by the values that differ, so that their text needs no groups of options.
    Raises `RecipeError` with the location of an override, also for one that changes the training.
    """
    given = composed.root.items[_TRAIN].items["cameras"]
    cameras = tuple(made([_override("train.cameras=[]", given), *_overrides(each)]) for each in given.items.values())
    settings = dict(recipe.config.settings)
    stated = [changes(recipe.config, camera.config, _TRAIN) for camera in cameras]
    settings[_CAMERAS] = replace(settings[_CAMERAS], value=stated)
    return replace(recipe, cameras=cameras, config=Config(settings))


def _overrides(camera: Value) -> list[Override]:
    found = [_override(str(value.plain), value) for value in camera.items.values()]
    if wrong := [o for o in found if o.path[0] == _TRAIN]:
        raise RecipeError(Diagnostic(o.mark, camera.name, f"{o.text} is no setting of a camera") for o in wrong)
    return found


def _override(text: str, value: Value) -> Override:
    return read_override(text, Location(str(value.mark), folder=value.mark.folder))
