"""Cost model: seconds and memory of a step, from laws of its node and from earlier runs."""

from __future__ import annotations

import itertools
import json
import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from statistics import median
from types import MappingProxyType
from typing import Any, NamedTuple

import torch

from neusee.nodes import Node
from neusee.workflows.engine.node_call import bands_in
from neusee.workflows.engine.processor_speed import probed_seconds, processor
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.graph.step_shapes import (
    Form,
    alike,
    bytes_of,
    complete,
    form_of,
    has_path,
    inputs_of,
    is_same,
    without_values,
)
from neusee.workflows.keys.cache_key import device_kind
from neusee.workflows.recipe.step_checks import machine_memory

# --- cost laws ------------------------------------------------------------------------------------

# Laws of the cost of a node: seconds and peak memory as functions of shapes and parameters, with
# measured coefficients.
#
# The peak memory of a step, beyond the memory in use before, is ``a + b inputs + c result + d
# work`` bytes, and its time is ``e + f operations`` seconds. ``node_costs.json`` has the
# coefficients of each shipped node, which tests/benchmarks/fit_costs.py fits to runs of the shipped
# recipes on a CPU, and the spread of the runs about the law. Seconds are the processor time of one
# thread, so that a busy machine does not make a law slow. The file names the processor of the runs
# and the time of a probe on it; on another processor the laws are scaled by the probe.


#: bytes of a result whose shape is not known, in a recipe without any known shape
_UNKNOWN_BYTES = float(1 << 26)


class Size(NamedTuple):
    """The size of the problem that a step solves, from which its costs follow."""

    inputs: float  #: bytes
    result: float  #: bytes
    #: bytes beside inputs and result, up to a constant factor: `Hooks.work` of the node
    work: float
    operations: float  #: up to a factor
    bands: int = 0  #: number of bands that can be computed one after another; 0 if not known
    known: bool = True  #: False where the shape of the result is a guess


class Range(NamedTuple):
    """The least and the largest value that a cost may take, as multiples of its prediction."""

    least: float = 1.0
    most: float = 1.0


Spread = tuple[Range, Range]  #: the spread of the peak memory, and the spread of the seconds
EXACT: Spread = (Range(), Range())


class Loading(NamedTuple):
    """The additional cost of the first step of a process that uses some libraries, because it
    loads them.
    """

    libraries: tuple[str, ...]
    memory: float  #: bytes, which the process keeps
    seconds: float


@dataclass(frozen=True, slots=True)
class Law:
    """The costs of a node as functions of the `Size` of a step."""

    memory: tuple[float, float, float, float]  #: bytes, and factors of inputs, result and work
    seconds: tuple[float, float]  #: s, and s for each operation
    spread: Spread = EXACT  #: spread of measured runs about the law
    #: the libraries that the node loads, whose cost is not in the numbers above
    loads: Loading | None = None
    #: bytes of the largest result that was measured, for a node without a rule of the shape
    most: float = 0.0

    def peak(self, size: Size) -> float:
        """Return the peak memory of a step in bytes beyond the memory in use before; at least
        its result.
        """
        a, b, c, d = self.memory
        return max(size.result, a + b * size.inputs + c * size.result + d * size.work)

    def time(self, size: Size) -> float:
        """Return the time of a step in s on the CPU."""
        return self.seconds[0] + self.seconds[1] * size.operations


@cache
def _file() -> Mapping[str, Any]:
    text = resources.files(__package__).joinpath("node_costs.json").read_text(encoding="utf-8")
    costs: dict[str, Any] = json.loads(text)
    return costs


@cache
def shipped() -> Mapping[str, Law]:
    """Return the laws of the shipped nodes, by the path of the node."""
    return {path: _law(law) for path, law in _file()["nodes"].items()}


@cache
def guess() -> Law:
    """Return the law for a node that was never measured: the largest cost of any shipped node at
    the same size.
    """
    return _law(_file()["guess"])


class Pace(NamedTuple):
    """The time of this processor as a multiple of the laws, and the range about it."""

    factor: float = 1.0
    range: Range = Range()


#: range of the pace of steps about that of the probe, on a processor other than that of the laws
_OTHER_PROCESSOR = Range(0.5, 2.0)


def pace() -> Pace:
    """Return the pace of this processor: 1 on that of the laws, and otherwise by a short probe."""
    laws = _file()
    if processor().takes_as_long(laws["processor"], laws["threads"]):
        return Pace()
    return Pace(probed_seconds(torch.get_num_threads()) / laws["probe"], _OTHER_PROCESSOR)


def _law(law: Mapping[str, Any]) -> Law:
    """Return the law that one entry of ``node_costs.json`` describes."""
    # least and largest multiple of the law: of the memory first, then of the seconds
    spread = (Range(*law["spread"][0]), Range(*law["spread"][1])) if "spread" in law else EXACT
    # the names of the libraries, then the bytes and the seconds of loading them
    loads = Loading(tuple(law["loads"][0]), *law["loads"][1:]) if "loads" in law else None
    return Law(tuple(law["memory"]), tuple(law["seconds"]), spread, loads, law.get("most", 0.0))


class ProgramLaw(NamedTuple):
    """The time of a command beside its steps: import of the program, and its report."""

    loading: float  #: s, of libraries, recipe and plan
    report: tuple[float, float, float]  #: s, s for each figure, and s for each step
    spread: tuple[float, float]  #: least and largest multiple of both

    def seconds(self, figures: int, steps: int) -> tuple[float, float]:
        """Return the processor time in s of import and of report on this processor."""
        factor, (fixed, of_figure, of_step) = pace().factor, self.report
        return factor * self.loading, factor * (fixed + of_figure * figures + of_step * steps)

    @property
    def range(self) -> Range:
        """Return the range about both times."""
        return _product(Range(*self.spread), pace().range)


@cache
def program_law() -> ProgramLaw:
    """Return the law of a command beside its steps."""
    law = _file()["program"]
    return ProgramLaw(law["loading"], tuple(law["report"]), tuple(law["spread"]))


class TrainingLaw(NamedTuple):
    """The costs of one pass forward and back of a network of a training.

    Each is a sum over 1, pixels, width x pixels and width² x pixels.
    """

    seconds: tuple[float, float, float, float]
    bytes: tuple[float, float, float, float]

    def time(self, width: int, pixels: float) -> float:
        """Return the processor time in s of a pass of one picture on this processor."""
        return pace().factor * _sum(self.seconds, width, pixels)

    def saved_bytes(self, width: int, pixels: float) -> float:
        """Return the memory in bytes that a pass keeps for its way back."""
        return _sum(self.bytes, width, pixels)


def _sum(coefficients: Sequence[float], width: int, pixels: float) -> float:
    terms = (1.0, pixels, width * pixels, width**2 * pixels)
    return sum(x * term for x, term in zip(coefficients, terms, strict=True))


@cache
def training_laws() -> Mapping[str, TrainingLaw]:
    """Return the laws of the networks of trainings, by kind."""
    laws = _file()["training"].items()
    return {kind: TrainingLaw(tuple(law["seconds"]), tuple(law["bytes"])) for kind, law in laws}


def libraries_of(paths: Iterable[str]) -> float:
    """Return the memory (bytes) of the libraries that these nodes load and that this process has
    not loaded yet.
    """
    total, loaded = 0.0, set[str]()
    for path in paths:
        law = shipped().get(path)
        if (
            law
            and law.loads
            and not all(name in loaded or name in sys.modules for name in law.loads.libraries)
        ):
            loaded.update(law.loads.libraries)
            total += law.loads.memory
    return total


class Sized(NamedTuple):
    """The size of a step, with the data from which it was computed: the points of a sweep share
    most steps.
    """

    step: Step
    inputs: Sequence[Any]
    below: Sequence[Size]
    least: float
    form: Form
    size: Size
    reads_file: bool  #: True if the step reads a file, which may change

    def holds(
        self, step: Step, inputs: Sequence[Any], below: Sequence[Size], smallest: float
    ) -> bool:
        """Return True if a step has the same node, parameters and known inputs, and therefore
        the same size.
        """
        if (
            self.reads_file
            or step.node is not self.step.node
            or smallest != self.least
            or below != self.below
        ):
            return False
        same_inputs = len(inputs) == len(self.inputs) and all(map(is_same, inputs, self.inputs))
        return same_inputs and (
            step.params is self.step.params or _equal(step.params, self.step.params)
        )


def _equal(params: Mapping[str, Any], others: Mapping[str, Any]) -> bool:
    with suppress(Exception):  # values such as tensors cannot be compared to one truth value
        return bool(params == others)
    return False


_sized: dict[str, Sized] = {}  # by step
_MOST_REMEMBERED_SIZES = 4096


def _remember(sized: Sized) -> None:
    """Keep the size of a step for the next recipe."""
    if len(_sized) >= _MOST_REMEMBERED_SIZES:
        _sized.clear()
    _sized[sized.step.name] = sized


def sizes_of(recipe: Recipe, order: Sequence[str]) -> dict[str, Size]:
    """Return the size of each step in ``order`` before anything runs; ``order`` lists each step
    after its inputs.

    A result of unknown shape counts as large as its inputs, or as the largest known result of the
    recipe if that is larger.
    """
    sizes = _sizes(recipe, order, 0.0)
    if all(size.known for size in sizes.values()):
        return sizes
    known_bytes = [size.result for size in sizes.values() if size.known and size.result < math.inf]
    return _sizes(recipe, order, max(known_bytes, default=_UNKNOWN_BYTES))


def _sizes(recipe: Recipe, order: Sequence[str], smallest: float) -> dict[str, Size]:
    """Return the size of each step in ``order``.

    A result of unknown shape counts at least ``smallest`` bytes. The sizes of the previous recipe
    are used again where a step is unchanged.
    """
    forms: dict[str, Form] = {}
    sizes: dict[str, Size] = {}
    for name in order:
        step = recipe.steps[name]
        inputs = inputs_of(step, forms)
        source_sizes = [sizes[source] for source in dict.fromkeys(step.sources)]
        remembered = _sized.get(name)
        if remembered is not None and remembered.holds(step, inputs, source_sizes, smallest):
            forms[name], sizes[name] = remembered.form, remembered.size
            continue
        try:
            forms[name] = form_of(step.node, inputs, step.params)
        except OverflowError:
            # more bytes than an address can express: no machine can hold it, and the plan refuses
            # it
            sizes[name] = Size(0.0, math.inf, math.inf, math.inf)
            continue
        sizes[name] = _size(step, inputs, forms[name], source_sizes, smallest)
        if forms[name] is None and not sizes[name].known:
            forms[name] = _guessed_form(inputs)
        if remembered is not None and alike(forms[name], remembered.form):
            # the same object, so that later steps keep their size
            forms[name] = remembered.form
        _remember(
            Sized(
                step,
                inputs,
                source_sizes,
                smallest,
                forms[name],
                sizes[name],
                has_path(step.params),
            )
        )
    return sizes


def _guessed_form(inputs: Sequence[Form]) -> Form:
    """Return the form of the first known input, so that the sizes of later steps can be
    computed.
    """
    return next((form for form in inputs if form is not None), None)


def _size(
    step: Step, inputs: Sequence[Form], form: Form, below: Sequence[Size], smallest: float
) -> Size:
    """Return the size of a step, from the ``form`` of its result or, if that is not known, from the
    sizes ``below`` of its inputs.

    ``smallest`` is a lower bound on the bytes of a result of unknown shape.
    """
    is_known = all(size.known for size in below)
    if form is not None and complete(step.node, inputs):
        return size_of(step.node, inputs, step.params, form)._replace(known=is_known)
    input_bytes = sum(size.result for size in below)
    law = shipped().get(step.node.path)
    if form is not None:
        result_bytes = bytes_of(form)
    elif law and law.most:
        result_bytes = law.most
    else:
        result_bytes, is_known = max(input_bytes, smallest), False
    # without a rule for the work, assume one operation for each number of 4 bytes
    return Size(input_bytes, result_bytes, 0.0, (input_bytes + result_bytes) / 4, 0, is_known)


def size_of(node: Node, inputs: Sequence[Any], params: Mapping[str, Any], result: Any) -> Size:
    """Return the size of a step from its inputs and its result, which may be values or forms
    without values.
    """
    input_bytes, result_bytes = bytes_of(list(inputs)), bytes_of(result)
    # without a rule of the node, assume one operation for each number of 4 bytes
    work_bytes, operations = 0.0, (input_bytes + result_bytes) / 4
    if node.hooks.work is not None:
        work_bytes, operations = node.hooks.work(result, *inputs, **params)
    return Size(
        input_bytes, result_bytes, float(work_bytes), float(operations), bands_in(node, inputs)
    )


def measured_size(
    node: Node, inputs: Sequence[Any], params: Mapping[str, Any], result: Any
) -> list[float] | None:
    """Return the size of a finished step in the form that the journal stores, or None if the rule
    of the node fails.
    """
    try:
        forms = [without_values(x) for x in inputs]
        return list(size_of(node, forms, params, without_values(result))[:4])
    except Exception:  # a wrong rule of a node must not lose its result
        return None


# --- cost model -----------------------------------------------------------------------------------

# Cost model: run time, size of the result and memory of a step, predicted from shapes and from
# earlier runs.
#
# The size of the result follows from its shape and type. Time and memory come from the first of
# these that exists: runs of the same node at the same size on this machine; the law of the node
# (`cost_model`), scaled by the runs of this machine; for a node that was never measured, the
# largest cost of the shipped nodes.


_FASTER = 10.0  #: speed of another kind of device relative to the CPU, until both are measured
_NEWEST = 5  #: number of earlier results that are used
MOST_RESULTS = (
    100  #: number of earlier results of a step or a node that are searched for results of its size
)
#: peak (bytes) below which the measured memory of the process is mostly noise
_NOISE_BYTES = 1 << 25
#: greatest ratio of the size of a step, whose node has no law, to the largest measured size
_LARGEST_EXTRAPOLATION = 8
_OVERHEAD_SECONDS = 1e-3  #: time (s) of a step below which it is mostly overhead

Row = Mapping[str, Any]  #: a line of the journal


@dataclass(frozen=True, slots=True)
class Estimate:
    """Predicted cost of a step: run time, size of the result, and memory."""

    seconds: Mapping[str, float]  #: by kind of device: ``cpu``, ``cuda``
    bytes: float  #: size of the result
    work: float  #: memory (bytes) during the run, beside the inputs and the result
    known: bool  #: False for a guess: neither the shape nor a measurement of the node is known
    spread: Spread = EXACT  #: of the peak memory and of the seconds
    bands: int = 0  #: number of bands that can be computed one after another; 0 if not known
    sized: bool = True  #: False where the size of the result is a guess as well
    #: memory (bytes) of the libraries that the step loads, which count as memory of the program
    libraries: float = 0.0
    measured: bool = False  #: True if runs on this processor decide the time

    @property
    def peak(self) -> float:
        """Return the memory of the step beside its inputs, in bytes."""
        return self.bytes + self.work + self.libraries


def _of_size(rows: Iterable[Row], size: Size) -> Iterator[Row]:
    """Yield the runs of a step of about this size, with a time that holds on this processor."""
    for row in rows:
        measured = _size_of_work(row)
        if measured and _alike(measured, size) and _is_timed(row):
            yield row


def _largest_extent(rows: Iterable[Row]) -> float:
    return max((_extent(_size_of_work(row)) for row in rows), default=0.0)


def _measured_peaks(rows: Iterable[Row]) -> list[float]:
    return [float(row["peak"]) for row in rows if row.get("peak") is not None]


class Costs:
    """Measured costs of steps and nodes, from the journal of a result store in order of time."""

    def __init__(
        self, rows: Iterable[Row], sizes: Mapping[str, Size] = MappingProxyType({})
    ) -> None:
        """Read measured costs; ``sizes`` has the size of each step of the recipe, from
        `cost_model.sizes_of`.
        """
        self._sizes = sizes
        self._steps: dict[str, list[Row]] = {}  # rows by "step node"
        self._nodes: dict[str, list[Row]] = {}  # rows by node, whatever the step is called
        self._ratio = {"cpu": 1.0}  # speed by kind of device, relative to the CPU
        self.learn(rows)

    def learn(self, rows: Iterable[Row]) -> None:
        """Add measured costs of later runs; of each step and node only the newest are kept."""
        has_other_kinds = False
        for row in map(_comparable, rows):
            if row.get("node") and row.get("step") and _is_measured(row):
                _append(self._steps.setdefault(f"{row['step']} {row['node']}", []), row)
                _append(self._nodes.setdefault(row["node"], []), row)
                has_other_kinds |= _kind(row) != "cpu"
        if has_other_kinds:
            self._ratio = {"cpu": 1.0, **self._measured_ratios()}

    def of(self, step: Step, kinds: Sequence[str], exact: Row | None = None) -> Estimate:
        """Predict the cost of ``step`` on each kind of device; ``exact`` holds measured costs of
        the same result.
        """
        size = self._sizes.get(step.name)
        # the same result was computed before
        exact = exact and _comparable(exact)
        if exact and _is_measured(exact) and _is_timed(exact):
            return self._repeated([exact], kinds, size)
        # the size is known: use runs of the node at this size, or its law
        if size is not None and size.known:
            return self._predicted(step.node.path, kinds, size)
        # the size is unknown: use earlier runs of this very step, or a guess
        rows = self._steps.get(f"{step.name} {step.node.path}", [])
        rows = [row for row in rows if _is_timed(row)][-_NEWEST:]
        return (
            self._repeated(rows, kinds, None) if rows else self._guess(step.node.path, kinds, size)
        )

    def in_turn(
        self, steps: Iterable[tuple[str, Step, Row | None]], kinds: Sequence[str]
    ) -> dict[str, Estimate]:
        """Predict the costs of steps that run one after another; the cost of loading a library is
        added to the first step that loads it.

        Args:
            steps: a key, the step, and the measured costs of the same result or None

        Returns: the costs by key.
        """
        estimates, loaded_libraries = dict[str, Estimate](), set[str]()
        for key, step, exact in steps:
            estimates[key] = self.of(step, kinds, exact)
            law = shipped().get(step.node.path)
            if (
                law
                and law.loads
                and not all(
                    name in loaded_libraries or name in sys.modules for name in law.loads.libraries
                )
            ):
                loaded_libraries.update(law.loads.libraries)
                # measured times of earlier runs contain that of loading
                if not self._measured(step, exact):
                    estimates[key] = _loading(estimates[key], law.loads)
        return estimates

    def _measured(self, step: Step, exact: Row | None) -> bool:
        """Return True if the predicted cost of a step comes from earlier runs, which include the
        loading of libraries.
        """
        size = self._sizes.get(step.name)
        rows = self._nodes.get(step.node.path, [])
        exact = exact and _comparable(exact)
        return (
            bool(exact and _is_measured(exact) and _is_timed(exact))
            or size is None
            or any(True for _ in _of_size(rows, size))
        )

    def with_sizes(self, sizes: Mapping[str, Size]) -> Costs:
        """Return the same measurements for the steps with other ``sizes``."""
        costs = copy(self)
        costs._sizes = sizes
        return costs

    def size_of(self, step: str) -> float:
        """Return the bytes of the result of the step with this name, or 0 if its shape is not
        known.
        """
        return self._sizes[step].result if step in self._sizes else 0.0

    def _predicted(self, path: str, kinds: Sequence[str], size: Size) -> Estimate:
        """Predict a step from runs at the same size, or from the law of its node, scaled by runs
        on this machine.
        """
        law, past_runs = shipped().get(path), self._nodes.get(path, [])
        # the newest runs come last in the journal
        runs_of_size = list(itertools.islice(_of_size(reversed(past_runs), size), _NEWEST))
        if runs_of_size:
            # back in the order of time
            return self._repeated(runs_of_size[::-1], kinds, size, law)
        runs_with_size = [row for row in past_runs if _size_of_work(row)]
        # runs at far smaller sizes do not predict this one
        if law is None and _LARGEST_EXTRAPOLATION * _largest_extent(runs_with_size) < _extent(size):
            return self._guess(path, kinds, size, runs_with_size[-_NEWEST:])
        law_or_guess = law or guess()
        # ratio of the newest runs on this machine to the law
        memory_factor, time_pace = _scales(law_or_guess, runs_with_size[-_NEWEST:], self._faster)
        peak = max(size.result, memory_factor * law_or_guess.peak(size))
        cpu_seconds = time_pace.factor * law_or_guess.time(size)
        seconds = {kind: cpu_seconds / self._faster(kind) for kind in kinds}
        memory_spread, time_spread = law_or_guess.spread
        spread = (memory_spread, _product(time_spread, time_pace.range))
        # `Estimate.work` is the peak without the result
        measured = any(map(_is_timed, runs_with_size))
        return Estimate(
            seconds,
            size.result,
            peak - size.result,
            True,
            spread,
            size.bands,
            measured=measured,
        )

    def _repeated(
        self, rows: Sequence[Row], kinds: Sequence[str], size: Size | None, law: Law | None = None
    ) -> Estimate:
        """Predict a step by the median of earlier runs of the same size."""
        # all rows have the same size, so that the median is this size
        result_bytes = size.result if size else float(median(row["bytes"] for row in rows))
        peaks = _measured_peaks(rows)
        lower_bound = law.peak(size) * law.spread[0].least if law and size else 0.0
        peak = max(median(peaks) if peaks else 0.0, result_bytes, lower_bound)
        seconds = {kind: self._seconds(rows, kind) for kind in kinds}
        usual_spread = law.spread if law else EXACT
        # spread of the memory about its prediction, and of the time about its median
        spread = (
            _range(peaks, peak, usual_spread[0]),
            _range([row["seconds"] for row in rows], None, usual_spread[1]),
        )
        bands = size.bands if size else 0
        return Estimate(
            seconds, result_bytes, peak - result_bytes, True, spread, bands, measured=True
        )

    def _guess(
        self, path: str, kinds: Sequence[str], size: Size | None, rows: Sequence[Row] = ()
    ) -> Estimate:
        """Predict the largest likely cost of a step whose shape is unknown, or whose node never ran
        at such a size.

        ``rows`` has runs at much smaller sizes: if the node exceeded its law there, the guess
        is increased by the same factor.
        """
        size, law = size or Size(0.0, 0.0, 0.0, 0.0, known=False), shipped().get(path) or guess()
        memory_factor, time_pace = _scales(law, rows, self._faster)
        # never below the law, because a guess is an upper limit
        slowest = max(1.0, time_pace.factor * time_pace.range.most)
        cpu_seconds = slowest * law.spread[1].most * law.time(size)
        peak = max(1.0, memory_factor) * law.spread[0].most * law.peak(size)
        seconds = {kind: cpu_seconds / self._faster(kind) for kind in kinds}
        # the guess is the largest value; the memory is at least that of the result
        spread = (Range(size.result / peak if peak else 0.0, 1.0), Range(0.0, 1.0))
        return Estimate(
            seconds, size.result, peak - size.result, False, spread, size.bands, size.known
        )

    def _seconds(self, rows: Sequence[Row], kind: str) -> float:
        """Return the median time (s) of runs on a kind of device. Without such runs, times of other
        kinds are scaled by the ratio of the speeds.
        """
        runs_on_kind = [row for row in rows if _kind(row) == kind]
        if runs_on_kind:
            return float(median(row["seconds"] for row in runs_on_kind))
        cpu_seconds = median(row["seconds"] * self._faster(_kind(row)) for row in rows)
        return float(cpu_seconds / self._faster(kind))

    def _faster(self, kind: str) -> float:
        """Return the speed of a kind of device relative to the CPU."""
        return self._ratio.get(kind, _FASTER)

    def _measured_ratios(self) -> dict[str, float]:
        """Return the speed of each kind of device relative to the CPU, from the steps that were
        measured on both.
        """
        ratios_by_kind: dict[str, list[float]] = {}
        for rows in self._steps.values():
            seconds_by_kind: dict[str, list[float]] = {}
            for row in filter(_is_timed, rows):
                seconds_by_kind.setdefault(_kind(row), []).append(row["seconds"])
            cpu_seconds = median(seconds_by_kind.pop("cpu", [0.0]))
            for kind, seconds in seconds_by_kind.items():
                if cpu_seconds > 0 and median(seconds) > 0:
                    ratios_by_kind.setdefault(kind, []).append(cpu_seconds / median(seconds))
        return {kind: median(ratios) for kind, ratios in ratios_by_kind.items()}


def _append(rows: list[Row], row: Row) -> None:
    """Append a row, and keep at most twice `MOST_RESULTS` of the newest rows."""
    rows.append(row)
    if len(rows) > 2 * MOST_RESULTS:
        del rows[:MOST_RESULTS]


def _loading(cost: Estimate, loads: Loading) -> Estimate:
    """Return the costs of a step that loads a library before it computes."""
    loading_seconds = pace().factor * loads.seconds
    seconds = {kind: time + loading_seconds for kind, time in cost.seconds.items()}
    return replace(cost, seconds=seconds, libraries=loads.memory)


def _range(values: Sequence[float], expected: float | None, usual: Range) -> Range:
    """Return the range of measured ``values`` about their median, or ``usual`` for fewer than
    two values.
    """
    expected = expected or (median(values) if values else 0.0)
    if len(values) < 2 or expected <= 0.0:
        return usual
    return Range(min(1.0, min(values) / expected), max(1.0, max(values) / expected))


def _comparable(row: Row) -> Row:
    """Return a journal line whose ``seconds`` can be compared with those of this machine: processor
    time of this processor, or None.

    The time of the clock, which lines of earlier versions have alone, is that of a GPU only: other
    work on the machine lengthens a step on a CPU by any factor.
    """
    if _kind(row) != "cpu":
        return row
    is_of_here = processor().takes_as_long(row.get("processor"), row.get("threads"))
    return {**row, "seconds": row.get("processor_seconds") if is_of_here else None}


def _is_timed(row: Row) -> bool:
    return row.get("seconds") is not None


def _is_measured(row: Row) -> bool:
    """Return True for a journal line with bytes and a peak of memory that this machine can have."""
    # a peak above the memory of this machine is damaged, or comes from another machine
    fits = _kind(row) != "cpu" or (row.get("peak") or 0) <= machine_memory()
    return fits and row.get("bytes") is not None


def _product(spread: Range, other: Range) -> Range:
    """Return the range of a product of two factors."""
    return Range(spread.least * other.least, spread.most * other.most)


def _scales(law: Law, rows: Sequence[Row], faster: Any) -> tuple[float, Pace]:
    """Return the median ratios of the runs on this machine to a law, for memory and for time.

    If nothing was measured, they are 1 for memory, and the pace of the processor for time.
    Small steps are left out, because allocators and overheads dominate their cost.
    """
    peak_ratios, time_ratios = [], []
    for row in rows:
        size = _size_of_work(row)
        if row.get("peak") and law.peak(size) > _NOISE_BYTES and _kind(row) == "cpu":
            peak_ratios.append(row["peak"] / law.peak(size))
        if _is_timed(row) and law.time(size) > _OVERHEAD_SECONDS:
            time_ratios.append(row["seconds"] * faster(_kind(row)) / law.time(size))
    time_pace = Pace(median(time_ratios)) if time_ratios else pace()
    return (median(peak_ratios) if peak_ratios else 1.0), time_pace


def _size_of_work(row: Row) -> Any:
    """Return the size of the step of a journal line, or None for a line without a valid size."""
    numbers = row.get("size")
    valid = (
        isinstance(numbers, list | tuple)
        and len(numbers) == 4
        and all(isinstance(x, int | float) for x in numbers)
    )
    return Size(*numbers) if valid else None  # type: ignore[misc]


def _extent(size: Size) -> float:
    """Return the bytes of inputs and result of a step."""
    return size.inputs + size.result


def _alike(size: Size, other: Size) -> bool:
    """Return True if two sizes agree in bytes, work and operations up to rounding."""
    return size[:4] == other[:4] or all(
        abs(a - b) <= 1e-9 * max(abs(a), abs(b)) for a, b in zip(size[:4], other[:4], strict=True)
    )


def _kind(row: Row) -> str:
    """Return the kind of device of a journal line; the CPU where none is named."""
    return device_kind(str(row.get("device") or "cpu"))
