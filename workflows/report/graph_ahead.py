"""The picture of the graph of a run, begun as soon as the state of each step at the end can be foreseen.

Where a state is another one in the end, the report draws the graph again, under another key.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.graph.step_record import StepRecord
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.report.contents import wanted
from neusee.workflows.report.files_beside import FilesBeside
from neusee.workflows.report.run_pictures import GRAPH_DRAWING, graphs, states_of
from neusee.workflows.store.result_store import Store


class GraphAhead:
    """A function of each result of a run, which begins the graph when the keys of all steps are known.

    Args: beside: draws the graph. done: the records of the steps that have finished, which the run fills.
    """

    def __init__(self, beside: FilesBeside, store: Store, done: Mapping[str, StepRecord]) -> None:
        self._beside, self._store, self._done = beside, store, done
        self._recipe: Recipe | None = None
        self._order: Sequence[str] = ()

    def __call__(self, recipe: Recipe, keys: Mapping[str, Key], step: str, value: Any) -> None:
        """Take note of a result; begin the graph, once for each recipe."""
        if recipe is not self._recipe:  # the first result, or a run that begins again with a smaller tolerance
            self._recipe, self._order = recipe, needed(recipe, wanted(recipe))
        if self._order and len(keys) >= len(self._order):
            for key, arguments in graphs(recipe, self._foreseen(keys)):
                self._beside.add("graph", key, GRAPH_DRAWING, arguments)
            self._order = ()

    def _foreseen(self, keys: Mapping[str, Key]) -> dict[str, str]:
        """Return the state of each step at the end: what is not stored runs, and equal results are computed once."""
        known = states_of({name: self._done[name] for name in self._order if name in self._done})
        seen, states = set[Key](), dict[str, str]()
        for name in self._order:
            there = keys[name] in seen or self._store.has(keys[name])
            states[name] = known.get(name) or ("cached" if there else "run")
            seen.add(keys[name])
        return states
