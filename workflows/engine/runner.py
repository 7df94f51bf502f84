"""Run of a recipe: stored results are reused, and missing ones are computed."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch

from neusee.workflows.engine.cost_model import sizes_of
from neusee.workflows.engine.execution import Execution, RunRequest, RunSeries, TaintedRun
from neusee.workflows.engine.local_executor import check_devices, memory_limit
from neusee.workflows.engine.machine_resources import give_back, limited, process_peak
from neusee.workflows.engine.node_call import to_device
from neusee.workflows.engine.placement_inputs import past_costs, running_peak
from neusee.workflows.engine.provenance import state_counts
from neusee.workflows.engine.result_values import arrays_of, figures_of_merit, metrics_of
from neusee.workflows.engine.step_job import Executor, Outcome, Show
from neusee.workflows.engine.wanted_steps import wanted
from neusee.workflows.graph.recipe_graph import (
    Event,
    Recipe,
    StepRecord,
    by_family,
    copies_of,
    needed,
    unknown_step,
)
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.keys.module_digest import Parts
from neusee.workflows.placement.heft_schedule import Schedule
from neusee.workflows.store.remote_store import open_store
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import stricter_scale, with_substitutions
from neusee.workflows.tolerance.error_propagation import (
    ErrorBounds,
    ToleranceNotProven,
    proof,
    tolerance_frontier,
)
from neusee.workflows.tolerance.skip_decision import skip_share

# --- step order -----------------------------------------------------------------------------------

# Order in which the results of a run are made: results that need only short steps come before those
# that need a long one.
#
# So pictures and files of the short steps are made while the long steps run, and values that only
# short steps read are freed early.


def shortest_first(
    recipe: Recipe,
    order: Iterable[str],
    first: Collection[str],
    others: Iterable[str],
    seconds: Mapping[str, float],
) -> list[str]:
    """Return the steps ``first``, and ``others`` that need only shorter steps, by the longest step
    that each needs.

    Args:
        order: all steps, each after its inputs
        first: steps whose results are needed before all others are made
        seconds: of each step that must run, as predicted. A step of ``others`` that needs a step as
            long as the longest that ``first`` need is left out.
    """
    longest: dict[str, float] = {}
    for name in order:
        source_times = (longest[source] for source in recipe.steps[name].sources)
        longest[name] = max(seconds.get(name, 0.0), max(source_times, default=0.0))
    longest_of_first = max((longest[name] for name in first), default=0.0)
    names = dict.fromkeys([*first, *(name for name in others if longest[name] < longest_of_first)])
    return sorted(names, key=longest.__getitem__)


# --- runner ---------------------------------------------------------------------------------------

# Run of a recipe: stored results are reused, and missing results that the outputs depend on are
# computed.


#: relative error that rounding causes in sums over bands, whatever their error limit
_ROUNDING = 1.4e-6


@dataclass(frozen=True, repr=False)
class Result:
    """Result of a run: the requested values, and a record of every step upstream of these
    values.
    """

    values: dict[str, Any]
    done: dict[str, StepRecord]
    keys: dict[str, Key]
    seconds: float
    peak_memory: int  #: peak bytes of this process so far
    recipe: Recipe
    store: Store
    device: str = "cpu"
    schedule: Schedule | None = None  #: predicted times of the steps that ran
    proof: ErrorBounds = field(default_factory=ErrorBounds)  #: error bounds of the steps
    #: predicted peak bytes of this process; None if another process computed
    predicted_peak: float | None = None
    origins: Mapping[Key, Mapping[str, Any]] = field(default_factory=dict)  #: the parts of each key
    #: the parts that each digest of code covers
    code: Mapping[str, Parts] = field(default_factory=dict)
    #: number of attempts; 2 or 3 if the error of the first could not be proved to be within the
    #: tolerance
    attempts: int = 1

    def value(self, step: str) -> Any:
        """Return the value of any step of the recipe; the value is read from the store or
        computed if necessary.
        """
        if step in self.values:
            return self.values[step]
        return run(self.recipe, self.store, (step,), device=self.device).values[step]

    __getitem__ = value

    def numpy(self, step: str) -> Any:
        """Return the value of a step with a NumPy array in place of every tensor."""
        return arrays_of(self.value(step))

    def metrics(self) -> dict[str, float | list[float]]:
        """Return every figure of merit that ``neusee run`` prints, such as
        ``restored_quality.psnr``.

        A figure with a value for each band is a list. A figure that this run did not need is read
        from the store or computed.
        """
        # figures of merit belong to the recipe before substitutions
        recipe = self.recipe.unsubstituted or self.recipe
        names = metrics_of(recipe, {*self.keys, *wanted(recipe)})
        values = values_of(self, recipe, names)
        return figures_of_merit({name: values[name] for name in names})

    def counts(self) -> str:
        """Return the number of steps in each state and the time, such as ``12 run, 3 cached in
        0.31 s``.
        """
        return f"{state_counts(self.done.values())} in {self.seconds:.3g} s"

    def __repr__(self) -> str:
        outputs = ", ".join(by_family(self.values))
        return f"<result of {self.recipe.name}: {outputs}; {self.counts()}>"


def values_of(result: Result, recipe: Recipe, steps: Iterable[str]) -> Mapping[str, Any]:
    """Return the values of a run, and those of other ``steps``, which ``recipe`` computes."""
    absent = [name for name in steps if name not in result.values]
    computed = run(recipe, result.store, absent, device=result.device).values if absent else {}
    return {**computed, **result.values}


def run(
    recipe: Recipe,
    store: Store | None = None,
    outputs: Iterable[str] | None = None,
    watch: Callable[[Event], None] | None = None,
    device: str = "cpu",
    executor: Executor | None = None,
    memory: int | None = None,
    show: Show | None = None,
    series: RunSeries | None = None,
    anew: Collection[str] = (),
) -> Result:
    """Return the values of the steps ``outputs``; compute the values that are not in ``store``.

    Args:
        outputs: if None, the outputs of the recipe
        device: one or several devices, such as ``cuda:0,cuda:1,cpu``, the preferred device first
        executor: computes the steps in place of this process
        memory: bytes that this process, and each GPU, may use; if None, most of the memory that is
            free
        show: is called with each result, while later steps wait
        series: what earlier runs found that holds for this one as well
        anew: steps that are computed, with all that follow from them, although their results are
            stored

    Raises: `RunError`, which names the step, and ValueError for a device that this machine does not
            have.
    """
    began = time.perf_counter()
    check_devices(device)
    names = _outputs_of(recipe, outputs)
    recomputed = copies_of(recipe, anew)
    recipe = with_substitutions(recipe, names)
    store = store or open_store()
    series = series or RunSeries.begun(store)
    attempt_number, carried_outcomes = 1, dict[str, Outcome]()
    while True:
        request = RunRequest(
            recipe,
            names,
            store,
            device.split(","),
            memory,
            executor,
            watch=watch or (lambda event: None),
            show=show or (lambda *_: None),
        )
        execution = Execution(request, series, carried_outcomes, recomputed)
        try:
            with limited(memory_limit(memory)):
                return replace(
                    _attempt(execution, names, began, show is not None), attempts=attempt_number
                )
        # the run begins again, and uses the value that was computed
        except TaintedRun as tainted:
            carried_outcomes[tainted.outcome.work.step.name] = tainted.outcome
            # from now on, keys of tainted code are private
            series.read_code_again(store)
        except ToleranceNotProven as failure:
            # the second attempt is stricter, and the third is exact
            tolerance_scale = stricter_scale(recipe, failure.over) if attempt_number == 1 else 0.0
            attempt_number, recipe = (
                attempt_number + 1,
                _stricter(recipe, tolerance_scale, execution, names),
            )
        finally:
            execution.close()
            give_back()


def _outputs_of(recipe: Recipe, outputs: Iterable[str] | None) -> tuple[str, ...]:
    """Return the steps whose values a run must return; raise ValueError for a name that is no
    step.
    """
    names = recipe.outputs if outputs is None else tuple(outputs)
    for name in names:
        if name not in recipe.steps:
            raise ValueError(unknown_step(name, recipe.steps))
    return names


def _stricter(recipe: Recipe, scale: float, work: Execution, outputs: tuple[str, ...]) -> Recipe:
    """Return the recipe of the next attempt, with the tolerance ``scale``. It is exact if that is
    0, or if a stricter recipe would fail as well.
    """
    original_recipe = recipe.unsubstituted or recipe
    stricter = with_substitutions(
        replace(original_recipe, tolerance_scale=scale, exact=scale == 0.0), outputs
    )
    if not stricter.exact and _futile(stricter, work, outputs):
        return replace(original_recipe, tolerance_scale=0.0, exact=True)
    return stricter


def _futile(stricter: Recipe, work: Execution, outputs: tuple[str, ...]) -> bool:
    """Return True if the run ``work`` would exceed the tolerance even if only rounding errors were
    left.

    Cheaper steps with the smaller limits of the recipe ``stricter`` still have the rounding errors
    of their sums.
    """
    # share of the tolerance that omitted steps may use
    share = skip_share(stricter)

    def at_best(name: str) -> StepRecord:
        record = work.done.get(name) or work.record_of_unneeded(name)
        # under the smaller limit this step would run, without an error
        if record.state == "left out" and (record.bound or 0.0) > stricter.allowed(name) * share:
            return replace(record, state="run")
        if not record.error or record.error[0] <= _ROUNDING:
            return record
        # the second number is proportional to the first
        return replace(record, error=(_ROUNDING, record.error[1] * _ROUNDING / record.error[0]))

    # as in `_attempt`: the steps that the judged steps need
    order = needed(
        work.recipe, tolerance_frontier(work.recipe, needed(work.recipe, outputs), outputs)
    )
    return proof(work.recipe, order, outputs, at_best, work.known_facts).over(stricter) > 1.0


def _attempt(work: Execution, outputs: tuple[str, ...], began: float, shows: bool) -> Result:
    """Run the recipe; raise `ToleranceNotProven` if its errors cannot be proved to be within the
    tolerance.
    """
    recipe = work.recipe
    order = needed(recipe, outputs)
    with torch.no_grad():
        work.resolve(order)
        # the steps whose errors must meet the tolerance
        judged_steps = tolerance_frontier(recipe, order, outputs)
        # keys of the values that must be computed for the outputs
        missing = work.missing(outputs) if judged_steps else set()
        _make_early(work, order, judged_steps, outputs, missing, shows)
        # if nothing must be computed, all records are known, and the proof covers every step
        steps_to_prove = order if judged_steps and not missing else needed(recipe, judged_steps)
        error_bounds = proof(
            recipe, steps_to_prove, outputs, partial(_record_so_far, work), work.known_facts
        )
        error_in_tolerances = error_bounds.over(recipe)
        if error_in_tolerances > 1.0 and not recipe.exact:
            raise ToleranceNotProven(error_in_tolerances)
        # compute or load the remaining values
        work.make([work.keys[name] for name in outputs], keep=False)
    # a proof before the steps ran does not cover them
    return _result_of(work, outputs, began, None if missing else error_bounds)


def _make_early(
    work: Execution,
    order: list[str],
    first: Iterable[str],
    outputs: tuple[str, ...],
    missing: set[Key],
    shows: bool,
) -> None:
    """Compute the missing results of the steps ``first``, whose errors must meet the tolerance.

    With ``shows``, outputs that need only shorter steps are computed as well; a sweep shows
    nothing.
    """
    early_steps = [name for name in first if work.keys[name] in missing]
    if early_steps and shows:
        early_steps = _targets_first(work, order, early_steps, outputs, missing)
    if early_steps:
        later = [work.keys[name] for name in outputs]
        work.make([work.keys[name] for name in early_steps], keep=False, later=later)


def _result_of(
    work: Execution, outputs: tuple[str, ...], began: float, proved: ErrorBounds | None
) -> Result:
    """Return the result of a finished run; if ``proved`` is None, the errors are bounded here."""
    recipe, store = work.recipe, work.store
    values = {name: to_device(work.values[work.keys[name]], work.devices[0]) for name in outputs}
    order = needed(recipe, outputs)
    # includes steps that did not run
    records = work.account(order)
    peak = process_peak()
    seconds = time.perf_counter() - began
    if proved is None:
        proved = proof(recipe, order, outputs, records.__getitem__, work.known_facts)
    return Result(
        values=values,
        done=records,
        keys=work.keys,
        seconds=seconds,
        peak_memory=peak,
        recipe=recipe,
        store=store,
        device=",".join(work.devices),
        schedule=work.schedule,
        proof=proved,
        predicted_peak=_predicted_peak(work),
        origins=work.origins,
        code=work.code.parts,
    )


def _record_so_far(work: Execution, name: str) -> StepRecord:
    """Return the record of a step that ran or was left out, or a record for a step that has not
    run.
    """
    return work.done.get(name) or work.record_of_unneeded(name)


def _predicted_peak(work: Execution) -> float | None:
    """Return the predicted peak bytes of this process; None if another process computed."""
    return running_peak(work.schedule, work.own.lanes) if work.executor is work.own else None


def _targets_first(
    work: Execution, order: list[str], early: list[str], outputs: tuple[str, ...], missing: set[Key]
) -> list[str]:
    """Return the steps ``early`` and the outputs that need only shorter steps, the shortest
    first.
    """
    work.costs = work.costs or past_costs(work.store, sizes_of(work.recipe, order))
    missing_steps = [
        (name, work.recipe.steps[name], None) for name in order if work.keys[name] in missing
    ]
    seconds = {
        name: cost.seconds["cpu"]
        for name, cost in work.costs.in_turn(missing_steps, ["cpu"]).items()
    }
    missing_outputs = [name for name in outputs if work.keys[name] in missing]
    return shortest_first(work.recipe, order, early, missing_outputs, seconds)
