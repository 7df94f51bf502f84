"""The outputs of a recipe for random values of its uncertain inputs; steps without these inputs run only once."""

from __future__ import annotations

import ctypes
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, cached_property
from typing import Any

import torch
from torch import Tensor

from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.local_executor import one_thread
from neusee.workflows.engine.node_call import place
from neusee.workflows.engine.provenance import timestamp
from neusee.workflows.engine.worker_processes import shared_in_order, workers_for
from neusee.workflows.graph.recipe_graph import needed
from neusee.workflows.keys.cache_key import device_kind, digest, key_of
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.recipe.distributions.uncertain_inputs import Inputs
from neusee.workflows.report.result_numbers import numbers_of
from neusee.workflows.store.memo import compute_once
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.uncertainty.scatter_estimate import FloatArray

Numbers = dict[str, list[float]]  #: elements of each quantity, such as ``restored_quality.psnr``
_ARENAS, _MAPPED, _TRIM = -8, -4, -1  #: M_ARENA_MAX, M_MMAP_MAX and M_TRIM_THRESHOLD of glibc's mallopt
_ABOUT = {"step": "study uncertainty"}
_NARROW = 8  #: a tensor of two axes counts as a picture if both are longer


class OutputDraws:
    """The outputs of a recipe for random values of its uncertain inputs; the store keeps the numbers of each draw."""

    def __init__(self, inputs: Inputs, store: Store, device: str = "cpu", workers: int = 0) -> None:
        self.inputs, self.store, self.device = inputs, store, device
        self.workers = workers  #: processes that compute draws; 0 means one for each free processor
        recipe = inputs.recipe
        self._order = needed(recipe, recipe.outputs)
        self._live = _reached_steps(inputs, self._order)
        self.outputs = tuple(name for name in recipe.outputs if name in self._live)
        self.is_constant = tuple(name for name in recipe.outputs if name not in self._live)
        self._code = Code(store.root / "code.json")
        self._fixed = self._keys({})
        self.computed = 0  #: draws that were not in the store
        self.seconds = 0.0  #: run time of these draws, s

    @cached_property
    def _function(self) -> Any:
        """Compute the steps that depend on no uncertain input, and return the recipe as a function of the inputs."""
        free = tuple(self.inputs.readers)
        return as_function(self.inputs.recipe, *free, outputs=self.outputs, store=self.store, device=self.device)

    def ready(self) -> float:
        """Compute the steps that depend on no uncertain input, and return the run time in seconds."""
        began = time.perf_counter()
        _ = self._function
        return time.perf_counter() - began

    def numbers(self, values: FloatArray) -> list[Numbers]:
        """Return all numbers in the outputs for each draw of the inputs; compute draws that the store does not have."""
        keys = [self.key(row) for row in values]
        found = [kept and kept["numbers"] for kept in map(self._kept, keys)]
        lacking = [i for i, numbers in enumerate(found) if numbers is None]
        for i, result in zip(lacking, self._results([values[i] for i in lacking]), strict=True):
            found[i] = self._keep(keys[i], result)
        return [numbers for numbers in found if numbers is not None]

    def pictures(self, values: FloatArray) -> dict[str, tuple[Tensor, Tensor]]:
        """Return mean and standard deviation of each output picture over the draws, and store each draw's numbers."""
        keys = [self.key(row) for row in values]
        whole = digest("uncertainty pictures", keys)
        if (first := self._kept(keys[0])) is not None and not first["pictures"]:
            return {}
        found: dict[str, tuple[Tensor, Tensor]]
        found = compute_once(self.store, whole, dict, lambda: self._sums(keys, values), _ABOUT)
        return found

    def _sums(self, keys: Sequence[str], values: FloatArray) -> dict[str, tuple[Tensor, Tensor]]:
        sums = dict[str, _Sum]()
        for key, result in zip(keys, self._results(list(values)), strict=True):
            self._keep(key, result)
            for name, value in result.items():
                if _is_picture(value):
                    sums.setdefault(name, _Sum()).add(value)
        return {name: (total.mean, total.sd) for name, total in sums.items()}

    def key(self, row: FloatArray) -> str:
        """Return the store key of one draw: a digest of the output keys of a run with the sampled input values."""
        recipe = self.inputs.recipe
        keys = self._keys(self.inputs.theta(self._named(row)))
        outputs = [[name, keys[name]] for name in self.outputs]
        within = [recipe.tolerance, recipe.exact, recipe.estimates, device_kind(self.device)]
        return digest("uncertainty draw", engine("studies.uncertainty.output_draws"), outputs, within)

    def _keys(self, theta: Mapping[str, Any]) -> dict[str, str]:
        """Return the store keys of steps that depend on the inputs ``theta``; if ``theta`` is empty, of other steps."""
        recipe, keys = self.inputs.recipe, dict(self._fixed) if theta else {}
        by_step: dict[str, dict[str, Any]] = {}
        for reader, value in theta.items():
            reads, _, param = reader.rpartition(".")
            by_step.setdefault(reads, {})[param] = value
        for name in self._order:
            if (name in self._live) != bool(theta):
                continue
            step = recipe.steps[name]
            if name in by_step:
                step = replace(step, params={**step.params, **by_step[name]})
            keys[name], _ = key_of(step, keys, recipe.seed, self._code, place(step, self.device))
        return keys

    def _kept(self, key: str) -> dict[str, Any] | None:
        with suppress(KeyError):
            found: dict[str, Any] = self.store.get(key)
            return found
        return None

    def _keep(self, key: str, result: Mapping[str, Any]) -> Numbers:
        numbers = quantities(result)
        shown = [name for name, value in result.items() if _is_picture(value)]
        about = {**_ABOUT, "seconds": self.seconds / max(1, self.computed), "date": timestamp()}
        self.store.put_small(key, {"numbers": numbers, "pictures": shown}, about)
        return numbers

    def _results(self, rows: Sequence[FloatArray]) -> Iterator[dict[str, Any]]:
        """Yield the outputs for each draw of the inputs, in order; worker processes compute in parallel."""
        if not rows:
            return
        self.ready()
        began = time.perf_counter()
        _keep_memory()
        workers = workers_for(len(rows), self.workers) if self.device == "cpu" else 1
        with one_thread():
            for result in shared_in_order(lambda number: self._result(rows[number]), len(rows), workers):
                self.computed += 1
                self.seconds += time.perf_counter() - began
                yield result
                began = time.perf_counter()

    def _result(self, row: FloatArray) -> dict[str, Any]:
        values = self._named(row)
        try:
            with torch.no_grad():
                found: dict[str, Any] = self._function(self.inputs.theta(values))
        except (RuntimeError, ValueError) as error:
            at = ", ".join(f"{name} = {value:.6g}" for name, value in values.items())
            raise ValueError(f"the recipe fails at the input values {at}: {error}") from error
        return found

    def _named(self, row: FloatArray) -> dict[str, float]:
        return dict(zip(self.inputs.names, map(float, row), strict=True))


def quantities(result: Mapping[str, Any]) -> Numbers:
    """Return all numbers in ``result`` by step and field, without pictures."""
    found: Numbers = {}
    for step, value in result.items():
        for _, field, _, number in () if _is_picture(value) else numbers_of(step, value):
            found.setdefault(f"{step}.{field}" if field else step, []).append(number)
    return found


def _reached_steps(inputs: Inputs, order: Sequence[str]) -> set[str]:
    live = {reader.rpartition(".")[0] for reader in inputs.readers}
    for name in order:
        if any(source in live for source in inputs.recipe.steps[name].sources):
            live.add(name)
    return live


def _is_picture(value: Any) -> bool:
    return isinstance(value, Tensor) and (value.ndim > 2 or (value.ndim == 2 and min(value.shape) > _NARROW))


class _Sum:
    """The running mean and standard deviation of pictures, by Welford's method."""

    def __init__(self) -> None:
        self.count = 0
        self.mean = self._squares = torch.zeros(())

    def add(self, picture: Tensor) -> None:
        x = picture.detach().cpu().float()
        self.count += 1
        apart = x - self.mean
        self.mean = self.mean + apart / self.count
        self._squares = self._squares + apart * (x - self.mean)

    @property
    def sd(self) -> Tensor:
        return (self._squares / max(1, self.count - 1)).sqrt()


@cache
def _keep_memory() -> None:
    """Make the process reuse freed memory, because a new allocation for each draw takes too long.

    The setting works with glibc only, and lasts for the rest of the process.
    """
    if sys.platform.startswith("linux"):
        with suppress(OSError, AttributeError):
            libc = ctypes.CDLL(None)
            for option, value in ((_ARENAS, 1), (_MAPPED, 0), (_TRIM, 2**31 - 1)):
                libc.mallopt(option, value)
