"""The machinery that reads a recipe, runs its steps in order, stores their results and reports on
the run.

    from neusee.workflows import load, run
    result = run(load("first_light", doe="axicon", sensor={"read_noise": "20 e-"}))
    result["restored"], result.numpy("restored"), result.metrics()

Names are imported when they are first used, so that ``neusee --help`` answers without torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neusee.workflows.engine.differentiable_function import as_function
    from neusee.workflows.engine.runner import Result, run
    from neusee.workflows.engine.step_job import Executor
    from neusee.workflows.graph.errors import Diagnostic, RecipeError, RunError
    from neusee.workflows.graph.recipe_graph import Event, Recipe, Step, StepRecord
    from neusee.workflows.placement.tasks_and_devices import Schedule
    from neusee.workflows.priors.recipe_physics import as_physics
    from neusee.workflows.recipe.loading import load, recipes
    from neusee.workflows.store.result_store import Store

_HOME = {
    "as_function": "engine.differentiable_function",
    "as_physics": "priors.recipe_physics",
    "Recipe": "graph.recipe_graph",
    "Step": "graph.recipe_graph",
    "Diagnostic": "graph.errors",
    "RecipeError": "graph.errors",
    "RunError": "graph.errors",
    "StepRecord": "graph.recipe_graph",
    "Event": "graph.recipe_graph",
    "load": "recipe.loading",
    "recipes": "recipe.loading",
    "Result": "engine.runner",
    "run": "engine.runner",
    "Schedule": "placement.tasks_and_devices",
    "Store": "store.result_store",
    "Executor": "engine.step_job",
}

__all__ = [
    "Diagnostic",
    "Event",
    "Executor",
    "Recipe",
    "RecipeError",
    "Result",
    "RunError",
    "Schedule",
    "Step",
    "StepRecord",
    "Store",
    "as_function",
    "as_physics",
    "load",
    "recipes",
    "run",
]


def __getattr__(name: str) -> Any:
    import importlib

    if name not in _HOME:
        raise AttributeError(f"module 'neusee.workflows' has no attribute {name!r}")
    return getattr(importlib.import_module(f"neusee.workflows.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
