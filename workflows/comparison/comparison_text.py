"""A comparison of two runs as lines of text for a terminal."""

from __future__ import annotations

from neusee.workflows.comparison.compare_runs import RunComparison
from neusee.workflows.comparison.comparison_page import difference_text, summary
from neusee.workflows.comparison.differences import ValueDifference, largest
from neusee.workflows.comparison.picture_differences import FileDifference
from neusee.workflows.report.text_table import columns

_MOST = 12  #: rows of each table


def lines(found: RunComparison) -> list[str]:
    """Return lines with the tables of a comparison; the page has what is cut here."""
    head = [f"left   {found.left.folder}", f"right  {found.right.folder}", *summary(found)]
    differ = largest(found.numbers)
    header = ["number", "index", "left", "right", "right - left", "relative"]
    numbers = _table([header, *map(difference_text, differ)]) if differ else []
    files = [each for each in (*found.figures, *found.data) if each.state != "same"]
    blocks = {
        "numbers": numbers,
        "pictures and data": [f"  {_file(each)}" for each in files],
        "recipe": [f"  {_value(each)}" for each in found.recipe],
        "code": [f"  {line}" for line in found.code or ()],
        "environment": [f"  {_value(each)}" for each in found.environment],
        "steps": [f"  {line}" for line in (*found.steps, *found.missing)],
    }
    tables = [["", title, *_cut(rows)] for title, rows in blocks.items() if rows]
    return [*head, *(line for block in tables for line in block)]


def _table(rows: list[list[str]]) -> list[str]:
    return [f"  {line}" for line in columns(rows, ">")]


def _cut(rows: list[str]) -> list[str]:
    more = len(rows) - _MOST
    return [*rows[:_MOST], f"  and {more} more on the page"] if more > 0 else rows


def _value(each: ValueDifference) -> str:
    sides = [
        (text or "none") + (f" ({source})" if source else "")
        for text, source in ((each.left, each.left_source), (each.right, each.right_source))
    ]
    return f"{each.name}: {sides[0]} -> {sides[1]}"


def _file(each: FileDifference) -> str:
    if each.largest is None:
        return f"{each.name}: {each.state}"
    return f"{each.name}: differs by at most {each.largest:.4g}, where the largest value is {each.scale:.4g}"
