"""Records of what became of the steps of a run: whether each ran, why, where, and what it took."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from neusee.nodes import Check, TensorStats

State = Literal["run", "cached", "left out", "not needed"]


@dataclass(frozen=True, slots=True)
class StepRecord:
    """Record of a step, with the reason."""

    step: str
    state: State  #: ``not needed``: nothing that ran needed the step
    why: str
    seconds: float
    key: str  #: of the cache
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


@dataclass(frozen=True, slots=True)
class Event:
    """Event for a live table: ``step`` has started (``done`` is None) or has finished."""

    step: str
    done: StepRecord | None
