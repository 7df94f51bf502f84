"""Records of a run: for each step whether the step ran, why, on which device, and its time and memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from neusee.nodes import Check, TensorStats

State = Literal["run", "cached", "left out", "not needed"]


@dataclass(frozen=True, slots=True)
class StepRecord:
    """Record of one step in a run: its state with the reason, time, memory and checks."""

    step: str
    state: State  #: ``not needed``: no step that ran needed this step
    why: str
    seconds: float
    key: str  #: cache key of the result
    facts: TensorStats | None = None
    checks: tuple[Check, ...] = ()
    device: str = "cpu"
    bytes: int = 0
    bound: float | None = None  #: upper bound of the change when the step is omitted
    began: float = 0.0  #: s since the run began
    lane: str = ""  #: device or worker of the executor that computed the step
    peak: int | None = None  #: peak bytes of memory beyond the memory in use before
    predicted: float | None = None  #: s predicted from earlier runs
    error: tuple[float, float] | None = None  #: of a cheaper step: rms and maximum, relative to the largest element
    kept: bool = True  #: whether the store holds the value


@dataclass(frozen=True, slots=True)
class Event:
    """Event for a live table: a step has started (``done`` is None) or has finished."""

    step: str
    done: StepRecord | None
