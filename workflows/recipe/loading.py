"""Loading of a recipe from its name or file and from arguments, with a check that reports all mistakes at once."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neusee.workflows.graph.diagnostics import Diagnostic, RecipeError, visible
from neusee.workflows.graph.final_values import Config
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.keys.regular_file import head_of
from neusee.workflows.recipe.bound_steps import Attempt
from neusee.workflows.recipe.distributions.mismatch_laws import read_mismatch
from neusee.workflows.recipe.distributions.nominal_values import Uncertain, settle
from neusee.workflows.recipe.expected_numbers import unaffected_expectations
from neusee.workflows.recipe.exported_files import exports_of
from neusee.workflows.recipe.global_settings import estimates_of, expectations, outputs_of, seed_and_tolerance
from neusee.workflows.recipe.graph_cache import CachedGraph, cache_graph, cached_graph
from neusee.workflows.recipe.known_before_run import CheckedStep, check_steps, refuse_indices
from neusee.workflows.recipe.node_families import NO_FAMILY, Own, class_context
from neusee.workflows.recipe.other_cameras import with_cameras
from neusee.workflows.recipe.own_families import KEY, OwnFamilies, read_own_families
from neusee.workflows.recipe.parameters import Checker
from neusee.workflows.recipe.recipe_settings import final_values, settings_of
from neusee.workflows.recipe.step_declarations import Declared, cached_of, declare, device_of
from neusee.workflows.recipe.text.composition import Composed, compose
from neusee.workflows.recipe.text.option_groups import groups_of, shared_folders
from neusee.workflows.recipe.text.overrides import Override
from neusee.workflows.recipe.text.python_overrides import overrides_of
from neusee.workflows.recipe.text.references import References
from neusee.workflows.recipe.text.yaml_values import Value, Where
from neusee.workflows.recipe.wiring import Wiring, cycles

if TYPE_CHECKING:
    from types import ModuleType

    from neusee.nodes.calibrate import Traceability
    from neusee.workflows.recipe.blocks.evaluate_block import EvaluateSettings
    from neusee.workflows.recipe.blocks.safety_block import Safety
    from neusee.workflows.recipe.blocks.train_block import Training
    from neusee.workflows.recipe.blocks.train_lift_block import LiftTraining

TRACED = "traceability"  #: key of the block in which a laboratory states its light and temperature
BLOCKS = ("train", "train_lift", "evaluate", TRACED)  #: keys of the blocks of settings in a recipe
SAFETY = "safety"  #: key of the block that an estimate of damage and dazzle reads


@dataclass(frozen=True, slots=True)
class Titled:
    """Name of a packaged recipe or of an option of a group, with the title from the first line of its file."""

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
    """Return a packaged recipe, or the recipe in a file whose name ends in ``.yaml``, after a check of all its values.

        load("first_light", ["sensor.read_noise=20 e-"])
        load("first_light", doe="axicon", sensor={"read_noise": "20 e-"}, lasers={"green": {"strength": 1e4}})
        load("first_light", **{"sensor.read_noise": "20 e-", "+lasers.red": {"wavelength": "638 nm", …}})

    ``values`` are overrides as Python values, which are applied after ``overrides``; a mapping changes only the values
    that it names. Paths are relative to ``folder`` (default: the working folder). Messages number ``overrides`` from
    ``first``. A note names the expected numbers that overrides affect, because these are not compared.
    Raises `RecipeError` with all mistakes.
    """
    name, beside = os.fspath(name_or_path), Path(folder or ".").absolute()
    changes: tuple[str | Override, ...] = (*overrides, *overrides_of(values, beside))
    composed = compose(name, changes, beside, first)
    recipe = check(composed)
    if recipe.training and recipe.training.cameras:
        recipe = with_cameras(recipe, composed, lambda words: check(compose(name, [*changes, *words], beside, first)))
    if recipe.expect and changes:
        recipe = unaffected_expectations(recipe, _as_written(name, beside))
    if recipe.expect and (problems := list(refuse_indices(recipe))):
        raise RecipeError(problems)
    return recipe


def _as_written(name: str, folder: Path) -> Recipe | None:
    """Return a recipe without the user's overrides, or None if the recipe is not valid without the overrides.

    The result is cached while the files and nodes of the recipe are unchanged.
    """
    composed = compose(name, (), folder)
    graph = cached_graph(composed.root, read_own_families(composed.root, []).modules)
    try:
        return check(composed) if graph is None else _checked(composed, graph)
    except RecipeError:
        return None


@functools.lru_cache(maxsize=16)
def _checked(composed: Composed, graph: CachedGraph) -> Recipe:
    """Return a composed recipe after a check of its values; the result is cached by recipe and step graph."""
    return check(composed)


def _settings_blocks(
    composed: Composed, modules: Mapping[str, ModuleType]
) -> tuple[Composed, Training | None, LiftTraining | None, EvaluateSettings | None, Traceability | None]:
    """Return a recipe without its blocks of settings, and these; few recipes need the import of their models."""
    from neusee.workflows.recipe.blocks.evaluate_block import read_evaluate
    from neusee.workflows.recipe.blocks.train_block import read_training
    from neusee.workflows.recipe.blocks.train_lift_block import read_lift_training

    composed, training = read_training(composed, class_context(modules))
    composed, lifting = read_lift_training(composed)
    composed, evaluation = read_evaluate(composed)
    if TRACED not in composed.root.items:
        return composed, training, lifting, evaluation, None
    from neusee.nodes.calibrate import Traceability
    from neusee.workflows.recipe.blocks.settings_block import read_block

    composed, traceability = read_block(composed, TRACED, Traceability, composed.root.items[TRACED].plain)
    return composed, training, lifting, evaluation, traceability


def check(composed: Composed) -> Recipe:
    """Return a composed recipe after a check of all its values; raise `RecipeError` with all mistakes."""
    blocks = [composed.root.items[key] for key in BLOCKS if key in composed.root.items]
    mistakes: list[Diagnostic] = []
    own = read_own_families(composed.root, mistakes)
    composed = composed.with_problems(mistakes)
    read = _settings_blocks(composed, own.modules) if blocks else (composed, None, None, None, None)
    composed, training, lifting, evaluation, traceability = read
    composed, uncertain = settle(composed)
    diagnostics = list(composed.diagnostics)
    uncertain = _with_mismatch(composed, uncertain, blocks[0] if training else None, diagnostics)
    root, references = composed.root, References(composed.root, diagnostics, dict(composed.replaced))
    checker = Checker([], own=own.modules)
    checker.files[(KEY,)] = own.places
    graph = cached_graph(root, own.modules)
    steps, absent = (graph.steps, graph.absent) if graph else declare(root, references, diagnostics, own)
    wiring, checked = Wiring(root, steps, absent, references, diagnostics), list[CheckedStep]()
    bound = {step.name: step for step in _bind(wiring, checker, graph, checked)}
    loops = _cycles(bound, steps, graph)
    diagnostics += loops
    seed, tolerance = seed_and_tolerance(root, references, checker.diagnostics)
    estimates, outputs = estimates_of(root, references, checker.diagnostics), outputs_of(root, wiring)
    check_steps(checked, checker, None if loops else outputs, graph.memory.forms if graph else None)
    expect, exports = expectations(root, wiring), exports_of(root, wiring)
    safety = _safety(root, references, diagnostics, checker.files)
    references.finish()
    if not composed.whole:  # a missing group causes further errors
        diagnostics = list(composed.diagnostics)
    if problems := _causes([*diagnostics, *checker.diagnostics], own):
        raise RecipeError(problems)
    if graph is None:
        cache_graph(root, steps, absent, {name: step.wires for name, step in bound.items()})
    memory = graph.memory if graph else None
    config = Config(final_values(wiring, bound, checker, uncertain, memory) | dict(settings_of(blocks, checker)))
    gone = {name: f"null ({value.mark})" for name, value in absent.items()}
    notes = (*composed.notes, *own.notes, *checker.notes, *references.notes, *(uncertain.notes if uncertain else ()))
    args = composed.name, composed.title, seed, tolerance, outputs, bound, expect, config, notes, gone, False, estimates
    recipe = Recipe(*args, uncertain=uncertain, safety=safety, traceability=traceability, exports=exports)
    return replace(recipe, training=training, lifting=lifting, evaluation=evaluation)


def _cycles(bound: Mapping[str, Step], steps: Mapping[str, Declared], graph: CachedGraph | None) -> list[Diagnostic]:
    """Return a diagnostic for each cycle of steps; a graph that was found to have none is not searched again."""
    sources = tuple(step.sources for step in bound.values())
    if graph and sources in graph.memory.sources:
        return []
    loops = list(cycles(bound, {name: step.value.key for name, step in steps.items()}))
    if graph and not loops:
        graph.memory.sources[:] = [sources]
    return loops


def _with_mismatch(
    composed: Composed, uncertain: Uncertain | None, block: Value | None, diagnostics: list[Diagnostic]
) -> Uncertain | None:
    """Return the uncertain values of a recipe with the differences that ``train.mismatch`` states, if any."""
    given = block.child("mismatch") if block else None
    if given is None or not (mismatch := read_mismatch(given, composed.root, diagnostics)):
        return uncertain
    return replace(uncertain or Uncertain(replace(composed, diagnostics=()), {}, None), mismatch=mismatch)


def _safety(
    root: Value, references: References, diagnostics: list[Diagnostic], files: dict[Where, Any]
) -> Safety | None:
    """Return the settings in the block ``safety`` of a recipe, or None; few recipes need the import of these."""
    if SAFETY not in root.items:
        return None
    from neusee.workflows.recipe.blocks.safety_block import read_safety

    return read_safety(root, references, diagnostics, files)


def _causes(problems: list[Diagnostic], own: OwnFamilies) -> list[Diagnostic]:
    """Return the mistakes without those that follow from a family that could not be read."""
    return [each for each in problems if own.is_whole or not each.message.startswith(NO_FAMILY)]


def _bind(wiring: Wiring, checker: Checker, graph: CachedGraph | None, checked: list[CheckedStep]) -> Iterator[Step]:
    """Yield every copy of every step with its parameters and inputs, and add each valid copy to ``checked``.

    ``graph`` has the inputs of each copy, and the copies that were checked with the same values before.
    """
    known, memory = (graph.wires, graph.memory) if graph else ({}, None)
    for step in wiring.steps.values():
        if not step.items:
            for part in ("from", "with", "device", "cache"):
                wiring.references.touch(step.part(part), step.dims)
        for items in step.items:
            name = step.instance(items)
            if memory and (same := memory.find(name, wiring.references)):
                checked.append(same)
                yield same.step
                continue
            attempt, scope = Attempt(wiring.references, checker), step.scope(wiring.root, items)
            given = wiring.references.resolve(step.part("with"), scope)
            wires = known[name] if name in known else wiring.wires(step, items)
            device = device_of(step, wiring.references, scope, checker.diagnostics)
            cached = cached_of(step, wiring.references, scope, checker.diagnostics)
            if step.node is None:
                continue
            params = checker.read(step.node, given, step.value.key)
            marks = {str(name): value.mark for name, value in given.items.items()}
            found = Step(name, step.node, params or {}, wires, step.value.key, marks, device, cached)
            if params is not None:
                checked.append(CheckedStep(found, given, step.value))
                attempt.remember(name, checked[-1], memory)
            yield found


def families_of(name: str, folder: Path | None = None) -> Own:
    """Return the modules of the families of nodes that a recipe names, by family, without a check of the recipe.

    Raises `RecipeError` if a family cannot be read.
    """
    diagnostics: list[Diagnostic] = []
    own = read_own_families(compose(name, (), (folder or Path.cwd()).absolute()).root, diagnostics)
    if diagnostics:
        raise RecipeError(diagnostics)
    return own.modules


# --- lists of recipes and groups ------------------------------------------------------------------------------------


def recipes() -> list[Titled]:
    """Return names and titles of all recipes that a name finds: those of the user, and the packaged recipes."""
    found: dict[str, Path] = {}
    for folder in shared_folders():
        for path in sorted(folder.glob("*.yaml")):
            found.setdefault(path.stem, path)
    return [_titled(path) for _, path in sorted(found.items())]


def groups(beside: Path | None = None) -> dict[str, list[Titled]]:
    """Return the options of all groups: those in ``beside``, those of the user, and the packaged options."""
    folders = [folder for folder in (beside, *shared_folders()) if folder]
    return {
        group: [_titled(next(p for f in folders if (p := f / group / f"{name}.yaml").is_file())) for name in names]
        for group, names in groups_of(*folders).items()
    }


_TITLE = 4096  #: bytes of the first line of a recipe, at most


def _titled(path: Path) -> Titled:
    first = head_of(path, _TITLE).decode("utf-8", "replace").partition("\n")[0].strip()
    return Titled(path.stem, visible(first.lstrip("# ")) if first.startswith("#") else "")
