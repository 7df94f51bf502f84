"""Records of finished steps, from an outcome of this run or from the metadata of a stored result."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from neusee.nodes import Check, TensorStats
from neusee.workflows.graph.step_record import StepRecord
from neusee.workflows.keys.cache_key import Key, device_kind

if TYPE_CHECKING:
    from neusee.workflows.engine.cost_model import Estimate
    from neusee.workflows.engine.step_job import Outcome


def error_in(about: Mapping[str, Any] | None) -> tuple[float, float] | None:
    """Return the approximation error in the metadata of a stored result, or None if the metadata contain none."""
    found = (about or {}).get("error")
    return (float(found[0]), float(found[1])) if found else None


def checks_in(about: Mapping[str, Any] | None) -> tuple[Check, ...]:
    """Return the checks in the metadata of a stored result, as they were when it was computed."""
    return tuple(Check(text, ok) for text, ok in (about or {}).get("checks") or ())


def facts_in(about: Mapping[str, Any] | None) -> TensorStats | None:
    """Return the statistics in the metadata of a stored result, or None if the metadata contain none."""
    found = (about or {}).get("facts")
    try:
        return TensorStats(**{**found, "shape": tuple(found["shape"])}) if found else None
    except (TypeError, LookupError):  # no statistics that this program writes
        return None


def unneeded(name: str, key: Key, about: Mapping[str, Any] | None, bound: float | None) -> StepRecord:
    """Return the record of a step whose value no other step needed; its checks are those of the stored result."""
    why, checks, error = "nothing needed it", checks_in(about), error_in(about)
    return StepRecord(name, "not needed", why, 0.0, key, checks=checks, bound=bound, error=error)


def loaded(name: str, key: Key, about: Mapping[str, Any], bound: float | None, why: str, seconds: float) -> StepRecord:
    """Return the record of a step whose stored result was read in ``seconds``."""
    why = why or f"computed {about.get('date')} in {about.get('seconds') or 0.0:.3g} s"
    size, error = about.get("bytes") or 0, error_in(about)
    return StepRecord(
        name, "cached", why, seconds, key, facts_in(about), checks_in(about), "cpu", size, bound, error=error
    )


def ran(outcome: Outcome, why: str, bound: float | None, began: float, expected: Estimate | None) -> StepRecord:
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
        expected.seconds[device_kind(work.device)] if expected and expected.known else None,
        outcome.deviation,
        expected.peak if expected and expected.known else None,
        outcome.kept,
    )
