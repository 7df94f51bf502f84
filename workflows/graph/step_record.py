"""Records of a run: the state of each step with the reason, and its device, time and memory."""

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
    bound: float | None = None  #: upper bound of the change of the result if the step is omitted
    began: float = 0.0  #: start time of the step in s after the start of the run
    lane: str = ""  #: device or worker of the executor that computed the step
    peak: int | None = None  #: peak memory in bytes beyond the memory in use before the step
    predicted: float | None = None  #: time in s predicted from earlier runs
    error: tuple[float, float] | None = None  #: of a cheaper step: rms and maximum, relative to the largest element
    kept: bool = True  #: whether the value is in the store


@dataclass(frozen=True, slots=True)
class Event:
    """Event of a run, for a live table of steps: the start of a step (``done`` is None) or its end."""

    step: str
    done: StepRecord | None
