"""The study of equal protection: page, gains below their bounds, pictures under attack, and what
is refused.
"""

import json
import math

import numpy as np
import pytest
from typer.testing import CliRunner

from neusee.workflows import load
from neusee.workflows.cli.app import app
from neusee.workflows.protection import protection_camera as front_optics
from neusee.workflows.protection.equal_rivals import MEASURES
from neusee.workflows.protection.protection_camera import (
    Front,
    FrontBench,
    FrontSettings,
    ProtectionCamera,
    usual_condition,
)
from neusee.workflows.protection.protection_result import LIGHTS
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.protection_study import crossing
from neusee.workflows.studies.run_study import study_recipe

SMALL = ["optics.samples=128", "optics.pitch=63.125 um", "optics.bands=3", "optics.window=[64, 64]"]
SMALL += ["scene.shape=[64, 64]", "sensor.shape=[48, 48]", "doe.waves=5"]
SETTINGS = FrontSettings(0.1, 0.12, 12.0, (64,), None)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Fronts are measured once for all tests."""
    return Store(tmp_path_factory.mktemp("protection"))


@pytest.fixture(scope="module")
def folder(store, tmp_path_factory):
    """A finished study of two draws."""
    return study_recipe(
        "protection",
        load("axicon", SMALL),
        store,
        tmp_path_factory.mktemp("runs"),
        draws=2,
        bands=3,
    )


def found(folder):
    return json.loads((folder / "provenance.json").read_text())


@pytest.mark.slow
def test_the_study_writes_page_table_figures_and_a_paragraph(folder):
    assert (folder / "report.html").stat().st_size > 10_000
    assert {path.stem for path in (folder / "figures").glob("*.png")} == {
        "region",
        "gain",
        "neq",
        "attack",
    }
    rows = (folder / "table.csv").read_text().splitlines()
    assert len(rows) == 1 + 8 * len(LIGHTS) * len(MEASURES)
    said = (folder / "paragraph.txt").read_text()
    assert "by the error of the filtered picture it" in said
    assert "Under attack" in said
    assert said.strip() in found(folder)["paragraph"]


@pytest.mark.slow
def test_the_gains_of_the_document_are_mask_less_rival_and_stay_below_the_bounds(folder):
    document = found(folder)
    for n, pair in document["bound"].items():
        assert pair["gain"] <= pair["bound"] * 1.001, n
    for n in ("10", "300", "10000"):
        gain, quiet = document["gain"][n], document["quiet"]
        assert (
            gain["error"]
            >= quiet["mask"][n]["error"] - quiet["best stop and filter"][n]["error"] - 1e-9
        )
        for rival in ("grey filter", "smaller stop"):
            assert quiet["best stop and filter"][n]["error"] >= quiet[rival][n]["error"]
        assert quiet["open lens"][n]["error"] >= quiet["best stop and filter"][n]["error"]
    # masks lead in the dark
    assert document["gain"]["10"]["NEQ"] > document["gain"]["10000"]["NEQ"]


@pytest.mark.slow
def test_the_smaller_stop_protects_as_the_mask_with_hardly_a_filter(folder):
    """Pixels average less of the wider spot of a stop away, so that its diameter is not the
    fourth root of the peak.
    """
    document = found(folder)
    stop, _, grey = document["rivals"]["smaller stop"].removeprefix("stop ").partition(", filter ")
    assert float(grey or 1) > 0.975
    assert float(stop) < 0.99 * document["protection"] ** 0.25


@pytest.mark.slow
def test_under_attack_the_mask_fills_more_pixels_than_the_filter(folder):
    lost = found(folder)["lost"]
    assert set(lost) >= {"open lens", "grey filter", "stop and filter", "mask"}
    assert all(len(values) == 2 for values in lost.values())
    assert np.median(lost["mask"]) < np.median(lost["grey filter"])


@pytest.mark.slow
def test_a_finished_study_measures_nothing_again(folder, store, tmp_path, monkeypatch):
    def refuse(*args, **more):
        raise AssertionError("a front was measured again")

    monkeypatch.setattr(front_optics.FrontBench, "_measure", refuse)
    again = study_recipe("protection", load("axicon", SMALL), store, tmp_path, draws=2, bands=3)
    assert found(again)["gain"] == found(folder)["gain"]


def test_the_light_at_which_a_gain_ends():
    assert crossing([-1.0] * 7) == 0.0
    assert math.isinf(crossing([1.0] * 7))
    assert crossing([1.0, -1.0, -1, -1, -1, -1, -1]) == pytest.approx(math.sqrt(10 * 30))


@pytest.mark.parametrize(
    ("recipe", "changes", "options", "said"),
    [
        ("plain_lens", ["doe=flat"], {}, "choose a mask, such as doe=axicon"),
        ("axicon", ["doe=axicon_and_filter"], {}, "shaded already: choose the mask alone"),
        ("axicon", [], {"size": 40.0}, "give a smaller --size"),
        ("calibrate", None, {}, "has no step psf\\[mask\\]: study a recipe of the camera"),
    ],
)
def test_an_unsuitable_recipe_is_refused_with_the_fix(
    recipe, changes, options, said, store, tmp_path
):
    words = (
        []
        if changes is None
        else [*changes, *(w for w in SMALL if recipe == "axicon" or "doe." not in w)]
    )
    with pytest.raises(ValueError, match=said):
        study_recipe(
            "protection", load(recipe, words), store, tmp_path, draws=2, bands=3, **options
        )


def test_a_wrong_option_is_refused_by_the_command():
    for words in (["--draws", "1"], ["--light", "moon"], ["--prnu", "2"], ["--size", "1"]):
        done = CliRunner().invoke(app, ["study", "protection", "axicon", *words])
        assert done.exit_code == 2


@pytest.mark.slow
def test_equal_heat_asks_for_a_darker_rival_than_equal_peak(store, tmp_path):
    """A mask widens the spot, which then cools less: its heat falls less than its peak."""
    camera = ProtectionCamera.of(load("axicon", SMALL), store, 3)
    heated = FrontBench(camera, store, FrontSettings(0.1, 0.12, 12.0, (64,), 0.1))
    one = heated.measure(Front(True), usual_condition())
    assert one.heat > 2 * one.peak
    stop = heated.measure(Front(False, 0.5), usual_condition())
    assert stop.heat == pytest.approx(0.5**3, rel=0.2)
    folder = study_recipe(
        "protection", load("axicon", SMALL), store, tmp_path, draws=2, bands=3, light="continuous"
    )
    assert found(folder)["protection"] == pytest.approx(one.heat, rel=1e-6)
    assert "heat of a laser" in found(folder)["paragraph"]
