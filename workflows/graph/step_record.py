"""Records of what became of the steps of a run: whether each ran, why, where, and what it took."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from neusee.nodes import Check, TensorStats

State = Literal["run", "cached", "left out", "not needed"]


@dataclass(frozen=True, slots=True)
class StepRecord:
    """What became of a step, and why."""

    step: str
    state: State  #: ``not needed``: nothing that ran needed the step
    why: str
    seconds: float
    key: str  #: of the cache
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


@dataclass(frozen=True, slots=True)
class Event:
    """For a live table: ``step`` has started (``done`` is None) or has finished."""

    step: str
    done: StepRecord | None
