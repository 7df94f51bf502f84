"""The scenes of an evaluation, each a crop of a photograph with a laser direction and a random
seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from torch import Tensor

from neusee.nodes import ParameterError
from neusee.nodes.scene import choose_photograph, crop_photograph, list_photographs
from neusee.workflows.engine.node_call import call
from neusee.workflows.engine.runner import run
from neusee.workflows.evaluation.pipelines import (
    BEAM,
    NONE,
    EvaluationRefused,
    PipelineRecipes,
    one_line,
)
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.keys.cache_key import digest, file_digest, key_of, stream_seed
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.recipe.uncertain_inputs import Inputs, NothingDrawn
from neusee.workflows.store.result_store import Store

PHOTOGRAPH = "scene.photograph"


class UnreadablePhotograph(EvaluationRefused):
    """Error for a photograph with a valid header and end that cannot be decoded."""


@dataclass(frozen=True)
class Scene:
    """One scene of an evaluation; its photograph is read at the first use."""

    number: int
    case: str  #: name of the laser, or none
    #: path of the photograph relative to its folder, or the node of the recipe's own scene
    name: str
    path: Path | None  #: photograph; None for the recipe's own scene
    shape: tuple[int, int]
    recipe: Recipe
    store: Store

    @property
    def seed(self) -> int:
        """Return the random seed for the noise and the laser direction of the scene.

        A run of the recipe with this seed gives the same values.
        """
        return self.recipe.seed + self.number

    @cached_property
    def picture(self) -> Tensor:
        """Return the picture of the scene in linear sRGB (3, y, x)."""
        if self.path is None:
            own_picture: Tensor = run(self.recipe, self.store, ("scene",))["scene"]
            return own_picture
        try:
            return crop_photograph(self.path, self.shape, self.recipe.seed, self.number)
        except (ParameterError, OSError, ValueError, SyntaxError) as error:
            raise UnreadablePhotograph(
                f"{self.path}: {error}: remove this file, and run the same command again"
            ) from error

    def key(self, code: Code) -> str:
        """Return the cache key of the picture of the scene."""
        if self.path is None:
            return digest(
                "own scene", key_of(self.recipe.steps["scene"], {}, self.recipe.seed, code)[0]
            )
        code_of_crop = code.digest(crop_photograph.__module__)
        return digest(
            "photograph",
            code_of_crop,
            file_digest(self.path),
            list(self.shape),
            self.recipe.seed,
            self.number,
        )

    def draw(self, inputs: Inputs) -> dict[str, float]:
        """Draw the uncertain values of the scene in SI units, equal for every pipeline
        and laser.
        """
        import numpy as np

        # a separate random stream for each name, independent of the other drawn values
        standard_normal = [
            np.random.default_rng([self.seed, stream_seed(0, name)]).standard_normal()
            for name in inputs.names
        ]
        return dict(
            zip(inputs.names, map(float, inputs.at(np.array([standard_normal]))[0]), strict=True)
        )

    def angle(self, recipe: Recipe) -> tuple[float, float]:
        """Draw the direction cosines (y, x) of the laser from the distribution in the paper."""
        step = recipe.steps[f"direction[{BEAM}]"]
        direction = call(step, [], step.params, self.seed, "cpu")
        return float(direction[0]), float(direction[1])

    def wavelength(self, recipe: Recipe, inputs: Inputs | None) -> float:
        """Return the wavelength of the laser in m, drawn if the recipe has a law for it."""
        name = f"lasers.{BEAM}.wavelength"
        if inputs is not None and name in inputs.names:
            return self.draw(inputs)[name]
        return float(recipe.steps[f"line[{BEAM}]"].params["wavelength"])


def scenes(
    recipe: Recipe, store: Store, root: Path | None, count: int | None, cases: Sequence[str]
) -> tuple[list[Scene], list[tuple[Path, str]]]:
    """Return ``count`` scenes with the lasers ``cases`` in turn, and the unreadable photographs
    with reasons.

    Without ``count`` there is one scene for each photograph.
    """
    scene_step, shape = recipe.steps["scene"], _shape(recipe)
    paths, unreadable = _photographs(scene_step, root)
    listed_scenes = []
    for number in range(max(1, len(paths)) if count is None else count):
        path = choose_photograph(paths, recipe.seed, number) if paths else None
        name = _scene_name(scene_step, path, root)
        listed_scenes.append(
            Scene(number, cases[number % len(cases)], name, path, shape, recipe, store)
        )
    return listed_scenes, unreadable


def _photographs(own: Step, root: Path | None) -> tuple[Sequence[Path], list[tuple[Path, str]]]:
    """Return the photographs in the folder ``root``, or that of the recipe's step ``own``; and
    unreadable ones with reasons.
    """
    if root is None:
        return ([own.params["file"]] if own.node.path == PHOTOGRAPH else []), []
    if not root.is_dir():
        raise EvaluationRefused(f"--data {root}: this folder does not exist")
    paths, unreadable = list_photographs(root)
    if not paths:
        reason = f"; {unreadable[0][0].name}: {unreadable[0][1]}" if unreadable else ""
        raise EvaluationRefused(
            f"--data {root}: the folder contains no readable PNG or JPEG file{reason}"
        )
    return paths, unreadable


def _scene_name(own: Step, path: Path | None, root: Path | None) -> str:
    """Return the name of a scene: the path of the photograph relative to its folder, or the node of
    the recipe.
    """
    if path is None:
        return own.node.path
    return path.relative_to(root).as_posix() if root else path.name


def photographs(shown: Sequence[Scene]) -> list[int]:
    """Return the index of each scene's photograph, for intervals over photographs.

    Equal files count as one photograph under any name. If all scenes show one photograph, they
    differ only in laser and noise, and each counts as one sample.
    """
    contents = [scene.name if scene.path is None else file_digest(scene.path) for scene in shown]
    contents_once = list(dict.fromkeys(contents))
    return (
        [contents_once.index(content) for content in contents]
        if len(contents_once) > 1
        else list(range(len(shown)))
    )


def wavelengths(pipeline: PipelineRecipes, shown: Sequence[Scene]) -> list[float | None]:
    """Return the wavelength of the laser of each scene in m; None without a laser."""
    inputs: dict[str, Inputs | None] = {}
    for case in {scene.case for scene in shown if scene.case != NONE}:
        inputs[case] = None
        with suppress(NothingDrawn):
            inputs[case] = Inputs.of(pipeline.recipe(case), pipeline.pipeline.outputs)
    return [
        scene.wavelength(pipeline.recipe(scene.case), inputs[scene.case])
        if scene.case != NONE
        else None
        for scene in shown
    ]


def refuse_directions(pipeline: PipelineRecipes, shown: Sequence[Scene]) -> None:
    """Raise `EvaluationRefused` if a scene's laser direction is too steep for the pupil sampling of
    the recipe.

    For each laser only the scenes with the largest angle over wavelength along y and along x are
    checked.
    """
    numbers = (scene.number for scene in shown)
    wavelength_of = dict(zip(numbers, wavelengths(pipeline, shown), strict=True))
    fault_lines: dict[str, None] = {}
    for case in dict.fromkeys(scene.case for scene in shown if scene.case != NONE):
        scenes_and_directions = [
            (scene, scene.angle(pipeline.recipe(case))) for scene in shown if scene.case == case
        ]
        for axis in (0, 1):
            # largest phase step between samples of the pupil
            scene, direction = max(
                scenes_and_directions,
                key=lambda pair: abs(pair[1][axis]) / (wavelength_of[pair[0].number] or 1.0),
            )
            fault_lines |= _direction_faults(
                pipeline, scene, direction, wavelength_of[scene.number]
            )
    if fault_lines:
        text = "\n".join(fault_lines)
        raise EvaluationRefused(
            f"{text}\nThe directions are drawn over the sensor: choose a smaller sensor.shape"
        )


def _direction_faults(
    pipeline: PipelineRecipes,
    scene: Scene,
    direction: tuple[float, float],
    wavelength: float | None,
) -> dict[str, None]:
    """Return a line for each error of the recipe with the laser of a scene."""
    try:
        # composing the recipe fails for a direction that the pupil sampling cannot represent
        pipeline.recipe(scene.case, direction, wavelength)
    except RecipeError as error:
        scene_text = f"scene {scene.number + 1} ({scene.case})"
        return dict.fromkeys(f"{scene_text}: {one_line(problem)}" for problem in error.diagnostics)
    return {}


def _shape(recipe: Recipe) -> tuple[int, int]:
    """Return the size (y, x) of the scene in pixels; raise `EvaluationRefused` if the recipe sets
    none.
    """
    shape = recipe.steps["scene"].params.get("shape")
    if shape is None and recipe.steps["scene"].node.path == PHOTOGRAPH:
        raise EvaluationRefused(
            "scene.shape is missing: write the size to crop from photographs, such as [768, 768]"
        )
    if shape is None:
        raise EvaluationRefused(
            "scene.shape is missing: write the size of the scene in pixels, such as [768, 768]"
        )
    return int(shape[0]), int(shape[1])
