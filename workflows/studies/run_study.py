"""Studies of a recipe: what its numbers are worth, where it breaks, and what it need not compute.

    study.accuracy(load("first_light"))     error against run time, over tolerances and knobs
    study.stability(load("first_light"))    stiff and extreme cases against float64
    study.leave_out(load("first_light"))    each omission beside the full computation
    study.calibration(load("calibrate"))    whether the posterior of a sensor is right, by simulations
    study.uncertainty(load("first_light", ["sensor.read_noise=normal(10.5 e-, 0.5 e-)"]))    what outputs are worth

Each writes a folder with a page, a table and pictures, and goes on where it was interrupted.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.store.remote_store import open_store
from neusee.workflows.store.result_store import Store

KINDS = ("accuracy", "stability", "leave-out", "calibration", "uncertainty")


def accuracy(recipe: Recipe, **how: Any) -> Path:
    """Error against run time of the recipe and of its steps; see `made`."""
    return made("accuracy", recipe, **how)


def stability(recipe: Recipe, **how: Any) -> Path:
    """Stiff and extreme cases, forward and gradient, against float64; see `made`."""
    return made("stability", recipe, **how)


def leave_out(recipe: Recipe, **how: Any) -> Path:
    """Runs with and without each omission, and whether its bound holds; see `made`."""
    return made("leave-out", recipe, **how)


def calibration(recipe: Recipe, **how: Any) -> Path:
    """Ranks of the truth among draws from the posterior of simulated frames; see `made`."""
    return made("calibration", recipe, **how)


def uncertainty(recipe: Recipe, **how: Any) -> Path:
    """How outputs scatter over draws of what the recipe is not sure of; see `made`."""
    return made("uncertainty", recipe, **how)


def made(
    kind: str,
    recipe: Recipe,
    store: Store | None = None,
    runs: Path = Path("runs"),
    command: Sequence[str] = (),
    progress: Callable[[str], None] = lambda line: None,
    **options: Any,
) -> Path:
    """Make one of `KINDS` and give its folder.

    Args: store: where its points are kept, so that it goes on where it was interrupted. runs: where
    the folder is made. tell: is given a line for each point that is done. options: of the kind of study.
    """
    room = kind.replace("-", "_")
    module = import_module(f"neusee.workflows.studies.{room}.{room}_study")
    folder: Path = module.study(recipe, store or open_store(), runs, list(command), progress, **options)
    return folder


def failed(folder: Path) -> int:
    """How many cells, bounds or bars of a finished study do not hold."""
    found: dict[str, Any] = json.loads((folder / "provenance.json").read_text())
    return int(found.get("failed", 0))
