"""Each omission beside the full computation: its bound, its measured change, and the time that it saves.

The full computation is the recipe with everything kept. Against it stand the recipe as it chooses, and the full one
with one omission alone; and against the recipe as it chooses, the same with one omission put back. Steps come from
the store wherever they can, and a row that was measured is kept there too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from torch import Tensor

from neusee.nodes import TensorStats
from neusee.workflows.engine.finished_step import facts_in
from neusee.workflows.engine.resolve_keys import resolve
from neusee.workflows.engine.runner import Result, run
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.keys.cache_key import Key, digest
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.store.memo import compute_once
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.leave_out.possible_omissions import Omission, omissions
from neusee.workflows.tolerance.error_norm import error_of, largest_error

_SURE = 4.0  #: standard errors by which a mean over pixels may differ from that over the noise
_ABOUT = {"step": "study leave-out"}
_ROUNDING = 2e-7  #: of a sum in float32, as a share of its largest element


@dataclass(frozen=True)
class OmissionRow:
    """One omission and its measured effect; errors as shares of the largest element."""

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
class OutputError:
    """The error of an output of the recipe as it chooses, against everything in full."""

    output: str
    bound: float | None  #: that the engine proved
    rms: float
    largest: float
    holds: bool


class OmissionComparison:
    """The full computation, the recipe as it chooses, and the recipe with one omission at a time."""

    def __init__(self, recipe: Recipe, store: Store) -> None:
        self.recipe, self.store = recipe, store
        self.full = replace(recipe, exact=True)
        self.truth = run(self.full, store)
        self.chosen = run(recipe, store)
        self.found = list(omissions(self.full, self.chosen, self.facts))

    def facts(self, step: str) -> TensorStats | None:
        """Return the statistics of a step in full, from the metadata where the store has them."""
        return facts_in(self.store.about(self.truth.keys[step])) or TensorStats.of(self.truth.value(step))

    def output_errors(self) -> list[OutputError]:
        """Return the error of each output of the recipe as it chooses."""
        found = []
        for name in self.recipe.outputs:
            value, reference = self.chosen.values[name], self.truth.values[name]
            rms, bound = error_of(value, reference), self.chosen.proof.of(name)
            holds = rms <= min(self.recipe.tolerance, math.inf if bound is None or self.chosen.recipe.exact else bound)
            found.append(OutputError(name, bound, rms, largest_error(value, reference), holds))
        return found

    def rows(self) -> Iterator[OmissionRow]:
        """Yield a row for each omission, from the store or measured now."""
        for omission in self.found:
            alone = omission.applied_to(self.full)
            yield compute_once(
                self.store, self._key(omission, alone), OmissionRow, partial(self._row, omission, alone), _ABOUT
            )

    def _row(self, omission: Omission, alone: Recipe) -> OmissionRow:
        seen = run(alone, self.store, tuple(omission.value_of(name) for name in omission.at))
        bounds = _bounds(omission, seen)
        pairs = {name: (seen.values[omission.value_of(name)], self.truth.value(name)) for name in omission.at}
        largest = max(largest_error(*pair) for pair in pairs.values())
        return OmissionRow(
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
        """Return the errors of the outputs by the omission alone, and with it put back; 0 where nothing changed."""
        if not changed:
            return dict.fromkeys(self.recipe.outputs, 0.0), 0.0 if omission.taken else None
        outputs = _worst_by_name(self.recipe.outputs, alone.outputs, run(alone, self.store), self.truth)
        return outputs, self._back(omission) if omission.taken else None

    def _holds(self, omission: Omission, bound: float, pair: tuple[Any, Any], result: Result) -> bool:
        """Return True if a change is within its bound: on average for noise and sums over bands, else everywhere."""
        if omission.kind == "stands in":  # both forms have an agreed error of their own
            agreed = [max(r.steps[n].node.rtol for n in names) for r, names in self._forms(omission, result)]
            return error_of(*pair) <= bound + sum(agreed)
        if omission.kind == "handed on" and self.full.steps[omission.name].node.random:
            return least_error(*pair) <= bound
        return largest_error(*pair) <= bound * (1 + 1e-5) + (_ROUNDING if bound else 0.0)

    def _forms(self, omission: Omission, result: Result) -> list[tuple[Recipe, Iterable[str]]]:
        return [(self.full, omission.exchange), (result.recipe, omission.exchange.values()), (self.full, omission.at)]

    def _back(self, omission: Omission) -> float:
        """Return the worst error of the recipe as it chooses, against the same with one omission put back."""
        recipe = self.full
        for other in reversed(self.found):  # the last first, for what is handed on may be left out itself
            if other.taken and other is not omission:
                recipe = other.applied_to(recipe)
        return max(_worst_by_name(self.recipe.outputs, recipe.outputs, run(recipe, self.store), self.chosen).values())

    def _seconds(self, one: Recipe, other: Recipe) -> float:
        """Return the seconds of the steps that only ``one`` needs."""
        keys = resolve(one, order := needed(one, one.outputs), self.store).keys
        only = [keys[name] for name in order if name not in set(needed(other, other.outputs))]
        return sum(float((self.store.about(key) or {}).get("seconds", 0.0)) for key in only)

    def _key(self, omission: Omission, alone: Recipe) -> Key:
        """Return what decides a row: both forms, what is chosen beside them, the bound, and the comparing code."""
        said = [[resolve(r, needed(r, r.outputs), self.store).keys[n] for n in r.outputs] for r in (self.full, alone)]
        chosen = [[name, self.chosen.keys[name]] for name in self.recipe.outputs]
        told = [omission.name, omission.kind, repr(omission.bound), omission.why, omission.taken]
        return digest("leave-out", said, chosen, told, engine("studies.leave_out.omission_rows"))


def _worst_by_name(names: Sequence[str], made: Sequence[str], result: Result, truth: Result) -> dict[str, float]:
    pairs = zip(names, made, strict=True)
    return {name: error_of(result.values[other], truth.values[name]) for name, other in pairs}


def _bounds(omission: Omission, result: Result) -> dict[str, float]:
    """Return a bound for each step to look at: the stated bound, or for sums over bands the proved bound."""
    if omission.kind != "stands in":
        return dict.fromkeys(omission.at, omission.bound)
    told = {name: result.proof.of(name) for name in omission.at}
    return {name: bound for name, bound in told.items() if bound is not None}


def least_error(value: Tensor, reference: Tensor) -> float:
    """Return the least root mean square over all noise, over the largest element, that one draw of the noise allows.

    Pixels are draws. Where rare large pixels decide the mean of the squares, its standard error is as large as the
    mean. The largest element was drawn too, and may lie as far above its own mean.
    """
    change = value.double() - reference.double()
    squares, count = change.square(), change.numel()
    mean = float(squares.mean())
    error = float(squares.std()) / math.sqrt(count) if count > 1 else mean
    top = float(reference.double().abs().max()) + _SURE * (float(change.std()) if count > 1 else 0.0)
    least = math.sqrt(max(mean - _SURE * error, 0.0))
    return least / top if top > 0 else least
