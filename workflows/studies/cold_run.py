"""Cold runs of a recipe: each begins with an empty store, so that it computes every needed step."""

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
    """Yield an empty store with a copy of the code digests in ``store``, and delete the empty store afterwards."""
    with TemporaryDirectory(prefix="neusee-") as folder:
        if os.path.isfile(store.code_memo):
            shutil.copyfile(store.code_memo, Path(folder) / store.code_memo.name)
        yield Store(folder)


def run_cold(recipe: Recipe, store: Store, device: str = "cpu") -> Result:
    """Return the result of a cold run on ``device``."""
    with cold(store) as empty:
        return run(recipe, empty, device=device)


def key_parts(recipe: Recipe, code: Code, device: str = "cpu") -> list[Any]:
    """Return the parts of a store key that identify a run: the keys of the outputs, the tolerance and ``exact``."""
    keys: dict[str, Key] = {}
    for name in needed(recipe, recipe.outputs):
        keys[name], _ = key_of(recipe.steps[name], keys, recipe.seed, code, device)
    return [[keys[name] for name in recipe.outputs], recipe.tolerance, recipe.exact]
