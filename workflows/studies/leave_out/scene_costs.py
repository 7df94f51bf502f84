"""What simpler scenes cost: the recipe without its laser, in one colour, behind a clean window, each from nothing.

Cost follows content where what is not in the scene is not computed. Each is run in a store of its own that is empty,
in one process; what a process does only once is done before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

from neusee.workflows.engine.provenance import machine, timestamp
from neusee.workflows.engine.runner import Result, run
from neusee.workflows.graph.diagnostics import RecipeError
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.keys.cache_key import Key, digest, key_of
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.recipe.changed_recipe import changed
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.cold_run import cold

_TIMES = 3  #: cold runs, of which the median counts
_QUICK = 5.0  #: s; what takes longer is run once
_WINDOW = ("flare.dirt", "flare.ghosts")
_UNREAD = "no step refers to it"
_LIFT = "steps.cube={node: spectra.lift_mallett, from: {rgb: scene, bands: bands}}"  #: of as few bands as one
_GREY = "steps.scene={node: scene.targets, with: {kind: siemens, shape: '${scene.shape}'}}"


@dataclass(frozen=True)
class Cost:
    """What one scene took."""

    scene: str
    seconds: float  #: median of the engine's cold runs; nan where it could not be run
    computing: float  #: s of it in the steps
    steps: int  #: that were computed
    left_out: tuple[str, ...]  #: steps that the engine left out, or replaced by cheaper ones
    refused: str = ""


def costs(recipe: Recipe, store: Store, tell: Callable[[str], None]) -> Iterator[Cost]:
    """The cost of each scene that ``recipe`` can be changed to; what was timed on this machine is not timed again."""
    code, warm = Code(store.code_memo), False
    for scene, made in scenes(recipe).items():
        if isinstance(made, str):
            yield Cost(scene, float("nan"), 0.0, 0, (), made)
            continue
        key = _key(made, code)
        if not store.has(key):
            if not warm:
                _cold(made, store)
                warm = True
            store.put(
                key, asdict(_cost(scene, made, store)), {"step": "study leave-out", "seconds": 0.0, "date": timestamp()}
            )
        found = store.get(key)
        cost = Cost(**{**found, "scene": scene, "left_out": tuple(found["left_out"])})
        tell(f"{scene}: {cost.seconds:.3g} s" if not cost.refused else f"{scene}: {cost.refused}")
        yield cost


def scenes(recipe: Recipe) -> dict[str, Recipe | str]:
    """Other scenes for the same camera, as far as the recipe has what they change, and why one cannot be."""
    found: dict[str, Recipe | str] = {
        "everything in full": replace(recipe, exact=True),
        "as the recipe chooses": recipe,
    }
    for scene, overrides in _overrides(recipe).items():
        try:
            found[scene] = _changed(recipe, overrides)
        except RecipeError as error:
            found[scene] = "; ".join(problem.message for problem in error.diagnostics)
    return found


def _changed(recipe: Recipe, overrides: Sequence[str]) -> Recipe:
    """``recipe`` with other values, and without those that no step refers to any more."""
    try:
        return changed(recipe, overrides)
    except RecipeError as error:
        unread = [f"~{problem.path}" for problem in error.diagnostics if _UNREAD in problem.message]
        if len(unread) < len(error.diagnostics):
            raise
        return changed(recipe, [*overrides, *unread])


def _overrides(recipe: Recipe) -> Mapping[str, Sequence[str]]:
    settings = recipe.config.settings
    lasers = [name for name in settings if name.startswith("lasers.")]
    window = sorted({name.partition("[")[0] for name in _behind_the_window(recipe)})
    every = {
        "no laser": ["lasers={}"] if lasers else [],
        "clean window": [f"steps.{name}=null" for name in window],
        "grey scene": [_GREY] if "scene" in recipe.steps and "scene.shape" in settings else [],
        "narrow band, 540 to 560 nm": _bands(recipe, "540 nm", "560 nm", 3),
        "one wavelength": [*_bands(recipe, "549 nm", "551 nm", 1), *([_LIFT] if "cube" in recipe.steps else [])],
    }
    least = [o for name in ("no laser", "clean window", "one wavelength") for o in every[name]]
    return {name: o for name, o in {**every, "one wavelength, no laser, clean window": least}.items() if o}


def _behind_the_window(recipe: Recipe) -> Iterator[str]:
    """What lies on the window, what it reflects, and what only makes photons of that."""
    window = {name for name, step in recipe.steps.items() if step.node.path in _WINDOW}
    for name, step in recipe.steps.items():
        needs = {w for i, w in step.wires.items() if isinstance(w, str) and i not in step.node.optional}
        if name in window or not needs.isdisjoint(window):
            window.add(name)
    return iter(window)


def _bands(recipe: Recipe, start: str, stop: str, count: int) -> list[str]:
    names = ("optics.start", "optics.stop", "optics.bands")
    if any(name not in recipe.config.settings for name in names):
        return []
    return [f"{name}={value}" for name, value in zip(names, (start, stop, count), strict=True)]


def _cost(scene: str, recipe: Recipe, store: Store) -> Cost:
    found: list[Result] = []
    try:
        while not found or (max(r.seconds for r in found) < _QUICK and len(found) < _TIMES):
            found.append(_cold(recipe, store))
    except RunError as error:
        return Cost(scene, float("nan"), 0.0, 0, (), f"{error.step}: {error.cause}")
    result = sorted(found, key=lambda r: r.seconds)[len(found) // 2]
    ran = [done.seconds for done in result.done.values() if done.state == "run"]
    left_out = [done.step for done in result.done.values() if done.state == "left out"]
    replaced = [economy.step for economy in result.recipe.substitutions]
    return Cost(scene, result.seconds, sum(ran), len(ran), (*left_out, *replaced))


def _cold(recipe: Recipe, store: Store) -> Result:
    with cold(store) as empty:
        return run(recipe, empty)


def _key(recipe: Recipe, code: Code) -> Key:
    """What decides a time: all that the outputs need, what may be left out, the engine and the machine."""
    keys: dict[str, Key] = {}
    for name in needed(recipe, recipe.outputs):
        keys[name], _ = key_of(recipe.steps[name], keys, recipe.seed, code)
    said = [[keys[name] for name in recipe.outputs], recipe.tolerance, recipe.exact]
    return digest("content", said, engine("studies.leave_out.scene_costs", "engine.runner"), machine())
