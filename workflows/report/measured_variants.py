"""Errors and run times of variants of a step, as the accuracy study measured them, for the pictures of later runs."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from neusee.workflows.engine.provenance import machine, timestamp
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.keys.cache_key import code_of, digest, plain
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.store.result_store import Store

Row = tuple[Any, ...]  #: property that is changed, new value, error, seconds


def keep_variants(recipe: Recipe, step: str, rows: Sequence[Row], store: Store) -> None:
    """Keep the errors and run times of the variants of a step, for recipes with this step, its inputs and machine."""
    if rows:
        about = {"step": f"variants of {step}", "date": timestamp(), "seconds": 0.0}
        store.put(_key(recipe, step, Code(store.code_memo)), [list(row) for row in rows], about)


def variants_of(recipe: Recipe, family: str, store: Store, code: Code) -> list[Row]:
    """Return the errors and run times of the variants of a step such as ``psf``, of any item; none if not measured."""
    for name in recipe.steps:
        if name.partition("[")[0] == family:
            with suppress(KeyError):
                rows = store.get(_key(recipe, name, code), list)
                return [(str(line), str(label), float(error), float(took)) for line, label, error, took in rows]
    return []


def _key(recipe: Recipe, step: str, code: Code) -> str:
    """Return the key of the variants of a step: its code, and the parameters of the step and of all steps before it."""
    before = [recipe.steps[name] for name in needed(recipe, (step,))]
    params = [[s.node.path, {name: plain(value) for name, value in s.params.items()}] for s in before]
    return digest("variants of a step", step, code_of(recipe.steps[step], code), params, machine())
