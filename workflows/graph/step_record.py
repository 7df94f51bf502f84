"""Records of the steps of a run: the state of each step with its reason, and the device, time and memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from neusee.nodes import Check, TensorStats

State = Literal["run", "cached", "left out", "not needed"]


@dataclass(frozen=True, slots=True)
class StepRecord:
    """Record of one step in a run: its state, the reason for this state, its time, memory and checks."""

    step: str
    state: State  #: ``not needed``: no step that ran needed this step
    why: str
    seconds: float
    key: str  #: cache key of the result
    facts: TensorStats | None = None
    checks: tuple[Check, ...] = ()
    device: str = "cpu"
    bytes: int = 0
    bound: float | None = None  #: upper bound of the change of the result if the step is omitted
    began: float = 0.0  #: start time of the step in s after the start of the run
    lane: str = ""  #: device or worker of the executor that computed the step
    peak: int | None = None  #: peak memory in bytes beyond the memory in use before the step
    predicted: float | None = None  #: time in s predicted from earlier runs
    error: tuple[float, float] | None = None  #: of a cheaper step: rms and maximum, relative to the largest element
    predicted_peak: float | None = None  #: predicted peak memory in bytes, as ``peak``
    kept: bool = True  #: whether the value is in the store


@dataclass(frozen=True, slots=True)
class Event:
    """Start or end of a step during a run, reported to a live display; ``done`` is None at the start."""

    step: str
    done: StepRecord | None
