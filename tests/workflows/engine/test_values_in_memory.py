"""A value in memory goes when no step needs it, but not while it is the only copy and copies are
asked for.
"""

from collections import Counter
from types import SimpleNamespace

from neusee.workflows.engine.execution import ValuesInMemory
from neusee.workflows.engine.step_job import Outcome


def outcome(key, kept=False, later=False):
    return Outcome(SimpleNamespace(key=key), value=key.upper(), kept=kept, is_written_later=later)


def test_values_go_when_unused_unless_they_are_only_here():
    stored = {"written"}
    values = ValuesInMemory(SimpleNamespace(has=stored.__contains__), later={"pending"})
    values["read"] = "READ"  # from the store
    for each in (
        outcome("alone"),
        outcome("kept", kept=True),
        outcome("pending", kept=True, later=True),
    ):
        values.add(each)
    for key in ("written", "unwritten"):  # of two writes in the background, the second failed
        values.add(outcome(key, kept=True, later=True))
    values.free(list(values), Counter({"kept": 1}), keep=True)
    assert set(values) == {"alone", "kept", "pending", "unwritten"}
    values.free(list(values), Counter(), keep=True)
    assert set(values) == {"alone", "pending", "unwritten"}
    values.add(outcome("alone", kept=True))  # computed again, and stored this time
    values.free(list(values), Counter(), keep=True)
    assert set(values) == {"pending", "unwritten"}
    values.free(list(values), Counter({"unwritten": -1}), keep=False)
    assert set(values) == {"pending"}


def test_a_value_that_is_not_kept_is_not_looked_up_in_the_store():
    asked = []
    values = ValuesInMemory(SimpleNamespace(has=asked.append), later=())
    values.add(outcome("alone"))
    values.free(["alone"], Counter(), keep=True)
    assert list(values) == ["alone"]
    assert asked == []
