"""Table of a forecast: ranges, guesses and the width of the lines."""

import json

import pytest

from neusee.workflows.engine import cost_model
from neusee.workflows.engine.cost_model import shipped
from neusee.workflows.engine.local_executor import lanes_of
from neusee.workflows.engine.processor_speed import processor
from neusee.workflows.engine.runner import run
from neusee.workflows.explain.run_forecast import (
    forecast,
    forecast_rows,
    memory_text,
    planned,
    seconds_text,
    table_lines,
)
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store


@pytest.fixture(autouse=True)
def laws_of_here(monkeypatch):
    """Tests compute on the processor of the laws, whatever the machine is."""
    here = {"processor": processor().name, "threads": processor().threads}
    laws = {**cost_model._file(), **here}
    monkeypatch.setattr(cost_model, "_file", lambda: laws)


def cost(least, expected, most):
    return {"expected": expected, "least": least, "most": most}


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (cost(0.6, 0.81, 1.2), "0.81 (0.60-1.2)"),
        (cost(9.0, 11.0, 13.4), "11 (9.0-13)"),
        (cost(4.0, 4.0, 4.0), "4.0"),
        (cost(0.001, 0.0099, 9.0), "<0.01"),
    ],
)
def test_seconds_stand_before_their_range(seconds, text):
    assert seconds_text(seconds) == text


@pytest.mark.parametrize(
    ("memory", "text"),
    [
        (cost(98e6, 120e6, 140e6), "120 MB (98-140)"),
        (cost(1.1e9, 1.38e9, 1.5e9), "1.38 GB (1.1-1.5)"),
        (cost(900e6, 999e6, 1400e6), "999 MB (900-1400)"),
        (cost(744.0, 744.0, 744.0), "<1 MB"),
    ],
)
def test_the_range_of_bytes_has_the_unit_of_its_value(memory, text):
    assert memory_text(memory) == text


@pytest.mark.parametrize("recipe", ["first_light", "six_lasers", "calibrate_camera"])
def test_no_line_of_a_plan_is_wider_than_80_columns(tmp_path, recipe):
    found = forecast(load(recipe, []), Store(tmp_path), memory=10**11)
    wide = [line for line in found.lines if len(line) > 80]
    assert wide == []


def test_each_step_of_a_plan_has_the_range_of_its_law(tmp_path):
    plan = planned(load("first_light", []), Store(tmp_path), lanes_of(["cpu"], 10**11))
    rows = {row["step"]: row for row in forecast_rows(plan, Store(tmp_path))}
    psf, law = rows["psf[mask]"], shipped()["optics.psf"]
    assert psf["node"] == "optics.psf"
    assert psf["reads"] == ["pupil[mask]"]
    assert psf["seconds"]["most"] == pytest.approx(law.spread[1].most * psf["seconds"]["expected"])
    assert psf["memory"]["least"] == pytest.approx(law.spread[0].least * psf["memory"]["expected"])
    assert psf["seconds"]["least"] < psf["seconds"]["expected"] < psf["seconds"]["most"]
    assert all(row["seconds"]["expected"] > 0 for row in rows.values() if row["state"] == "run")
    json.dumps(list(rows.values()), allow_nan=False)


def test_a_guess_is_written_with_its_upper_end_and_what_is_known_is_not_called_a_guess(
    tmp_path, monkeypatch
):
    monkeypatch.setattr("neusee.workflows.engine.cost_model.shipped", dict)
    plan = planned(load("first_light", []), Store(tmp_path), lanes_of(["cpu"], 10**12))
    rows = [row for row in forecast_rows(plan, Store(tmp_path)) if row["step"] == "psf[mask]"]
    assert rows[0]["guess"]
    assert rows[0]["seconds"]["expected"] == rows[0]["seconds"]["most"] > 0
    line = table_lines(rows)[1]
    assert line.count("guess <") == 2
    assert "  32.5 MB  " in line


def test_the_total_time_has_a_range_around_it(tmp_path):
    found = forecast(load("first_light", []), Store(tmp_path), memory=10**11)
    seconds = found.totals["seconds"]
    assert seconds["least"] < seconds["expected"] < seconds["most"]
    assert f"about {seconds_text(seconds)} s" in " ".join(" ".join(found.lines).split())
    assert found.totals["memory_of_steps"] > 10**8


def test_a_forecast_counts_import_and_report_and_is_a_guess_before_a_step_ran(tmp_path):
    found = forecast(load("first_light", []), Store(tmp_path), memory=10**11)
    parts = [found.totals[f"seconds{part}"] for part in ("", "_of_import", "_of_report")]
    whole = found.totals["seconds_of_command"]
    for end in ("expected", "least", "most"):
        assert whole[end] == pytest.approx(sum(part[end] for part in parts))
    assert found.totals["measured"] == 0
    assert "a guess by laws" in " ".join(found.lines)


def test_nothing_is_probed_where_nothing_is_forecast(tmp_path, monkeypatch):
    recipe, store = load("calibrate_camera", []), Store(tmp_path)
    run(recipe, store)
    monkeypatch.setattr(cost_model, "_file", lambda: {**shipped(), "processor": "another"})
    monkeypatch.setattr(cost_model, "probed_seconds", lambda threads: pytest.fail("a probe"))
    assert forecast(recipe, store, memory=10**11).totals["steps"] == 0
