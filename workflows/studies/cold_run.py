"""Cold runs of a recipe, which start with an empty store and compute every step that the outputs
depend on.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from neusee.workflows.engine.runner import Result, run
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.keys.cache_key import Key, key_of
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.store.result_store import Store


@contextmanager
def cold(store: Store) -> Iterator[Store]:
    """Yield a temporary store with the code digests of ``store`` and no results, and delete the
    temporary store.
    """
    with TemporaryDirectory(prefix="neusee-") as folder:
        if os.path.isfile(store.code_memo):
            shutil.copyfile(store.code_memo, Path(folder) / store.code_memo.name)
        yield Store(folder)


def run_cold(recipe: Recipe, store: Store, device: str = "cpu") -> Result:
    """Run ``recipe`` on ``device`` with a temporary store that has no results, and return the
    result.
    """
    with cold(store) as empty_store:
        return run(recipe, empty_store, device=device)


def key_parts(recipe: Recipe, code: Code, device: str = "cpu") -> list[Any]:
    """Return the parts of a store key that identify a run: output keys, tolerance, and True for
    a full computation.
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
