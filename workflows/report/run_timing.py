"""What a run cost and what the cache saved: from the account of its steps, as plain JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from neusee.workflows.store.byte_sizes import format_size

StepRow = Mapping[str, Any]  #: a step as the report says it


def timing(steps: Sequence[StepRow], planned: float | None = None) -> dict[str, Any]:
    """Seconds predicted and taken, what was served instead of computed, and what went through the disk.

    A key that several steps share is counted once. ``planned`` is the length of the schedule, where one was made.
    """
    ran = [s for s in steps if s["state"] == "run"]
    own = {s["key"] for s in ran}
    served = _once(s for s in steps if s["state"] in ("cached", "not needed") and s["key"] not in own)
    told = [s for s in ran if s["predicted"] is not None]
    took, saved = sum(s["seconds"] for s in ran), sum(s["made_in"] for s in served)
    ends = [s["began"] + s["seconds"] for s in ran]
    return {
        "ran": len(ran),
        "served": len([s for s in steps if s["state"] in ("cached", "not needed")]),
        "steps": len(steps),
        "seconds": took,
        "span": max(ends) - min(s["began"] for s in ran) if ran else 0.0,
        "planned": planned if ran else None,
        "told": len(told),
        "predicted": sum(s["predicted"] for s in told),
        "actual": sum(s["seconds"] for s in told),
        "saved": saved,
        "share": saved / (saved + took) if saved + took else 0.0,
        "read": sum(s["bytes"] for s in served if s["state"] == "cached"),
        "written": sum(s["bytes"] for s in ran if s["kept"]),
    }


def _once(steps: Any) -> list[StepRow]:
    """The first step of each key; one that was read counts before one that was not looked at."""
    found: dict[str, StepRow] = {}
    for step in steps:
        if step["key"] not in found or step["state"] == "cached":
            found[step["key"]] = step
    return list(found.values())


def said_of(found: Mapping[str, Any]) -> list[str]:
    """The same in sentences."""
    lines = []
    if found["ran"]:
        lines.append(f"{found['ran']} of {found['steps']} steps ran: {_seconds(found['seconds'])} of computing.")
    if found["told"]:
        known = "they were" if found["told"] == found["ran"] else f"the {found['told']} that ran before were"
        predicted, actual = _seconds(found["predicted"]), _seconds(found["actual"])
        lines.append(f"By earlier runs {known} expected to take {predicted}; they took {actual}.")
    if found["planned"] is not None:
        planned, span = _seconds(found["planned"]), _seconds(found["span"])
        lines.append(f"The plan, with branches side by side, was {planned} long; it took {span}.")
    if found["served"]:
        share = f"{100 * found['share']:.3g} % of all computing"
        lines.append(f"The cache served {found['served']} steps and saved {_seconds(found['saved'])}, {share}.")
    lines.append(f"Read from the cache: {format_size(found['read'])}; written to it: {format_size(found['written'])}.")
    return lines


def _seconds(value: float) -> str:
    return f"{value:.3g} s" if value < 100 else f"{value:.0f} s"
