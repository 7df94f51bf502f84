"""Records of finished steps: of one that was computed now, and what a stored result says of itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from neusee.nodes import TensorStats
from neusee.workflows.graph.step_record import StepRecord

if TYPE_CHECKING:
    from neusee.workflows.engine.step_job import Outcome


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
