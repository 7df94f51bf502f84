"""The plumbing: read a recipe, order its steps, find, place and run them, and say what happened.

    from neusee.workflows import load
    result = load("first_light", doe="axicon", sensor={"read_noise": "20 e-"}).run()
    result["restored"], result.numpy("restored"), result.metrics()

Names are imported when they are first used, so that ``neusee --help`` answers without torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neusee.workflows._call import RunError
    from neusee.workflows._function import as_function
    from neusee.workflows._graph import Recipe, Step
    from neusee.workflows._marks import Problem, RecipeError
    from neusee.workflows._recipe import load, recipes
    from neusee.workflows._run import Done, Event, Result, run
    from neusee.workflows._schedule import Schedule
    from neusee.workflows._store import Store
    from neusee.workflows._work import Executor

_HOME = {
    "RunError": "_call",
    "as_function": "_function",
    "Recipe": "_graph",
    "Step": "_graph",
    "Problem": "_marks",
    "RecipeError": "_marks",
    "load": "_recipe",
    "recipes": "_recipe",
    "Done": "_run",
    "Event": "_run",
    "Result": "_run",
    "run": "_run",
    "Schedule": "_schedule",
    "Store": "_store",
    "Executor": "_work",
}

__all__ = [
    "Done",
    "Event",
    "Executor",
    "Problem",
    "Recipe",
    "RecipeError",
    "Result",
    "RunError",
    "Schedule",
    "Step",
    "Store",
    "as_function",
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
