"""Contents of a report: figures, data files, and the results that they show."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from neusee.workflows.engine.provenance import machine, timestamp
from neusee.workflows.graph.recipe_graph import Recipe, Step, needed
from neusee.workflows.keys.cache_key import code_of, digest, plain
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.store.result_store import Store

# --- contents -------------------------------------------------------------------------------------

# Contents of the report of a run: figures and data files, and the steps whose results they show.
#
# The report shows what the outputs of the recipe need; no step runs for the report alone.
#
# Only ``contents.toml`` and ``engine/wanted_steps.py`` name the steps of the camera graph. A text
# names the source of one argument of a drawing function:
#
#     psf[mask]                    the value of a step
#     spot[mask,*]                 a dictionary with the value of each copy of a step
#     psf[mask].pixel_pitch        a parameter of a step
#     line[*].file                 a dictionary with a parameter of each copy of a step
#     variants of psf              errors and run times of its variants, from a study of accuracy
#     psf[mask]()                  a function: the node of a step with the parameters of the step
#
# A leading ``?`` marks an optional argument: if the recipe lacks the step, the figure is drawn
# without this argument.


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of the report: title, caption, drawing function, and the steps that supply the
    function's arguments.
    """

    name: str
    title: str
    caption: str
    draw: str  #: the drawing function, as ``module:function`` below neusee.workflows
    needs: Mapping[str, str]
    #: True for a figure that is drawn only if an argument is a table of the user
    only_tables: bool = False


_TABLES = tomllib.loads(
    resources.files(__package__).joinpath("contents.toml").read_text(encoding="utf-8")
)
FIGURES = tuple(Figure(**figure) for figure in _TABLES["figure"])


#: Files of ``data/``: the format of each file, and the needs of the function that writes the file.
FILES: Mapping[str, tuple[str, Mapping[str, str]]] = {
    name: (file["format"], file["needs"]) for name, file in _TABLES["files"].items()
}


OUTPUTS = "outputs.safetensors"


def files_of(recipe: Recipe) -> dict[str, tuple[str, Mapping[str, str]]]:
    """Return format and needs of the data files that a recipe requests, by name."""
    files = {**FILES, OUTPUTS: ("safetensors", {step: step for step in recipe.outputs})}
    return {
        name: file
        for name, file in files.items()
        if recipe.exports is None or name in recipe.exports
    }


# --- measured variants ----------------------------------------------------------------------------

# Errors and run times of variants of a step, as the accuracy study measured them, for the pictures
# of later runs.


Row = tuple[Any, ...]  #: property that is changed, new value, error, seconds


def keep_variants(recipe: Recipe, step: str, rows: Sequence[Row], store: Store) -> None:
    """Store the errors and run times of the variants of a step, for recipes with the same step,
    inputs and machine.
    """
    if rows:
        description = {"step": f"variants of {step}", "date": timestamp(), "seconds": 0.0}
        store.put(
            _key(recipe, step, Code(store.code_memo)), [list(row) for row in rows], description
        )


def variants_of(recipe: Recipe, family: str, store: Store, code: Code) -> list[Row]:
    """Return the errors and run times of the variants of a step such as ``psf``, of the first copy
    with stored ones; none if no copy was measured.
    """
    for name in recipe.steps:
        if name.partition("[")[0] == family:
            with suppress(KeyError):
                rows = store.get(_key(recipe, name, code), list)
                return [
                    (str(property_name), str(new_value), float(error), float(seconds))
                    for property_name, new_value, error, seconds in rows
                ]
    return []


def _key(recipe: Recipe, step: str, code: Code) -> str:
    """Return the key of the variants of a step: its code, and the parameters of the step and of
    all steps before it.
    """
    steps_before = [recipe.steps[name] for name in needed(recipe, (step,))]
    params = [
        [step_before.node.path, {name: plain(value) for name, value in step_before.params.items()}]
        for step_before in steps_before
    ]
    return digest("variants of a step", step, code_of(recipe.steps[step], code), params, machine())


# --- requirements ---------------------------------------------------------------------------------

# Lookup of the results, parameters and functions of a recipe from which a figure or a data file is
# made.


_MEASURED = "variants of "
_PARAMETER = re.compile(r"(?P<step>[^.]+)\.(?P<name>\w+)")


class Missing(LookupError):
    """Error for a step that a figure or data file reads, if the recipe lacks the step or the run
    does not need it.
    """


@dataclass(frozen=True, slots=True)
class Bound:
    """A function that applies the node of a step, with the parameters of this step, to other
    inputs.
    """

    step: Step

    def __call__(self, *inputs: Any, **changes: Any) -> Any:
        return self.step.node(*inputs, **{**self.step.params, **changes})

    def reference(self, *inputs: Any, **changes: Any) -> Any:
        """Call the float64 reference implementation of the node; raise `Missing` if the node has
        none.
        """
        if self.step.node.hooks.reference is None:
            raise Missing(
                f"the node {self.step.node.path} has no reference implementation in float64"
            )
        return self.step.node.hooks.reference(*inputs, **{**self.step.params, **changes})


@dataclass(frozen=True, slots=True)
class Source:
    """The source of an argument of a drawing function: steps to read, function of their results,
    and part of a key.
    """

    steps: tuple[str, ...]
    make: Any  #: a function of the values by step, which returns the argument
    identity: Any  #: plain JSON


def find(need: str, recipe: Recipe, keys: Mapping[str, str], code: Code, store: Store) -> Source:
    """Find the source of an argument of a drawing function in a recipe, from a text such as
    ``psf[mask]``.

    The module `contents` lists all forms of this text. ``store`` has the measurements of studies.
    """
    if need.startswith(_MEASURED):
        return _variants(need.removeprefix(_MEASURED), recipe, code, store)
    # the node of a step, as a function
    if need.endswith("()"):
        step = _step(need[:-2], recipe)
        params = [[name, plain(value)] for name, value in step.params.items()]
        return Source((), lambda values: Bound(step), [step.node.path, code_of(step, code), params])
    if match := _PARAMETER.fullmatch(need):
        value = _parameter(match["step"], match["name"], recipe)
        return Source((), lambda values: value, plain(value))
    # all copies of a step
    if need.endswith("*]"):
        return _items(need[:-2], recipe, keys)
    _step(need, recipe)
    if need not in keys:
        raise Missing(f"no output of this run needs the step {need}")
    return Source((need,), lambda values: values[need], keys[need])


def _variants(family: str, recipe: Recipe, code: Code, store: Store) -> Source:
    """Find the errors and run times of the variants of a step, which a study of accuracy has
    measured.
    """
    if not any(name.partition("[")[0] == family for name in recipe.steps):
        raise Missing(f"the recipe has no step {family}")
    rows = variants_of(recipe, family, store, code)
    if not rows:
        raise Missing(
            f"`neusee study accuracy {recipe.name}` measures it, and the next run shows it"
        )
    return Source((), lambda values: rows, rows)


def _parameter(step: str, name: str, recipe: Recipe) -> Any:
    """Return a parameter of a step, or a dictionary with the parameter of each copy of a step
    such as ``line[*]``.
    """
    if not step.endswith("*]"):
        return _step(step, recipe).params.get(name)
    prefix = step[:-2]
    return {
        copy_name[len(prefix) : -1]: copy.params.get(name)
        for copy_name, copy in recipe.steps.items()
        if copy_name.startswith(prefix)
    }


def is_table(value: Any) -> bool:
    """Return True for a parameter that is a file or coefficients, or a dictionary with such a
    parameter.
    """
    if isinstance(value, Mapping):
        return any(isinstance(item, Path | tuple) for item in value.values())
    return isinstance(value, Path)


def _step(name: str, recipe: Recipe) -> Step:
    """Return a step of the recipe; raise `Missing` if it has none of this name."""
    if name not in recipe.steps:
        raise Missing(f"the recipe has no step {name}")
    return recipe.steps[name]


def _items(prefix: str, recipe: Recipe, keys: Mapping[str, str]) -> Source:
    """Find all copies of a step from the beginning of their names, such as ``spot[mask,``."""
    copy_of_item = {
        copy_name[len(prefix) : -1]: copy_name
        for copy_name in recipe.steps
        if copy_name.startswith(prefix) and copy_name in keys
    }
    if not copy_of_item:
        raise Missing(f"the recipe has no step {prefix}…]")
    identity = [[item, keys[name]] for item, name in copy_of_item.items()]
    return Source(
        tuple(copy_of_item.values()),
        lambda values: {item: values[name] for item, name in copy_of_item.items()},
        identity,
    )
