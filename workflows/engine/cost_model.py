"""Cost model: run time, size of the result and memory of a step, predicted from earlier runs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.keys.cache_key import device_kind

GUESS = 0.01  #: s for a step without any measurement
_FASTER = 10.0  #: speed of another kind of device relative to the CPU, until both are measured
_NEWEST = 5  #: number of earlier results that are used

Row = Mapping[str, Any]  #: a line of the journal


@dataclass(frozen=True, slots=True)
class Estimate:
    """Predicted cost of a step: run time, size of the result, and memory."""

    seconds: Mapping[str, float]  #: by kind of device: ``cpu``, ``cuda``
    bytes: float  #: size of the result
    work: float  #: memory during the run, beside the inputs and the result
    known: bool  #: True if this step was measured before


class Costs:
    """Measured costs of steps and nodes, from the journal of a result store in order of time."""

    def __init__(self, rows: Iterable[Row]) -> None:
        self._steps: dict[str, list[Row]] = {}
        self._nodes: dict[str, list[Row]] = {}
        for row in rows:
            if row.get("node") and row.get("step") and _is_measured(row):
                self._steps.setdefault(f"{row['step']} {row['node']}", []).append(row)
                self._nodes.setdefault(row["node"], []).append(row)
        self._ratio = {"cpu": 1.0, **self._measured_ratios()}

    def of(self, step: Step, kinds: Sequence[str], exact: Row | None = None) -> Estimate:
        """Predict the cost of ``step`` on each kind of device; ``exact`` holds measured costs of the same result."""
        own = self._steps.get(f"{step.name} {step.node.path}", [])
        exact = exact if exact and _is_measured(exact) else None
        rows = [exact] if exact else own[-_NEWEST:] or self._nodes.get(step.node.path, [])[-_NEWEST:]
        if not rows:
            return Estimate({kind: GUESS / self._faster(kind) for kind in kinds}, 0.0, 0.0, False)
        size = float(median(row["bytes"] for row in rows))
        peaks = [float(row["peak"]) for row in rows if row.get("peak") is not None]
        work = max(0.0, median(peaks) - size) if peaks else 0.0
        seconds = {kind: self._seconds(rows, own, kind) for kind in kinds}
        return Estimate(seconds, size, work, bool(exact or own))

    def _seconds(self, rows: Sequence[Row], own: Sequence[Row], kind: str) -> float:
        here = [row for row in (*own[-_NEWEST:], *rows) if _kind(row) == kind]
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


def _is_measured(row: Row) -> bool:
    return row.get("seconds") is not None and row.get("bytes") is not None


def _kind(row: Row) -> str:
    return device_kind(str(row.get("device") or "cpu"))
