"""The metrics of one scene, laser and pipeline, and the command that repeats them."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neusee.nodes.metrics import quality
from neusee.nodes.resampling import resize
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.node_call import call, place
from neusee.workflows.evaluation.evaluation_scenes import PHOTOGRAPH, Scene
from neusee.workflows.evaluation.pipelines import (
    BEAM,
    NONE,
    WAVELENGTHS,
    NamedRecipe,
    PipelineRecipes,
    laser_line,
)
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.graph.recipe_graph import (
    FRAME,
    TOLD,
    Recipe,
    Step,
    dependents,
    knowers,
    known,
    needed,
    with_copies,
)
from neusee.workflows.keys.cache_key import device_kind, digest, key_of
from neusee.workflows.keys.code_digest import Code, engine
from neusee.workflows.recipe.blocks.settings_block import Mismatch
from neusee.workflows.recipe.distributions.shapes import written
from neusee.workflows.recipe.loading import load
from neusee.workflows.recipe.uncertain_inputs import Inputs, NothingDrawn
from neusee.workflows.store.result_store import Store, compute_once
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

# --- mistold filter -------------------------------------------------------------------------------

# Recipes whose restorer gets optics and laser data with one error, while the camera stays as it is.
#
# The steps that compute the data of the restorer are copied with a changed parameter; the copies
# have the prefix ``told_``.


def errors_of(recipe: Recipe, mismatch: Mismatch) -> dict[str, Mapping[str, Any]]:
    """Return the possible errors in the data of the restorer, by description: each maps parameters
    to offsets.

    The offset None removes an input: ``dirt`` of a pupil. The result is empty if the restorer uses
    no optics or laser data.
    """
    told_steps = known(recipe, _readers(recipe))
    if not told_steps:
        return {}
    steps_of_knowledge = needed(recipe, told_steps)
    return _laser_errors(recipe, mismatch, steps_of_knowledge) | _pupil_errors(
        recipe, mismatch, steps_of_knowledge
    )


def _laser_errors(
    recipe: Recipe, mismatch: Mismatch, steps: Sequence[str]
) -> dict[str, Mapping[str, Any]]:
    """Return the errors in direction and wavelength of a laser whose direction ``steps`` read."""
    direction, line_step = f"direction[{BEAM}]", f"line[{BEAM}]"
    steps_with_direction = [name for name in steps if direction in recipe.steps[name].sources]
    if not steps_with_direction:
        return {}
    errors: dict[str, Mapping[str, Any]] = {}
    if mismatch.pixels:
        lens_params = recipe.steps[steps_with_direction[0]].params
        # convert pixels on the sensor to an angle
        angle = mismatch.pixels * lens_params["pixel_pitch"] / lens_params["focal_length"]
        errors[f"direction {mismatch.pixels:g} px off"] = {f"{direction}.angle": (angle, angle)}
    if mismatch.wavelength and "wavelength" in recipe.steps[line_step].params:
        error_text = f"wavelength {mismatch.wavelength * 1e9:g} nm off"
        errors[error_text] = {f"{line_step}.wavelength": mismatch.wavelength}
    return errors


def _pupil_errors(
    recipe: Recipe, mismatch: Mismatch, steps: Sequence[str]
) -> dict[str, Mapping[str, Any]]:
    """Return the errors in defocus and dirt of the pupils among ``steps``."""
    pupils = [name for name in steps if recipe.steps[name].node.path == "optics.pupil"]
    dirty = [name for name in pupils if recipe.steps[name].wires.get("dirt") is not None]
    errors: dict[str, Mapping[str, Any]] = {}
    if mismatch.defocus and pupils:
        error_text = f"defocus {mismatch.defocus:g} waves off"
        errors[error_text] = _of_each(pupils, "defocus", mismatch.defocus)
    if mismatch.dirt and dirty:
        errors["dirt not told"] = _of_each(dirty, "dirt", None)
    return errors


def _of_each(steps: Sequence[str], parameter: str, value: Any) -> dict[str, Any]:
    """Return a mapping with the same value for a parameter of each step."""
    return {f"{step}.{parameter}": value for step in steps}


def mistold(recipe: Recipe, error: Mapping[str, Any]) -> Recipe:
    """Return the recipe with an erroneous copy of each step affected by ``error``, which only the
    restorer reads.
    """
    errors_of_steps = {
        name: value for name, value in error.items() if name.rpartition(".")[0] in recipe.steps
    }
    changed = {name.rpartition(".")[0] for name in errors_of_steps}
    readers = _readers(recipe)
    copied = {
        name
        for name in dependents(recipe, changed) & set(needed(recipe, known(recipe, readers)))
        if not recipe.steps[name].node.random or name in changed  # another name would draw anew
    }
    return with_copies(recipe, readers, copied, lambda step: _changed(step, errors_of_steps))


def shifted(value: Any, by: Any) -> Any:
    """Return a parameter plus an error: a number, or the two angles of a direction."""
    return (
        tuple(component + added for component, added in zip(value, by, strict=True))
        if isinstance(by, tuple)
        else value + by
    )


def _readers(recipe: Recipe) -> list[str]:
    """Return the steps that restore the picture behind the mask and use optics or laser data."""
    return knowers(recipe, dependents(recipe, [FRAME])) if FRAME in recipe.steps else []


def _changed(step: Step, error: Mapping[str, Any]) -> Step:
    """Return a step with the errors, by ``step.parameter``, added to its parameters; the error None
    removes the input of this name.
    """
    params, wires = dict(step.params), dict(step.wires)
    for parameter_path, added_error in error.items():
        name, _, param = parameter_path.rpartition(".")
        if name != step.name:
            continue
        if added_error is None:
            wires[param] = None
        elif params[param] is not None:  # a direction is drawn for each scene
            params[param] = shifted(params[param], added_error)
    return replace(step, params=params, wires=wires)


# --- evaluation points ----------------------------------------------------------------------------

# Evaluation points: the metrics of one scene at one laser strength with one pipeline (mask and
# restorer).


_MOVED = ("spot", "photons")  #: names of the first steps that depend on the laser strength

PointNumbers = dict[str, Any]  #: numbers by name; ``bsr`` is a list


@dataclass(frozen=True)
class PointRequest:
    """The scene and the laser strength of an evaluation point."""

    scene: Scene
    strength: float

    @property
    def lit(self) -> str:
        """Return the name of the laser in the scene; ``none`` if the strength is 0."""
        return self.scene.case if self.strength > 0 else NONE


class EvaluationPoints:
    """Computes evaluation points; results that several points use are computed once."""

    def __init__(self, store: Store, small: int, device: str = "cpu") -> None:
        """Prepare points whose reduced pictures have ``small`` pixels on their shorter side."""
        self.store, self.small, self.device = store, small, device
        self.computed = 0  #: number of evaluation points that were not in the store
        self.seconds = 0.0  #: s, computing time of these points
        self._code = Code(store.code_memo)
        #: by name, laser, and `id` of the recipe
        self._functions: dict[tuple[str, str, int], Any] = {}
        #: by `id` of a recipe; the recipe is kept too, so that its `id` is not reused
        self._drawn: dict[Any, tuple[Recipe, Inputs | None]] = {}
        #: results that do not depend on a scene, by key: one copy for all functions
        self._fixed: dict[str, Any] = {}
        self._kept = _SharedResults()

    def point(self, pipeline: PipelineRecipes, point: PointRequest) -> PointNumbers:
        """Return the metrics of an evaluation point, from the store or computed now."""
        compute = partial(self._measure, pipeline, point)
        return compute_once(
            self.store, self.key(pipeline, point), dict, compute, {"step": "evaluate"}
        )

    def _measure(self, pipeline: PipelineRecipes, point: PointRequest) -> PointNumbers:
        """Compute the metrics of a point, and add to the count and the computing time."""
        began = time.perf_counter()
        numbers = self._numbers(pipeline, self.values(pipeline, point))
        self.seconds += time.perf_counter() - began
        self.computed += 1
        return numbers

    def values(
        self, pipeline: PipelineRecipes, point: PointRequest, further: Sequence[str] = ()
    ) -> dict[str, Any]:
        """Run a pipeline for one scene and laser; return the outputs and the results of the
        ``further`` steps.
        """
        outputs = (*pipeline.pipeline.outputs, *further)
        function = self._function(pipeline, point.lit, outputs)
        self._kept.turn(point)
        with torch.no_grad():
            parameter_values = self._changed(pipeline, point, outputs)
            # parameters that the function takes as arguments
            free_values = {
                name: value for name, value in parameter_values.items() if name in function.free
            }
            values: dict[str, Any] = function({"scene": point.scene.picture, **free_values})
        return values

    def forget(self) -> None:
        """Free all results that depend on the laser."""
        # the second part of the name is the laser
        self._functions = {name: f for name, f in self._functions.items() if name[1] == NONE}
        in_use = set[int]()
        for function in self._functions.values():
            in_use |= set(map(id, function.fixed.values()))
        self._fixed = {key: value for key, value in self._fixed.items() if id(value) in in_use}
        self._kept.clear()

    def release(self) -> None:
        """Free all results, before pipelines with other recipes are evaluated."""
        self._functions.clear()
        self._drawn.clear()
        self._fixed.clear()
        self._kept.clear()

    def key(self, pipeline: PipelineRecipes, point: PointRequest) -> str:
        """Return the cache key of an evaluation point, from the keys of its steps and the settings
        of the comparison.
        """
        recipe, outputs = pipeline.recipe(point.lit), pipeline.pipeline.outputs
        keys = self.point_keys(pipeline, point, outputs)
        tolerances_and_settings = [
            recipe.tolerance,
            recipe.exact,
            recipe.estimates,
            device_kind(self.device),
            self.small,
        ]
        code_of_metrics = [self._code.digest(function.__module__) for function in (quality, resize)]
        return digest(
            "evaluate",
            engine("evaluation.evaluation_points"),
            [keys[name] for name in outputs],
            tolerances_and_settings,
            code_of_metrics,
        )

    def point_keys(
        self, pipeline: PipelineRecipes, point: PointRequest, outputs: Sequence[str]
    ) -> dict[str, str]:
        """Return the cache keys of the steps of an evaluation point."""
        recipe = pipeline.recipe(point.lit)
        params: dict[str, dict[str, Any]] = {}
        for name, value in self._changed(pipeline, point, outputs).items():
            step, _, param = name.rpartition(".")
            params.setdefault(step, {})[param] = value
        steps = {
            name: replace(recipe.steps[name], params={**recipe.steps[name].params, **changed})
            for name, changed in params.items()
        }
        return self.keys(replace(recipe, steps={**recipe.steps, **steps}), outputs, point.scene)

    def keys(
        self, recipe: Recipe, outputs: Iterable[str], scene: Scene | None = None
    ) -> dict[str, str]:
        """Return the cache key of each step; steps that depend on the scene use the seed of the
        scene.
        """
        keys = {"scene": scene.key(self._code)} if scene else {}
        depends_on_scene = dependents(recipe, keys)
        for name in needed(recipe, outputs):
            if name not in keys:
                step = recipe.steps[name]
                seed = scene.seed if scene and name in depends_on_scene else recipe.seed
                keys[name], _ = key_of(step, keys, seed, self._code, place(step, self.device))
        return keys

    def _function(self, pipeline: PipelineRecipes, case: str, outputs: tuple[str, ...]) -> Any:
        """Return the recipe as a function of the inputs that differ between points, built once.

        These inputs are the scene, the uncertain inputs that the outputs need and, with a laser
        (``case``), its direction and strength; also their copies for the restorer.
        """
        name = (f"{pipeline.name} {outputs}", case, id(pipeline.recipe))
        if name not in self._functions:
            recipe = replace(pipeline.recipe(case), estimates=False)  # one PSF for all scenes
            full_recipe = with_substitutions(
                recipe, outputs
            )  # as in `run`, but the scene is an argument
            steps = set(needed(full_recipe, outputs))
            inputs = self.inputs(pipeline, case, outputs)
            free = [
                "scene",
                *(
                    reader
                    for reader in (inputs.readers if inputs else ())
                    if reader.rpartition(".")[0] in steps
                ),
            ]
            if case != NONE:
                free += [
                    f"direction[{BEAM}].angle",
                    *(f"{spot}.strength" for spot in spots(recipe, outputs)),
                ]
            free += [TOLD + name for name in free if TOLD + name.rpartition(".")[0] in steps]
            # results that do not depend on the laser strength are shared within a scene
            shared_caller = self._kept.caller(
                dependents(full_recipe, list(filter(_is_moved, full_recipe.steps)))
            )
            options: dict[str, Any] = {
                "store": self.store,
                "device": self.device,
                "caller": shared_caller,
            }
            self._functions[name] = as_function(full_recipe, *free, outputs=outputs, **options)
            self._share(self._functions[name], full_recipe)
        return self._functions[name]

    def _changed(
        self, pipeline: PipelineRecipes, point: PointRequest, outputs: Sequence[str]
    ) -> dict[str, Any]:
        """Return the parameters set by an evaluation point: drawn values, laser direction and laser
        strength.

        A step's copy for the restorer gets the same values plus the error of the pipeline.
        """
        recipe = pipeline.recipe(point.lit)
        inputs = self.inputs(pipeline, point.lit, outputs)
        changed = inputs.theta(point.scene.draw(inputs)) if inputs else {}
        if point.lit != NONE:
            changed[f"direction[{BEAM}].angle"] = point.scene.angle(recipe)
            changed |= {f"{spot}.strength": point.strength for spot in spots(recipe, outputs)}
        copies = {
            name: value
            for name, value in changed.items()
            if TOLD + name.rpartition(".")[0] in recipe.steps
        }
        added_errors = {name: value for name, value in pipeline.error.items() if value is not None}
        told_values = {
            TOLD + name: shifted(x, added_errors[name]) if name in added_errors else x
            for name, x in copies.items()
        }
        return changed | told_values

    def inputs(self, pipeline: PipelineRecipes, case: str, outputs: Sequence[str]) -> Inputs | None:
        """Return the uncertain inputs of a pipeline, or None if no output depends on one.

        For a pipeline with an error, the inputs are those of the recipe without the error.
        """
        recipe = (pipeline.true or pipeline.recipe)(case)
        if recipe.uncertain is None or not recipe.uncertain.names:
            return None
        key = (id(recipe), tuple(outputs))
        if key not in self._drawn:
            self._drawn[key] = (recipe, None)
            with suppress(NothingDrawn):  # no output depends on an uncertain input
                self._drawn[key] = (recipe, Inputs.of(recipe, outputs))
        return self._drawn[key][1]

    def _share(self, function: Any, recipe: Recipe) -> None:
        """Replace constant results of a recipe function by equal results of an earlier function, to
        save memory.
        """
        keys = self.keys(recipe, function.fixed)
        for name, value in function.fixed.items():
            function.fixed[name] = self._fixed.setdefault(keys[name], value)

    def _numbers(self, pipeline: PipelineRecipes, values: Mapping[str, Any]) -> PointNumbers:
        """Return the metrics of a point from its outputs: at full size, and of the reduced picture
        if it is smaller.
        """
        pipeline_names, truth = pipeline.pipeline, values["truth"]
        small_quality = full_quality = values[pipeline_names.quality]
        if min(truth.shape[-2:]) > self.small:
            domain = pipeline.recipe(NONE).steps[pipeline_names.quality].params["domain"]
            small_quality = quality(
                reduced(values[pipeline_names.picture], self.small),
                reduced(truth, self.small),
                domain=domain,
            )
        peak, saturated = values["peak[mask]"], values["saturated[mask]"]
        return {
            **{name: float(value) for name, value in full_quality._asdict().items()},
            **{f"{name} small": float(value) for name, value in small_quality._asdict().items()},
            "saturated": float(saturated.pixels),
            "peak": float(peak.irradiance),
            "above": float(peak.above),
            "bsr": values["bsr[mask]"].tolist(),
        }


class _SharedResults:
    """A cache of results that successive evaluation points share, by scene and by laser
    strength.
    """

    def __init__(self) -> None:
        self._of_scene: dict[Any, tuple[Any, Any]] = {}
        self._of_strength: dict[Any, tuple[Any, Any]] = {}
        self._scene: tuple[Any, ...] = ()
        self._strength = -1.0
        self._seed = 0

    def clear(self) -> None:
        """Remove all cached results from memory."""
        self._of_scene.clear()
        self._of_strength.clear()

    def turn(self, point: PointRequest) -> None:
        """Start an evaluation point: free the cached results of other scenes, lasers and laser
        strengths.
        """
        scene = (point.scene.number, point.scene.seed, point.scene.case)
        if scene != self._scene:
            self._of_scene.clear()
        if (*scene, point.strength) != (*self._scene, self._strength):
            self._of_strength.clear()
        self._scene, self._strength, self._seed = scene, point.strength, point.scene.seed

    def caller(self, moved: set[str]) -> Callable[..., Any]:
        """Return a function that computes a step, or returns the cached result for identical input
        objects.

        ``moved`` names the steps that depend on the laser strength.
        """

        def compute(
            step: Step, inputs: Sequence[Any], params: Mapping[str, Any], seed: int, device: str
        ) -> Any:
            results = self._of_strength if step.name in moved else self._of_scene
            # the result of a random step depends on the seed of the scene
            random_key = (step.name, self._seed) if step.node.random else ()
            # equal inputs are identical objects, because each is computed once
            identities = [
                tuple(map(id, argument)) if type(argument) is list else id(argument)
                for argument in inputs
            ]
            key = (random_key, step.node.path, repr(sorted(params.items())), device, *identities)
            # keep the inputs too, so that their `id` is not reused
            if key not in results:
                results[key] = (inputs, call(step, inputs, params, self._seed, device))
            return results[key][1]

        return compute


def _is_moved(step: str) -> bool:
    """Return True if a step is one of the first that depend on the laser strength, or a copy of
    one.
    """
    return step.partition("[")[0].removeprefix(TOLD) in _MOVED


def spots(recipe: Recipe, outputs: Sequence[str]) -> list[str]:
    """Return the steps with the strength of a laser as a parameter."""
    return [name for name in needed(recipe, outputs) if name.startswith("spot[")]


def reduced(picture: Tensor, side: int) -> Tensor:
    """Clip a picture to [0, 1], and resize it with antialiasing to ``side`` pixels on its shorter
    side.
    """
    height, width = picture.shape[-2:]
    scale = side / min(height, width)
    return resize(picture.clamp(0, 1), round(height * scale), round(width * scale))


# --- point commands -------------------------------------------------------------------------------

# The `neusee run` command that reproduces the numbers of an evaluation point to the last bit.
#
# The command contains the camera, the mask and the restorer, the crop of the photograph, the laser
# with its direction, the seed of the scene, and the values drawn for the scene.


_WAVELENGTH, _DIRECTION = f"lasers.{BEAM}.wavelength", f"direction[{BEAM}]"


@dataclass(frozen=True)
class PointCommands:
    """What the commands of all points of an evaluation have in common."""

    named: NamedRecipe  #: the recipe; commands are run in its folder
    bench: EvaluationPoints

    def commands(
        self,
        pipelines: Sequence[PipelineRecipes],
        scenes: Sequence[Scene],
        strengths: Sequence[float],
    ) -> dict[str, list[dict[float, str]]]:
        """Return the command of each point by pipeline, scene and strength; empty if no command
        reproduces the point.

        For each pipeline one point of scene 0, which has the seed of the evaluation, and one of
        another scene are checked: the command must load a recipe whose steps have the same keys.
        """
        has_same_keys: dict[tuple[str, bool], bool] = {}
        commands_by_pipeline: dict[str, list[dict[float, str]]] = {}
        for pipeline in pipelines:
            commands_by_pipeline[pipeline.name] = []
            for scene in scenes:
                points = [
                    PointRequest(scene, strength)
                    for strength in (strengths if scene.case != NONE else (0.0,))
                ]
                kind_of_scene = (pipeline.name, scene.number == 0)
                if kind_of_scene not in has_same_keys:
                    has_same_keys[kind_of_scene] = self.is_same(pipeline, points[-1])
                commands_by_strength = {
                    point.strength: self._command(pipeline, point)
                    if has_same_keys[kind_of_scene]
                    else ""
                    for point in points
                }
                commands_by_pipeline[pipeline.name].append(commands_by_strength)
        return commands_by_pipeline

    def _command(self, pipeline: PipelineRecipes, point: PointRequest) -> str:
        """Return the command of a point."""
        return shlex.join(["neusee", "run", self.named.name, *self.words(pipeline, point)])

    def words(
        self, pipeline: PipelineRecipes, point: PointRequest, strength: float | None = None
    ) -> list[str]:
        """Return the arguments of `neusee run` after the recipe name; ``strength`` replaces that of
        the laser.
        """
        scene, pipeline_names = point.scene, pipeline.pipeline
        recipe = pipeline.recipe(point.lit)
        drawn_values = self._drawn(pipeline, point)
        wavelength = drawn_values.pop(_WAVELENGTH, None)
        arguments = [
            change if isinstance(change, str) else change.text for change in self.named.changes
        ]
        arguments += [
            *pipeline.words,
            *_scene_words(recipe, scene),
            _laser_word(pipeline, point, wavelength, strength),
        ]
        arguments += [f"{path}={value}" for path, value in drawn_values.items()]
        outputs = ", ".join(
            f'"{name}"' for name in (pipeline_names.quality, "saturated[mask]", "peak[mask]")
        )
        return [*arguments, f"seed={scene.seed}", "estimates=false", f"outputs=[{outputs}]"]

    def _drawn(self, pipeline: PipelineRecipes, point: PointRequest) -> dict[str, str]:
        """Return the values drawn for a scene, as recipe texts."""
        inputs = self.bench.inputs(pipeline, point.lit, pipeline.pipeline.outputs)
        if inputs is None:
            return {}
        laws, units = inputs.uncertain.laws, inputs.uncertain.units
        drawn_values = point.scene.draw(inputs)
        return {
            path: str(written(value, laws[path].unit if path in laws else units[path]))
            for path, value in drawn_values.items()
        }

    def is_same(self, pipeline: PipelineRecipes, point: PointRequest) -> bool:
        """Return True if the recipe of the command has steps with the same keys as the evaluation
        point.

        An evaluation computes a laser of strength 1 and then sets the strength of each spot; this
        comparison does the same. A random step that does not depend on the scene, such as dirt on
        the lens, has the seed of the evaluation, which the command has only for scene 0.
        """
        # the command does not output bsr[mask]
        outputs = [name for name in pipeline.pipeline.outputs if name != "bsr[mask]"]
        try:
            recipe = load(self.named.name, self.words(pipeline, point, 1.0), self.named.folder)
        except RecipeError:
            return False
        scene = point.scene
        if scene.seed != scene.recipe.seed and _has_fixed_noise(recipe, outputs):
            return False
        if scene.path is not None and not _shows(recipe, scene):
            return False
        steps = dict(recipe.steps)
        for name in spots(recipe, outputs):
            steps[name] = replace(
                steps[name], params={**steps[name].params, "strength": point.strength}
            )
        # `keys` applies the seed of the scene to the steps that depend on it
        same_seed = replace(recipe, seed=scene.recipe.seed, steps=steps)
        return self.bench.keys(same_seed, outputs, scene) == self.bench.point_keys(
            pipeline, point, outputs
        )


def _has_fixed_noise(recipe: Recipe, outputs: Sequence[str]) -> bool:
    """Return True if an output depends on a random step that depends on neither scene nor laser."""
    order = needed(recipe, outputs)
    varying = dependents(recipe, ["scene"], order) | {_DIRECTION}
    return any(recipe.steps[name].node.random for name in order if name not in varying)


def _shows(recipe: Recipe, scene: Scene) -> bool:
    """Return True if the scene of a recipe is the crop of the photograph in ``scene``."""
    step = recipe.steps["scene"]
    if step.node.path != PHOTOGRAPH or scene.path is None:
        return False
    file, shape, crop = (step.params.get(name) for name in ("file", "shape", "crop"))
    same_file = Path(str(file)).absolute() == scene.path.absolute()
    return (
        same_file
        and tuple(shape or ()) == scene.shape
        and tuple(crop or ()) == (scene.recipe.seed, scene.number)
    )


def _scene_words(recipe: Recipe, scene: Scene) -> list[str]:
    """Return the recipe arguments for a crop of a photograph; empty for the recipe's own scene."""
    if scene.path is None:
        return []
    file, crop = _quoted(scene.path), f"[{scene.recipe.seed}, {scene.number}]"
    step = recipe.steps["scene"]
    if step.node.path == PHOTOGRAPH and "scene.file" in recipe.config.settings:
        return [f"scene.file={file}", f"+steps.scene.with.crop={crop}"]
    shape = list(scene.shape)
    return [
        f"steps.scene={{node: {PHOTOGRAPH}, with: {{file: {file}, shape: {shape}, crop: {crop}}}}}"
    ]


def _laser_word(
    pipeline: PipelineRecipes, point: PointRequest, wavelength: str | None, strength: float | None
) -> str:
    """Return the recipe argument for the laser of a scene, with direction and strength."""
    if point.lit == NONE:
        return "lasers={}"
    # direction cosines, written as angles in rad
    y, x = point.scene.angle(pipeline.recipe(point.lit))
    if wavelength is None:
        line = laser_line(WAVELENGTHS[point.lit], pipeline.fwhm)
    else:
        line = f"wavelength: '{wavelength}', fwhm: {pipeline.fwhm * 1e9:g} nm"
    shown = point.strength if strength is None else strength
    return f"lasers={{{BEAM}: {{{line}, strength: {shown!r}, angle: [{y!r} rad, {x!r} rad]}}}}"


def _quoted(path: Path) -> str:
    """Return a path as a YAML text in single quotes; quotes within are doubled."""
    return "'" + str(path.absolute()).replace("'", "''") + "'"


def shown_commands(
    commands: Mapping[str, Sequence[Mapping[float, str]]],
) -> list[tuple[str, int, float, str]]:
    """Return pipeline, scene index, strength and command of one point of each pipeline, with the
    strongest laser.
    """
    rows: list[tuple[str, int, float, str]] = []
    for pipeline, scenes in commands.items():
        places_and_strengths = [
            (scene_index, max(commands_of_scene))
            for scene_index, commands_of_scene in enumerate(scenes)
            if commands_of_scene
        ]
        if places_and_strengths:
            # the strongest laser, and the first scene with it
            scene_index, strength = max(
                places_and_strengths, key=lambda point: (point[1], -point[0])
            )
            rows.append((pipeline, scene_index, strength, scenes[scene_index][strength]))
    return rows
