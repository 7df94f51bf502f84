"""The command of `neusee run` that gives the numbers of an evaluation point, to the last bit.

The command has the camera of the evaluation, the mask and the restorer, the part of the photograph, the laser with its
direction, the seed of the scene, and the values that were drawn for the scene.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from neusee.workflows.evaluation.evaluation_points import EvaluationPoints, PointRequest, spots
from neusee.workflows.evaluation.evaluation_scenes import PHOTOGRAPH, Scene
from neusee.workflows.evaluation.pipelines import BEAM, NONE, WAVELENGTHS, PipelineRecipes, laser_line
from neusee.workflows.graph.diagnostics import RecipeError
from neusee.workflows.graph.recipe_graph import Recipe, dependents, needed
from neusee.workflows.recipe.distributions.scalar import written
from neusee.workflows.recipe.loading import load
from neusee.workflows.recipe.text.overrides import Override

_WAVELENGTH, _DIRECTION = f"lasers.{BEAM}.wavelength", f"direction[{BEAM}]"


@dataclass(frozen=True)
class PointCommands:
    """What the commands of all points of an evaluation have in common."""

    recipe: str
    changes: Sequence[str | Override]
    folder: Path  #: in which the commands are run
    bench: EvaluationPoints

    def commands(
        self, each: Sequence[PipelineRecipes], scenes: Sequence[Scene], strengths: Sequence[float]
    ) -> dict[str, list[dict[float, str]]]:
        """Return the command of each point by pipeline, scene and strength; empty where no command gives the point.

        One point of each pipeline is proved, and one beyond the scene 0, which has the seed of the evaluation: the
        command loads a recipe whose steps have the same keys.
        """
        proved: dict[tuple[str, bool], bool] = {}
        listed: dict[str, list[dict[float, str]]] = {}
        for pipeline in each:
            listed[pipeline.name] = []
            for scene in scenes:
                points = [PointRequest(scene, k) for k in (strengths if scene.case != NONE else (0.0,))]
                kind = (pipeline.name, scene.number == 0)
                if kind not in proved:
                    proved[kind] = self.is_same(pipeline, points[-1])
                own = {point.strength: self._command(pipeline, point) if proved[kind] else "" for point in points}
                listed[pipeline.name].append(own)
        return listed

    def _command(self, pipeline: PipelineRecipes, point: PointRequest) -> str:
        return shlex.join(["neusee", "run", self.recipe, *self.words(pipeline, point)])

    def words(self, pipeline: PipelineRecipes, point: PointRequest, strength: float | None = None) -> list[str]:
        """Return the arguments of `neusee run` after the recipe; ``strength`` replaces that of the laser."""
        scene, line = point.scene, pipeline.pipeline
        recipe = pipeline.recipe(point.lit)
        drawn = self._drawn(pipeline, point)
        wavelength = drawn.pop(_WAVELENGTH, None)
        words = [change if isinstance(change, str) else change.text for change in self.changes]
        words += [*pipeline.words, *_scene_words(recipe, scene), _laser_word(pipeline, point, wavelength, strength)]
        words += [f"{path}={value}" for path, value in drawn.items()]
        outputs = ", ".join(f'"{name}"' for name in (line.quality, "saturated[mask]", "peak[mask]"))
        return [*words, f"seed={scene.seed}", "estimates=false", f"outputs=[{outputs}]"]

    def _drawn(self, pipeline: PipelineRecipes, point: PointRequest) -> dict[str, str]:
        """Return the values that were drawn for a scene, as they are written in a recipe."""
        inputs = self.bench.inputs(pipeline, point.lit, pipeline.pipeline.outputs)
        if inputs is None:
            return {}
        laws, units = inputs.uncertain.laws, inputs.uncertain.units
        drawn = point.scene.draw(inputs)
        return {
            path: str(written(value, laws[path].unit if path in laws else units[path])) for path, value in drawn.items()
        }

    def is_same(self, pipeline: PipelineRecipes, point: PointRequest) -> bool:
        """Return True if the recipe of a command has the steps of an evaluation point, with equal keys.

        An evaluation computes a laser of strength 1 and gives each spot its strength, and so does this comparison.
        A random step that no scene reaches, such as dirt on the lens, has the seed of the evaluation, which the command
        gives only for the scene 0.
        """
        outputs = [name for name in pipeline.pipeline.outputs if name != "bsr[mask]"]
        try:
            recipe = load(self.recipe, self.words(pipeline, point, 1.0), self.folder)
        except RecipeError:
            return False
        scene = point.scene
        if scene.seed != scene.recipe.seed and _has_fixed_noise(recipe, outputs):
            return False
        if scene.path is not None and not _shows(recipe, scene):
            return False
        steps = dict(recipe.steps)
        for name in spots(recipe, outputs):
            steps[name] = replace(steps[name], params={**steps[name].params, "strength": point.strength})
        same_seed = replace(recipe, seed=scene.recipe.seed, steps=steps)
        return self.bench.keys(same_seed, outputs, scene) == self.bench.point_keys(pipeline, point, outputs)


def _has_fixed_noise(recipe: Recipe, outputs: Sequence[str]) -> bool:
    order = needed(recipe, outputs)
    moved = dependents(recipe, ["scene"], order) | {_DIRECTION}
    return any(recipe.steps[name].node.random for name in order if name not in moved)


def _shows(recipe: Recipe, scene: Scene) -> bool:
    """Return True if the scene of a recipe is the part of the photograph that an evaluation shows."""
    step = recipe.steps["scene"]
    if step.node.path != PHOTOGRAPH or scene.path is None:
        return False
    file, shape, crop = (step.params.get(name) for name in ("file", "shape", "crop"))
    same_file = Path(str(file)).absolute() == scene.path.absolute()
    return same_file and tuple(shape or ()) == scene.shape and tuple(crop or ()) == (scene.recipe.seed, scene.number)


def _scene_words(recipe: Recipe, scene: Scene) -> list[str]:
    """Return the words that show a part of a photograph, or nothing for the recipe's own scene."""
    if scene.path is None:
        return []
    file, crop = _quoted(scene.path), f"[{scene.recipe.seed}, {scene.number}]"
    step = recipe.steps["scene"]
    if step.node.path == PHOTOGRAPH and "scene.file" in recipe.config.settings:
        return [f"scene.file={file}", f"+steps.scene.with.crop={crop}"]
    shape = list(scene.shape)
    return [f"steps.scene={{node: {PHOTOGRAPH}, with: {{file: {file}, shape: {shape}, crop: {crop}}}}}"]


def _laser_word(pipeline: PipelineRecipes, point: PointRequest, wavelength: str | None, strength: float | None) -> str:
    """Return the word that sets the laser of a scene, with its direction and strength."""
    if point.lit == NONE:
        return "lasers={}"
    y, x = point.scene.angle(pipeline.recipe(point.lit))
    if wavelength is None:
        line = laser_line(WAVELENGTHS[point.lit], pipeline.fwhm)
    else:
        line = f"wavelength: '{wavelength}', fwhm: {pipeline.fwhm * 1e9:g} nm"
    shown = point.strength if strength is None else strength
    return f"lasers={{{BEAM}: {{{line}, strength: {shown!r}, angle: [{y!r} rad, {x!r} rad]}}}}"


def _quoted(path: Path) -> str:
    return "'" + str(path.absolute()).replace("'", "''") + "'"


def shown_commands(
    commands: Mapping[str, Sequence[Mapping[float, str]]],
) -> list[tuple[str, int, float, str]]:
    """Return pipeline, place of the scene, strength and command of one point of each pipeline: the strongest laser."""
    rows: list[tuple[str, int, float, str]] = []
    for pipeline, scenes in commands.items():
        lit = [(place, max(own)) for place, own in enumerate(scenes) if own]
        if lit:
            place, strength = max(lit, key=lambda point: (point[1], -point[0]))
            rows.append((pipeline, place, strength, scenes[place][strength]))
    return rows
