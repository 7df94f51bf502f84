"""The rows of a parametrized test as one test, whose message names every row that failed.

A table of fifty mistakes is one check: its rows are set up, run and torn down one after another, as
pytest would, and reported together. A test that stands alone, a slow one, and a row that is asked
for by its name (`file.py::test[row]`) stay as they are. `pytest --each-row` shows every row apart.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import groupby

import pytest
from _pytest.runner import runtestprotocol

_APART = ("slow", "long", "alone", "gpu")  #: marks of tests whose rows are reported one by one


class Rows(pytest.Item):
    """All rows of one parametrized test."""

    def __init__(self, *, rows: list[pytest.Function], **names: object) -> None:
        super().__init__(**names)  # type: ignore[arg-type]
        self.rows = rows
        self.own_markers += [mark for mark in rows[0].own_markers if mark.name != "parametrize"]

    def runtest(self) -> None:
        """Not called: the rows are run by `pytest_runtest_protocol`."""
        raise NotImplementedError

    def reportinfo(self) -> tuple[object, int | None, str]:
        """Return where the test stands."""
        path, line, _ = self.rows[0].reportinfo()
        return path, line, self.name


def _table_of(item: pytest.Item) -> object:
    """Return what the rows of one test have in common, or the item itself where it is no row."""
    if not isinstance(item, pytest.Function) or not hasattr(item, "callspec"):
        return item
    if any(item.get_closest_marker(name) for name in _APART):
        return item
    return item.parent, item.originalname


def grouped(items: Iterable[pytest.Item]) -> Iterator[pytest.Item]:
    """Yield the items, with the rows of each parametrized test as one item."""
    for _, neighbours in groupby(items, _table_of):
        rows = list(neighbours)
        if len(rows) == 1:
            yield rows[0]
        else:
            first = rows[0]
            yield Rows.from_parent(first.parent, name=first.originalname, rows=rows)


def _first(item: pytest.Item | None) -> pytest.Item | None:
    return item.rows[0] if isinstance(item, Rows) else item


def run(item: Rows, following: pytest.Item | None) -> None:
    """Run all rows, and report them as one test."""
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    reports = []
    for row, after in zip(item.rows, [*item.rows[1:], _first(following)], strict=True):
        reports += [(row, report) for report in runtestprotocol(row, False, nextitem=after)]
    for phase in ("setup", "call", "teardown"):
        of_phase = [(row, report) for row, report in reports if report.when == phase]
        if of_phase:
            item.ihook.pytest_runtest_logreport(report=_together(item, phase, of_phase))
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)


def _together(
    item: Rows, phase: str, reports: list[tuple[pytest.Function, pytest.TestReport]]
) -> pytest.TestReport:
    """Return one report of a phase of all rows."""
    failed = [(row, report) for row, report in reports if report.failed]
    skipped = [report for _, report in reports if report.skipped]
    outcome, text = "passed", None
    if failed:
        outcome = "failed"
        head = f"{len(failed)} of {len(item.rows)} rows failed in {phase}"
        names = [row.callspec.id for row, _ in failed]
        text = "\n".join(
            [
                head,
                *names,
                *(f"\n[{row.callspec.id}]\n{report.longreprtext}" for row, report in failed),
            ]
        )
    elif len(skipped) == len(item.rows):
        outcome, text = "skipped", skipped[0].longrepr
    return pytest.TestReport(
        nodeid=item.nodeid,
        location=item.location,
        keywords={name: 1 for name in item.keywords},
        outcome=outcome,
        longrepr=text,
        when=phase,
        sections=[section for _, report in failed for section in report.sections],
        duration=sum(report.duration for _, report in reports),
        start=min(report.start for _, report in reports),
        stop=max(report.stop for _, report in reports),
    )
