"""One point of a work-precision diagram: a cold run, timed, and its outputs against those of the reference.

Cold is a store of its own in a temporary folder, with nothing in it but the digests of code, so that all that the
outputs need is computed and kept as in a first run. A point is kept in the study's store under what decides it; a study
that was stopped goes on from there.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from statistics import median
from typing import Any

from neusee.workflows.engine.provenance import machine, timestamp
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.graph.step_record import Event
from neusee.workflows.keys.cache_key import digest, key_of
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.cold_run import cold
from neusee.workflows.tolerance.cheaper_steps import with_substitutions
from neusee.workflows.tolerance.error_norm import error_of

TIMES = 3  #: cold runs of a point, of which the median counts
_QUICK = 5.0  #: s; what takes longer is run once
_WITHIN = ("tolerance", "exact")  #: fields of a recipe that stand in no key


@dataclass(frozen=True)
class Trial:
    """A setting to try: the recipe with it, or why it cannot be."""

    line: str  #: the knob
    label: str
    recipe: Recipe | None
    refused: str = ""
    value: float | None = None  #: of a tolerance
    own: bool = False  #: whether it is what the recipe itself says


@dataclass(frozen=True)
class Measured:
    """What was found of a recipe; plain values, so that it can be kept."""

    errors: dict[str, list[float]] = field(default_factory=dict)  #: by output, one a seed
    seconds: list[float] = field(default_factory=list)  #: of the engine, one a cold run
    computing: float = 0.0  #: s in the steps, of the first of them
    load: float = 0.0  #: runnable processes for each core, this one included, as the machine said before
    bound: float | None = None  #: what the engine proved of the worst output
    steps: dict[str, float] = field(default_factory=dict)  #: s by step
    refused: str = ""


@dataclass(frozen=True)
class Point:
    """A trial and what was found of it."""

    trial: Trial
    found: Measured

    @property
    def seconds(self) -> float:
        return median(self.found.seconds) if self.found.seconds else float("inf")

    @property
    def by_seed(self) -> list[float]:
        """The worst output's error of each seed."""
        return [max(column) for column in zip(*self.found.errors.values(), strict=True)]

    @property
    def error(self) -> float:
        """Median over the seeds of the worst output's error."""
        return median(self.by_seed) if self.by_seed else float("inf")

    @property
    def most(self) -> float:
        """The greatest error of any output and seed: what a tolerance must hold."""
        return max(self.by_seed, default=float("inf"))

    @property
    def sound(self) -> bool:
        """Whether it was run and compared."""
        return bool(self.found.errors and self.found.seconds)


class Bench:
    """Measures recipes against the reference, each once."""

    def __init__(self, reference: Recipe, store: Store, seeds: int, device: str = "cpu") -> None:
        self.reference, self.store, self.device = reference, store, device
        self.seeds = seeds if draws(reference) else 1
        self._truth: dict[int, dict[str, Any]] = {}
        self._code = Code(store.code_memo)
        self._warm = False

    def point(self, trial: Trial) -> Point:
        """The point of a trial, from the store or measured now."""
        if trial.recipe is None:
            return Point(trial, Measured(refused=trial.refused))
        key = self.key(trial.recipe)
        if self.store.has(key):
            return Point(trial, Measured(**self.store.get(key)))
        found = self._measure(trial.recipe)
        self.store.put(key, asdict(found), _about(found.seconds))
        return Point(trial, found)

    def again(self, point: Point, number: int) -> Point:
        """The point with one more cold run, if it is a quick one; ``number`` tells its runs apart."""
        recipe, seconds = point.trial.recipe, point.found.seconds
        if recipe is None or not seconds or seconds[0] >= _QUICK:
            return point
        key = digest(self.key(recipe), number)
        if self.store.has(key):
            one = [float(s) for s in self.store.get(key)]
        else:
            self._warm_up(recipe)
            with cold(self.store) as store:
                one = [run(recipe, store, device=self.device).seconds]
            self.store.put(key, one, _about(one))
        return Point(point.trial, replace(point.found, seconds=[*seconds, *one]))

    def key(self, recipe: Recipe) -> str:
        """What decides a point: both recipes with their code and files, the engine, the seeds and the machine."""
        both = [self._says(r) for r in (recipe, self.reference)]
        return digest("accuracy", both, self.seeds, self.device, engine(), machine())

    def truth(self, seed: int) -> dict[str, Any]:
        """The reference's outputs; they are kept in the store as those of any run."""
        if seed not in self._truth:
            recipe = replace(self.reference, seed=self.reference.seed + seed)
            result = run(recipe, self.store, device=self.device)
            self._truth[seed] = result.values
            self._warm |= sum(done.state == "run" for done in result.done.values()) > len(result.done) / 2
        return self._truth[seed]

    def _says(self, recipe: Recipe) -> list[Any]:
        keys: dict[str, str] = {}
        for name in needed(recipe, recipe.outputs):
            keys[name], _ = key_of(recipe.steps[name], keys, recipe.seed, self._code, self.device)
        return [[keys[name] for name in recipe.outputs], *(getattr(recipe, name) for name in _WITHIN)]

    def _measure(self, recipe: Recipe) -> Measured:
        load = os.getloadavg()[0] / (os.cpu_count() or 1) if hasattr(os, "getloadavg") else 0.0
        ran: dict[str, float] = {}

        def watch(event: Event) -> None:
            if event.done is not None and event.done.state == "run":  # again where the engine tries again
                ran[event.step] = ran.get(event.step, 0.0) + event.done.seconds

        try:
            self._warm_up(recipe)
            with cold(self.store) as store:
                result = run(recipe, store, watch=watch, device=self.device)
                errors = self._errors(recipe, result.values, store)
        except RunError as error:
            return Measured(refused=f"{error.step}: {error.cause}")
        return Measured(errors, [result.seconds], sum(ran.values()), load, result.proof.worst, ran)

    def _warm_up(self, recipe: Recipe) -> None:
        """What a process does only once, to import libraries and to read code, is no time of the first point."""
        self.truth(0)
        for step in with_substitutions(recipe, recipe.outputs).steps.values():
            self._code.digest(step.node.fn.__module__)
        self._code.save()
        if not self._warm:
            with cold(self.store) as store:
                run(recipe, store, device=self.device)
            self._warm = True

    def _errors(self, recipe: Recipe, values: Mapping[str, Any], store: Store) -> dict[str, list[float]]:
        """Of every output that keeps its shape, for each seed; the steps that draw nothing are not run again."""
        found = compared(values, self.truth(0))
        for seed in range(1, self.seeds):
            again = run(replace(recipe, seed=recipe.seed + seed), store, device=self.device)
            for name, errors in compared(again.values, self.truth(seed)).items():
                found[name] += errors
        return found


def compared(values: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, list[float]]:
    """The error of each output; one of another shape than the reference's cannot be compared and is left away."""
    found: dict[str, list[float]] = {}
    for name, value in values.items():
        try:
            found[name] = [error_of(value, truth[name])]
        except ValueError:
            continue
    return found


def draws(recipe: Recipe) -> bool:
    """Whether anything that the outputs need is random."""
    return any(recipe.steps[name].node.random for name in needed(recipe, recipe.outputs))


def _about(seconds: Sequence[float]) -> dict[str, Any]:
    return {"step": "study accuracy", "seconds": sum(seconds), "date": timestamp()}
