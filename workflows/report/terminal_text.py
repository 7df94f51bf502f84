"""Text for a terminal: tables, the commands to try next, and a result as JSON."""

from __future__ import annotations

import json
import math
import re
import shlex
import textwrap
from collections.abc import Callable, Sequence
from shutil import get_terminal_size
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Recipe


# --- text table -----------------------------------------------------------------------------------

# Tables as lines of text, in which each column is as wide as its widest cell.


Rows = Sequence[Sequence[str]]


def columns(rows: Rows, numbers: str = "<", gap: str = "  ") -> list[str]:
    """Return a line of text for each table row, with the first column aligned left.

    ``numbers`` aligns all other columns left (``<``) or right (``>``).
    """
    widths = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
    forms = [f"{'<' if column == 0 else numbers}{width}" for column, width in enumerate(widths)]
    return [
        gap.join(f"{cell:{form}}" for cell, form in zip(row, forms, strict=True)).rstrip()
        for row in rows
    ]


def indented(rows: Rows) -> list[str]:
    """Return an indented line of text for each table row, with numbers aligned right and a dash
    for an empty cell.
    """
    rows_without_gaps = [[name, *(cell or "–" for cell in cells)] for name, *cells in rows]
    return [f"  {line}" for line in columns(rows_without_gaps, ">", "  ")]


def wrapped(text: str) -> list[str]:
    """Return a text as indented lines that are no wider than the terminal."""
    return textwrap.wrap(
        text, get_terminal_size().columns, initial_indent="  ", subsequent_indent="  "
    )


def lasts(seconds: float) -> str:
    """Return a duration in words, such as ``3 h 05 min``, ``2 min 10 s`` or ``4 s``."""
    rounded = round(seconds)
    if rounded >= 3600:
        return f"{rounded // 3600} h {rounded % 3600 // 60:02} min"
    return f"{rounded // 60} min {rounded % 60:02} s" if rounded >= 60 else f"{rounded} s"


# --- json output ----------------------------------------------------------------------------------

# The result of a command as JSON, as the option ``--json`` prints it.


def json_line(document: dict[str, Any]) -> str:
    """Return the result of a command as one JSON object on one line of ASCII, which each terminal
    can show.

    A number that is not finite is null.
    """
    return json.dumps(_finite(document), default=str, allow_nan=False)


def _finite(value: Any) -> Any:
    """Return a value for JSON: with text as keys, lists, and null for a number that
    is not finite.
    """
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


# --- next commands --------------------------------------------------------------------------------

# The commands to try after a run.


def commands_to_try(
    recipe: Recipe, words: Sequence[str], works: Callable[[Sequence[str]], bool]
) -> list[str]:
    """Return three commands to try after a run, each with a comment, quoted for a shell.

    ``words`` are the name and the changes of the recipe, as the user wrote them. ``works`` tells
    whether a recipe with its changes can be loaded.
    """
    noise = "sensor.read_noise"
    changed_recipes = {
        "only what follows is run": _with(words, f"{noise}=20 e-")
        if noise in recipe.config.settings
        else [],
        "another mask": _with(words, f"doe={_another_mask(recipe)}")
        if "height" in recipe.steps
        else [],
    }
    loadable = {
        purpose: changed_words
        for purpose, changed_words in changed_recipes.items()
        if changed_words and works(changed_words)
    }
    commands_with_comments = [
        [shlex.join(["neusee", "run", *changed_words]), f"# {purpose}"]
        for purpose, changed_words in loadable.items()
    ]
    commands_with_comments += [
        [shlex.join(["neusee", "plan", *words]), "# what would run, how long"],
        ["neusee nodes optics.psf", "# what a step computes, and its source"],
        ["neusee recipes", "# what else there is"],
    ]
    # the recipe's own commands first, then general ones
    return columns(commands_with_comments[:3], gap="   ")


def _another_mask(recipe: Recipe) -> str:
    """Return the name of a mask that the recipe does not have."""
    return "axicon" if recipe.steps["height"].node.path == "doe.vortex" else "vortex"


def _with(words: Sequence[str], change: str) -> list[str]:
    """Return the words of a recipe with one more change, in place of changes of the same value
    or of a part of it.
    """
    path = change.partition("=")[0]
    same_value = re.compile(rf"[~+]?{re.escape(path)}([.=]|$)")
    return [*(word for word in words if not same_value.match(word)), change]
