"""The page says what was left out, what that may change at most, and, where it was run in full,
what it did change.
"""

import json
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from neusee.workflows import load
from neusee.workflows.cli.app import app
from neusee.workflows.engine.runner import run
from neusee.workflows.report import run_folder
from neusee.workflows.report.tolerance_spent import said_of_errors, spent
from neusee.workflows.simulation.simulate_recipe import simulate
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.left_out_steps import OmissionComparison
from neusee.workflows.tolerance import cheaper_steps
from neusee.workflows.tolerance.cheaper_steps import with_substitutions
from neusee.workflows.tolerance.error_norm import error_of

SMALL = [
    "optics.samples=90",
    "optics.pitch=89.76 um",
    "optics.window=[48, 48]",
    "scene.shape=[64, 64]",
    "sensor.shape=[48, 48]",
    "optics.bands=7",
    "doe=vortex",
    "lasers.green.angle=[0.1 mrad, 0 mrad]",
]


@pytest.fixture(scope="module")
def recipe():
    return load("first_light", SMALL)


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "cache")


@pytest.fixture(scope="module")
def warm(recipe, tmp_path_factory):
    """A store with the run of the recipe and, of the same scene and light, the run in full."""
    store = Store(tmp_path_factory.mktemp("warm") / "cache")
    for each in (recipe, replace(recipe, exact=True)):
        run(each, store)
    return store


def test_sums_over_bands_stand_in_for_images_that_nobody_asks_for(recipe):
    found = with_substitutions(recipe, recipe.outputs)
    assert {e.step for e in found.substitutions} == {"image[plain]", "image[mask]"}
    assert found.steps["scene_photons[mask]"].wires["irradiance"] == "image[mask].channels"
    assert found.steps["image[mask]"] == recipe.steps["image[mask]"]
    assert found.unsubstituted is recipe
    assert with_substitutions(found, recipe.outputs) is found


def test_the_well_is_summed_only_where_it_is_asked_for(recipe):
    for outputs, rows in (
        (["raw[mask]"], "responses.rows"),
        (["raw[mask]", "peak[mask]"], "responses.wells"),
    ):
        found = with_substitutions(recipe, outputs)
        assert found.steps["image[mask].channels"].wires["rows"] == rows
        assert found.steps[rows].params["well"] == (rows == "responses.wells")


def test_an_image_that_is_asked_for_is_whole(recipe, warm):
    found = with_substitutions(recipe, [*recipe.outputs, "image[mask]"])
    assert {e.step for e in found.substitutions} == {"image[plain]"}
    result = run(recipe, warm)
    assert result["image[mask]"].shape == (7, 64, 64)


@pytest.mark.parametrize(
    "change",
    [{"exact": True}, {"tolerance": 0.0}, {"tolerance": 1e-5}],
    ids=["keep all", "no tolerance", "fine"],
)
def test_nothing_stands_in_where_nothing_may(recipe, change):
    whole = replace(recipe, **change)
    assert with_substitutions(whole, recipe.outputs) is whole


def test_bands_that_are_levelled_one_by_one_are_not_summed():
    recipe = load("first_light", [*SMALL, "reading.level=per_band"])
    assert with_substitutions(recipe, recipe.outputs) is recipe


def test_a_scene_that_is_learnt_is_whole(recipe):
    assert with_substitutions(recipe, recipe.outputs, {"scene"}) is recipe
    assert with_substitutions(recipe, recipe.outputs, {"height"}).substitutions


def test_the_errors_are_within_their_bounds_and_these_within_the_tolerance(recipe, warm):
    result, full = run(recipe, warm), run(replace(recipe, exact=True), warm)
    assert set(result.proof.held) >= {"raw[plain]", "raw[mask]"}
    assert 0 < result.proof.worst <= recipe.tolerance
    for name in ("raw[plain]", "raw[mask]"):
        assert error_of(result[name], full[name]) <= result.proof.worst


def test_a_large_tolerance_spoils_no_figure_of_merit(recipe, warm):
    wide = replace(recipe, tolerance=0.1)
    result, full = run(wide, warm), run(replace(recipe, exact=True), warm)
    assert "read[plain]" in result.done
    assert result.done["read[plain]"].state != "left out"
    assert (spent(result)["held"], spent(full)["held"]) == (1e-3, recipe.tolerance)
    assert result.proof.worst <= 1e-3
    for arm in ("plain", "mask"):
        assert (
            error_of(result[f"developed_quality[{arm}]"], full[f"developed_quality[{arm}]"]) <= 0.1
        )
    assert run(wide, warm, ["raw[plain]"]).recipe.limit("raw[plain]") == 0.1


def test_what_a_cheaper_step_says_and_took_is_said_again_from_the_cache(recipe, tmp_path):
    first = spent(run(recipe, Store(tmp_path)))["economies"]
    again = run(recipe, Store(tmp_path))
    assert {record.state for record in again.done.values()} <= {"cached", "not needed", "left out"}
    assert all(each["what"] and each["seconds"] for each in first if each["instead"])
    for name in ("what", "seconds", "bound", "instead", "why"):
        assert [each[name] for each in spent(again)["economies"]] == [
            each[name] for each in first
        ], name


@pytest.mark.slow
def test_measured_errors_stand_where_the_full_run_is_stored(recipe, store):
    result = run(recipe, store)
    before = spent(result)
    assert {row["measured"] for row in before["outputs"]} == {None}
    full = run(replace(recipe, exact=True), store)
    after = spent(result)
    measured = {row["output"]: row["measured"] for row in after["outputs"]}
    assert set(measured) == set(recipe.outputs)
    assert measured["raw[mask]"] == error_of(result["raw[mask]"], full["raw[mask]"])
    economy = after["economies"][0]
    alike = [
        step.seconds
        for name, step in full.done.items()
        if name.startswith(economy["step"].partition("[")[0] + "[")
    ]
    # arms of one size are one measurement
    assert min(alike) - 1e-9 <= economy["full_seconds"] <= max(alike) + 1e-9
    assert spent(full)["economies"] == []
    assert spent(full)["exact"]
    assert f"measured beside --exact: {max(measured.values()):.1e}" in said_of_errors(after)
    assert "not measured" not in said_of_errors(after)
    assert "measured" not in said_of_errors(before)


@pytest.mark.slow
def test_the_command_line_shows_what_stands_in(tmp_path, monkeypatch):
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))
    done = CliRunner().invoke(
        app, ["run", "first_light", *SMALL, "outputs=[raw]", "--out", str(tmp_path / "runs")]
    )
    assert done.exit_code == 0, done.output
    assert "cube.mixture" in done.output
    assert "cheaper  image[mask] (at most" in done.output


@pytest.mark.slow
def test_the_command_line_shows_a_run_that_could_not_prove_its_tolerance(tmp_path, monkeypatch):
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(
        cheaper_steps, "_SMALLEST_TOLERANCE", 0.0
    )  # so fine a tolerance would not even be tried
    words = [
        "run",
        "first_light",
        *SMALL,
        "tolerance=1e-7",
        "outputs=[raw]",
        "--out",
        str(tmp_path / "runs"),
    ]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert "cheaper" not in done.output
    assert "\n  cube  " in done.output


@pytest.mark.slow
def test_the_page_says_it(recipe, warm, tmp_path):
    done = simulate(recipe, warm, tmp_path / "runs", ["neusee"])
    page, doc = done.page.read_text(), json.loads((done.folder / "provenance.json").read_text())
    assert "image[mask].channels" in page
    for row in doc["spent"]["outputs"]:
        error = "" if row["error"] is None else f"{row['error']:.2g}"
        assert f'<td class="n">{error}</td><td>{row["kind"]}</td>' in page
    assert doc["spent"]["economies"][0]["bound"] <= recipe.tolerance
    assert max(doc["spent"]["bounds"].values()) <= recipe.tolerance
    whole = simulate(replace(recipe, exact=True), warm, tmp_path / "runs", ["neusee"])
    assert "every step was computed in full" in whole.page.read_text()
    assert "measured beside --exact" in run_folder.page(
        {**doc, "spent": spent(run(recipe, warm))}, {}
    )


def account_of(*rows):
    names = ("output", "error", "kind", "measured")
    return {"outputs": [dict(zip(names, row, strict=True)) for row in rows], "coverage": 0.95}


def test_a_measurement_of_some_outputs_is_not_that_of_all():
    """The photons of a recipe were off by 5.3e-6, its pictures by 2e-3, and the terminal said
    "measured 5.3e-06".
    """
    account = account_of(("photons", 7.4e-6, "proved", 5.3e-6), ("raw", 4.6e-3, "estimated", None))
    assert (
        said_of_errors(account)
        == "error    7.4e-06 in photons at most, proved; 4.6e-03 in raw, an estimate that 95% of"
        " errors do not exceed; measured beside --exact: 5.3e-06 in photons; not measured: raw"
    )


def test_an_error_that_is_not_known_is_named_and_none_is_none():
    account = account_of(("raw", None, "unknown", None), ("lsr", 0.0, "exact", None))
    assert said_of_errors(account) == "error    unknown in raw"
    assert said_of_errors(account_of(("lsr", 0.0, "exact", 0.0))) == "error    none in the outputs"


def test_study_and_run_state_the_same_error(recipe, warm):
    rows = {row["output"]: row for row in spent(run(recipe, warm))["outputs"]}
    for output in OmissionComparison(recipe, warm).output_errors():
        row = rows[output.output]
        assert (output.bound, output.kind, output.rms) == (
            row["error"],
            row["kind"],
            row["measured"],
        )
