"""Studies of a recipe: what its numbers are worth, where it breaks, and what it need not compute.

    made("accuracy", load("first_light"))       error against run time, over tolerances and knobs
    made("stability", load("first_light"))      stiff and extreme cases against float64
    made("leave-out", load("first_light"))      each omission beside the full computation
    made("calibration", load("calibrate"))      whether the posterior of a sensor is right, by simulations
    made("uncertainty", load("first_light", ["sensor.read_noise=normal(10.5 e-, 0.5 e-)"]))  what outputs are worth

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
    room = kind.replace("-", "_")
    module = import_module(f"neusee.workflows.studies.{room}.{room}_study")
    folder: Path = module.study(recipe, store or open_store(), runs, list(command), tell, **options)
    return folder


def failed(folder: Path) -> int:
    """How many cells, bounds or bars of a finished study do not hold."""
    found: dict[str, Any] = json.loads((folder / "provenance.json").read_text())
    return int(found.get("failed", 0))
