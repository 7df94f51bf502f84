"""Run a recipe: walk back from what is wanted, stop at what is known, compute the rest.

Nothing here is recursive over the graph, and values are held by key: two steps that are
the same computation are computed once, and a step that is left out shares its input's key.
"""

from __future__ import annotations

import resource
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from typing import Any, Literal

import torch

from neusee.nodes import Check, Facts
from neusee.workflows._call import RunError, call, examine, place, to_device, versions
from neusee.workflows._code import Code
from neusee.workflows._codec import tensors_in
from neusee.workflows._graph import Recipe, Step, in_order, needed
from neusee.workflows._keys import Key, key_of, plain
from neusee.workflows._marks import nearest
from neusee.workflows._store import Store
from neusee.workflows._verdict import Verdict, judge

State = Literal["run", "cached", "left out", "asleep"]


@dataclass(frozen=True, slots=True)
class Done:
    """What became of a step, and why."""

    step: str
    state: State  #: ``asleep``: nothing that ran needed it
    why: str
    seconds: float
    key: Key
    facts: Facts | None = None
    checks: tuple[Check, ...] = ()
    device: str = "cpu"
    bytes: int = 0
    bound: float | None = None  #: what leaving the step out may change at most
    began: float = 0.0  #: s since the run began
    lane: str = ""  #: which place of the executor computed it
    peak: int | None = None  #: bytes of memory beside what was there before it ran
    predicted: float | None = None  #: s that earlier runs made one expect
    kept: bool = True  #: whether the store has the value


@dataclass(frozen=True, slots=True)
class Event:
    """For a live table: ``step`` has started (``done`` is None) or has finished."""

    step: str
    done: Done | None


@dataclass(frozen=True, repr=False)
class Result:
    """What a run gives: the values that were asked for, and an account of every step they need."""

    values: dict[str, Any]
    done: dict[str, Done]
    keys: dict[str, Key]
    seconds: float
    peak_memory: int  #: bytes, of this process so far
    recipe: Recipe
    store: Store
    device: str = "cpu"

    def value(self, step: str) -> Any:
        """The value of any step of the recipe: from this run, from the store, or computed now."""
        if step in self.values:
            return self.values[step]
        return run(self.recipe, self.store, (step,), device=self.device).values[step]

    __getitem__ = value

    def numpy(self, step: str) -> Any:
        """The value of a step with a numpy array for every tensor."""
        from neusee.workflows._notebook import arrays_of

        return arrays_of(self.value(step))

    def metrics(self) -> dict[str, float | list[float]]:
        """The figures of merit by name, such as ``restored_quality.psnr``; a list where there is one a band."""
        from neusee.workflows._notebook import numbers_of

        return numbers_of(self)

    def __repr__(self) -> str:
        from neusee.workflows._notebook import result_line

        return result_line(self)

    def _repr_html_(self) -> str:
        from neusee.workflows._notebook import result_html

        return result_html(self)


def run(
    recipe: Recipe,
    store: Store | None = None,
    outputs: Iterable[str] | None = None,
    watch: Callable[[Event], None] | None = None,
    device: str = "cpu",
) -> Result:
    """Give the values of ``outputs`` (the recipe's own, if None), computing what ``store`` does not hold."""
    began = time.perf_counter()
    wanted = recipe.outputs if outputs is None else tuple(outputs)
    for name in wanted:
        if name not in recipe.steps:
            raise ValueError(f"no step {name!r}; {nearest(name, recipe.steps)}")
    work = _Run(recipe, store or Store(), device, watch or (lambda event: None))
    order = needed(recipe, wanted)
    try:
        with torch.no_grad():
            work.resolve(order)
            work.make([work.keys[name] for name in wanted], keep=False)
    finally:
        work.code.save()
    values = {name: to_device(work.values[work.keys[name]], device) for name in wanted}
    done = work.account(order)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return Result(values, done, work.keys, time.perf_counter() - began, peak, recipe, work.store, device)


class _Lost(Exception):
    """A stored result turned out to be damaged when it was read: plan again without it."""


class _Run:
    """One run under way."""

    def __init__(self, recipe: Recipe, store: Store, device: str, watch: Callable[[Event], None]) -> None:
        self.recipe, self.store, self.device, self.watch = recipe, store, device, watch
        self.code = Code(store.code_memo)
        self.keys: dict[str, Key] = {}
        self.makers: dict[Key, Step] = {}  # the first step of each key
        self.origins: dict[Key, dict[str, Any]] = {}  # what went into each key
        self.values: dict[Key, Any] = {}
        self.facts: dict[Key, Facts | None] = {}
        self.verdicts: dict[str, Verdict] = {}
        self.done: dict[str, Done] = {}

    def resolve(self, order: list[str]) -> None:
        """Give every step its key, and leave out those whose bound allows it."""
        for name in order:
            step = self.recipe.steps[name]
            if step.node.bound is not None:
                verdict = self.verdicts[name] = self._judge(step)
                if verdict.left_out:
                    self._leave_out(step, verdict)
                    continue
            try:
                key, origin = key_of(step, self.keys, self.recipe.seed, self.code, place(step, self.device))
            except (OSError, LookupError, TypeError) as error:
                raise RunError(step, [], error) from error
            self.keys[name] = key
            if key not in self.makers:
                self.makers[key], self.origins[key] = step, origin

    def make(self, targets: list[Key], keep: bool) -> None:
        """Hold the values of ``targets``; with ``keep``, also what cannot be read from the store again."""
        while True:
            below = _Below(self)
            plan = [key for key in in_order(below, targets) if key in below.missing]
            try:
                return self._execute(plan, targets, keep)
            except _Lost:
                continue

    def account(self, order: list[str]) -> dict[str, Done]:
        """What became of every step, in running order."""
        for name in order:
            if name in self.done:
                continue
            key = self.keys[name]
            twin = self.done.get(self.makers[key].name)
            if twin is None or twin.state == "asleep":
                self._finish(Done(name, "asleep", "nothing that ran needed it", 0.0, key, bound=self._bound(name)))
            else:
                self._finish(replace(twin, step=name, state="cached", why=f"the same as {twin.step}", seconds=0.0))
        return {name: self.done[name] for name in order}

    def sources(self, key: Key) -> list[Key]:
        return [self.keys[name] for name in self.makers[key].sources]

    def known(self, key: Key) -> bool:
        return key in self.values or self.store.has(key)

    def _execute(self, plan: list[Key], targets: list[Key], keep: bool) -> None:
        uses = Counter(targets)
        for key in plan:
            uses.update(self.sources(key))
        self._free(list(self.values), uses, keep)
        for key in plan:
            self._compute(key)
            sources = self.sources(key)
            uses.subtract(sources)
            self._free([*sources, key], uses, keep)
        for key in targets:
            self._fetch(key)

    def _free(self, keys: Iterable[Key], uses: Counter[Key], keep: bool) -> None:
        """Let go of values at their last use."""
        for key in keys:
            if uses[key] <= 0 and key in self.values and not (keep and not self.store.has(key)):
                del self.values[key]

    def _fetch(self, key: Key) -> Any:
        """A value that was computed, or is stored."""
        if key not in self.values:
            began, about = time.perf_counter(), self.store.about(key)
            try:
                loaded = self.store.get(key)
            except KeyError:
                raise _Lost(key) from None
            assert about is not None
            self.values[key] = loaded
            if self.makers[key].name not in self.done:
                self._finish(self._cached(key, about, time.perf_counter() - began))
        return self.values[key]

    def _cached(self, key: Key, about: dict[str, Any], seconds: float) -> Done:
        name = self.makers[key].name
        why = f"made {about['date']} in {about['seconds']:.3g} s"
        checks = tuple(Check(text, ok) for text, ok in about["checks"])
        size, bound = about["bytes"], self._bound(name)
        return Done(name, "cached", why, seconds, key, self._stored_facts(key), checks, "cpu", size, bound)

    def _compute(self, key: Key) -> None:
        step = self.makers[key]
        inputs = [self._gather(step, name) for name in step.node.inputs]
        self.watch(Event(step.name, None))
        began, where = time.perf_counter(), place(step, self.device)
        value = call(step, inputs, step.params, self.recipe.seed, where)
        checks = examine(step, value, inputs)
        del inputs
        seconds = time.perf_counter() - began
        if self.origins[key]["params"] != {name: plain(param) for name, param in step.params.items()}:
            raise RunError(step, [], OSError("a file changed while it was read: run again"))
        self.values[key], self.facts[key] = value, Facts.of(value)
        size, bound, why = sum(t.nbytes for t in tensors_in(value)), self._bound(step.name), self._why(step.name)
        done = Done(step.name, "run", why, seconds, key, self.facts[key], checks, where, size, bound)
        self._keep(step, done)
        self._finish(done)

    def _keep(self, step: Step, done: Done) -> None:
        """Store a value with everything that is known of it."""
        about = {
            "step": step.name,
            "recipe": self.recipe.name,
            "origin": self.origins[done.key],
            "facts": done.facts and asdict(done.facts),
            "checks": [[check.text, check.ok] for check in done.checks],
            "seconds": done.seconds,
            "device": done.device,
            "versions": versions(),
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        try:
            self.store.put(done.key, self.values[done.key], about)
        except TypeError as error:
            raise RunError(step, [], error) from error

    def _gather(self, step: Step, name: str) -> Any:
        wire = step.wires.get(name)
        if wire is None or isinstance(wire, str):
            return None if wire is None else self._fetch(self.keys[wire])
        return [self._fetch(self.keys[source]) for source in wire]

    def _judge(self, step: Step) -> Verdict:
        """The verdict on a step; an input runs first where the bound asks for facts that no one has yet."""

        def facts_of(name: str) -> Facts | None:
            key = self.keys[name]
            if key not in self.facts and not self.store.has(key):
                self.make([key], keep=True)
            return self.facts[key] if key in self.facts else self._stored_facts(key)

        return judge(step, step.params, facts_of, self.recipe.tolerance)

    def _leave_out(self, step: Step, verdict: Verdict) -> None:
        key = self.keys[step.name] = self.keys[verdict.instead]
        self._finish(Done(step.name, "left out", verdict.why, 0.0, key, bound=verdict.bound))

    def _stored_facts(self, key: Key) -> Facts | None:
        found = (self.store.about(key) or {}).get("facts")
        return Facts(**{**found, "shape": tuple(found["shape"])}) if found else None

    def _why(self, name: str) -> str:
        verdict = self.verdicts.get(name)
        return f"not in the store; {verdict.why}" if verdict else "not in the store"

    def _bound(self, name: str) -> float | None:
        return self.verdicts[name].bound if name in self.verdicts else None

    def _finish(self, done: Done) -> None:
        self.done[done.step] = done
        self.watch(Event(done.step, done))


class _Below(dict[Key, list[Key]]):
    """By key the keys that it needs: its sources where it is missing, none where its value is known."""

    def __init__(self, work: _Run) -> None:
        self.work, self.missing = work, set[Key]()

    def __missing__(self, key: Key) -> list[Key]:
        if self.work.known(key):
            self[key] = []
        else:
            self.missing.add(key)
            self[key] = self.work.sources(key)
        return self[key]
