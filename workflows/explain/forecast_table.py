"""Table of a forecast: what each step of a recipe would cost, with the range that is expected, in 80 columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from neusee.workflows.engine.cost_laws import Range
from neusee.workflows.keys.cache_key import device_kind
from neusee.workflows.report.text_table import columns
from neusee.workflows.store.byte_sizes import UNITS, format_size

if TYPE_CHECKING:
    from neusee.workflows.engine.cost_model import Estimate
    from neusee.workflows.explain.run_forecast import Plan
    from neusee.workflows.store.result_store import Store

Row = dict[str, Any]
_SHORT, _SMALL = 0.01, 1e6  #: s and bytes below which a cost is not written out in the table
_SURE = 1e7  #: bytes of a peak below which its range is not written, because freed memory is used again


def forecast_rows(plan: Plan, store: Store) -> list[Row]:
    """Return what is expected of each step of a recipe as values for JSON: its state, its costs and their ranges.

    A range is a dict with the keys ``expected``, ``least`` and ``most``. A guess counts at its upper end.
    """
    return [_row(name, plan, store) for name in plan.order]


def _row(name: str, plan: Plan, store: Store) -> Row:
    step, about = plan.recipe.steps[name], store.about(plan.keys[name])
    row: Row = {"step": name, "node": step.node.path, "state": "", "where": "", "seconds": None, "bytes": None}
    row |= {"memory": None, "guess": False, "reads": list(dict.fromkeys(step.sources))}
    if plan.left_out.get(name):
        return row | {"state": "left out"}
    if name in plan.expected:
        where = plan.lanes.get(name, "?")
        return row | {"state": "run", "where": where, **_costs(plan.expected[name], where)}
    state = "stored" if store.has(plan.keys[name]) else "run" if name in plan.awake else "not needed"
    known = {"seconds": _ranged(about["seconds"], Range()), "bytes": about["bytes"]} if about else {}
    return row | {"state": state, **known}


def _costs(cost: Estimate, where: str) -> Row:
    seconds = cost.seconds.get(device_kind(where), cost.seconds["cpu"])
    memory, time = cost.spread
    peak = _ranged(cost.peak, memory)
    peak["least"] = max(peak["least"], cost.bytes)
    found = {"seconds": _ranged(seconds, time), "bytes": cost.bytes, "memory": peak}
    return found | {"guess": not cost.known, "bytes_guessed": not cost.sized}


def _ranged(expected: float, around: Range) -> dict[str, float]:
    return {"expected": expected, "least": expected * around.least, "most": expected * around.most}


def table_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the table of a forecast as lines of text, from the rows of `forecast_rows`.

    A range is written behind its value, ``0.81 (0.7-1.2)``. What is negligible is written as below a limit, and a
    guess as ``guess`` with its upper end.
    """
    head = ["step", "where", "seconds", "bytes", "memory"]
    return columns([head, *(_cells(row) for row in rows)])


def _cells(row: Mapping[str, Any]) -> list[str]:
    state = row["where"] or row["state"]
    seconds, memory = row["seconds"], row["memory"]
    size = "" if row["bytes"] is None else format_size(row["bytes"])
    if row["guess"]:
        size = f"guess <{size}" if row["bytes_guessed"] else size
        return [row["step"], state, f"guess <{seconds['most']:.2g}", size, f"guess <{format_size(memory['most'])}"]
    return [row["step"], state, seconds_text(seconds) if seconds else "", size, memory_text(memory) if memory else ""]


def seconds_text(cost: Mapping[str, float]) -> str:
    """Return a duration in s with its range as text, such as ``0.81 (0.7-1.2)``."""
    if cost["expected"] < _SHORT:
        return f"<{_SHORT}"
    return f"{_figures(cost['expected'])}{_between(cost, 1.0)}"


def memory_text(cost: Mapping[str, float]) -> str:
    """Return a number of bytes with its range as text, such as ``120 MB (98-140)``."""
    if cost["expected"] < _SMALL:
        return f"<{format_size(_SMALL)}"
    text = format_size(cost["expected"])
    return text if cost["expected"] < _SURE else f"{text}{_between(cost, UNITS[text.split()[1]])}"


def _between(cost: Mapping[str, float], unit: float) -> str:
    """Return the range of a cost as text, or an empty text for a cost that is known exactly."""
    least, most = (_figures(cost[end] / unit) for end in ("least", "most"))
    return f" ({least}-{most})" if least != most else ""


def _figures(value: float) -> str:
    """Return a number as text without an exponent: two decimals below 1, one below 10, and none above."""
    return f"{value:.{2 if value < 0.995 else 1 if value < 9.95 else 0}f}"
