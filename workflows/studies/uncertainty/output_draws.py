"""Outputs of a recipe at one draw of its inputs after another: only what they reach, several draws at once."""

from __future__ import annotations

import ctypes
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.node_call import place
from neusee.workflows.engine.provenance import timestamp
from neusee.workflows.engine.threads import one_thread
from neusee.workflows.graph.recipe_graph import needed
from neusee.workflows.keys.cache_key import digest, key_of
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.recipe.distributions.uncertain_inputs import Inputs
from neusee.workflows.report.result_numbers import numbers_of
from neusee.workflows.store.result_store import Store

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Places = NDArray[np.float64]

Numbers = dict[str, list[float]]  #: by quantity, such as ``restored_quality.psnr``, its elements
_ARENAS, _MAPPED, _TRIM = -8, -4, -1  #: M_ARENA_MAX, M_MMAP_MAX and M_TRIM_THRESHOLD of glibc's mallopt
_NARROW = 8  #: columns that a table has at most; what has more of both is a picture


class Draws:
    """Computes outputs at draws and keeps their numbers in the store, draw by draw."""

    def __init__(self, inputs: Inputs, store: Store, device: str = "cpu", workers: int = 0) -> None:
        self.inputs, self.store, self.device = inputs, store, device
        self.workers = 1 if device != "cpu" else workers or os.cpu_count() or 1
        recipe = inputs.recipe
        self._order = needed(recipe, recipe.outputs)
        self._live = _reached(inputs, self._order)
        self.outputs = tuple(name for name in recipe.outputs if name in self._live)
        self.is_constant = tuple(name for name in recipe.outputs if name not in self._live)
        self._code = Code(store.root / "code.json")
        self._fixed = self._keys({})
        self.computed = 0  #: draws that were not in the store
        self.seconds = 0.0  #: of them

    @cached_property
    def _function(self) -> Any:
        """What the inputs do not reach is computed here, once."""
        free = tuple(self.inputs.readers)
        return as_function(self.inputs.recipe, *free, outputs=self.outputs, store=self.store, device=self.device)

    def ready(self) -> float:
        """Compute what no input reaches; the seconds it took."""
        began = time.perf_counter()
        _ = self._function
        return time.perf_counter() - began

    def numbers(self, values: Places) -> list[Numbers]:
        """All numbers of the outputs at each draw (draw, input); what is stored is not computed again."""
        keys = [self.key(row) for row in values]
        found = [kept and kept["numbers"] for kept in map(self._kept, keys)]
        lacking = [i for i, numbers in enumerate(found) if numbers is None]
        for i, result in zip(lacking, self._results([values[i] for i in lacking]), strict=True):
            found[i] = self._keep(keys[i], result)
        return [numbers for numbers in found if numbers is not None]

    def pictures(self, values: Places) -> dict[str, tuple[Tensor, Tensor]]:
        """Mean and standard deviation of every output that is a picture, pixel by pixel; its numbers are kept too."""
        keys = [self.key(row) for row in values]
        whole = digest("uncertainty pictures", keys)
        if (first := self._kept(keys[0])) is not None and not first["pictures"]:
            return {}
        with suppress(KeyError):
            return _pairs(self.store.get(whole))
        began, sums = time.perf_counter(), dict[str, _Sum]()
        for key, result in zip(keys, self._results(list(values)), strict=True):
            self._keep(key, result)
            for name, value in result.items():
                if _is_picture(value):
                    sums.setdefault(name, _Sum()).add(value)
        found = {part: x for name, s in sums.items() for part, x in ((f"{name} mean", s.mean), (f"{name} sd", s.sd))}
        if found:
            seconds = time.perf_counter() - began
            self.store.put(whole, found, {"step": "study uncertainty", "seconds": seconds, "date": timestamp()})
        return _pairs(found)

    def key(self, row: Places) -> str:
        """What decides the outputs at a draw: the keys of a run with these values."""
        recipe = self.inputs.recipe
        keys = self._keys(self.inputs.theta(self._named(row)))
        within = [recipe.tolerance, recipe.exact, self.device.partition(":")[0]]
        return digest(
            "uncertainty draw",
            engine("studies.uncertainty.output_draws"),
            [[name, keys[name]] for name in self.outputs],
            within,
        )

    def _keys(self, theta: Mapping[str, Any]) -> dict[str, str]:
        """By step; without ``theta``, of those alone that no input reaches."""
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
        about = {"step": "study uncertainty", "seconds": self.seconds / max(1, self.computed), "date": timestamp()}
        self.store.put_small(key, {"numbers": numbers, "pictures": shown}, about)
        return numbers

    def _results(self, rows: Sequence[Places]) -> Iterator[dict[str, Any]]:
        """Outputs at each draw, in order: as many at once as there are cores, each on one thread."""
        if not rows:
            return
        self.ready()
        began = time.perf_counter()
        _keep_memory()
        with one_thread(), ThreadPoolExecutor(self.workers) as pool:
            for first in range(0, len(rows), self.workers):
                for result in pool.map(self._result, rows[first : first + self.workers]):
                    self.computed += 1
                    self.seconds += time.perf_counter() - began
                    yield result
                    began = time.perf_counter()

    def _result(self, row: Places) -> dict[str, Any]:
        values = self._named(row)
        try:
            with torch.no_grad():
                found: dict[str, Any] = self._function(self.inputs.theta(values))
        except (RuntimeError, ValueError) as error:
            at = ", ".join(f"{name} = {value:.6g}" for name, value in values.items())
            raise ValueError(f"at {at}: {error}") from error
        return found

    def _named(self, row: Places) -> dict[str, float]:
        return dict(zip(self.inputs.names, map(float, row), strict=True))


def quantities(result: Mapping[str, Any]) -> Numbers:
    """Every small result by the name of its step and field."""
    found: Numbers = {}
    for step, value in result.items():
        for _, field, _, number in () if _is_picture(value) else numbers_of(step, value):
            found.setdefault(f"{step}.{field}" if field else step, []).append(number)
    return found


def _reached(inputs: Inputs, order: Sequence[str]) -> set[str]:
    live = {reader.rpartition(".")[0] for reader in inputs.readers}
    for name in order:
        if any(source in live for source in inputs.recipe.steps[name].sources):
            live.add(name)
    return live


def _is_picture(value: Any) -> bool:
    return isinstance(value, Tensor) and (value.ndim > 2 or (value.ndim == 2 and min(value.shape) > _NARROW))


def _pairs(found: Mapping[str, Tensor]) -> dict[str, tuple[Tensor, Tensor]]:
    names = dict.fromkeys(name.removesuffix(" mean").removesuffix(" sd") for name in found)
    return {name: (found[f"{name} mean"], found[f"{name} sd"]) for name in names}


class _Sum:
    """Mean and standard deviation of pictures that come one after another (Welford)."""

    def __init__(self) -> None:
        self.count = 0
        self.mean = self._squares = torch.zeros(())

    def add(self, picture: Tensor) -> None:
        x = picture.detach().cpu().float()
        self.count += 1
        if self.count == 1:
            self.mean, self._squares = x.clone(), torch.zeros_like(x)
            return
        apart = x - self.mean
        self.mean += apart / self.count
        self._squares += apart * (x - self.mean)

    @property
    def sd(self) -> Tensor:
        return (self._squares / max(1, self.count - 1)).sqrt()


@cache
def _keep_memory() -> None:
    """Let the process keep the memory of a draw for the next: to ask the system anew takes longer than to compute.

    Of glibc alone, and from now on.
    """
    if sys.platform.startswith("linux"):
        with suppress(OSError, AttributeError):
            libc = ctypes.CDLL(None)
            for option, value in ((_ARENAS, 1), (_MAPPED, 0), (_TRIM, 2**31 - 1)):
                libc.mallopt(option, value)
