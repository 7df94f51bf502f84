"""Records of finished steps, from an outcome of this run or from the metadata of a stored result."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from neusee.nodes import TensorStats
from neusee.workflows.graph.step_record import StepRecord
from neusee.workflows.keys.cache_key import device_kind

if TYPE_CHECKING:
    from neusee.workflows.engine.cost_model import Estimate
    from neusee.workflows.engine.step_job import Outcome


def error_in(about: Mapping[str, Any] | None) -> tuple[float, float] | None:
    """Return the approximation error in the metadata of a stored result, or None if the metadata contain none."""
    found = (about or {}).get("error")
    return (float(found[0]), float(found[1])) if found else None


def facts_in(about: Mapping[str, Any] | None) -> TensorStats | None:
    """Return the statistics in the metadata of a stored result, or None if the metadata contain none."""
    found = (about or {}).get("facts")
    try:
        return TensorStats(**{**found, "shape": tuple(found["shape"])}) if found else None
    except (TypeError, LookupError):  # no statistics that this program writes
        return None


def ran(outcome: Outcome, why: str, bound: float | None, began: float, expected: Estimate) -> StepRecord:
    """Return the record of a step that was computed in the run that started at the time ``began``."""
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
        expected.seconds[device_kind(work.device)] if expected.known else None,
        outcome.deviation,
        expected.peak if expected.known else None,
        outcome.kept,
    )
