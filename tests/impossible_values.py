"""Values that no number of a recipe can have, written in place of each number of the packaged
recipes.
"""

from __future__ import annotations

import random
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neusee.nodes.units import read_written
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import Diagnostic, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.graph.step_shapes import tensors_of
from neusee.workflows.recipe.loading import load, recipes
from neusee.workflows.store.result_store import Store

NUMBERS = ("0", "-1", ".nan", ".inf", "-.inf", "1e30", "-1e30", "1e-30")
OTHERS = ("1 parsec", "3 kg", "red", "true", "[]", "{}", "''")
#: words of a programmer, which no message to a user has
RAW = (
    "Traceback",
    "Error(",
    "aten::",
    "NoneType",
    "tensor(",
    "math domain",
    "float division",
    "Input should",
    "nan, nan",
)


@dataclass(frozen=True)
class Case:
    """A change of one number of a packaged recipe."""

    recipe: str
    path: str
    text: str

    @property
    def change(self) -> str:
        return f"{self.path}={self.text}"


def cases(share: float = 1.0, seed: int = 0) -> list[Case]:
    """Return a share of all changes of numbers of the packaged recipes, drawn with a seed.

    A number that several recipes take from the same place is changed once.
    """
    seen: dict[tuple[str, str, str], None] = {}
    found: list[Case] = []
    for title in recipes():
        for path, setting in load(title.name).config.settings.items():
            place = (path, str(setting.value), setting.source)
            if place not in seen and _has_number(setting.value) and not path.startswith("expect."):
                seen[place] = None
                found += (Case(title.name, path, text) for text in _texts(setting.value))
    draw = random.Random(seed)
    return [case for case in found if draw.random() < share]


def _has_number(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return any(map(_has_number, value))
    return not isinstance(value, bool) and _unit(value) is not None


def _unit(value: Any) -> str | None:
    """Return the unit that is written behind a number, "" without a unit; None if the text is
    not a number.
    """
    if value is None or isinstance(value, dict):
        return None
    try:
        read_written(value)
    except ValueError:
        return None
    return str(value).strip().lstrip("+-.0123456789eE ").strip() if isinstance(value, str) else ""


def _texts(value: Any) -> Iterator[str]:
    if not isinstance(value, list | tuple):
        unit = _unit(value)
        yield from (f"{number} {unit}".strip() for number in NUMBERS)
        yield from OTHERS
        return
    shown = [str(part) for part in value]
    for number in NUMBERS:
        yield _list([f"{number} {_unit(value[0]) or ''}".strip(), *shown[1:]])
    yield from (
        "[]",
        _list(shown * 7),
        _list(shown[:-1] or [_list(shown)]),
        "red",
        "true",
        _list(["red"] * len(shown)),
    )


def _list(parts: list[str]) -> str:
    return f"[{', '.join(parts)}]"


@dataclass(frozen=True)
class Outcome:
    """What a check of a changed recipe gave: the recipe, or the diagnostics of its refusal, or
    what must not be.
    """

    case: Case
    recipe: Recipe | None = None
    refusal: tuple[Diagnostic, ...] = ()
    fault: str = ""


def outcome(case: Case) -> Outcome:
    """Check a changed recipe; a warning, an error of Python and a refusal without a place are
    faults.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return Outcome(case, recipe=load(case.recipe, [case.change]))
        except RecipeError as error:
            faults = [fault for one in error.diagnostics if (fault := _fault(one))]
            return Outcome(case, refusal=tuple(error.diagnostics), fault="; ".join(faults))
        except Exception as error:
            return Outcome(case, fault=f"{type(error).__name__}: {error}")


def _fault(refusal: Diagnostic) -> str:
    """Return what is wrong with a refusal: no place, no sentence, or words of a programmer."""
    if not refusal.mark.line and not refusal.mark.file.startswith("argument"):
        return f"no line: {refusal}"
    if not refusal.message or any(word in refusal.message for word in RAW):
        return f"no sentence for a user: {refusal.message!r}"
    return ""


#: the camera of the paper, small enough to run in a moment
SMALL = {
    "optics.samples": "64",
    "optics.pitch": "126.22 um",
    "optics.bands": "3",
    "optics.window": "[32, 32]",
    "scene.shape": "[28, 28]",
    "sensor.shape": "[24, 24]",
    "outputs": "[raw, lsr, bsr, saturated]",
}


def fault_of_run(case: Case, folder: Path) -> str | None:
    """Return what must not be in a small run of a changed recipe, "" for a good run, and None for a
    refusal.

    A warning, an error of a step and an output that is not finite must not be.
    """
    small = [f"{path}={text}" for path, text in SMALL.items() if path != case.path]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            recipe = load(case.recipe, [*small, case.change])
        except RecipeError:
            return None
        try:
            result = run(recipe, Store(folder))
        except Exception as error:
            return f"{type(error).__name__}: {error}"
    wrong = [
        name for name, value in result.values.items() if not all(map(_is_finite, tensors_of(value)))
    ]
    return f"not finite: {', '.join(wrong)}" if wrong else ""


def _is_finite(tensor: Tensor) -> bool:
    return bool(torch.isfinite(tensor).all())
