"""What a run computes: the outputs of the recipe and what these need, and nothing for the report
alone.
"""

import json

import pytest

from neusee.workflows.engine.wanted_steps import TABLE, compared, wanted
from neusee.workflows.graph.recipe_graph import needed
from neusee.workflows.recipe.loading import load, recipes
from neusee.workflows.report.console import closing
from neusee.workflows.report.contents import FIGURES
from neusee.workflows.simulation.simulate_recipe import simulate
from neusee.workflows.store.result_store import Store

RECIPE = """
seed: 3
tolerance: 0
outputs: [full]
steps:
  scene: {node: scene.targets, with: {kind: siemens, shape: [16, 16]}}
  full: {node: restore.electrons, from: {raw: scene}, with: {gain: 1 DN/e-, offset: 0 e-}}
  restored_quality: {node: metrics.quality, from: {estimate: full, truth: scene}}
expect:
  a corner: {step: full, at: [0, 0, 0], value: 0.5, rtol: 1e-3}
  the quality: {step: restored_quality, at: [psnr], value: 1, rtol: 1e-3}
"""


@pytest.fixture
def report(write, tmp_path):
    """Run the recipe with changes; give the document of its report."""

    def report(*changes):
        recipe = load(write(RECIPE), changes, tmp_path)
        return simulate(
            recipe, Store(tmp_path / "cache"), tmp_path / "runs", ["neusee", "run"]
        ).document

    return report


def test_nothing_runs_that_no_output_needs(report):
    doc = report()
    assert [step["step"] for step in doc["steps"]] == ["scene", "full"]
    assert doc["table"]["rows"] == doc["table"]["columns"] == []


def test_an_expected_number_that_no_output_needs_is_said_to_be_unchecked(report):
    doc = report()
    assert [number["name"] for number in doc["expected"]] == ["a corner"]
    assert doc["unchecked"] == [{"name": "the quality", "step": "restored_quality"}]
    assert "1 of 1 expected numbers within tolerance, 1 more not checked" in doc["verdict"]
    said = "not checked, because no output of this run needs their steps: the quality"
    assert said in doc["notes"]
    assert f"  {said}" in closing(doc, "report.html", [])


def test_the_outputs_of_the_command_line_decide(report):
    doc = report("outputs=[scene]")
    assert [step["step"] for step in doc["steps"]] == ["scene"]
    assert (doc["expected"], len(doc["unchecked"])) == ([], 2)
    assert doc["verdict"].startswith("None of 2 expected numbers checked; ")


def test_the_table_has_the_rows_and_columns_that_there_are(report):
    doc = report("outputs=[restored_quality]")
    assert doc["table"]["columns"] == ["PSNR (dB)", "SSIM"]
    assert [row["name"] for row in doc["table"]["rows"]] == ["restored"]
    assert doc["missed"] == ["the quality"]
    assert json.dumps(doc["unchecked"]) == "[]"


@pytest.mark.parametrize("name", [recipe.name for recipe in recipes()])
def test_the_reports_of_the_shipped_recipes_lack_nothing(name):
    recipe = load(name)
    order = set(needed(recipe, recipe.outputs))
    shown = {step for row in TABLE.values() for step in row.values()} & recipe.steps.keys()
    drawn = {need for figure in FIGURES for need in figure.needs.values()} & recipe.steps.keys()
    assert shown <= set(needed(recipe, wanted(recipe)))
    assert drawn <= order
    assert compared(recipe)[1] == []


def test_the_suppression_of_first_light_needs_no_restoration():
    recipe = load("first_light", ["outputs=[lsr]", "sensor.read_noise=20 e-"])
    order = {step.partition("[")[0] for step in needed(recipe, recipe.outputs)}
    assert "lsr" in order
    assert not {"restored", "raw", "scene", "transfer"} & order
    assert len(compared(recipe)[0]) == len(recipe.expect) > 0
