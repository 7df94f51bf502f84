"""Record of each step of a run: whether the step ran, why, where, and its cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from neusee.nodes import Check, TensorStats
from neusee.workflows.keys.cache_key import Key

if TYPE_CHECKING:
    from neusee.workflows.engine.step_job import Outcome

State = Literal["run", "cached", "left out", "not needed"]


@dataclass(frozen=True, slots=True)
class StepRecord:
    """Record of a step, with the reason."""

    step: str
    state: State  #: ``not needed``: no step that ran needed this step
    why: str
    seconds: float
    key: Key
    facts: TensorStats | None = None
    checks: tuple[Check, ...] = ()
    device: str = "cpu"
    bytes: int = 0
    bound: float | None = None  #: upper bound on the change that omitting the step makes
    began: float = 0.0  #: s since the run began
    lane: str = ""  #: lane of the executor that computed the step
    peak: int | None = None  #: peak bytes of memory beside the memory in use before
    predicted: float | None = None  #: s predicted from earlier runs
    error: tuple[float, float] | None = None  #: of a cheaper form: rms and maximum, over the largest element
    kept: bool = True  #: whether the store has the value


def error_in(about: Mapping[str, Any] | None) -> tuple[float, float] | None:
    """Return the approximation error that a stored result carries, or None."""
    found = (about or {}).get("error")
    return (float(found[0]), float(found[1])) if found else None


def facts_in(about: Mapping[str, Any] | None) -> TensorStats | None:
    """Return the statistics that a stored result carries, or None."""
    found = (about or {}).get("facts")
    return TensorStats(**{**found, "shape": tuple(found["shape"])}) if found else None


def ran(outcome: Outcome, why: str, bound: float | None, began: float, predicted: float | None) -> StepRecord:
    """Return the record of a step computed in a run that started at ``began``."""
    work = outcome.work
    return StepRecord(
        work.step.name,
        "run",
        why,
        outcome.seconds,
        work.key,
        outcome.facts,
        outcome.checks,
        work.device,
        outcome.bytes,
        bound,
        outcome.began - began,
        work.lane,
        outcome.peak,
        predicted,
        outcome.deviation,
        outcome.kept,
    )


@dataclass(frozen=True, slots=True)
class Event:
    """Event for a live table: ``step`` has started (``done`` is None) or has finished."""

    step: str
    done: StepRecord | None
