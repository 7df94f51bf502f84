"""What became of each step of a run: whether it ran, why, where, and what it took."""

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
    """What became of a step, and why."""

    step: str
    state: State  #: ``asleep``: nothing that ran needed it
    why: str
    seconds: float
    key: Key
    facts: TensorStats | None = None
    checks: tuple[Check, ...] = ()
    device: str = "cpu"
    bytes: int = 0
    bound: float | None = None  #: what leaving the step out may change at most
    began: float = 0.0  #: s since the run began
    lane: str = ""  #: which place of the executor computed it
    peak: int | None = None  #: bytes of memory beside what was there before it ran
    predicted: float | None = None  #: s that earlier runs made one expect
    error: tuple[float, float] | None = None  #: of a cheaper form: rms and of the largest element, over the largest
    kept: bool = True  #: whether the store has the value


def error_in(about: Mapping[str, Any] | None) -> tuple[float, float] | None:
    """What a stored result says of its own error."""
    found = (about or {}).get("error")
    return (float(found[0]), float(found[1])) if found else None


def facts_in(about: Mapping[str, Any] | None) -> TensorStats | None:
    """What a stored result says of its facts."""
    found = (about or {}).get("facts")
    return TensorStats(**{**found, "shape": tuple(found["shape"])}) if found else None


def ran(outcome: Outcome, why: str, bound: float | None, began: float, predicted: float | None) -> StepRecord:
    """The account of a step that was computed in a run that ``began`` then."""
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
    """For a live table: ``step`` has started (``done`` is None) or has finished."""

    step: str
    done: StepRecord | None
