"""Provenance of results and records of finished steps: machine, versions and times."""

from __future__ import annotations

import functools
import platform
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import torch

from neusee.nodes import Check, TensorStats
from neusee.workflows.graph.recipe_graph import StepRecord
from neusee.workflows.keys.cache_key import Key, device_kind

if TYPE_CHECKING:
    from neusee.workflows.engine.cost_model import Estimate
    from neusee.workflows.engine.step_job import Outcome


# --- provenance -----------------------------------------------------------------------------------

# Provenance of a result: the machine, the versions of the libraries, and the time.


@functools.cache
def versions() -> dict[str, str]:
    """Return the versions of Python and of the numerical libraries; no cache key depends on
    these versions.
    """
    libraries = ("neusee", "torch", "kornia", "colour-science", "OpenEXR")
    return {
        "python": platform.python_version(),
        **{name: version_of(name) or "none" for name in libraries},
    }


def version_of(package: str) -> str:
    """Return the version of an installed package, or an empty string if the package or its metadata
    is missing.
    """
    # FileNotFoundError comes from the package importlib_metadata; metadata without a version cause
    # a warning in Python 3.13, and will cause a KeyError
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            return version(package) or ""
        except (PackageNotFoundError, FileNotFoundError, KeyError):
            return ""


def machine() -> Sequence[str]:
    """Return the name and type of the machine, the number of threads and the versions of the
    libraries.
    """
    return [platform.node(), platform.machine(), str(torch.get_num_threads()), *versions().values()]


def timestamp() -> str:
    """Return the present time in UTC, to the second, in ISO format."""
    return datetime.now(UTC).isoformat(timespec="seconds")


# --- finished step --------------------------------------------------------------------------------

# Records of finished steps, from an outcome of this run or from the metadata of a stored result.


def error_in(about: Mapping[str, Any] | None) -> tuple[float, float] | None:
    """Return the approximation error in the metadata of a stored result, or None if the metadata
    contain none.
    """
    error = (about or {}).get("error")
    return (float(error[0]), float(error[1])) if error else None


def checks_in(about: Mapping[str, Any] | None) -> tuple[Check, ...]:
    """Return the checks in the metadata of a stored result, as they were when it was computed."""
    return tuple(Check(text, passed) for text, passed in (about or {}).get("checks") or ())


def facts_in(about: Mapping[str, Any] | None) -> TensorStats | None:
    """Return the statistics in the metadata of a stored result, or None if the metadata contain
    none.
    """
    facts = (about or {}).get("facts")
    try:
        return TensorStats(**{**facts, "shape": tuple(facts["shape"])}) if facts else None
    except (TypeError, LookupError):  # not in the form that this program writes
        return None


def unneeded(
    name: str, key: Key, about: Mapping[str, Any] | None, bound: float | None
) -> StepRecord:
    """Return the record of a step whose value no other step needed; its checks come from the stored
    result.
    """
    reason, checks, error = "nothing needed it", checks_in(about), error_in(about)
    return StepRecord(name, "not needed", reason, 0.0, key, checks=checks, bound=bound, error=error)


def loaded(
    name: str, key: Key, about: Mapping[str, Any], bound: float | None, why: str, seconds: float
) -> StepRecord:
    """Return the record of a step whose stored result was read in ``seconds``."""
    why = why or f"computed {about.get('date')} in {about.get('seconds') or 0.0:.3g} s"
    result_bytes, error = about.get("bytes") or 0, error_in(about)
    return StepRecord(
        name,
        "cached",
        why,
        seconds,
        key,
        facts_in(about),
        checks_in(about),
        "cpu",
        result_bytes,
        bound,
        error=error,
    )


def ran(
    outcome: Outcome, why: str, bound: float | None, began: float, expected: Estimate | None
) -> StepRecord:
    """Return the record of a step that was computed in the run that started at the time
    ``began``.
    """
    job = outcome.work
    return StepRecord(
        job.step.name,
        "run",
        why,
        outcome.seconds,
        job.key,
        outcome.facts,
        outcome.checks,
        job.device,
        outcome.bytes,
        bound,
        # start time (s) after the start of the run
        outcome.began - began,
        job.lane,
        outcome.peak,
        # a guess does not count as a prediction
        expected.seconds[device_kind(job.device)] if expected and expected.known else None,
        outcome.deviation,
        expected.peak if expected and expected.known else None,
        outcome.kept,
    )


def state_counts(records: Iterable[StepRecord]) -> str:
    """Return the number of steps in each state as text, such as ``12 run, 3 cached``.

    A step whose result no other step had to load counts as cached.
    """
    counts = Counter(
        "cached" if record.state == "not needed" else str(record.state) for record in records
    )
    return (
        ", ".join(
            f"{counts[state]} {state}" for state in ("run", "cached", "left out") if counts[state]
        )
        or "nothing to do"
    )
