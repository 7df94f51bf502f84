"""Run times of simpler scenes: the recipe without a laser, at one wavelength, or behind a clean window."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from neusee.workflows.engine.provenance import machine
from neusee.workflows.engine.runner import Result
from neusee.workflows.graph.diagnostics import UNREAD, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.recipe.changed_recipe import changed
from neusee.workflows.store.memo import compute_once
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.cold_run import key_parts, run_cold

_TIMES = 3  #: cold runs of a scene; the median of their times counts
_QUICK = 5.0  #: s; a scene that takes longer is run once
_WINDOW = ("flare.dirt", "flare.ghosts")
_LIFT = "steps.cube={node: spectra.lift_mallett, from: {rgb: scene, bands: bands}}"  #: works even with one band
_GREY = "steps.scene={node: scene.targets, with: {kind: siemens, shape: '${scene.shape}'}}"


@dataclass(frozen=True)
class SceneCost:
    """The run time of a recipe with one scene, and the steps that the engine left out."""

    scene: str
    seconds: float  #: median of the engine's cold runs; NaN if the scene could not be run
    computing: float  #: s in the steps
    steps: int  #: number of computed steps
    left_out: tuple[str, ...]  #: steps that the engine left out, or replaced by cheaper steps
    refused: str = ""


def measure_scenes(recipe: Recipe, store: Store, progress: Callable[[str], None]) -> Iterator[SceneCost]:
    """Yield the run time of ``recipe`` with each simpler scene; measure the time if the store does not have it."""
    code, warm = Code(store.code_memo), list[Result]()
    for scene, changed_recipe in scenes(recipe).items():
        if isinstance(changed_recipe, str):
            yield SceneCost(scene, float("nan"), 0.0, 0, (), changed_recipe)
            continue

        def compute(scene: str = scene, recipe: Recipe = changed_recipe) -> SceneCost:
            if not warm:  # the first run of a process imports libraries and reads code
                warm.append(run_cold(recipe, store))
            return _cost(scene, recipe, store)

        decided = engine("studies.leave_out.scene_costs", "engine.runner"), machine()
        key = digest("content", key_parts(changed_recipe, code), *decided)
        cost = replace(compute_once(store, key, SceneCost, compute, {"step": "study leave-out"}), scene=scene)
        progress(f"{scene}: {cost.refused or f'{cost.seconds:.3g} s'}")
        yield cost


def scenes(recipe: Recipe) -> dict[str, Recipe | str]:
    """Return the recipe with each simpler scene by name, or the reason why the recipe cannot have the scene."""
    found: dict[str, Recipe | str] = {"everything in full": replace(recipe, exact=True)}
    found["as the recipe chooses"] = recipe
    for scene, overrides in _overrides(recipe).items():
        try:
            found[scene] = _changed(recipe, overrides)
        except RecipeError as error:
            found[scene] = "; ".join(problem.message for problem in error.diagnostics)
    return found


def _changed(recipe: Recipe, overrides: Sequence[str]) -> Recipe:
    """Apply overrides to ``recipe``, and remove the recipe values that no step reads any more."""
    try:
        return changed(recipe, overrides)
    except RecipeError as error:
        unread = [f"~{problem.path}" for problem in error.diagnostics if problem.code == UNREAD]
        if len(unread) < len(error.diagnostics):
            raise
        return changed(recipe, [*overrides, *unread])


def _overrides(recipe: Recipe) -> Mapping[str, Sequence[str]]:
    settings = recipe.config.settings
    lasers = [name for name in settings if name.startswith("lasers.")]
    window = sorted({name.partition("[")[0] for name in _window_steps(recipe)})
    every = {
        "no laser": ["lasers={}"] if lasers else [],
        "clean window": [f"steps.{name}=null" for name in window],
        "grey scene": [_GREY] if "scene" in recipe.steps and "scene.shape" in settings else [],
        "narrow band, 540 to 560 nm": _bands(recipe, "540 nm", "560 nm", 3),
        "one wavelength": [*_bands(recipe, "549 nm", "551 nm", 1), *([_LIFT] if "cube" in recipe.steps else [])],
    }
    least = [o for name in ("no laser", "clean window", "one wavelength") for o in every[name]]
    return {name: o for name, o in {**every, "one wavelength, no laser, clean window": least}.items() if o}


def _window_steps(recipe: Recipe) -> set[str]:
    """Return the names of the steps that compute window dirt or ghosts, and of steps that require these results."""
    window = {name for name, step in recipe.steps.items() if step.node.path in _WINDOW}
    for name, step in recipe.steps.items():
        needs = {w for i, w in step.wires.items() if isinstance(w, str) and i not in step.node.optional}
        if name in window or not needs.isdisjoint(window):
            window.add(name)
    return window


def _bands(recipe: Recipe, start: str, stop: str, count: int) -> list[str]:
    names = ("optics.shortest", "optics.longest", "optics.bands")
    if any(name not in recipe.config.settings for name in names):
        return []
    return [f"{name}={value}" for name, value in zip(names, (start, stop, count), strict=True)]


def _cost(scene: str, recipe: Recipe, store: Store) -> SceneCost:
    results: list[Result] = []
    try:
        while not results or (max(r.seconds for r in results) < _QUICK and len(results) < _TIMES):
            results.append(run_cold(recipe, store))
    except RunError as error:
        return SceneCost(scene, float("nan"), 0.0, 0, (), f"{error.step}: {error.cause}")
    result = sorted(results, key=lambda r: r.seconds)[len(results) // 2]
    ran = [done.seconds for done in result.done.values() if done.state == "run"]
    left_out = [done.step for done in result.done.values() if done.state == "left out"]
    replaced = [economy.step for economy in result.recipe.substitutions]
    return SceneCost(scene, result.seconds, sum(ran), len(ran), (*left_out, *replaced))
