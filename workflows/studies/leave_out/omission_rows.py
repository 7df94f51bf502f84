"""Each omission beside the full computation: what it changes, at most and in truth, and what it saves.

The full computation is the recipe with everything kept. Against it stand the recipe as it chooses, and the full one
with one omission alone; and against the recipe as it chooses, the same with one omission put back. Steps come from
the store wherever they can, and a row that was measured is kept there too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from torch import Tensor

from neusee.nodes import TensorStats
from neusee.workflows.engine.finished_step import facts_in
from neusee.workflows.engine.provenance import timestamp
from neusee.workflows.engine.resolve_keys import resolve
from neusee.workflows.engine.runner import Result, run
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.keys.cache_key import Key, digest
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.leave_out.possible_omissions import Omission, omissions
from neusee.workflows.tolerance.error_norm import error_of, largest_error

_SURE = 4.0  #: standard errors that a mean over pixels may lie beside that over the noise
_ROUNDING = 2e-7  #: of a sum in float32, as a share of its largest element


@dataclass(frozen=True)
class Row:
    """One omission and what was found of it; errors as shares of the largest element."""

    name: str
    kind: str
    why: str
    taken: bool
    bound: float
    rms: float  #: at the step, or at what reads it
    largest: float
    outputs: dict[str, float]  #: root mean square, of this alone against everything in full
    back: float | None  #: root mean square, of the worst output of the recipe as it chooses, with this put back
    seconds: float  #: that its steps took
    holds: bool


@dataclass(frozen=True)
class Promise:
    """An output of the recipe as it chooses, against everything in full."""

    output: str
    bound: float | None  #: that the engine proved
    rms: float
    largest: float
    holds: bool


class Bench:
    """The full computation, the recipe as it chooses, and one omission at a time."""

    def __init__(self, recipe: Recipe, store: Store) -> None:
        self.recipe, self.store = recipe, store
        self.full = replace(recipe, exact=True)
        self.truth = run(self.full, store)
        self.chosen = run(recipe, store)
        self.found = list(omissions(self.full, self.chosen, self.facts))

    def facts(self, step: str) -> TensorStats | None:
        """Facts of a step in full, without reading it where they are stored."""
        return facts_in(self.store.about(self.truth.keys[step])) or TensorStats.of(self.truth.value(step))

    def promises(self) -> list[Promise]:
        """What became of each output of the recipe as it chooses."""
        found = []
        for name in self.recipe.outputs:
            value, reference = self.chosen.values[name], self.truth.values[name]
            rms, bound = error_of(value, reference), self.chosen.proof.of(name)
            holds = rms <= min(self.recipe.tolerance, math.inf if bound is None or self.chosen.recipe.exact else bound)
            found.append(Promise(name, bound, rms, largest_error(value, reference), holds))
        return found

    def rows(self) -> Iterator[Row]:
        """A row for each omission, from the store where it was measured before."""
        for omission in self.found:
            alone = omission.made(self.full)
            key = self._key(omission, alone)
            if not self.store.has(key):
                about = {"step": "study leave-out", "seconds": 0.0, "date": timestamp()}
                self.store.put(key, asdict(self._row(omission, alone)), about)
            yield Row(**self.store.get(key))

    def _row(self, omission: Omission, alone: Recipe) -> Row:
        seen = run(alone, self.store, tuple(omission.value_of(name) for name in omission.at))
        bounds = _bounds(omission, seen)
        pairs = {name: (seen.values[omission.value_of(name)], self.truth.value(name)) for name in omission.at}
        largest = max(largest_error(*pair) for pair in pairs.values())
        return Row(
            omission.name,
            omission.kind,
            omission.why,
            omission.taken,
            max(bounds.values(), default=math.inf),
            max(error_of(*pair) for pair in pairs.values()),
            largest,
            *self._reached(omission, alone, changed=largest > 0),
            self._seconds(self.full, alone) - self._seconds(alone, self.full),
            all(self._holds(omission, bound, pairs[name], seen) for name, bound in bounds.items()),
        )

    def _reached(self, omission: Omission, alone: Recipe, changed: bool) -> tuple[dict[str, float], float | None]:
        """What comes of it at the outputs, alone and put back; where nothing was changed, nothing does."""
        if not changed:
            return dict.fromkeys(self.recipe.outputs, 0.0), 0.0 if omission.taken else None
        outputs = _worst_by_name(self.recipe.outputs, alone.outputs, run(alone, self.store), self.truth)
        return outputs, self._back(omission) if omission.taken else None

    def _holds(self, omission: Omission, bound: float, pair: tuple[Any, Any], result: Result) -> bool:
        """Whether a change keeps to its bound: of noise and of what stands in on average, of all else the largest."""
        if omission.kind == "stands in":  # both forms have an agreed error of their own
            agreed = [max(r.steps[n].node.rtol for n in names) for r, names in self._forms(omission, result)]
            return error_of(*pair) <= bound + sum(agreed)
        if omission.kind == "handed on" and self.full.steps[omission.name].node.random:
            return surely(*pair) <= bound
        return largest_error(*pair) <= bound * (1 + 1e-5) + (_ROUNDING if bound else 0.0)

    def _forms(self, omission: Omission, result: Result) -> list[tuple[Recipe, Iterable[str]]]:
        return [(self.full, omission.exchange), (result.recipe, omission.exchange.values()), (self.full, omission.at)]

    def _back(self, omission: Omission) -> float:
        """The worst output of the recipe as it chooses, against the same with one omission put back."""
        recipe = self.full
        for other in reversed(self.found):  # the last first, for what is handed on may be left out itself
            if other.taken and other is not omission:
                recipe = other.made(recipe)
        return max(_worst_by_name(self.recipe.outputs, recipe.outputs, run(recipe, self.store), self.chosen).values())

    def _seconds(self, one: Recipe, other: Recipe) -> float:
        """What the steps took that only ``one`` needs."""
        keys = resolve(one, order := needed(one, one.outputs), self.store).keys
        only = [keys[name] for name in order if name not in set(needed(other, other.outputs))]
        return sum(float((self.store.about(key) or {}).get("seconds", 0.0)) for key in only)

    def _key(self, omission: Omission, alone: Recipe) -> Key:
        """What decides a row: both forms with all that is chosen beside it, the bound, and how they are compared."""
        said = [[resolve(r, needed(r, r.outputs), self.store).keys[n] for n in r.outputs] for r in (self.full, alone)]
        chosen = [[name, self.chosen.keys[name]] for name in self.recipe.outputs]
        told = [omission.name, omission.kind, repr(omission.bound), omission.why, omission.taken]
        return digest("leave-out", said, chosen, told, engine("studies.leave_out.omission_rows"))


def _worst_by_name(names: Sequence[str], made: Sequence[str], result: Result, truth: Result) -> dict[str, float]:
    pairs = zip(names, made, strict=True)
    return {name: error_of(result.values[other], truth.values[name]) for name, other in pairs}


def _bounds(omission: Omission, result: Result) -> dict[str, float]:
    """By step that is looked at: what was stated, or what the engine proved of a reader of what stands in."""
    if omission.kind != "stands in":
        return dict.fromkeys(omission.at, omission.bound)
    told = {name: result.proof.of(name) for name in omission.at}
    return {name: bound for name, bound in told.items() if bound is not None}


def surely(value: Tensor, reference: Tensor) -> float:
    """What the root mean square over all noise is at least, over the largest element, from one draw of it.

    Pixels are draws; rare large ones leave the mean of their squares unsure by as much as it is. The largest element
    was drawn too, and may lie as far above.
    """
    change = value.double() - reference.double()
    squares, count = change.square(), change.numel()
    mean = float(squares.mean())
    error = float(squares.std()) / math.sqrt(count) if count > 1 else mean
    top = float(reference.double().abs().max()) + _SURE * (float(change.std()) if count > 1 else 0.0)
    least = math.sqrt(max(mean - _SURE * error, 0.0))
    return least / top if top > 0 else least
