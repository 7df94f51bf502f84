"""Run of a recipe: stored results are reused, and missing results that the outputs depend on are computed."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from neusee.workflows.engine.cost_laws import sizes_of
from neusee.workflows.engine.device_names import check_devices
from neusee.workflows.engine.execution import Execution
from neusee.workflows.engine.local_executor import memory_limit
from neusee.workflows.engine.memory_use import give_back, process_peak
from neusee.workflows.engine.memory_watch import limited
from neusee.workflows.engine.node_call import to_device
from neusee.workflows.engine.placement_inputs import past_costs, running_peak
from neusee.workflows.engine.private_steps import TaintedRun
from neusee.workflows.engine.run_series import RunSeries
from neusee.workflows.engine.step_job import Executor, Outcome, Show
from neusee.workflows.engine.step_order import shortest_first
from neusee.workflows.graph.recipe_graph import Recipe, copies_of, needed, unknown_step
from neusee.workflows.graph.step_record import Event, StepRecord
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.keys.code_memo import Parts
from neusee.workflows.placement.heft_schedule import Schedule
from neusee.workflows.store.remote_store import open_store
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import stricter_scale, with_substitutions
from neusee.workflows.tolerance.error_budget import skip_share
from neusee.workflows.tolerance.error_propagation import ErrorBounds, ToleranceNotProven, proof, tolerance_frontier

_ROUNDING = 1.4e-6  #: error that rounding leaves in sums over bands, whatever their limit


@dataclass(frozen=True, repr=False)
class Result:
    """Result of a run: the requested values, and a record of every step upstream of these values."""

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
    predicted_peak: float | None = None  #: predicted peak bytes of this process; None if another process computed
    origins: Mapping[Key, Mapping[str, Any]] = field(default_factory=dict)  #: the parts of each key
    code: Mapping[str, Parts] = field(default_factory=dict)  #: what each digest of code covers
    attempts: int = 1  #: 2 or 3 where the error of the first could not be proved to be within the tolerance

    def value(self, step: str) -> Any:
        """Return the value of any step of the recipe; the value is read from the store or computed if necessary."""
        if step in self.values:
            return self.values[step]
        return run(self.recipe, self.store, (step,), device=self.device).values[step]

    __getitem__ = value

    def numpy(self, step: str) -> Any:
        """Return the value of a step with a NumPy array in place of every tensor."""
        from neusee.workflows.report.notebook import arrays_of

        return arrays_of(self.value(step))

    def metrics(self) -> dict[str, float | list[float]]:
        """Return every figure of merit that ``neusee run`` prints, such as ``restored_quality.psnr``.

        A figure with a value for each band is a list. A figure that this run did not need is read from the store or
        computed.
        """
        from neusee.workflows.report.notebook import numbers_of

        return numbers_of(self)

    def __repr__(self) -> str:
        from neusee.workflows.report.notebook import result_line

        return result_line(self)

    def _repr_html_(self) -> str:
        from neusee.workflows.report.notebook import result_html

        return result_html(self)


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

    Args: outputs: if None, the outputs of the recipe. device: one or several devices, such as
    ``cuda:0,cuda:1,cpu``, the preferred device first. executor: computes the steps in place of this process.
    memory: bytes that this process, and each GPU, may use; if None, most of the memory that is free.
    show: is told each computed result, while later steps wait. series: what earlier runs found that holds for this
    one as well. anew: steps that are computed, with all that follow from them, although their results are stored.
    Raises `RunError`, which names the step, and ValueError for a device that this machine does not have.
    """
    began = time.perf_counter()
    check_devices(device)
    wanted = recipe.outputs if outputs is None else tuple(outputs)
    for name in wanted:
        if name not in recipe.steps:
            raise ValueError(unknown_step(name, recipe.steps))
    again = copies_of(recipe, anew)
    recipe, store, watch = with_substitutions(recipe, wanted), store or open_store(), watch or (lambda event: None)
    series = series or RunSeries.begun(store)
    how = (executor, memory, show or (lambda *_: None), series)
    attempt, carried = 1, dict[str, Outcome]()
    while True:
        work = Execution(recipe, store, device.split(","), watch, wanted, *how, carried, again)
        try:
            with limited(memory_limit(memory)):
                return replace(_attempt(work, wanted, began, show is not None), attempts=attempt)
        except TaintedRun as seen:
            carried[seen.outcome.work.step.name] = seen.outcome
            series.read_code_again(store)
        except ToleranceNotProven as failed:
            scale = stricter_scale(recipe, failed.over) if attempt == 1 else 0.0  # a third attempt is exact
            attempt, whole = attempt + 1, recipe.unsubstituted or recipe
            recipe = with_substitutions(replace(whole, tolerance_scale=scale, exact=scale == 0.0), wanted)
            if not recipe.exact and _futile(recipe, work, wanted):
                recipe = replace(whole, tolerance_scale=0.0, exact=True)
        finally:
            work.close()
            give_back()


def _futile(stricter: Recipe, work: Execution, wanted: tuple[str, ...]) -> bool:
    """Return True if the error of the run ``work`` is above the tolerance even where only rounding is left of it.

    Cheaper steps with smaller limits, as the recipe ``stricter`` has them, keep the rounding of their sums.
    """
    share = skip_share(stricter)

    def at_best(name: str) -> StepRecord:
        done = work.done.get(name) or work.asleep(name)
        if done.state == "left out" and (done.bound or 0.0) > stricter.allowed(name) * share:
            return replace(done, state="run")
        if not done.error or done.error[0] <= _ROUNDING:
            return done
        return replace(done, error=(_ROUNDING, done.error[1] * _ROUNDING / done.error[0]))

    order = needed(work.recipe, tolerance_frontier(work.recipe, needed(work.recipe, wanted), wanted))
    return proof(work.recipe, order, wanted, at_best, work.known_facts).over(stricter) > 1.0


def _attempt(work: Execution, wanted: tuple[str, ...], began: float, shows: bool) -> Result:
    """Run the recipe; raise `ToleranceNotProven` if its errors cannot be proved to be within the tolerance."""
    recipe, store = work.recipe, work.store
    order = needed(recipe, wanted)
    with torch.no_grad():
        work.resolve(order)
        first = tolerance_frontier(recipe, order, wanted)
        missing, targets = work.missing(wanted) if first else set(), [work.keys[name] for name in wanted]
        if early := [name for name in first if work.keys[name] in missing]:
            early = _targets_first(work, order, early, wanted, missing) if shows else early  # a sweep shows nothing
            work.make([work.keys[name] for name in early], keep=False, later=targets)

        def known(name: str) -> StepRecord:
            return work.done.get(name) or work.asleep(name)

        lead = order if first and not missing else needed(recipe, first)
        proved = proof(recipe, lead, wanted, known, work.known_facts)
        over = proved.over(recipe)
        if over > 1.0 and not recipe.exact:
            raise ToleranceNotProven(over)
        work.make(targets, keep=False)
    values = {name: to_device(work.values[work.keys[name]], work.devices[0]) for name in wanted}
    done = work.account(order)
    peak = process_peak()
    seconds = time.perf_counter() - began
    if missing:  # otherwise all results were known before
        proved = proof(recipe, order, wanted, done.__getitem__, work.known_facts)
    device = ",".join(work.devices)
    expected = running_peak(work.schedule, work.own.lanes) if work.executor is work.own else None
    code = work.origins, work.code.parts
    return Result(values, done, work.keys, seconds, peak, recipe, store, device, work.schedule, proved, expected, *code)


def _targets_first(
    work: Execution, order: list[str], early: list[str], wanted: tuple[str, ...], missing: set[Key]
) -> list[str]:
    """Return the steps ``early`` and the outputs that need only shorter steps, the shortest first."""
    work.costs = work.costs or past_costs(work.store, sizes_of(work.recipe, order))
    steps = [(name, work.recipe.steps[name], None) for name in order if work.keys[name] in missing]
    seconds = {name: cost.seconds["cpu"] for name, cost in work.costs.in_turn(steps, ["cpu"]).items()}
    others = [name for name in wanted if work.keys[name] in missing]
    return shortest_first(work.recipe, order, early, others, seconds)
