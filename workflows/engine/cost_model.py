"""Cost model: run time, size of the result and memory of a step, predicted from shapes and from earlier runs.

The result has the bytes of its shape and type. For time and memory, runs of the same node at the same size on this
machine come first; then the law of the node (`cost_laws`), scaled by the runs of this machine; then, for a node that
was never measured, the upper end of what shipped nodes need.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from statistics import median
from types import MappingProxyType
from typing import Any

from neusee.workflows.engine.cost_laws import EXACT, Law, Loading, Range, Size, Spread, guess, shipped
from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.keys.cache_key import device_kind
from neusee.workflows.recipe.known_before_run import machine_memory

_FASTER = 10.0  #: speed of another kind of device relative to the CPU, until both are measured
_NEWEST = 5  #: number of earlier results that are used
_MOST = 100  #: earlier results of a step or a node among which those of its size are searched
_LEAST = 1 << 25  #: bytes of a peak below which the memory of the process is mostly noise
_FARTHEST = 8  #: how much larger a step of a node without a law may be than the largest one that was measured
_SHORT = 1e-3  #: s of a step below which its time is mostly overhead

Row = Mapping[str, Any]  #: a line of the journal


@dataclass(frozen=True, slots=True)
class Estimate:
    """Predicted cost of a step: run time, size of the result, and memory."""

    seconds: Mapping[str, float]  #: by kind of device: ``cpu``, ``cuda``
    bytes: float  #: size of the result
    work: float  #: memory during the run, beside the inputs and the result
    known: bool  #: False for a guess: neither the shape nor a measurement of the node is known
    spread: Spread = EXACT  #: of the peak memory and of the seconds
    bands: int = 0  #: number of bands that can be computed one after another; 0 if not known
    sized: bool = True  #: False where the size of the result is a guess as well
    libraries: float = 0.0  #: bytes of the libraries that the step loads, which count in the memory of the program

    @property
    def peak(self) -> float:
        """Return the memory of the step beside its inputs, in bytes."""
        return self.bytes + self.work + self.libraries


class Costs:
    """Measured costs of steps and nodes, from the journal of a result store in order of time."""

    def __init__(self, rows: Iterable[Row], sizes: Mapping[str, Size] = MappingProxyType({})) -> None:
        """Read measured costs; ``sizes`` has the size of each step of the recipe, from `cost_laws.sizes_of`."""
        self._sizes = sizes
        self._steps: dict[str, list[Row]] = {}
        self._nodes: dict[str, list[Row]] = {}
        self._ratio = {"cpu": 1.0}
        self.learn(rows)

    def learn(self, rows: Iterable[Row]) -> None:
        """Add measured costs of later runs; of each step and node only the newest are kept."""
        others = False
        for row in rows:
            if row.get("node") and row.get("step") and _is_measured(row):
                _append(self._steps.setdefault(f"{row['step']} {row['node']}", []), row)
                _append(self._nodes.setdefault(row["node"], []), row)
                others |= _kind(row) != "cpu"
        if others:
            self._ratio = {"cpu": 1.0, **self._measured_ratios()}

    def of(self, step: Step, kinds: Sequence[str], exact: Row | None = None) -> Estimate:
        """Predict the cost of ``step`` on each kind of device; ``exact`` holds measured costs of the same result."""
        size = self._sizes.get(step.name)
        if exact and _is_measured(exact):
            return self._repeated([exact], kinds, size)
        if size is not None and size.known:
            return self._predicted(step.node.path, kinds, size)
        rows = self._steps.get(f"{step.name} {step.node.path}", [])[-_NEWEST:]
        return self._repeated(rows, kinds, None) if rows else self._guess(step.node.path, kinds, size)

    def in_turn(self, steps: Iterable[tuple[str, Step, Row | None]], kinds: Sequence[str]) -> dict[str, Estimate]:
        """Predict the costs of steps that run one after another: a library costs the first step that loads it.

        Args: steps: a key, the step, and the measured costs of the same result or None. Returns: the costs by key.
        """
        found, loaded = dict[str, Estimate](), set[str]()
        for key, step, exact in steps:
            found[key] = self.of(step, kinds, exact)
            law = shipped().get(step.node.path)
            if law and law.loads and not all(name in loaded or name in sys.modules for name in law.loads.libraries):
                loaded.update(law.loads.libraries)
                if not self._measured(step, exact):
                    found[key] = _loading(found[key], law.loads)
        return found

    def _measured(self, step: Step, exact: Row | None) -> bool:
        """Return True if the costs of a step are those of earlier runs, which loaded the libraries as well."""
        size = self._sizes.get(step.name)
        rows = self._nodes.get(step.node.path, [])
        return (
            bool(exact and _is_measured(exact))
            or size is None
            or any(_alike(_size(row), size) for row in rows if _size(row))
        )

    def with_sizes(self, sizes: Mapping[str, Size]) -> Costs:
        """Return the same measurements for the steps with other ``sizes``."""
        found = copy(self)
        found._sizes = sizes
        return found

    def size_of(self, step: str) -> float:
        """Return the bytes of the result of the step with this name, or 0 if its shape is not known."""
        return self._sizes[step].result if step in self._sizes else 0.0

    def _predicted(self, path: str, kinds: Sequence[str], size: Size) -> Estimate:
        """Predict a step from runs at the same size, or from the law of its node, scaled by runs on this machine."""
        law, past = shipped().get(path), self._nodes.get(path, [])
        newest = (row for row in reversed(past) if (other := _size(row)) and _alike(other, size))
        if same := list(itertools.islice(newest, _NEWEST)):
            return self._repeated(same[::-1], kinds, size, law)
        rows = [row for row in past if _size(row)]
        if law is None and _FARTHEST * max((_extent(_size(row)) for row in rows), default=0.0) < _extent(size):
            return self._guess(path, kinds, size, rows[-_NEWEST:])
        base = law or guess()
        factors = _scales(base, rows[-_NEWEST:], self._faster)
        peak = max(size.result, factors[0] * base.peak(size))
        on_cpu = factors[1] * base.time(size)
        seconds = {kind: on_cpu / self._faster(kind) for kind in kinds}
        return Estimate(seconds, size.result, peak - size.result, True, base.spread, size.bands)

    def _repeated(
        self, rows: Sequence[Row], kinds: Sequence[str], size: Size | None, law: Law | None = None
    ) -> Estimate:
        """Predict a step by the median of earlier runs of the same size."""
        result = size.result if size else float(median(row["bytes"] for row in rows))
        peaks = [float(row["peak"]) for row in rows if row.get("peak") is not None]
        least = law.peak(size) * law.spread[0].least if law and size else 0.0
        peak = max(median(peaks) if peaks else 0.0, result, least)
        seconds = {kind: self._seconds(rows, kind) for kind in kinds}
        usual = law.spread if law else EXACT
        spread = (_range(peaks, peak, usual[0]), _range([row["seconds"] for row in rows], None, usual[1]))
        return Estimate(seconds, result, peak - result, True, spread, size.bands if size else 0)

    def _guess(self, path: str, kinds: Sequence[str], size: Size | None, rows: Sequence[Row] = ()) -> Estimate:
        """Predict the upper end of the costs of a step whose shape is unknown or whose node never ran at such a size.

        ``rows`` has runs at sizes that are much smaller: a node that took more there than the law says takes more here.
        """
        size, law = size or Size(0.0, 0.0, 0.0, 0.0, known=False), shipped().get(path) or guess()
        more = [max(1.0, factor) for factor in _scales(law, rows, self._faster)]
        on_cpu, peak = more[1] * law.spread[1].most * law.time(size), more[0] * law.spread[0].most * law.peak(size)
        seconds = {kind: on_cpu / self._faster(kind) for kind in kinds}
        spread = (Range(size.result / peak if peak else 0.0, 1.0), Range(0.0, 1.0))
        return Estimate(seconds, size.result, peak - size.result, False, spread, size.bands, size.known)

    def _seconds(self, rows: Sequence[Row], kind: str) -> float:
        here = [row for row in rows if _kind(row) == kind]
        if here:
            return float(median(row["seconds"] for row in here))
        on_cpu = median(row["seconds"] * self._faster(_kind(row)) for row in rows)
        return float(on_cpu / self._faster(kind))

    def _faster(self, kind: str) -> float:
        return self._ratio.get(kind, _FASTER)

    def _measured_ratios(self) -> dict[str, float]:
        """Return the speed of each kind of device relative to the CPU, from the steps that were measured on both."""
        found: dict[str, list[float]] = {}
        for rows in self._steps.values():
            by_kind: dict[str, list[float]] = {}
            for row in rows:
                by_kind.setdefault(_kind(row), []).append(row["seconds"])
            cpu = median(by_kind.pop("cpu", [0.0]))
            for kind, seconds in by_kind.items():
                if cpu > 0 and median(seconds) > 0:
                    found.setdefault(kind, []).append(cpu / median(seconds))
        return {kind: median(ratios) for kind, ratios in found.items()}


def _append(rows: list[Row], row: Row) -> None:
    """Append a row to the newest ones, of which at most twice `_MOST` are there at any time."""
    rows.append(row)
    if len(rows) > 2 * _MOST:
        del rows[:_MOST]


def _loading(cost: Estimate, loads: Loading) -> Estimate:
    """Return the costs of a step that loads a library before it computes."""
    seconds = {kind: time + loads.seconds for kind, time in cost.seconds.items()}
    return replace(cost, seconds=seconds, libraries=loads.memory)


def _range(values: Sequence[float], expected: float | None, usual: Range) -> Range:
    """Return the range of measured ``values`` about their median, or ``usual`` for fewer than two values."""
    expected = expected or (median(values) if values else 0.0)
    if len(values) < 2 or expected <= 0.0:
        return usual
    return Range(min(1.0, min(values) / expected), max(1.0, max(values) / expected))


def _is_measured(row: Row) -> bool:
    """Return True for a journal line with a time, a size and a peak of memory that this machine can have."""
    fits = _kind(row) != "cpu" or (row.get("peak") or 0) <= machine_memory()
    return fits and row.get("seconds") is not None and row.get("bytes") is not None


def _scales(law: Law, rows: Sequence[Row], faster: Any) -> tuple[float, float]:
    """Return the factors from a law to the runs of this machine, for memory and for time; 1 where nothing was measured.

    Small steps are left out, because allocators and overheads hide what they need.
    """
    peaks, times = [], []
    for row in rows:
        size = _size(row)
        if row.get("peak") and law.peak(size) > _LEAST and _kind(row) == "cpu":
            peaks.append(row["peak"] / law.peak(size))
        if law.time(size) > _SHORT:
            times.append(row["seconds"] * faster(_kind(row)) / law.time(size))
    return (median(peaks) if peaks else 1.0), (median(times) if times else 1.0)


def _size(row: Row) -> Any:
    """Return the size of the step of a journal line, or None for a line without a valid size."""
    found = row.get("size")
    valid = isinstance(found, list | tuple) and len(found) == 4 and all(isinstance(x, int | float) for x in found)
    return Size(*found) if valid else None  # type: ignore[misc]


def _extent(size: Size) -> float:
    return size.inputs + size.result


def _alike(one: Size, other: Size) -> bool:
    return one[:4] == other[:4] or all(
        abs(a - b) <= 1e-9 * max(abs(a), abs(b)) for a, b in zip(one[:4], other[:4], strict=True)
    )


def _kind(row: Row) -> str:
    return device_kind(str(row.get("device") or "cpu"))
