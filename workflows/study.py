"""Studies of a recipe: what its numbers are worth, where it breaks, and what it need not compute.

    study.accuracy(load("first_light"))     error against run time, over tolerances and knobs
    study.stability(load("first_light"))    stiff and extreme cases against float64
    study.leave_out(load("first_light"))    each omission beside the full computation

Each writes a folder with a page, a table and pictures, and goes on where it was interrupted.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from neusee.workflows._graph import Recipe
from neusee.workflows._remote import open_store
from neusee.workflows._store import Store

KINDS = ("accuracy", "stability", "leave-out")


def accuracy(recipe: Recipe, **how: Any) -> Path:
    """Error against run time of the recipe and of its steps; see `made`."""
    return made("accuracy", recipe, **how)


def stability(recipe: Recipe, **how: Any) -> Path:
    """Stiff and extreme cases, forward and gradient, against float64; see `made`."""
    return made("stability", recipe, **how)


def leave_out(recipe: Recipe, **how: Any) -> Path:
    """Runs with and without each omission, and whether its bound holds; see `made`."""
    return made("leave-out", recipe, **how)


def made(
    kind: str,
    recipe: Recipe,
    store: Store | None = None,
    runs: Path = Path("runs"),
    command: Sequence[str] = (),
    tell: Callable[[str], None] = lambda line: None,
    **options: Any,
) -> Path:
    """Make one of `KINDS` and give its folder.

    Args: store: where its points are kept, so that it goes on where it was interrupted. runs: where
    the folder is made. tell: is given a line for each point that is done. options: of the kind of study.
    """
    from neusee.workflows import _study_accuracy, _study_leave_out, _study_stability

    studies = {"accuracy": _study_accuracy, "stability": _study_stability, "leave-out": _study_leave_out}
    folder: Path = studies[kind].study(recipe, store or open_store(), runs, list(command), tell, **options)
    return folder


def failed(folder: Path) -> int:
    """How many cells or bounds of a finished study do not hold."""
    found: dict[str, Any] = json.loads((folder / "provenance.json").read_text())
    return int(found.get("failed", 0))
