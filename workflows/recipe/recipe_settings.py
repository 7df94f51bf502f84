"""Final values of a checked recipe: those that it writes, and the default values of the nodes of its steps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

from neusee.workflows.graph.final_values import Setting
from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.recipe.bound_steps import GraphMemory
from neusee.workflows.recipe.distributions.nominal_values import Uncertain
from neusee.workflows.recipe.parameters import Checker
from neusee.workflows.recipe.step_declarations import Declared
from neusee.workflows.recipe.text.overrides import arguments_in
from neusee.workflows.recipe.text.yaml_values import Value
from neusee.workflows.recipe.wiring import Wiring


def final_values(
    wiring: Wiring,
    bound: dict[str, Step],
    checker: Checker,
    uncertain: Uncertain | None,
    memory: GraphMemory | None,
) -> dict[str, Setting]:
    """Return the final values of a recipe by path: the written values and the default values of the steps' nodes."""
    settings: dict[str, Setting] = {}
    spare = wiring.references.spare
    for key, block in wiring.root.items.items():
        if key != "steps":
            found = _block_settings(block, checker, memory)
            settings |= {name: value for name, value in found.items() if value.path not in spare}
            continue
        for name, step in block.items.items():
            settings |= _block_settings(step, checker, memory)
            if str(name) in wiring.steps:
                settings |= _defaults(wiring.steps[str(name)], bound)
    for name, law in uncertain.laws.items() if uncertain else ():
        if name in settings:
            settings[name] = replace(settings[name], value=law.full_text)
    return settings


def _block_settings(block: Value, checker: Checker, memory: GraphMemory | None) -> dict[str, Setting]:
    """Return the final values of a block by path, those of an earlier check if the block is the same object."""
    known = memory.settings.get(block.path) if memory else None
    same = known is not None and known[0] is block
    found = known[1] if known and same else dict(settings_of([block], checker))
    if any(setting.path in checker.files for setting in found.values()):  # paths of files may differ
        return dict(settings_of([block], checker))
    if memory and not same:
        memory.settings[block.path] = block, found
    return found


def settings_of(blocks: Iterable[Value], checker: Checker) -> Iterator[tuple[str, Setting]]:
    """Yield the values that blocks of a recipe write, each with its path."""
    for leaf in (leaf for block in blocks for leaf in block.leaves()):
        value: Any = checker.files.get(leaf.path, leaf.plain)
        sources = dict.fromkeys(map(str, (leaf.mark, *arguments_in(leaf))))
        yield leaf.name, Setting(value, ", ".join(sources), leaf.path)


def _defaults(step: Declared, bound: dict[str, Step]) -> Iterator[tuple[str, Setting]]:
    """Yield the parameters of a step that the recipe does not set, with the default values in SI."""
    first = bound.get(step.instances[0]) if step.instances else None
    for name, value in (first.params if first else {}).items():
        if first and name not in first.param_marks:
            path = (*step.value.path, "with", name)
            yield ".".join(map(str, path)), Setting(value, f"default of {first.node.path}", path, True)
