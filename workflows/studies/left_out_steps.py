"""The steps that a recipe can leave out: error bound, measured error and saved run time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

from torch import Tensor

from neusee.nodes import TensorStats
from neusee.workflows.engine.provenance import facts_in
from neusee.workflows.engine.resolve_keys import resolve
from neusee.workflows.engine.runner import Result, run
from neusee.workflows.graph.errors import RunError
from neusee.workflows.graph.recipe_graph import Recipe, Step, Wire, in_order, needed
from neusee.workflows.keys.cache_key import Key, digest
from neusee.workflows.keys.code_digest import engine
from neusee.workflows.store.result_store import Store, compute_once
from neusee.workflows.tolerance.cheaper_steps import with_substitutions
from neusee.workflows.tolerance.error_norm import error_of, largest_error
from neusee.workflows.tolerance.error_propagation import Kind
from neusee.workflows.tolerance.skip_decision import FactsOf, judge, without

# --- possible omissions ---------------------------------------------------------------------------

# The ways to omit steps of a recipe, each as a change of the full recipe.
#
# There are three kinds. ``handed on``: a step whose node bounds its effect is left out, and the
# first input of the step takes the place of its result. ``not added``: light or dirt whose largest
# element is bounded is not added. ``stands in``: sums over bands replace an image of all bands.
# Each omission can be measured alone, even if the engine does not choose it.


OmissionKind = Literal["handed on", "not added", "stands in"]


@dataclass(frozen=True)
class Omission:
    """One way to save run time: steps that can be omitted or replaced by cheaper steps."""

    name: str
    kind: OmissionKind
    #: the replacement of each omitted step; empty text for none
    exchange: Mapping[str, str]
    #: upper bound of the relative change at the compared steps; NaN if only a run can give it
    bound: float
    why: str
    taken: bool  #: whether a normal run of the recipe has this omission
    #: compared steps: the omitted step itself, or the steps that read it
    at: tuple[str, ...]
    beside: tuple[Step, ...] = ()  #: replacing steps that are not in the recipe

    def applied_to(self, recipe: Recipe) -> Recipe:
        """Return ``recipe`` with only this omission applied."""
        readers = set(recipe.steps) if self.kind != "stands in" else set(self.at)
        steps = {**recipe.steps, **{step.name: step for step in self.beside}}
        for name in readers & recipe.steps.keys():
            steps[name] = replace(recipe.steps[name], wires=self._wires(recipe.steps[name]))
        outputs = tuple(self.value_of(name) for name in recipe.outputs)
        # replacing steps come before the steps that read them
        order = in_order({name: step.sources for name, step in steps.items()}, steps)
        return replace(recipe, steps={name: steps[name] for name in order}, outputs=outputs)

    def value_of(self, step: str) -> str:
        """Return the step whose result takes the place of the result of ``step`` after this
        omission.
        """
        return self.exchange.get(step, step) if self.kind == "handed on" else step

    def _wires(self, reader: Step) -> Mapping[str, Wire]:
        """Return the inputs of a step that reads an omitted result, with the result removed or
        replaced.
        """
        if self.kind == "not added":
            return without(reader, dict.fromkeys(self.exchange))
        return {i: _exchanged(wire, self.exchange) for i, wire in reader.wires.items()}


def _exchanged(wire: Wire, exchange: Mapping[str, str]) -> Wire:
    """Return a connection with replaced steps exchanged."""
    if isinstance(wire, tuple):
        return tuple(exchange.get(name, name) for name in wire)
    return wire and exchange.get(wire, wire)


def omissions(full: Recipe, result: Result, facts_of: FactsOf) -> Iterator[Omission]:
    """Yield each way to omit steps of the full computation ``full`` for which an error bound is
    known.
    """
    order = needed(full, full.outputs)
    yield from _stand_ins(full, order, result)
    for name in order:
        done = result.done.get(name)
        reason = done.why if done is not None and done.state == "left out" else ""
        # a step that the run never reached was omitted together with its reader
        is_chosen = done is None or bool(reason)
        for omission in (
            _handed_on(full.steps[name], facts_of),
            _not_added(full, order, name, facts_of),
        ):
            if omission is not None and math.isfinite(omission.bound):
                yield replace(omission, taken=is_chosen, why=reason or omission.why)


def _handed_on(step: Step, facts_of: FactsOf) -> Omission | None:
    """Return the omission that passes the first input of a step on as its result; None if the node
    states no bound.
    """
    if step.node.hooks.skip_bound is None:
        return None
    decision = judge(step, step.params, facts_of, math.inf)
    reason = f"changes at most {decision.bound:.2g}"
    return Omission(
        step.name,
        "handed on",
        {step.name: decision.instead},
        decision.bound,
        reason,
        False,  # taken: set by `omissions`
        (step.name,),
    )


def _not_added(recipe: Recipe, order: list[str], name: str, facts_of: FactsOf) -> Omission | None:
    """Return the omission of light or dirt that other steps only add; None without a bound."""
    step = recipe.steps[name]
    readers = _adding(recipe, order, name) if step.node.hooks.zero_bound is not None else ()
    if not readers:
        return None
    largest = _largest(step, facts_of)
    reason = f"no element above {largest:.2g}"
    return Omission(
        name,
        "not added",
        {name: ""},
        _share(largest, recipe, readers, facts_of),
        reason,
        False,  # taken: set by `omissions`
        readers,
    )


def _stand_ins(full: Recipe, order: list[str], result: Result) -> Iterator[Omission]:
    """Yield the `Omission` that computes sums over spectral bands in place of images of all bands.

    All images are replaced together, because two images that a step compares must be computed in
    the same way.
    """
    with_sums = with_substitutions(replace(full, exact=False, estimates=False), full.outputs)
    replacements = [economy for economy in with_sums.substitutions if economy.instead]
    if not replacements:
        return
    exchange = {economy.step: economy.instead for economy in replacements}
    sums = tuple(step for name, step in with_sums.steps.items() if name not in full.steps)
    instead = set(exchange.values())
    readers = tuple(n for n in order if not instead.isdisjoint(with_sums.steps[n].sources))
    is_chosen = {economy.step for economy in result.recipe.substitutions} >= exchange.keys()
    yield Omission(
        name=", ".join(exchange),
        kind="stands in",
        exchange=exchange,
        bound=math.nan,
        why=replacements[0].why,
        taken=is_chosen,
        at=readers,
        beside=sums,
    )


def _adding(recipe: Recipe, order: list[str], name: str) -> tuple[str, ...]:
    """Return the steps that read the result of ``name``, if all of them only add it; else an empty
    tuple.
    """
    readers = [
        recipe.steps[reader_name]
        for reader_name in order
        if name in recipe.steps[reader_name].sources
    ]
    return (
        tuple(reader.name for reader in readers)
        if all(_only_adds(reader, name) for reader in readers)
        else ()
    )


def _only_adds(reader: Step, name: str) -> bool:
    """Return True if a step reads the result ``name`` only at additive inputs."""
    inputs_read = {
        input_name
        for input_name, wire in reader.wires.items()
        if name == wire or (isinstance(wire, tuple) and name in wire)
    }
    return inputs_read <= {added_input for added_input, *_ in reader.node.additive_inputs}


def _largest(step: Step, facts_of: FactsOf) -> float:
    """Return an upper bound of the largest element of a step's result, from statistics of its
    inputs.
    """
    assert step.node.hooks.zero_bound is not None
    input_statistics = [_facts(step.wires.get(name), facts_of) for name in step.node.inputs]
    try:
        return float(step.node.hooks.zero_bound(*input_statistics, **step.params))
    except Exception as error:
        raise RunError(step, [], error) from error


def _facts(wire: Wire, facts_of: FactsOf) -> TensorStats | list[TensorStats | None] | None:
    """Return the statistics of the result or results at an input."""
    return [facts_of(name) for name in wire] if isinstance(wire, tuple) else wire and facts_of(wire)  # type: ignore[return-value]


def _share(largest: float, recipe: Recipe, readers: tuple[str, ...], facts_of: FactsOf) -> float:
    """Return the ratio of ``largest`` to the smallest of the readers' largest elements; infinite if
    a reader's result is no tensor.
    """
    if largest == 0:
        return 0.0
    if any(recipe.steps[name].node.hints.get("return") is not Tensor for name in readers):
        return math.inf
    smallest_of_largest = min(_top(facts_of(name)) for name in readers)
    return largest / smallest_of_largest if smallest_of_largest > 0 else math.inf


def _top(facts: TensorStats | None) -> float:
    """Return the largest absolute value of a result; 0 if unknown."""
    return max(abs(facts.min), abs(facts.max)) if facts else 0.0


# --- omission rows --------------------------------------------------------------------------------

# Comparison of a recipe with and without omissions: error bound, measured error and saved run time.
#
# The full computation is the recipe without omissions. It is compared with the recipe with all
# omissions that the engine chooses, and with one omission alone. The recipe with the chosen
# omissions is also compared with the same recipe after one of the omissions is undone.


#: number of standard errors by which a mean over pixels may differ from the expectation over the
#: noise
_SURE = 4.0
_STORED_AS = {"step": "study leave-out"}
_ROUNDING = 2e-7  #: rounding error of a sum in float32, relative to its largest element


@dataclass(frozen=True)
class OmissionRow:
    """The effect of an omission: error bound, errors relative to the largest element, and saved run
    time.
    """

    name: str
    kind: str
    why: str
    taken: bool
    bound: float
    rms: float  #: root mean square error at the step, or at the steps that read its result
    largest: float
    outputs: dict[str, float]  #: root mean square error of each output with this omission alone
    back: float | None  #: root mean square change of the worst output when this omission is undone
    seconds: float  #: run time that the omission saves
    holds: bool


@dataclass(frozen=True)
class OutputError:
    """The error of one output after the engine's omissions, relative to the full computation."""

    output: str
    bound: float | None  #: error stated by the run and on its page; None if unknown
    kind: Kind
    rms: float
    largest: float
    holds: bool


class OmissionComparison:
    """The runs to compare: full computation, the engine's omissions, and each omission alone."""

    def __init__(self, recipe: Recipe, store: Store) -> None:
        self.recipe, self.store = recipe, store
        self.full = replace(recipe, exact=True)
        self.truth = run(self.full, store)
        self.chosen = run(recipe, store)
        self.found = list(omissions(self.full, self.chosen, self.facts))

    def facts(self, step: str) -> TensorStats | None:
        """Return statistics of a step's result in the full computation, from the store's metadata
        if possible.
        """
        return facts_in(self.store.about(self.truth.keys[step])) or TensorStats.of(
            self.truth.value(step)
        )

    def output_errors(self) -> list[OutputError]:
        """Return the error of each output after the engine's omissions."""
        errors = []
        for name in self.recipe.outputs:
            value, reference = self.chosen.values[name], self.truth.values[name]
            rms_error, proof = error_of(value, reference), self.chosen.proof
            bound, kind = proof.stated_of(name), proof.kind_of(name)
            # an error may exceed the tolerance only by noise and rounding, which the stated error
            # includes
            holds = rms_error <= (
                self.recipe.tolerance if bound is None or self.chosen.recipe.exact else bound
            )
            errors.append(
                OutputError(name, bound, kind, rms_error, largest_error(value, reference), holds)
            )
        return errors

    def rows(self) -> Iterator[OmissionRow]:
        """Yield the errors and the saved run time of each omission, from the store or
        measured now.
        """
        for omission in self.found:
            with_omission = omission.applied_to(self.full)
            key, compute = (
                self._key(omission, with_omission),
                partial(self._row, omission, with_omission),
            )
            yield compute_once(self.store, key, OmissionRow, compute, _STORED_AS)

    def _row(self, omission: Omission, alone: Recipe) -> OmissionRow:
        """Return the comparison of the full computation with one omission alone."""
        result = run(alone, self.store, tuple(omission.value_of(name) for name in omission.at))
        bounds = _bounds(omission, result)
        values_and_truths = {
            name: (result.values[omission.value_of(name)], self.truth.value(name))
            for name in omission.at
        }
        largest = max(
            largest_error(*value_and_truth) for value_and_truth in values_and_truths.values()
        )
        return OmissionRow(
            omission.name,
            omission.kind,
            omission.why,
            omission.taken,
            max(bounds.values(), default=math.inf),
            # rms at the step, or at the steps that read it
            max(error_of(*value_and_truth) for value_and_truth in values_and_truths.values()),
            largest,
            # the errors of the outputs, and their change when the omission is undone
            *self._reached(omission, alone, changed=largest > 0),
            # s, run time of the omitted steps minus that of their replacements
            self._seconds(self.full, alone) - self._seconds(alone, self.full),
            all(
                self._holds(omission, bound, values_and_truths[name], result)
                for name, bound in bounds.items()
            ),
        )

    def _reached(
        self, omission: Omission, alone: Recipe, changed: bool
    ) -> tuple[dict[str, float], float | None]:
        """Return the error of each output with one omission alone, and the change when it is undone
        in the chosen recipe.
        """
        if not changed:
            return dict.fromkeys(self.recipe.outputs, 0.0), 0.0 if omission.taken else None
        outputs = _errors(self.recipe.outputs, alone.outputs, run(alone, self.store), self.truth)
        return outputs, self._back(omission) if omission.taken else None

    def _holds(
        self, omission: Omission, bound: float, pair: tuple[Any, Any], result: Result
    ) -> bool:
        """Return True if the bound holds: for the rms error (noise and band sums) or for the
        largest error (all others).
        """
        if omission.kind == "stands in":  # both computations have a documented error of their own
            steps = [self.full.steps[name] for name in omission.exchange]
            cheaper = [result.recipe.steps[name] for name in omission.exchange.values()]
            readers = [self.full.steps[name] for name in omission.at]
            documented_errors = [
                max(step.node.rtol for step in group) for group in (steps, cheaper, readers)
            ]
            return error_of(*pair) <= bound + sum(documented_errors)
        if omission.kind == "handed on" and self.full.steps[omission.name].node.random:
            return least_error(*pair) <= bound
        # 1e-5 is rounding of the bound itself
        return largest_error(*pair) <= bound * (1 + 1e-5) + (_ROUNDING if bound else 0.0)

    def _back(self, omission: Omission) -> float:
        """Return the largest change of an output when one of the engine's omissions is undone."""
        without_this = self.full
        # from last to first, because a passed-on input may itself be omitted
        for chosen_omission in reversed(self.found):
            if chosen_omission.taken and chosen_omission is not omission:
                without_this = chosen_omission.applied_to(without_this)
        return max(
            _errors(
                self.recipe.outputs,
                without_this.outputs,
                run(without_this, self.store),
                self.chosen,
            ).values()
        )

    def _seconds(self, recipe: Recipe, other: Recipe) -> float:
        """Return the run time of the steps that ``recipe`` needs and ``other`` does not."""
        # the store keeps the run time of each result with its key
        keys = resolve(recipe, order := needed(recipe, recipe.outputs), self.store).keys
        not_in_other = [
            keys[name] for name in order if name not in set(needed(other, other.outputs))
        ]
        return sum(float((self.store.about(key) or {}).get("seconds", 0.0)) for key in not_in_other)

    def _key(self, omission: Omission, alone: Recipe) -> Key:
        """Return the store key of a comparison, from the output keys of both recipes and of the
        chosen one.
        """
        outputs = [
            [
                resolve(compared, needed(compared, compared.outputs), self.store).keys[output]
                for output in compared.outputs
            ]
            for compared in (self.full, alone)
        ]
        chosen_keys = [[name, self.chosen.keys[name]] for name in self.recipe.outputs]
        details = [omission.name, omission.kind, repr(omission.bound), omission.why, omission.taken]
        return digest("leave-out", outputs, chosen_keys, details, engine("studies.left_out_steps"))


def _errors(
    names: Sequence[str], others: Sequence[str], result: Result, truth: Result
) -> dict[str, float]:
    """Return the error of each output in ``names``; ``others`` are their names in ``result``."""
    pairs = zip(names, others, strict=True)
    return {
        name: error_of(result.values[name_in_result], truth.values[name])
        for name, name_in_result in pairs
    }


def _bounds(omission: Omission, result: Result) -> dict[str, float]:
    """Return the error bound of each compared step, stated by its node or proved by the engine."""
    if omission.kind != "stands in":
        return dict.fromkeys(omission.at, omission.bound)
    bounds = {name: result.proof.of(name) for name in omission.at}
    return {name: bound for name, bound in bounds.items() if bound is not None}


def least_error(value: Tensor, reference: Tensor) -> float:
    """Return a lower bound of the relative rms error over all noise, estimated from one noisy
    result.

    Each pixel counts as a draw. If a few large pixels dominate the mean square error, the standard
    error of the mean is as large as the mean. The largest element is random too, so four standard
    deviations are added to it.
    """
    difference = value.double() - reference.double()
    squared_errors, count = difference.square(), difference.numel()
    mean_square = float(squared_errors.mean())
    standard_error = float(squared_errors.std()) / math.sqrt(count) if count > 1 else mean_square
    largest = float(reference.double().abs().max()) + _SURE * (
        float(difference.std()) if count > 1 else 0.0
    )
    lower_limit = math.sqrt(max(mean_square - _SURE * standard_error, 0.0))
    return lower_limit / largest if largest > 0 else lower_limit
