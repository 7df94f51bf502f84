"""The commands to try after a run."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from neusee.workflows.report.text_table import columns

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Recipe


def commands_to_try(recipe: Recipe, words: Sequence[str], works: Callable[[Sequence[str]], bool]) -> list[str]:
    """Return three commands to try after a run, each with a comment, quoted for a shell.

    ``words`` are the name and the changes of the recipe, as the user wrote them. ``works`` tells whether a recipe with
    its changes can be loaded.
    """
    noise = "sensor.read_noise"
    changed = {
        "only what follows is run": _with(words, f"{noise}=20 e-") if noise in recipe.config.settings else [],
        "another mask": _with(words, f"doe={_another_mask(recipe)}") if "height" in recipe.steps else [],
    }
    tried = {what: again for what, again in changed.items() if again and works(again)}
    shown = [[shlex.join(["neusee", "run", *again]), f"# {what}"] for what, again in tried.items()]
    shown += [
        [shlex.join(["neusee", "plan", *words]), "# what would run, how long"],
        ["neusee nodes optics.psf", "# what a step computes, and its source"],
        ["neusee recipes", "# what else there is"],
    ]
    return columns(shown[:3], gap="   ")


def _another_mask(recipe: Recipe) -> str:
    return "axicon" if recipe.steps["height"].node.path == "doe.vortex" else "vortex"


def _with(words: Sequence[str], change: str) -> list[str]:
    """Return the words of a recipe with one more change, in place of changes of the same value or of a part of it."""
    path = change.partition("=")[0]
    same = re.compile(rf"[~+]?{re.escape(path)}([.=]|$)")
    return [*(word for word in words if not same.match(word)), change]
