"""The table of contradictions in the paper: all 41 are there, each key is a switch, and the
handbook page agrees.
"""

import re
from pathlib import Path

import pytest

from neusee.workflows import load
from neusee.workflows.cli.catalogue import node_lines
from neusee.workflows.report.checked_recipe import opening
from neusee.workflows.report.paper_readings import READINGS, SETTLED, consequences, in_force

PAGE = Path(__file__).parents[3] / "recipes" / "guide" / "readings.md"
CAMERA = [row for row in READINGS if row.path.startswith(("reading.", "sensor."))]
TRAINING = [row for row in READINGS if row not in CAMERA]
FREE = 'lasers.drawn.strength="uniform(0, 2e6)"'


def numbers(rows):
    return [int(n) for row in rows for n in re.findall(r"C(\d+)", row.number)]


def states(*words):
    return {row.path: state for row, state in in_force(load(words[0], words[1:]).config.values)}


def test_each_of_the_41_contradictions_is_a_reading_or_settled_with_a_reason():
    assert sorted({*numbers(READINGS), *numbers(SETTLED)}) == list(range(1, 42))
    assert not {*numbers(READINGS)} & {*numbers(SETTLED)}
    assert all(len(row.why) > 30 and row.why.endswith(".") and row.matter for row in SETTLED)
    assert all(row.reason and row.coherent != row.as_printed for row in READINGS)


def test_the_shipped_recipes_are_coherent():
    found = states("train_small")
    assert found.keys() == {row.path for row in READINGS}
    assert set(found.values()) == {"coherent"}
    assert set(states("first_light").values()) == {"coherent"}
    assert consequences(load("train_small").config.values) == []


def test_two_groups_and_one_argument_set_every_printed_value():
    assert {row.argument for row in READINGS} == {"reading=as_printed", "train=as_printed", FREE}
    found = states("first_light", "reading=as_printed")
    assert {path for path, state in found.items() if state == "as printed"} == {
        row.path for row in CAMERA
    }
    found = states("train_small", "train=as_printed", FREE)
    assert {path for path, state in found.items() if state == "as printed"} == {
        row.path for row in TRAINING
    }


@pytest.mark.parametrize("row", CAMERA, ids=lambda row: row.path)
def test_a_printed_value_reaches_a_step(row):
    exposure = ["sensor.exposure=0.2 s"]  # where the exposure of saturation counts
    usual = load("first_light", exposure)
    printed = load("first_light", [*exposure, f"{row.path}={told(row.as_printed)}"])
    changed = [
        name for name, step in printed.steps.items() if step.params != usual.steps[name].params
    ]
    assert changed


@pytest.mark.parametrize("row", TRAINING, ids=lambda row: row.path)
def test_a_printed_value_reaches_the_training(row):
    usual, printed = (
        load("train_small"),
        load("train_small", [f"{row.path}={told(row.as_printed)}"]),
    )
    law = row.path.startswith("lasers.")
    assert printed.uncertain != usual.uncertain if law else printed.training != usual.training


def test_a_consequence_is_told_only_where_the_printed_value_is_in_force():
    printed = load("first_light", ["reading=as_printed", "sensor.c1=0"])
    told = consequences(printed.config.values)
    assert [line.partition(" ")[0] for line in told] == [
        row.path for row in CAMERA if row.consequence
    ]
    assert "c1 = 0: at c1 = 0 no light is left" in " ".join(told)
    assert not [line for line in told if re.search(r"[{}]", line)]
    assert [line for line in opening(printed, "run") if line.endswith(told[0])] == [
        f"note     {told[0]}"
    ]
    one = load("first_light", ["reading.photon_mean=literal"])
    assert len(consequences(one.config.values)) == 1


def test_the_command_lists_every_contradiction():
    lines = "\n".join(node_lines("reading"))
    for row in (*READINGS, *SETTLED):
        assert f"{row.number}" in lines
        assert row.matter in lines


def page_rows():
    """Return the two tables of the page, as the table of contradictions gives them."""
    one = [
        f"| {r.number} | {r.matter} | `{r.path}` | `{told(r.coherent)}` | `{told(r.as_printed)}` "
        f"| {r.reason} |"
        for r in READINGS
    ]
    return one, [f"| {r.number} | {r.matter} | {r.why} |" for r in SETTLED]


def told(value):
    return str(value).lower() if isinstance(value, bool) else str(value)


def test_the_page_of_the_guide_has_the_rows_of_the_table():
    found = [
        line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| C")
    ]
    keyed, settled = page_rows()
    assert found == keyed + settled
