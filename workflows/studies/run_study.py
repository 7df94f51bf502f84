"""Studies of a recipe: accuracy, stability, left-out steps, calibration, uncertainty and equal
protection.

    study_recipe("accuracy", load("first_light"))       error against run time
    study_recipe("stability", load("first_light"))      stiff and extreme cases against float64
    study_recipe("leave-out", load("first_light"))      each omission against the full computation
    study_recipe("calibration", load("calibrate"))      posterior of simulated sensors against truth
    study_recipe("uncertainty", noisy)                  scatter of outputs
    study_recipe("protection", load("five_half_rings"))  mask, filters and stops of equal protection

where ``noisy = load("first_light", ["sensor.read_noise=normal(10.5 e-, 0.5 e-)"])``. Each study
writes a folder with a page, a table and pictures, and continues after an interruption.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from neusee.workflows.engine.runner import Result, run
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.keys.cache_key import Key, key_of
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.sealed_files import text_of
from neusee.workflows.report.study_report import StudyOutcome, StudyRun
from neusee.workflows.store.remote_store import open_store
from neusee.workflows.store.result_store import Store


class StudyRefused(ValueError):
    """Error for a study whose recipe or options leave nothing to study; the message says how to fix
    it.
    """


KINDS = ("accuracy", "stability", "leave-out", "calibration", "uncertainty", "protection")


def study_recipe(
    kind: str,
    recipe: Recipe,
    store: Store | None = None,
    runs: Path = Path("runs"),
    command: Sequence[str] = (),
    progress: Callable[[str], None] = lambda line: None,
    **options: Any,
) -> Path:
    """Run a study of ``recipe`` and return the folder of the study; ``kind`` is one of `KINDS`.

    Args:
        store: keeps finished parts, so that an interrupted study continues
        runs: the parent of the study's folder
        progress: is called with a line of text for each finished part
        options: arguments of the kind of study
    """
    module = import_module(f"neusee.workflows.studies.{kind.replace('-', '_')}_study")
    study_options = getattr(module, f"{kind.title().replace('-', '')}Options")(**options)
    study_run = StudyRun(kind, recipe, command)
    outcome: StudyOutcome = module.study(recipe, store or open_store(), progress, study_options)
    document = study_run.document(outcome.content)
    return study_run.write(runs, outcome.key, document, outcome.report)


def count_failures(folder: Path) -> int:
    """Return the number of failed tests of a finished study, from its ``provenance.json``."""
    document: dict[str, Any] = json.loads(text_of(folder / "provenance.json"))
    return int(document.get("failed", 0))


# --- cold runs ------------------------------------------------------------------------------------

# Cold runs start with an empty store and compute every step that the outputs depend on.


@contextmanager
def cold(store: Store) -> Iterator[Store]:
    """Yield a temporary store that has the code digests of ``store`` but no results; delete it
    afterwards.
    """
    with TemporaryDirectory(prefix="neusee-") as folder:
        if os.path.isfile(store.code_memo):
            shutil.copyfile(store.code_memo, Path(folder) / store.code_memo.name)
        yield Store(folder)


def run_cold(recipe: Recipe, store: Store, device: str = "cpu") -> Result:
    """Run ``recipe`` on ``device`` with an empty temporary store, and return the result."""
    with cold(store) as empty_store:
        return run(recipe, empty_store, device=device)


def key_parts(recipe: Recipe, code: Code, device: str = "cpu") -> list[Any]:
    """Return the parts of a store key that identify a run: output keys, tolerance, and flags for
    exact computation and estimates.
    """
    keys: dict[str, Key] = {}
    for name in needed(recipe, recipe.outputs):
        keys[name], _ = key_of(recipe.steps[name], keys, recipe.seed, code, device)
    return [
        [keys[name] for name in recipe.outputs],
        recipe.tolerance,
        recipe.exact,
        recipe.estimates,
    ]
