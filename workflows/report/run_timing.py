"""Times of a run: computing time, time that the cache saved, and predicted time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from neusee.workflows.store.byte_sizes import format_size

StepRow = Mapping[str, Any]  #: a step in the document of a run

#: of the file ``timing.csv``, which has a line for each step
COLUMNS = (
    "step",
    "node",
    "device",
    "lane",
    "state",
    "began",
    "seconds",
    "predicted",
    "peak",
    "predicted_peak",
    "bytes",
    "key",
)


def rows(steps: Iterable[StepRow]) -> list[list[Any]]:
    """Return the rows of ``timing.csv``, one for each step of a run, with the values of `COLUMNS`."""
    return [[step[column] for column in COLUMNS] for step in steps]


def timing(steps: Sequence[StepRow], planned: float | None = None) -> dict[str, Any]:
    """Return the total times of a run (predicted, actual, saved by the cache), and the bytes read and written.

    Steps with the same result count once.
    """
    ran = [s for s in steps if s["state"] == "run"]
    own = {s["key"] for s in ran}
    served = _once(s for s in steps if s["state"] in ("cached", "not needed") and s["key"] not in own)
    known = [s for s in ran if s["predicted"] is not None]
    took, saved = sum(s["seconds"] for s in ran), sum(s["made_in"] for s in served)
    ends = [s["began"] + s["seconds"] for s in ran]
    return {
        "ran": len(ran),
        "served": len([s for s in steps if s["state"] in ("cached", "not needed")]),
        "steps": len(steps),
        "seconds": took,
        "span": max(ends) - min(s["began"] for s in ran) if ran else 0.0,
        "planned": planned if ran else None,
        "told": len(known),
        "predicted": sum(s["predicted"] for s in known),
        "actual": sum(s["seconds"] for s in known),
        "saved": saved,
        "share": saved / (saved + took) if saved + took else 0.0,
        "read": sum(s["bytes"] for s in served if s["state"] == "cached"),
        "written": sum(s["bytes"] for s in ran if s["kept"]),
    }


def _once(steps: Iterable[StepRow]) -> list[StepRow]:
    """Return one step for each distinct result, with preference for a step whose result was read from the cache."""
    found: dict[str, StepRow] = {}
    for step in steps:
        if step["key"] not in found or step["state"] == "cached":
            found[step["key"]] = step
    return list(found.values())


def said_of(found: Mapping[str, Any]) -> list[str]:
    """Return the times and the sizes in bytes of a run, which `timing` computed, as sentences."""
    lines = []
    if found["ran"]:
        lines.append(f"{found['ran']} of {found['steps']} steps ran: {_seconds(found['seconds'])} of computing time.")
    if found["told"]:
        known = "these steps" if found["told"] == found["ran"] else f"the {found['told']} whose time was no guess"
        predicted, actual = _seconds(found["predicted"]), _seconds(found["actual"])
        lines.append(f"Predicted for {known}: {predicted}; actual: {actual}.")
    if found["planned"] is not None:
        planned, span = _seconds(found["planned"]), _seconds(found["span"])
        lines.append(f"Planned duration, with parallel branches: {planned}; actual: {span}.")
    if found["ran"] and found.get("peak", [None])[0]:
        predicted, actual = (format_size(size) for size in found["peak"])
        lines.append(f"Predicted peak memory of the program while the steps ran: {predicted}; actual: {actual}.")
    if found["served"]:
        share = f"{100 * found['share']:.3g} % of all computing time"
        lines.append(f"The cache served {found['served']} steps and saved {_seconds(found['saved'])}, {share}.")
    lines.append(f"Read from the cache: {format_size(found['read'])}; written to it: {format_size(found['written'])}.")
    return lines


def _seconds(value: float) -> str:
    return f"{value:.3g} s" if value < 100 else f"{value:.0f} s"
