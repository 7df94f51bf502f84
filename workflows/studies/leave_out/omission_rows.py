"""Comparison of a recipe with and without left-out steps: error bound, measured error and saved run time.

The full computation is the recipe without omissions. It is compared with the recipe with all omissions that the engine
chooses, and with one omission alone. The recipe with the chosen omissions is also compared with the same recipe after
one of the omissions is undone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
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
from neusee.workflows.tolerance.error_propagation import Kind

_SURE = 4.0  #: standard errors by which a mean over pixels may differ from the mean over all noise
_ABOUT = {"step": "study leave-out"}
_ROUNDING = 2e-7  #: rounding error of a sum in float32, relative to its largest element


@dataclass(frozen=True)
class OmissionRow:
    """The effect of left-out steps: error bound, errors relative to the largest element, and saved run time."""

    name: str
    kind: str
    why: str
    taken: bool
    bound: float
    rms: float  #: error at the step, or at the steps that read its result
    largest: float
    outputs: dict[str, float]  #: root mean square error of each output with this omission alone
    back: float | None  #: root mean square change of the worst output when this omission is undone
    seconds: float  #: run time that the omission saves
    holds: bool


@dataclass(frozen=True)
class OutputError:
    """The error of one output after the engine has left out steps, relative to the full computation."""

    output: str
    bound: float | None  #: error that the run states, as its page does; None if it is unknown
    kind: Kind
    rms: float
    largest: float
    holds: bool


class OmissionComparison:
    """The runs to compare: all steps computed, the engine's choice of steps left out, and each step left out alone."""

    def __init__(self, recipe: Recipe, store: Store) -> None:
        self.recipe, self.store = recipe, store
        self.full = replace(recipe, exact=True)
        self.truth = run(self.full, store)
        self.chosen = run(recipe, store)
        self.found = list(omissions(self.full, self.chosen, self.facts))

    def facts(self, step: str) -> TensorStats | None:
        """Return statistics of a step's result in the full computation, from the store's metadata if possible."""
        return facts_in(self.store.about(self.truth.keys[step])) or TensorStats.of(self.truth.value(step))

    def output_errors(self) -> list[OutputError]:
        """Return the error of each output after the engine has left out its choice of steps."""
        errors = []
        for name in self.recipe.outputs:
            value, reference = self.chosen.values[name], self.truth.values[name]
            rms, proved = error_of(value, reference), self.chosen.proof
            bound, kind = proved.stated_of(name), proved.kind_of(name)
            # beyond the tolerance only by what noise and rounding add, which the stated error counts
            holds = rms <= (self.recipe.tolerance if bound is None or self.chosen.recipe.exact else bound)
            errors.append(OutputError(name, bound, kind, rms, largest_error(value, reference), holds))
        return errors

    def rows(self) -> Iterator[OmissionRow]:
        """Yield the errors and saved run time of each omission of steps; measure the omissions that are not stored."""
        for omission in self.found:
            alone = omission.applied_to(self.full)
            key, compute = self._key(omission, alone), partial(self._row, omission, alone)
            yield compute_once(self.store, key, OmissionRow, compute, _ABOUT)

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
        """Return the error of each output with one omission of steps, and the change when this omission is undone."""
        if not changed:
            return dict.fromkeys(self.recipe.outputs, 0.0), 0.0 if omission.taken else None
        outputs = _errors(self.recipe.outputs, alone.outputs, run(alone, self.store), self.truth)
        return outputs, self._back(omission) if omission.taken else None

    def _holds(self, omission: Omission, bound: float, pair: tuple[Any, Any], result: Result) -> bool:
        """Return True if the bound holds for the rms error (noise and band sums) or the largest error (all others)."""
        if omission.kind == "stands in":  # both computations have a documented error of their own
            steps = [self.full.steps[name] for name in omission.exchange]
            cheaper = [result.recipe.steps[name] for name in omission.exchange.values()]
            readers = [self.full.steps[name] for name in omission.at]
            rtol = [max(step.node.rtol for step in group) for group in (steps, cheaper, readers)]
            return error_of(*pair) <= bound + sum(rtol)
        if omission.kind == "handed on" and self.full.steps[omission.name].node.random:
            return least_error(*pair) <= bound
        return largest_error(*pair) <= bound * (1 + 1e-5) + (_ROUNDING if bound else 0.0)

    def _back(self, omission: Omission) -> float:
        """Return the largest change of an output when one of the engine's omissions of steps is undone."""
        recipe = self.full
        for other in reversed(self.found):  # from the last, because the input that is handed on may be left out too
            if other.taken and other is not omission:
                recipe = other.applied_to(recipe)
        return max(_errors(self.recipe.outputs, recipe.outputs, run(recipe, self.store), self.chosen).values())

    def _seconds(self, one: Recipe, other: Recipe) -> float:
        """Return the run time of the steps that recipe ``one`` needs and recipe ``other`` does not need."""
        keys = resolve(one, order := needed(one, one.outputs), self.store).keys
        only = [keys[name] for name in order if name not in set(needed(other, other.outputs))]
        return sum(float((self.store.about(key) or {}).get("seconds", 0.0)) for key in only)

    def _key(self, omission: Omission, alone: Recipe) -> Key:
        outputs = [
            [resolve(r, needed(r, r.outputs), self.store).keys[n] for n in r.outputs] for r in (self.full, alone)
        ]
        chosen = [[name, self.chosen.keys[name]] for name in self.recipe.outputs]
        details = [omission.name, omission.kind, repr(omission.bound), omission.why, omission.taken]
        return digest("leave-out", outputs, chosen, details, engine("studies.leave_out.omission_rows"))


def _errors(names: Sequence[str], others: Sequence[str], result: Result, truth: Result) -> dict[str, float]:
    """Return the error of each output in ``names``; ``others`` are the names of the same outputs in ``result``."""
    pairs = zip(names, others, strict=True)
    return {name: error_of(result.values[other], truth.values[name]) for name, other in pairs}


def _bounds(omission: Omission, result: Result) -> dict[str, float]:
    """Return the error bound of each compared step: the bound that its node states, or that the engine proves."""
    if omission.kind != "stands in":
        return dict.fromkeys(omission.at, omission.bound)
    return {name: bound for name in omission.at if (bound := result.proof.of(name)) is not None}


def least_error(value: Tensor, reference: Tensor) -> float:
    """Return a lower limit of the relative root mean square error over all noise, estimated from one noisy result.

    Each pixel counts as a draw. If a few large pixels dominate the mean square error, the standard error of the mean is
    as large as the mean. The largest element is random too, so four standard
    deviations are added to it.
    """
    change = value.double() - reference.double()
    squares, count = change.square(), change.numel()
    mean = float(squares.mean())
    error = float(squares.std()) / math.sqrt(count) if count > 1 else mean
    top = float(reference.double().abs().max()) + _SURE * (float(change.std()) if count > 1 else 0.0)
    least = math.sqrt(max(mean - _SURE * error, 0.0))
    return least / top if top > 0 else least
