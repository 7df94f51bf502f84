"""Error propagation: bounds on the effect of omitted and cheaper steps on the outputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from neusee.nodes import ErrorBound, TensorStats
from neusee.workflows.graph.errors import RunError
from neusee.workflows.graph.recipe_graph import Recipe, Step, StepRecord, Wire, needed
from neusee.workflows.graph.step_shapes import forms_of, tensors_of
from neusee.workflows.tolerance.skip_decision import UNKNOWN, ErrorBudget, FactsOf

# --- error propagation ----------------------------------------------------------------------------

# Error propagation: upper bounds on the effect of omitted and approximated steps, from node to
# node.
#
# A node computes the error of its result from the errors of its inputs (`Node.propagate_error`).
# After a node without this hook no error bound is known; the errors of its inputs must meet the
# tolerance instead.


_Input = ErrorBound | list[ErrorBound] | None
_EXACT = ErrorBound(0.0)
Kind = Literal["exact", "proved", "estimated", "unknown"]
#: fraction of the estimated errors, over random recipes, that are at least as large as the true
#: error
COVERAGE = 0.95


@dataclass(frozen=True, slots=True)
class ErrorBounds:
    """Upper bounds on the errors of results, each relative to the largest element of the result."""

    #: error bound by step; infinite if a node gives no bound
    shares: Mapping[str, float] = field(default_factory=dict)
    #: error bounds that must meet the tolerance: of outputs, and of inputs of nodes without bounds
    held: Mapping[str, float] = field(default_factory=dict)
    #: errors that a run states for these results. They include the effect of a single draw of the
    #: noise and an estimate of the rounding to digital numbers, which the tolerance does not limit
    stated: Mapping[str, float] = field(default_factory=dict)
    estimated: frozenset[str] = frozenset()  #: steps whose stated error includes an estimate

    def of(self, step: str) -> float | None:
        """Return the error bound of a step's result, or None if no bound is known."""
        share = self.shares.get(step, 0.0)
        return share if math.isfinite(share) else None

    def stated_of(self, step: str) -> float | None:
        """Return the error that a run states for the result of a step, or None if it is unknown."""
        error = self.stated.get(step, self.shares.get(step, 0.0))
        return error if math.isfinite(error) else None

    def worst_stated(self, steps: Iterable[str]) -> float | None:
        """Return the largest error that a run states for the results of ``steps``, or None if
        one is unknown.
        """
        errors = [self.stated_of(step) for step in steps]
        known_errors = [error for error in errors if error is not None]
        return max(known_errors, default=0.0) if len(known_errors) == len(errors) else None

    def kind_of(self, step: str) -> Kind:
        """Return whether the error that a run states for a step is a proved bound or an
        estimate.
        """
        error = self.stated_of(step)
        if error is None:
            return "unknown"
        if error == 0.0:
            return "exact"
        return "estimated" if step in self.estimated else "proved"

    @property
    def worst(self) -> float:
        """Return the largest error bound of the results that must meet the tolerance."""
        return max(self.held.values(), default=0.0)

    def over(self, recipe: Recipe) -> float:
        """Return the largest ratio of an error bound to the error limit in ``recipe``; infinity
        if a limit is 0.
        """
        errors_and_limits = [
            (share, recipe.limit(name)) for name, share in self.held.items() if share > 0
        ]
        return max(
            (share / limit if limit > 0 else math.inf for share, limit in errors_and_limits),
            default=0.0,
        )


class ToleranceNotProven(Exception):
    """Error for a run whose error bound is ``over`` times the tolerance."""

    def __init__(self, over: float) -> None:
        super().__init__(f"the error bound is {over:.2g} times the tolerance")
        self.over = over


def tolerance_frontier(recipe: Recipe, order: Iterable[str], outputs: Iterable[str]) -> list[str]:
    """Return the approximate steps whose error bounds must meet the tolerance.

    These steps are outputs, or inputs of nodes that give no error bound.
    """
    inexact, frontier = set[str](), dict[str, None]()
    for name in order:
        step = recipe.steps[name]
        inexact_sources = [source for source in step.sources if source in inexact]
        # this step gives no bound: the errors of its inputs must meet the tolerance
        if inexact_sources and not _bounds_its_error(step, recipe):
            frontier |= dict.fromkeys(inexact_sources)
        elif inexact_sources or _may_err(step):
            inexact.add(name)
    return list(frontier | dict.fromkeys(name for name in outputs if name in inexact))


def unbounded_steps(recipe: Recipe, order: Sequence[str]) -> frozenset[str]:
    """Return the steps whose errors reach a node that gives no error bound for its result."""
    unbounded = set[str]()
    # go upstream from the outputs
    for name in reversed(order):
        if name in unbounded or not _bounds_its_error(recipe.steps[name], recipe):
            unbounded.update(recipe.steps[name].sources)
    return frozenset(unbounded)


def _may_err(step: Step) -> bool:
    """Return True if a step may be left out, or if its result may be approximate even for exact
    inputs.
    """
    return step.node.hooks.approximation_error is not None or step.node.hooks.skip_bound is not None


def _bounds_its_error(step: Step, recipe: Recipe) -> bool:
    """Return True if a step gives an error bound for any errors of its inputs."""
    return _propagates(step, recipe) or step.node.hooks.approximation_error is not None


def _propagates(step: Step, recipe: Recipe) -> bool:
    """Return True if the node of a step states how errors pass through it, by a bound, or by an
    estimate if the recipe allows estimates.
    """
    hooks = step.node.hooks
    return hooks.propagate_error is not None and (recipe.estimates or not hooks.estimated)


def proof(
    recipe: Recipe,
    order: Iterable[str],
    outputs: Iterable[str],
    done: Callable[[str], StepRecord],
    facts_of: FactsOf,
) -> ErrorBounds:
    """Return the error bounds of all results of a run, derived from known statistics without
    computing a step.
    """
    bounds: dict[str, ErrorBound] = {}
    held_shares: dict[str, float] = {}
    for name in order:
        step = recipe.steps[name]
        if not _may_err(step) and bounds.keys().isdisjoint(step.sources):
            continue  # the result is exact, as for almost every step
        bound = _bound(step, bounds, done(name), facts_of, recipe)
        if bound is None:
            continue
        if math.isinf(bound.rms):
            held_shares |= _finite_shares(bounds, step.sources)
        bounds[name] = bound
    held_shares |= _finite_shares(bounds, outputs)
    # the stated errors include a single draw of the noise, and rounding
    bounds_of_one_picture = bounds | _of_one_picture(recipe, bounds, done, facts_of)
    return ErrorBounds(
        {name: bound.share for name, bound in bounds.items()},
        held_shares,
        {name: bounds_of_one_picture[name].share for name in held_shares},
        frozenset(name for name, bound in bounds_of_one_picture.items() if bound.estimated),
    )


def _finite_shares(bounds: Mapping[str, ErrorBound], names: Iterable[str]) -> dict[str, float]:
    """Return the relative error bound of each step in ``names`` that has a finite bound."""
    shares = {name: bounds[name].share for name in names if name in bounds}
    return {name: share for name, share in shares.items() if math.isfinite(share)}


def _bound(
    step: Step,
    bounds: Mapping[str, ErrorBound],
    done: StepRecord,
    facts_of: FactsOf,
    recipe: Recipe,
    one_draw: bool = False,
) -> ErrorBound | None:
    """Return the error bound of a step's result from the bounds of its inputs in ``bounds``, or
    None if it is exact.

    The bound is the root mean square over all draws of the noise, or with ``one_draw`` the error of
    a single draw.
    """
    own_error = _own(step, done, facts_of, one_draw)
    sources = [bounds[source] for source in step.sources if source in bounds]
    if own_error is None and not any(bound.rms for bound in sources):
        return None
    inputs = [_gathered(step.wires.get(input_name), bounds) for input_name in step.node.inputs]
    stats = facts_of(step.name)
    hook = _propagation(step, one_draw) if _propagates(step, recipe) else None
    carried_error = _carried(step, inputs, stats, hook)
    return _together(carried_error, own_error, stats)


def _propagation(step: Step, one_draw: bool) -> Callable[..., float | ErrorBound] | None:
    """Return the hook of a node that bounds how errors pass through it; with ``one_draw``, the hook
    for a single draw of the noise if there is one.
    """
    hooks = step.node.hooks
    if one_draw and hooks.propagate_error is not None:
        return hooks.propagate_draw or hooks.propagate_error
    return hooks.propagate_error


def _together(carried: ErrorBound, own: ErrorBound | None, facts: TensorStats | None) -> ErrorBound:
    """Return the sum of two errors: the error caused by the inputs of a step, and the error that
    the step itself adds.
    """
    if own is None:
        return replace(carried, stats=facts)
    largest_error = None
    if own.peak is not None and carried.peak is not None:
        largest_error = own.peak + carried.peak
    return ErrorBound(
        carried.rms + own.rms,
        stats=facts,
        # without an error of the inputs, only the step's own largest error counts
        peak=own.peak if carried.rms == 0.0 else largest_error,
        estimated=carried.estimated or own.estimated,
        scattered=carried.scattered + own.scattered,
    )


def _of_one_picture(
    recipe: Recipe,
    bounds: Mapping[str, ErrorBound],
    done: Callable[[str], StepRecord],
    facts_of: FactsOf,
) -> dict[str, ErrorBound]:
    """Return those bounds that are larger for a single draw of the noise, or because of rounding to
    digital numbers.
    """
    larger_bounds: dict[str, ErrorBound] = {}
    for name, bound_of_draws in bounds.items():
        step, record = recipe.steps[name], done(name)
        hooks, is_omitted = step.node.hooks, record.state == "left out"
        draw_hook = hooks.skip_draw if is_omitted else hooks.propagate_draw or hooks.rounding_error
        if draw_hook is None and larger_bounds.keys().isdisjoint(step.sources):
            continue
        # larger bounds of earlier steps replace the usual ones
        bound = (
            _bound(step, {**bounds, **larger_bounds}, record, facts_of, recipe, one_draw=True)
            or bound_of_draws
        )
        if hooks.rounding_error is not None and not is_omitted:
            bound = _with_rounding(step, bound)
        larger_bounds[name] = bound
    return larger_bounds


def _with_rounding(step: Step, bound: ErrorBound) -> ErrorBound:
    """Return the error bound of digital numbers, including an estimate of their rounding."""
    rounding = step.node.hooks.rounding_error
    if rounding is None or bound.stats is None or not 0.0 < bound.rms < math.inf:
        return bound
    total_rms = float(rounding(bound.rms, result=bound.stats, **step.params))
    # independent errors add in squares: total^2 = before^2 + added^2
    added_rms = math.sqrt(max(total_rms**2 - bound.rms**2, 0.0))
    # added linearly, as any two errors: a bound, not the most likely value
    return replace(
        bound, rms=bound.rms + added_rms, scattered=bound.scattered + added_rms, estimated=True
    )


def _own(
    step: Step, done: StepRecord, facts_of: FactsOf, one_draw: bool = False
) -> ErrorBound | None:
    """Return the error that a step adds by its own approximation or omission, in the unit of its
    result.
    """
    is_omitted, hooks = done.state == "left out", step.node.hooks
    share = done.bound if is_omitted else done.error and done.error[0]
    if not share or (facts := facts_of(done.step)) is None:
        return None
    if is_omitted:
        return _of_omission(step, share, facts, one_draw)
    # `share` is relative to the exact result, but only the approximate result is known
    rms = _of_full_result(share, max(abs(facts.min), abs(facts.max)))
    return ErrorBound(rms, peak=done.error[1] if done.error else None, estimated=hooks.estimated)


def _of_omission(step: Step, share: float, facts: TensorStats, one_draw: bool) -> ErrorBound:
    """Return the error caused by leaving out a step, which is at most ``share`` of the step's full
    result.
    """
    hooks = step.node.hooks
    largest_element = max(abs(facts.min), abs(facts.max))
    if hooks.skip_scale is not None:
        largest_element = hooks.skip_scale(facts, **step.params)
    rms = _of_full_result(share, largest_element)
    if one_draw and hooks.skip_draw is not None:
        rms *= hooks.skip_draw(facts, **step.params)
    return ErrorBound(
        rms, estimated=hooks.skip_estimated, scattered=rms if step.node.random else 0.0
    )


def _of_full_result(share: float, largest: float) -> float:
    """Return an upper bound on ``share`` times the largest element of the exact result, computed
    from the ``largest`` element of the present result.
    """
    # full <= largest / (1 - share), because the largest element of the present result is at least 1
    # - share of the full one
    return share * largest / (1.0 - share) if share < 1.0 and largest > 0 else math.inf


def _carried(
    step: Step,
    inputs: list[_Input],
    result: TensorStats | None,
    hook: Callable[..., float | ErrorBound] | None,
) -> ErrorBound:
    """Return the error of a step's result that the errors of its inputs cause; infinite if no
    ``hook`` bounds it.

    The approximation error of a step may include cheaper forms of its inputs, but never steps left
    out upstream, which the step cannot know.
    """
    errors = [error for error in _flat(inputs) if error.rms]
    if not errors:
        return _EXACT
    estimated = step.node.hooks.estimated or any(error.estimated for error in errors)
    # without statistics of the result no hook can bound the error
    if hook is None or result is None or any(math.isinf(error.rms) for error in errors):
        return ErrorBound(math.inf, estimated=estimated)
    return _passed_apart(step, inputs, result, hook, estimated)


def _passed_apart(
    step: Step,
    inputs: list[_Input],
    result: TensorStats,
    hook: Callable[..., float | ErrorBound],
    estimated: bool,
) -> ErrorBound:
    """Return the error of a step's result, with errors like noise passed separately from all other
    errors of the inputs.
    """
    hooks = step.node.hooks
    other_error = _passed(step, hook, _parts(inputs, scattered=False), result)
    noise_error = _passed(
        step, hooks.propagate_scattered or hook, _parts(inputs, scattered=True), result
    )
    return ErrorBound(
        other_error.rms + noise_error.rms,
        # an error like noise has no largest value
        peak=other_error.peak if noise_error.rms == 0.0 else None,
        estimated=estimated,
        scattered=other_error.scattered + noise_error.rms,
    )


def _passed(
    step: Step, hook: Callable[..., float | ErrorBound], inputs: list[_Input], result: TensorStats
) -> ErrorBound:
    """Return the error that a hook of a node computes from the errors of the inputs; zero for exact
    inputs.
    """
    if not any(error.rms for error in _flat(inputs)):
        return ErrorBound(0.0, peak=0.0)
    try:
        error = hook(*inputs, result=result, **step.params)
    except Exception as problem:
        raise RunError(step, [], problem) from problem
    return (
        error
        if isinstance(error, ErrorBound)
        # a plain number is a root mean square; the largest error is unknown
        else ErrorBound(float(error), peak=0.0 if error == 0 else None)
    )


def _parts(inputs: list[_Input], *, scattered: bool) -> list[_Input]:
    """Return the errors of the inputs that are like noise (``scattered``), or all other errors of
    the inputs.
    """

    def part(error: ErrorBound) -> ErrorBound:
        rms = error.scattered if scattered else max(error.rms - error.scattered, 0.0)
        return replace(error, rms=rms, scattered=0.0)

    # a list input has a list of errors
    return [
        [part(error) for error in errors] if isinstance(errors, list) else errors and part(errors)
        for errors in inputs
    ]


def _gathered(wire: Wire, bounds: Mapping[str, ErrorBound]) -> _Input:
    """Return the error of the result that an input is connected to, a list of errors for a list of
    steps, or None for an input without a connection.
    """
    if wire is None or isinstance(wire, str):
        return None if wire is None else bounds.get(wire, _EXACT)
    return [bounds.get(name, _EXACT) for name in wire]


def _flat(inputs: Iterable[_Input]) -> Iterator[ErrorBound]:
    """Yield each error, including those inside lists."""
    for error in inputs:
        if isinstance(error, list):
            yield from error
        elif error:
            yield error


# --- expected errors ------------------------------------------------------------------------------

# Errors that the cheaper steps of a plan are expected to cause in the outputs, computed before
# anything runs.
#
# A tolerance is relative to the largest digital number. If the full well or the converter cuts off
# most of the light, an error that is small relative to the brightest pixel of the image is large
# relative to that number. Nodes predict the range of their result from their parameters
# (`Node.expected_range`). The errors of the plan are propagated through these ranges, as `proof`
# propagates the errors of a run through its results. A run still proves its errors from the
# computed results.


def expected_excess(recipe: Recipe, outputs: Iterable[str], share: float = 1.0) -> float:
    """Return the expected ratio of the largest error of ``outputs`` to its limit; 0 if
    nothing is known.

    The error of each cheaper step of ``recipe`` is expected to be ``share`` times its limit.
    """
    outputs = tuple(outputs)
    order = needed(recipe, outputs)
    order = needed(recipe, tolerance_frontier(recipe, order, outputs))
    expected_errors = {
        substitution.instead: share * substitution.within
        for substitution in recipe.substitutions
        if substitution.instead
    }
    ranges = _Ranges(recipe, order)
    records = {name: _record(recipe.steps[name], expected_errors, ranges) for name in order}
    try:
        return proof(recipe, order, outputs, records.__getitem__, ranges.known.get).over(recipe)
    except RunError:  # a rule needs more than a range
        return 0.0


def _record(step: Step, within: Mapping[str, float], ranges: _Ranges) -> StepRecord:
    """Return the expected record of a step: left out, or with the error of a cheaper step."""
    bound = ranges.left_out.get(step.name)
    if bound is not None:
        return StepRecord(step.name, "left out", "", 0.0, "", bound=bound)
    # the error of the cheaper step itself, and of the cheaper forms that it reads
    error = within.get(step.name, 0.0) + sum(within.get(source, 0.0) for source in step.sources)
    states_error = error and step.node.hooks.approximation_error is not None
    return StepRecord(step.name, "run", "", 0.0, "", error=(error, error) if states_error else None)


class _Ranges:
    """Expected statistics of the results of a recipe, as far as the nodes predict them, and the
    steps that will be left out.
    """

    def __init__(self, recipe: Recipe, order: Iterable[str]) -> None:
        self.known: dict[str, TensorStats] = {}
        self.left_out: dict[str, float] = {}  #: error bound of each step that will be left out
        order = list(order)
        self._forms, self._budget = forms_of(recipe, order), ErrorBudget(recipe)
        for name in order:
            self._add(recipe.steps[name])

    def _add(self, step: Step) -> None:
        """Add the expected range of the result of a step if its node predicts one, and whether the
        step will be left out.
        """
        hooks = step.node.hooks
        if hooks.expected_range is None:
            self._budget.pass_on(step)
            return
        inputs = [self._of(step.wires.get(name)) for name in step.node.inputs]
        if hooks.skip_bound is not None and all(source in self.known for source in step.sources):
            decision = self._budget.verdict(step, step.params, self.known.get)
            if decision.left_out:
                self.known[step.name], self.left_out[step.name] = (
                    self.known[decision.instead],
                    decision.bound,
                )
                return
        try:
            smallest, largest = hooks.expected_range(*inputs, **step.params)
        except LookupError:
            return
        tensors = tensors_of(self._forms[step.name])
        result_shape = tuple(tensors[0].shape) if tensors else ()
        # the sum (NaN) and the number of nonzero elements (0) are unknown
        self.known[step.name] = TensorStats(
            result_shape, "float32", smallest, largest, math.nan, 0, True
        )

    def _of(self, wire: Wire) -> Any:
        """Return the statistics of the result that an input is connected to, or a list of them;
        unknown statistics raise `LookupError` when they are read.
        """
        if wire is None:
            return None
        return (
            self.known.get(wire, UNKNOWN)
            if isinstance(wire, str)
            else [self.known.get(n, UNKNOWN) for n in wire]
        )
