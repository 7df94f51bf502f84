"""What a laser does to a camera: a YAML recipe runs as a graph of cached, differentiable physical
steps.

    import neusee

    recipe = neusee.load("laser_free", doe="axicon", sensor={"read_noise": "20 e-"})
    result = neusee.run(recipe, outputs=["lsr[mask]", "raw[mask]"])
    result.metrics()["lsr[mask]"], result.numpy("raw[mask]")
    table = neusee.sweep("laser_free", axes={"doe": ["axicon", "vortex"]}, changes={"outputs":
    ["lsr[mask]"]}).table()

The first argument of every verb is the name or the file of a recipe, and all options are given by
name. `run` returns values, `sweep` a table over values of parameters, `train` trains a mask and its
restoration, `evaluate` compares masks and restorers, `calibrate` finds the posterior of a sensor,
and `study` measures how accurate the numbers of a recipe are. `run`, `train`, `calibrate` and
`study` also take a recipe that `load` returned.

A caller may want to catch `RecipeError` (a mistake in a recipe, before anything runs), `RunError`
(a step failed) and `ParameterError` (a node refuses a parameter). ``recipes/guide/exceptions.md``
lists every exception with the functions that raise it, ``recipes/guide/torch_func.md`` the nodes
that work under `torch.func`, ``neusee --help`` the commands.

A name is imported when a caller first uses the name, so ``import neusee`` is fast and loads neither
torch nor pydantic.
"""

TYPE_CHECKING = False  # as in `typing`, whose import takes longer than the rest of this file
if TYPE_CHECKING:
    from typing import Any

    from neusee.nodes import ParameterError
    from neusee.workflows import RecipeError, Result, RunError, Store, as_function, load
    from neusee.workflows.api.verbs import calibrate, evaluate, run, study, sweep, train
    from neusee.workflows.graph.recipe_graph import Recipe, Step
    from neusee.workflows.sweeps.sweep_run import Sweep

__version__ = "0.1.0"

_VERBS = ("calibrate", "evaluate", "run", "study", "sweep", "train")
_HOME = {
    "ParameterError": "nodes",
    "Sweep": "workflows.sweeps.sweep_run",
    **dict.fromkeys(("Recipe", "RecipeError", "Result", "RunError", "Step", "Store"), "workflows"),
    **dict.fromkeys(("as_function", "load"), "workflows"),
    **dict.fromkeys(_VERBS, "workflows.api.verbs"),
}

__all__ = [
    "ParameterError",
    "Recipe",
    "RecipeError",
    "Result",
    "RunError",
    "Step",
    "Store",
    "Sweep",
    "__version__",
    "as_function",
    "calibrate",
    "evaluate",
    "load",
    "run",
    "study",
    "sweep",
    "train",
]


def __getattr__(name: str) -> "Any":
    """Import and return a public name when a caller first uses the name."""
    if name not in _HOME:
        raise AttributeError(f"module 'neusee' has no attribute {name!r}")
    import importlib

    found = globals()[name] = getattr(importlib.import_module(f"neusee.{_HOME[name]}"), name)
    return found


def _tell_notebooks() -> None:
    """Tell IPython, where it runs, how a notebook shows a recipe and a result of a run.

    The pages are imported when the first of them is shown.
    """
    import sys

    running = getattr(sys.modules.get("IPython"), "get_ipython", None)
    shell = running() if running else None
    if shell is not None:
        html = shell.display_formatter.formatters["text/html"]
        html.for_type_by_name("neusee.workflows.graph.recipe_graph", "Recipe", _recipe_html)
        html.for_type_by_name("neusee.workflows.engine.runner", "Result", _result_html)


def _recipe_html(recipe: "Recipe") -> str:
    from neusee.workflows.report.notebook import recipe_html

    return recipe_html(recipe)


def _result_html(result: "Result") -> str:
    from neusee.workflows.report.notebook import result_html

    return result_html(result)


_tell_notebooks()


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
