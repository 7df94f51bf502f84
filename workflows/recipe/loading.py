"""Loading of a recipe from its name or file and arguments; all mistakes are reported together."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

from neusee.workflows.graph.errors import Diagnostic, Location, RecipeError
from neusee.workflows.graph.final_values import Config, Setting, changes
from neusee.workflows.graph.recipe_graph import Recipe, Step, Wire
from neusee.workflows.keys.sealed_files import head_of
from neusee.workflows.recipe import lazy_imports as lazy
from neusee.workflows.recipe.asked_nodes import THEMSELVES, AskedNodes
from neusee.workflows.recipe.distributions.law_text import read_mismatch
from neusee.workflows.recipe.distributions.nominal_values import Uncertain, settle
from neusee.workflows.recipe.global_settings import (
    estimates_of,
    expectations,
    exports_of,
    outputs_of,
    seed_and_tolerance,
    unaffected_expectations,
)
from neusee.workflows.recipe.node_families import (
    KEY,
    NO_FAMILY,
    Own,
    OwnFamilies,
    class_context,
    read_own_families,
)
from neusee.workflows.recipe.step_checks import (
    Attempt,
    CachedGraph,
    CheckedStep,
    Checker,
    GraphMemory,
    cache_graph,
    cached_graph,
    check_steps,
    refuse_indices,
)
from neusee.workflows.recipe.steps import Declared, Wiring, cached_of, cycles, declare, device_of
from neusee.workflows.recipe.text.composition import Composed, compose
from neusee.workflows.recipe.text.overrides import (
    Override,
    arguments_in,
    overrides_of,
    read_override,
)
from neusee.workflows.recipe.text.recipe_files import groups_of, shared_folders
from neusee.workflows.recipe.text.references import References
from neusee.workflows.recipe.text.yaml_values import Value, Where, title_of

if TYPE_CHECKING:
    from types import ModuleType

    from neusee.nodes.calibrate import Traceability
    from neusee.workflows.recipe.blocks.safety_block import Safety
    from neusee.workflows.recipe.blocks.settings_block import EvaluateSettings
    from neusee.workflows.recipe.blocks.train_block import LiftTraining, Training


# --- other cameras --------------------------------------------------------------------------------

# The other cameras of a training: the same recipe, each time with other overrides.


_TRAIN, _CAMERAS = "train", "train.cameras"


def with_cameras(
    recipe: Recipe, composed: Composed, made: Callable[[Sequence[Override]], Recipe]
) -> Recipe:
    """Return a recipe with one further recipe for each camera in `train.cameras`, which ``made``
    loads with the overrides of the camera.

    The final values describe each camera by the values that differ, so that their text needs no
    options of groups. Raises `RecipeError` with the location of an override, also for an override
    that changes the training.
    """
    block = composed.root.items[_TRAIN].items["cameras"]
    cameras = tuple(
        made([_override("train.cameras=[]", block), *_overrides(camera)])
        for camera in block.items.values()
    )
    settings = dict(recipe.config.settings)
    differing_values = [changes(recipe.config, camera.config, _TRAIN) for camera in cameras]
    settings[_CAMERAS] = replace(settings[_CAMERAS], value=differing_values)
    return replace(recipe, cameras=cameras, config=Config(settings))


def _overrides(camera: Value) -> list[Override]:
    """Return the overrides of one camera; raise `RecipeError` for one that changes the training."""
    overrides = [_override(str(value.plain), value) for value in camera.items.values()]
    if of_training := [override for override in overrides if override.path[0] == _TRAIN]:
        raise RecipeError(
            Diagnostic(
                override.mark, camera.name, f"{override.text} does not set a parameter of a camera"
            )
            for override in of_training
        )
    return overrides


def _override(text: str, value: Value) -> Override:
    return read_override(text, Location(str(value.mark), folder=value.mark.folder))


# --- recipe settings ------------------------------------------------------------------------------

# Final values of a checked recipe: those that it writes, and the default values of the nodes of its
# steps.


def final_values(
    wiring: Wiring,
    bound: dict[str, Step],
    checker: Checker,
    uncertain: Uncertain | None,
    memory: GraphMemory | None,
) -> dict[str, Setting]:
    """Return the final values of a recipe by path: the written values and the default values of
    the steps' nodes.
    """
    settings: dict[str, Setting] = {}
    spare = wiring.references.spare
    for key, block in wiring.root.items.items():
        # values of packaged options that no step uses are left out
        if key != "steps":
            block_settings = _block_settings(block, checker, memory)
            settings |= {
                name: value for name, value in block_settings.items() if value.path not in spare
            }
            continue
        for name, step in block.items.items():
            settings |= _block_settings(step, checker, memory)
            if str(name) in wiring.steps:
                settings |= _defaults(wiring.steps[str(name)], bound)
    # a distribution stands as it was written, not as the number of this run
    for name, law in uncertain.laws.items() if uncertain else ():
        if name in settings:
            settings[name] = replace(settings[name], value=law.full_text)
    return settings


def _block_settings(
    block: Value, checker: Checker, memory: GraphMemory | None
) -> dict[str, Setting]:
    """Return the final values of a block by path, those of an earlier check if the block is the
    same object.
    """
    earlier = memory.settings.get(block.path) if memory else None
    is_same = earlier is not None and earlier[0] is block
    settings = earlier[1] if earlier and is_same else dict(settings_of([block], checker))
    # paths of files may differ
    if any(setting.path in checker.files for setting in settings.values()):
        return dict(settings_of([block], checker))
    if memory and not is_same:
        memory.settings[block.path] = block, settings
    return settings


def settings_of(blocks: Iterable[Value], checker: Checker) -> Iterator[tuple[str, Setting]]:
    """Yield the values that blocks of a recipe write, each with its path."""
    for leaf in chain.from_iterable(block.leaves() for block in blocks):
        value: Any = checker.files.get(leaf.path, leaf.plain)
        sources = dict.fromkeys(map(str, (leaf.mark, *arguments_in(leaf))))
        yield leaf.name, Setting(value, ", ".join(sources), leaf.path)


def _defaults(step: Declared, bound: dict[str, Step]) -> Iterator[tuple[str, Setting]]:
    """Yield the parameters of a step that the recipe does not set, with the default values in
    SI.
    """
    first_copy = bound.get(step.instances[0]) if step.instances else None
    for name, value in (first_copy.params if first_copy else {}).items():
        if first_copy and name not in first_copy.param_marks:
            path = (*step.value.path, "with", name)
            yield (
                ".".join(map(str, path)),
                Setting(value, f"default of {first_copy.node.path}", path, True),
            )


# --- loading --------------------------------------------------------------------------------------

# Loading of a recipe from its name or file and from arguments, with a check that reports all
# mistakes at once.


TRACED = "traceability"  #: key of the block in which a laboratory states its light and temperature
BLOCKS = ("train", "train_lift", "evaluate", TRACED)  #: keys of the blocks of settings in a recipe
SAFETY = "safety"  #: key of the block that an estimate of damage and dazzle reads


@dataclass(frozen=True, slots=True)
class Titled:
    """Name of a packaged recipe or of an option of a group, with the title from the first line
    of its file.
    """

    name: str
    title: str


def load(
    name_or_path: str | os.PathLike[str],
    /,
    overrides: Sequence[str | Override] = (),
    folder: str | os.PathLike[str] | None = None,
    first: int = 1,
    **values: Any,
) -> Recipe:
    """Return a packaged recipe, or the recipe in a file whose name ends in ``.yaml``, after a check
    of all its values.

        load("first_light", ["sensor.read_noise=20 e-"])
        load("first_light", doe="axicon", sensor={"read_noise": "20 e-"})
        load("first_light", lasers={"green": {"strength": 1e4}})
        load("first_light", **{"sensor.read_noise": "20 e-"})
        load("first_light", **{"+lasers.red": {"wavelength": "638 nm", …}})

    ``values`` are overrides as Python values, which are applied after ``overrides``; a mapping
    changes only the values that it names. Paths are relative to ``folder`` (default: the working
    folder). Messages number ``overrides`` from ``first``. A note names the expected numbers that
    overrides affect, because these are not compared. Raises `RecipeError` with all mistakes.
    """
    name, base_folder = os.fspath(name_or_path), Path(folder or ".").absolute()
    changes: tuple[str | Override, ...] = (*overrides, *overrides_of(values, base_folder))
    return load_with(THEMSELVES, name, changes, base_folder, first)


def load_with(
    asked: AskedNodes,
    name: str,
    changes: Sequence[str | Override],
    folder: Path,
    first: int = 1,
) -> Recipe:
    """Return a recipe as `load` does, where ``asked`` answers in place of the nodes."""
    composed = compose(name, changes, folder, first)
    recipe = check(composed, asked)
    if recipe.training and recipe.training.cameras:
        recipe = with_cameras(
            recipe,
            composed,
            lambda words: check(compose(name, [*changes, *words], folder, first), asked),
        )
    # expected numbers of an extended recipe hold only if the changes do not affect them
    for extended in composed.extended if recipe.expect else ():
        recipe = _without_changed_numbers(recipe, extended, folder, asked)
    if recipe.expect and changes:
        recipe = unaffected_expectations(recipe, _as_written(name, folder, asked))
    if recipe.expect and (problems := list(refuse_indices(recipe, asked))):
        raise RecipeError(problems)
    return recipe


def _without_changed_numbers(
    recipe: Recipe, extended: Path, folder: Path, asked: AskedNodes
) -> Recipe:
    """Return a recipe without the expected numbers of an extended recipe that its changes affect.

    A file that is not a valid recipe by itself has no expected numbers.
    """
    extended_recipe = _as_written(str(extended), folder, asked)
    return recipe if extended_recipe is None else unaffected_expectations(recipe, extended_recipe)


def _as_written(name: str, folder: Path, asked: AskedNodes) -> Recipe | None:
    """Return a recipe without the user's overrides, or None if the recipe is not valid without the
    overrides.

    The result is cached while the files and nodes of the recipe are unchanged.
    """
    composed = compose(name, (), folder)
    graph = None
    if asked.reuses_checks:
        graph = cached_graph(composed.root, read_own_families(composed.root, []).modules)
    try:
        return check(composed, asked) if graph is None else _checked(composed, graph)
    except RecipeError:
        return None


@functools.lru_cache(maxsize=16)
def _checked(composed: Composed, graph: CachedGraph) -> Recipe:
    """Return a composed recipe after a check of its values; the result is cached by recipe and
    step graph.
    """
    return check(composed)


def _settings_blocks(
    composed: Composed, blocks: Sequence[Value], modules: Mapping[str, ModuleType]
) -> tuple[
    Composed, Training | None, LiftTraining | None, EvaluateSettings | None, Traceability | None
]:
    """Return a recipe without its blocks of settings, and these blocks; their models are imported
    only for a recipe with such a block.
    """
    if not blocks:
        return composed, None, None, None, None
    composed, training = lazy.train_block.read_training(composed, class_context(modules))
    composed, lifting = lazy.train_block.read_lift_training(composed)
    composed, evaluation = lazy.settings_block.read_evaluate(composed)
    if TRACED not in composed.root.items:
        return composed, training, lifting, evaluation, None
    composed, traceability = lazy.settings_block.read_block(
        composed, TRACED, lazy.calibrate.Traceability, composed.root.items[TRACED].plain
    )
    return composed, training, lifting, evaluation, traceability


def check(composed: Composed, asked: AskedNodes = THEMSELVES) -> Recipe:
    """Return a composed recipe after a check of all its values; raise `RecipeError` with all
    mistakes. ``asked`` answers in place of the nodes.
    """
    blocks = [composed.root.items[key] for key in BLOCKS if key in composed.root.items]
    asked.refuse_code_of({*composed.root.items} & {KEY, SAFETY, *BLOCKS})
    mistakes: list[Diagnostic] = []
    # code of the user first, because blocks and steps may name it
    own_families = read_own_families(composed.root, mistakes)
    composed = composed.with_problems(mistakes)
    blocks_read = _settings_blocks(composed, blocks, own_families.modules)
    composed, training, lifting, evaluation, traceability = blocks_read
    # a number in place of each distribution
    composed, uncertain = settle(composed)
    diagnostics = list(composed.diagnostics)
    # `train` is the first of `BLOCKS`
    uncertain = _with_mismatch(composed, uncertain, blocks[0] if training else None, diagnostics)
    root = composed.root
    # the steps, and what they read
    references = References(root, diagnostics, dict(composed.replaced))
    checker = Checker([], own=own_families.modules, asked=asked)
    checker.files[(KEY,)] = own_families.places
    graph = _known_graph(root, own_families.modules, asked)
    memory = graph.memory if graph else None
    steps, absent = _declared(graph, root, references, diagnostics, own_families, asked)
    wiring, checked = Wiring(root, steps, absent, references, diagnostics), list[CheckedStep]()
    bound = {step.name: step for step in _bind(wiring, checker, graph, checked)}
    cycles_found = _cycles(bound, steps, graph)
    diagnostics += cycles_found
    # keys of the whole recipe
    seed, tolerance = seed_and_tolerance(root, references, checker.diagnostics)
    estimates = estimates_of(root, references, checker.diagnostics)
    outputs = outputs_of(root, wiring)
    # shapes are known only along a graph without a cycle
    outputs_of_shapes = None if cycles_found else outputs
    earlier_forms = memory.forms if memory else None
    check_steps(checked, checker, outputs_of_shapes, earlier_forms)
    expect, exports = expectations(root, wiring), exports_of(root, wiring)
    safety = _safety(root, references, diagnostics, checker.files)
    # after all that could use a value
    references.finish()
    _refuse_mistakes(composed, diagnostics, checker, own_families)
    # only a recipe without mistakes comes this far
    asked.learn(checked)
    _offer_graph(graph, root, steps, absent, bound, asked)
    settings = final_values(wiring, bound, checker, uncertain, memory)
    note_lists = (composed.notes, own_families.notes, checker.notes, references.notes)
    return Recipe(
        name=composed.name,
        title=composed.title,
        seed=seed,
        tolerance=tolerance,
        outputs=outputs,
        steps=bound,
        expect=expect,
        config=Config(settings | dict(settings_of(blocks, checker))),
        notes=(*chain.from_iterable(note_lists), *_notes_of(uncertain)),
        absent=_places_of_null(absent),
        estimates=estimates,
        uncertain=uncertain,
        training=training,
        lifting=lifting,
        safety=safety,
        evaluation=evaluation,
        traceability=traceability,
        exports=exports,
    )


def _known_graph(root: Value, own: Own, asked: AskedNodes) -> CachedGraph | None:
    """Return the cached step graph of a recipe, if an earlier check may stand for this one."""
    return cached_graph(root, own) if asked.reuses_checks else None


def _offer_graph(
    graph: CachedGraph | None,
    root: Value,
    steps: dict[str, Declared],
    absent: dict[str, Value],
    bound: Mapping[str, Step],
    asked: AskedNodes,
) -> None:
    """Add the step graph of a recipe to the cache, unless it is there or has no nodes."""
    if graph is None and asked.are_imported:
        cache_graph(root, steps, absent, {name: step.wires for name, step in bound.items()})


def _declared(
    graph: CachedGraph | None,
    root: Value,
    references: References,
    diagnostics: list[Diagnostic],
    own: OwnFamilies,
    asked: AskedNodes,
) -> tuple[dict[str, Declared], dict[str, Value]]:
    """Return the declared steps of a recipe and its null steps, from the cached graph if there is
    one.
    """
    if graph is not None:
        return graph.steps, graph.absent
    return declare(root, references, diagnostics, own, asked)


def _refuse_mistakes(
    composed: Composed, diagnostics: list[Diagnostic], checker: Checker, own: OwnFamilies
) -> None:
    """Raise `RecipeError` with the mistakes of a recipe, if it has any."""
    if not composed.whole:  # a missing group causes further errors
        diagnostics = list(composed.diagnostics)
    if problems := _causes([*diagnostics, *checker.diagnostics], own):
        raise RecipeError(problems)


def _notes_of(uncertain: Uncertain | None) -> tuple[str, ...]:
    return uncertain.notes if uncertain else ()


def _places_of_null(absent: Mapping[str, Value]) -> dict[str, str]:
    return {name: f"null ({value.mark})" for name, value in absent.items()}


def _cycles(
    bound: Mapping[str, Step], steps: Mapping[str, Declared], graph: CachedGraph | None
) -> list[Diagnostic]:
    """Return a diagnostic for each cycle of steps; a graph that was found to have none is not
    searched again.
    """
    sources = tuple(step.sources for step in bound.values())
    if graph and sources in graph.memory.sources:
        return []
    loops = list(cycles(bound, {name: step.value.key for name, step in steps.items()}))
    if graph and not loops:
        graph.memory.sources[:] = [sources]
    return loops


def _with_mismatch(
    composed: Composed,
    uncertain: Uncertain | None,
    block: Value | None,
    diagnostics: list[Diagnostic],
) -> Uncertain | None:
    """Return the uncertain values of a recipe with the differences that ``train.mismatch``
    states, if any.
    """
    stated = block.child("mismatch") if block else None
    if stated is None or not (mismatch := read_mismatch(stated, composed.root, diagnostics)):
        return uncertain
    return replace(
        uncertain or Uncertain(replace(composed, diagnostics=()), {}, None), mismatch=mismatch
    )


def _safety(
    root: Value, references: References, diagnostics: list[Diagnostic], files: dict[Where, Any]
) -> Safety | None:
    """Return the settings in the block ``safety`` of a recipe, or None; the module is imported only
    for a recipe with this block.
    """
    if SAFETY not in root.items:
        return None
    return lazy.safety_block.read_safety(root, references, diagnostics, files)


def _causes(problems: list[Diagnostic], own: OwnFamilies) -> list[Diagnostic]:
    """Return the mistakes without those that follow from a family that could not be read."""
    return [
        problem for problem in problems if own.is_whole or not problem.message.startswith(NO_FAMILY)
    ]


def _bind(
    wiring: Wiring, checker: Checker, graph: CachedGraph | None, checked: list[CheckedStep]
) -> Iterator[Step]:
    """Yield every copy of every step with its parameters and inputs, and add each valid copy to
    ``checked``.

    ``graph`` has the inputs of each copy, and the copies that an earlier check with the same values
    found valid.
    """
    cached_wires, memory = (graph.wires, graph.memory) if graph else ({}, None)
    for step in wiring.steps.values():
        # no copy is made, but the values to which the step refers count as used
        if not step.items:
            for key in ("from", "with", "device", "cache"):
                wiring.references.touch(step.entry(key), step.dims)
        for items in step.items:
            name = step.instance(items)
            # the same values were checked before
            if memory and (checked_before := memory.find(name, wiring.references)):
                checked.append(checked_before)
                yield checked_before.step
                continue
            attempt = Attempt(wiring.references, checker)
            bound = _bound_copy(wiring, checker, step, items, cached_wires)
            if bound is None:
                continue
            if bound.is_valid:
                checked.append(CheckedStep(bound.step, bound.parameters, step.value))
                attempt.remember(name, checked[-1], memory)
            yield bound.step


class _BoundCopy(NamedTuple):
    """One copy of a step, with the parameters that the recipe writes."""

    step: Step
    parameters: Value
    is_valid: bool  #: whether the parameters are right


def _bound_copy(
    wiring: Wiring,
    checker: Checker,
    step: Declared,
    items: tuple[str, ...],
    known_wires: Mapping[str, Mapping[str, Wire]],
) -> _BoundCopy | None:
    """Return one copy of a step with its parameters and inputs, or None if its node does
    not exist.
    """
    name, scope = step.instance(items), step.scope(wiring.root, items)
    parameters = wiring.references.resolve(step.entry("with"), scope)
    wires = known_wires[name] if name in known_wires else wiring.wires(step, items)
    device = device_of(step, wiring.references, scope, checker.diagnostics)
    cached = cached_of(step, wiring.references, scope, checker.diagnostics)
    if step.node is None:
        return None
    params = checker.read(step.node, parameters, step.value.key)
    marks = {str(name): value.mark for name, value in parameters.items.items()}
    step_copy = Step(name, step.node, params or {}, wires, step.value.key, marks, device, cached)
    return _BoundCopy(step_copy, parameters, params is not None)


def families_of(name: str, folder: Path | None = None) -> Own:
    """Return the modules of the families of nodes that a recipe names, by family, without a check
    of the recipe.

    Raises `RecipeError` if a family cannot be read.
    """
    diagnostics: list[Diagnostic] = []
    families = read_own_families(
        compose(name, (), (folder or Path.cwd()).absolute()).root, diagnostics
    )
    if diagnostics:
        raise RecipeError(diagnostics)
    return families.modules


# --- lists of recipes and groups ------------------------------------------------------------------


def recipes() -> list[Titled]:
    """Return names and titles of all recipes that can be found by name: those of the user, and the
    packaged recipes.
    """
    paths: dict[str, Path] = {}
    for folder in shared_folders():
        for path in sorted(folder.glob("*.yaml")):
            paths.setdefault(path.stem, path)
    return [_titled(path) for _, path in sorted(paths.items())]


def groups(beside: Path | None = None) -> dict[str, list[Titled]]:
    """Return the options of all groups: those in ``beside``, those of the user, and the packaged
    options.
    """
    folders = [folder for folder in (beside, *shared_folders()) if folder]
    return {
        group: [
            _titled(next(p for f in folders if (p := f / group / f"{name}.yaml").is_file()))
            for name in names
        ]
        for group, names in groups_of(*folders).items()
    }


_TITLE = 4096  #: largest number of bytes of a recipe that are read for its title


def _titled(path: Path) -> Titled:
    """Return a recipe with its title: the first line of its file, if that is a comment."""
    return Titled(path.stem, title_of(head_of(path, _TITLE).decode("utf-8", "replace")))


# --- changed recipe -------------------------------------------------------------------------------

# Changes of a loaded recipe: its final values are written to a file, changed by overrides and
# checked again.


def changed(recipe: Recipe, overrides: Sequence[str]) -> Recipe:
    """Return a loaded recipe with values changed by ``overrides``; raise `RecipeError` for an
    invalid value.
    """
    with TemporaryDirectory(prefix="neusee-") as folder:
        path = Path(folder) / "recipe.yaml"
        # written out and read again, so that every override is checked
        path.write_text(recipe.config.to_yaml(), encoding="utf-8")
        loaded = load(path, overrides)
    loaded = replace(
        loaded,
        name=recipe.name,
        title=recipe.title,
        seed=recipe.seed,
        outputs=recipe.outputs,
        expect=(),
    )
    return replace(
        loaded,
        tolerance=recipe.tolerance,
        exact=recipe.exact,
        estimates=recipe.estimates and loaded.estimates,
    )


def recipe_at(uncertain: Uncertain, values: Mapping[str, float]) -> Recipe:
    """Return the recipe with the given numbers in SI units in place of its uncertain values.

    Raises `RecipeError` for an invalid value.
    """
    return check(uncertain.composed_at(values))
