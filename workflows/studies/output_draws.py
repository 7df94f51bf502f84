"""The outputs of a recipe for random values of its uncertain inputs, and their scatter."""

from __future__ import annotations

import ctypes
import math
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import chain
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.local_executor import one_thread
from neusee.workflows.engine.node_call import place
from neusee.workflows.engine.provenance import timestamp
from neusee.workflows.engine.result_values import numbers_of
from neusee.workflows.engine.worker_processes import shared_in_order, workers_for
from neusee.workflows.graph.errors import Diagnostic, RecipeError
from neusee.workflows.graph.recipe_graph import needed
from neusee.workflows.keys.cache_key import device_kind, digest, key_of
from neusee.workflows.keys.code_digest import Code, engine
from neusee.workflows.recipe.distributions.shapes import FloatArray as ShapesFloatArray
from neusee.workflows.recipe.uncertain_inputs import InputDraws, Inputs
from neusee.workflows.store.result_store import Store, compute_once
from neusee.workflows.studies.reused_choices import ReusedChoices

# --- scatter estimate -----------------------------------------------------------------------------

# Means and standard deviations of quantities over random draws, and the standard errors of these
# standard deviations.


FloatArray = NDArray[np.float64]
#: a quantity with a standard deviation below this fraction of its largest value counts as constant
_CONSTANT = 1e-12


@dataclass(frozen=True)
class Scatter:
    """The mean, standard deviation and quantiles over all draws, for each element of one
    quantity.
    """

    mean: FloatArray
    sd: FloatArray
    low: FloatArray  #: 5 %
    high: FloatArray  #: 95 %
    #: relative error of the greatest standard deviation; 0 if the quantity is constant
    error: float

    @property
    def is_constant(self) -> bool:
        """Return True if the quantity has the same finite value in all draws."""
        return bool(np.isfinite(self.mean).all()) and not float(self.sd.max()) > 0


def scatter(values: FloatArray, sequences: int = 0) -> Scatter:
    """Return mean, standard deviation and quantiles of ``values`` (draw, element) over the draws.

    With ``sequences``, draw i belongs to the scrambled Sobol sequence i % sequences; otherwise
    draws are independent.
    """
    # a quantity that is infinite in a draw has no standard deviation
    with np.errstate(invalid="ignore"):
        mean, sd = values.mean(0), values.std(0, ddof=1)
        low_quantile, high_quantile = np.quantile(values, [0.05, 0.95], axis=0)
    sd = np.where(sd > _CONSTANT * np.abs(values).max(0), sd, 0.0)
    # the element with the largest standard deviation
    most_uncertain = values[:, int(sd.argmax())]
    error = 0.0
    if sd.max() > 0:
        error = (
            _of_sequences(most_uncertain, sequences) if sequences else _jackknife(most_uncertain)
        )
    return Scatter(mean, sd, low_quantile, high_quantile, error)


def _jackknife(x: FloatArray) -> float:
    """Return the relative standard error of the standard deviation of independent draws ``x``, by
    the jackknife.
    """
    count = len(x)
    squared_distances = (x - x.mean()) ** 2
    # leave-one-out standard deviations
    deviation_without = np.sqrt(
        (squared_distances.sum() - squared_distances * count / (count - 1)).clip(0.0) / (count - 2)
    )
    error = math.sqrt(
        (count - 1) / count * float(((deviation_without - deviation_without.mean()) ** 2).sum())
    )
    return error / float(x.std(ddof=1))


def _of_sequences(x: FloatArray, count: int) -> float:
    """Return the relative standard error of the standard deviation, from the variance within each
    Sobol sequence.
    """
    squares = (x - x.mean()) ** 2
    means = np.array([squares[sequence::count].mean() for sequence in range(count)])
    # the relative error of a square root is half of that of the variance
    return float(means.std(ddof=1) / math.sqrt(count) / means.mean() / 2)


def worst_known(scatter: Mapping[str, Scatter]) -> str:
    """Return the name of the quantity whose standard deviation has the largest relative error."""
    return max(scatter, key=lambda name: scatter[name].error)


# --- allowed draws --------------------------------------------------------------------------------

# Only draws whose values the recipe allows together are used; the number of omitted draws is
# reported.
#
# Each value may be allowed alone while two exclude each other, such as a full well below the
# offset.


class AllowedDraws:
    """The allowed draws of the inputs in order; a study extends their number step by step."""

    def __init__(self, inputs: Inputs, draws: InputDraws, sequences: int) -> None:
        self._inputs, self._draws = inputs, draws
        #: number of draws that are omitted together, so that Sobol sequences stay equally long
        self._block = max(1, sequences)
        self._allowed: list[int] = []
        self.tried = 0
        self.left_out = 0
        self.reason = ""  #: why the last draw was left out

    @property
    def available(self) -> int:
        """Return the largest number of draws that can be tried."""
        return len(self._draws.z)

    @property
    def statement(self) -> str:
        """Return the number of omitted draws and the reason as text; empty for none."""
        return f"{self.left_out} of {self.tried} draws ({self.reason})" if self.left_out else ""

    @property
    def z(self) -> ShapesFloatArray:
        """Return the standard normal numbers (draw, input) of the allowed draws so far."""
        return self._draws.z[self._allowed]

    @property
    def values(self) -> ShapesFloatArray:
        """Return the values (draw, input) of the allowed draws so far, in SI."""
        return self._draws.values[self._allowed]

    def extend(self, count: int) -> None:
        """Check further draws until ``count`` draws have been checked."""
        while self.tried < min(count, self.available):
            block = range(self.tried, min(self.tried + self._block, self.available))
            problems = [self._inputs.problem(self._draws.values[draw]) for draw in block]
            faults = [problem for problem in problems if problem is not None]
            if faults:
                self.left_out += len(block)
                self.reason = _text(faults[-1])
            else:
                self._allowed += block
            self.tried = block.stop


def refuse_combinations(inputs: Inputs, ends: ShapesFloatArray, draws: AllowedDraws) -> None:
    """Raise `RecipeError` if values of ``ends`` (run, input), or of a draw, are not allowed
    together.

    The draws are those checked before any run.
    """
    problems = [problem for problem in map(inputs.problem, ends) if problem is not None]
    if problems:
        raise RecipeError(problems)
    if draws.left_out:
        fault_text = (
            f"{draws.left_out} of the first {draws.tried} draws have values that are not allowed"
            " together"
        )
        # the place in the recipe of the first input
        value = inputs.uncertain.composed.root.below(inputs.names[0].split("."))
        assert value is not None
        advice = "give narrower or truncated distributions"
        raise RecipeError(
            [
                Diagnostic(
                    value.mark, ", ".join(inputs.names), f"{fault_text} ({draws.reason}): {advice}"
                )
            ]
        )


def _text(problem: Diagnostic) -> str:
    """Return an error as text, with the path of its value if it has one."""
    return f"{problem.path}: {problem.message}" if problem.path else problem.message


# --- output draws ---------------------------------------------------------------------------------

# The outputs of a recipe for random values of its uncertain inputs; steps that do not depend on
# these inputs run only once.


Numbers = dict[str, list[float]]  #: elements of each quantity, such as ``restored_quality.psnr``
#: M_ARENA_MAX, M_MMAP_MAX and M_TRIM_THRESHOLD of glibc's mallopt
_ARENAS, _MAPPED, _TRIM = -8, -4, -1
_STORED_AS = {"step": "study uncertainty"}
_NARROW = 8  #: a tensor of two axes counts as a picture if both axes are longer than this


class OutputDraws:
    """The outputs of a recipe for random values of its uncertain inputs; the numbers of each draw
    are kept in the store.
    """

    def __init__(self, inputs: Inputs, store: Store, device: str = "cpu", workers: int = 0) -> None:
        """Prepare draws of the outputs; ``workers`` processes compute draws on the CPU, 0 means one
        for each free processor.
        """
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
        """Compute the steps that depend on no uncertain input, and return the recipe as a function
        of the uncertain inputs.
        """
        free_parameters = tuple(self.inputs.readers)
        function = as_function(
            self.inputs.recipe,
            *free_parameters,
            outputs=self.outputs,
            store=self.store,
            device=self.device,
        )
        self._choices = ReusedChoices(function.recipe, function.live, free_parameters)
        return replace(function, caller=self._choices)

    def ready(self) -> float:
        """Compute the steps that depend on no uncertain input, and return the run time in s."""
        began = time.perf_counter()
        _ = self._function
        return time.perf_counter() - began

    def numbers(self, values: FloatArray) -> list[Numbers]:
        """Return all numbers of the outputs for each draw of the inputs, from the store or computed
        now.
        """
        keys = [self.key(row) for row in values]
        # so that the next command need not read the code of all nodes again
        self._code.save()
        # None for a draw that is not stored
        stored = [record and record["numbers"] for record in map(self._kept, keys)]
        lacking = [draw for draw, numbers in enumerate(stored) if numbers is None]
        for draw, result in zip(
            lacking, self._results([values[draw] for draw in lacking]), strict=True
        ):
            stored[draw] = self._keep(keys[draw], result)
        return [numbers for numbers in stored if numbers is not None]

    def pictures(self, values: FloatArray) -> dict[str, tuple[Tensor, Tensor]]:
        """Return mean and standard deviation of each output picture over the draws; the numbers of
        each draw are stored too.
        """
        keys = [self.key(row) for row in values]
        pictures_key = digest("uncertainty pictures", keys)
        # the first draw tells whether there are pictures at all
        if (first_record := self._kept(keys[0])) is not None and not first_record["pictures"]:
            return {}
        moments: dict[str, tuple[Tensor, Tensor]]
        moments = compute_once(
            self.store, pictures_key, dict, lambda: self._sums(keys, values), _STORED_AS
        )
        return moments

    def _sums(self, keys: Sequence[str], values: FloatArray) -> dict[str, tuple[Tensor, Tensor]]:
        """Compute all draws, store their numbers, and return mean and standard deviation of each
        picture.
        """
        sums = dict[str, _Sum]()
        for key, result in zip(keys, self._results(list(values)), strict=True):
            self._keep(key, result)
            for name, value in result.items():
                if _is_picture(value):
                    sums.setdefault(name, _Sum()).add(value)
        return {name: (running.mean, running.sd) for name, running in sums.items()}

    def key(self, row: FloatArray) -> str:
        """Return the store key of one draw: a digest of the output keys of a run with these input
        values.
        """
        recipe = self.inputs.recipe
        keys = self._keys(self.inputs.theta(self._named(row)))
        outputs = [[name, keys[name]] for name in self.outputs]
        tolerance_and_device = [
            recipe.tolerance,
            recipe.exact,
            recipe.estimates,
            device_kind(self.device),
        ]
        return digest(
            "uncertainty draw",
            engine("studies.output_draws"),
            outputs,
            tolerance_and_device,
        )

    def _keys(self, theta: Mapping[str, Any]) -> dict[str, str]:
        """Return the store keys of steps: of those that depend on the inputs, with the values
        ``theta`` by ``step.parameter``; or of all others, if ``theta`` is empty.
        """
        recipe, keys = self.inputs.recipe, dict(self._fixed) if theta else {}
        by_step: dict[str, dict[str, Any]] = {}
        for reader, value in theta.items():
            reading_step, _, param = reader.rpartition(".")
            by_step.setdefault(reading_step, {})[param] = value
        for name in self._order:
            if (name in self._live) != bool(theta):
                continue
            step = recipe.steps[name]
            if name in by_step:
                step = replace(step, params={**step.params, **by_step[name]})
            keys[name], _ = key_of(step, keys, recipe.seed, self._code, place(step, self.device))
        return keys

    def _kept(self, key: str) -> dict[str, Any] | None:
        """Return the stored record of a draw, or None."""
        with suppress(KeyError):
            record: dict[str, Any] = self.store.get(key)
            return record
        return None

    def _keep(self, key: str, result: Mapping[str, Any]) -> Numbers:
        """Store the numbers of a draw and the names of its pictures, and return the numbers."""
        numbers = quantities(result)
        picture_names = [name for name, value in result.items() if _is_picture(value)]
        description = {
            **_STORED_AS,
            "seconds": self.seconds / max(1, self.computed),
            "date": timestamp(),
        }
        self.store.put_small(key, {"numbers": numbers, "pictures": picture_names}, description)
        return numbers

    def _results(self, rows: Sequence[FloatArray]) -> Iterator[dict[str, Any]]:
        """Yield the outputs for each draw of the inputs, in order; worker processes compute in
        parallel.
        """
        if not rows:
            return
        self.ready()
        # exclude the time in which the caller uses the result
        began = time.perf_counter()
        _keep_memory()
        workers = workers_for(len(rows), self.workers) if self.device == "cpu" else 1
        # choices that this process makes are known to all workers, which begin after it
        alone = 1 if self._choices.is_waiting else 0
        others = shared_in_order(
            lambda number: self._result(rows[alone + number]), len(rows) - alone, workers
        )
        with one_thread():
            for result in chain(map(self._result, rows[:alone]), others):
                self.computed += 1
                self.seconds += time.perf_counter() - began
                yield result
                began = time.perf_counter()

    def _result(self, row: FloatArray) -> dict[str, Any]:
        """Return the outputs for one draw ``row`` (input,); raise `ValueError` with the input
        values if the recipe fails.
        """
        values = self._named(row)
        try:
            with torch.no_grad():
                result: dict[str, Any] = self._function(self.inputs.theta(values))
        except (RuntimeError, ValueError) as error:
            values_text = ", ".join(f"{name} = {value:.6g}" for name, value in values.items())
            raise ValueError(
                f"the recipe fails at the input values {values_text}: {error}"
            ) from error
        return result

    def _named(self, row: FloatArray) -> dict[str, float]:
        return dict(zip(self.inputs.names, map(float, row), strict=True))


def quantities(result: Mapping[str, Any]) -> Numbers:
    """Return all numbers in ``result`` by step and field, without pictures."""
    numbers: Numbers = {}
    for step, value in result.items():
        for _, field, _, number in () if _is_picture(value) else numbers_of(step, value):
            numbers.setdefault(f"{step}.{field}" if field else step, []).append(number)
    return numbers


def _reached_steps(inputs: Inputs, order: Sequence[str]) -> set[str]:
    """Return the steps that depend on an uncertain input; ``order`` lists each step after its
    sources.
    """
    reached = {reader.rpartition(".")[0] for reader in inputs.readers}
    for name in order:
        if any(source in reached for source in inputs.recipe.steps[name].sources):
            reached.add(name)
    return reached


def _is_picture(value: Any) -> bool:
    return isinstance(value, Tensor) and (
        value.ndim > 2 or (value.ndim == 2 and min(value.shape) > _NARROW)
    )


class _Sum:
    """The running mean and standard deviation of pictures, by Welford's method."""

    def __init__(self) -> None:
        self.count = 0
        self.mean = self._squares = torch.zeros(())

    def add(self, picture: Tensor) -> None:
        new_picture = picture.detach().cpu().float()
        self.count += 1
        distance = new_picture - self.mean
        self.mean = self.mean + distance / self.count
        # Welford: deviation from the old mean times deviation from the new mean
        self._squares = self._squares + distance * (new_picture - self.mean)

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
            # one arena, no separately mapped blocks, and no freed memory returned below 2 GiB
            for option, value in ((_ARENAS, 1), (_MAPPED, 0), (_TRIM, 2**31 - 1)):
                libc.mallopt(option, value)
