"""The verbs of `neusee`: one shape of signature, and each the same as the function of its room."""

import inspect
import json
import re
from pathlib import Path

import pytest
import torch

import neusee
from neusee.workflows.api import verbs
from neusee.workflows.calibration import run_calibration
from neusee.workflows.studies import run_study
from neusee.workflows.training import lift_training, run_training
from neusee.workflows.training.resumable_loop import TrainingSession

SMALL = {
    "optics": {"samples": 96, "pitch": "84.15 um", "bands": 5, "window": [24, 24]},
    "scene": {"shape": [32, 32]},
    "sensor": {"shape": [24, 24]},
}
WORDS = ["optics.samples=96", "optics.pitch=84.15 um", "optics.bands=5", "optics.window=[24, 24]"]
WORDS += ["scene.shape=[32, 32]", "sensor.shape=[24, 24]"]
VERBS = verbs.__all__


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))


@pytest.mark.parametrize("verb", VERBS)
def test_a_recipe_comes_first_and_all_else_by_name(verb):
    first, *rest = inspect.signature(getattr(neusee, verb)).parameters.values()
    assert (first.name, first.kind) == ("recipe", first.POSITIONAL_OR_KEYWORD)
    assert first.default is first.empty
    assert {p.kind for p in rest} <= {first.KEYWORD_ONLY, first.VAR_KEYWORD}
    assert {"changes", "store"} <= {p.name for p in rest}


@pytest.mark.parametrize("name", ["device", "out", "progress", "command", "changes", "store"])
def test_an_option_is_the_same_in_every_verb_that_has_it(name):
    every = [inspect.signature(getattr(neusee, verb)).parameters.get(name) for verb in VERBS]
    assert len({str(option) for option in every if option is not None}) == 1


def test_run_takes_a_name_a_file_or_a_recipe_and_changes_in_both_forms(tmp_path):
    recipe = neusee.load("laser_free", doe="axicon", **SMALL)
    (tmp_path / "mine.yaml").write_text(
        (Path(neusee.__file__).parent / "recipes" / "laser_free.yaml").read_text()
    )
    every = [
        neusee.run(recipe, outputs="lsr[mask]"),
        neusee.run("laser_free", changes={"doe": "axicon", **SMALL}, outputs=["lsr[mask]"]),
        neusee.run(tmp_path / "mine.yaml", changes=["doe=axicon", *WORDS], outputs=("lsr[mask]",)),
    ]
    assert len({result.keys["lsr[mask]"] for result in every}) == 1
    assert all(torch.equal(result["lsr[mask]"], every[0]["lsr[mask]"]) for result in every)


@pytest.mark.parametrize("verb", ["run", "train", "calibrate", "study"])
def test_a_recipe_that_is_read_takes_no_changes(verb):
    more = {"kind": "accuracy"} if verb == "study" else {}
    with pytest.raises(
        TypeError, match="laser_free is loaded already: pass the name of the recipe"
    ):
        getattr(neusee, verb)(neusee.load("laser_free"), changes={"doe": "axicon"}, **more)


@pytest.mark.parametrize(
    ("verb", "more"),
    [("sweep", {"axes": {"doe": ["flat"]}}), ("evaluate", {"pipelines": "flat+none"})],
)
def test_a_verb_that_reads_a_recipe_anew_asks_for_its_name(verb, more):
    with pytest.raises(
        TypeError, match=f"{verb} loads the recipe several times: pass the name or file"
    ):
        getattr(neusee, verb)(neusee.load("laser_free"), **more)


def test_a_text_in_the_place_of_changes_is_refused_with_the_fix():
    with pytest.raises(TypeError, match=re.escape("write changes=['doe=axicon']")):
        neusee.run("laser_free", changes="doe=axicon")


def test_sweep_takes_changes_as_values_and_as_words():
    how = {"axes": {"doe": ["axicon", "vortex"]}}
    values = neusee.sweep("laser_free", changes={**SMALL, "outputs": ["lsr[mask]"]}, **how)
    words = neusee.sweep("laser_free", changes=[*WORDS, 'outputs=["lsr[mask]"]'], **how)
    assert [row["value"] for row in values.rows] == [row["value"] for row in words.rows]
    assert {row["doe"] for row in values.rows} == {"axicon", "vortex"}


@pytest.mark.slow
def test_evaluate_takes_pipelines_as_a_text():
    told = []
    folder = neusee.evaluate(
        "first_light",
        pipelines="flat+none",
        changes=SMALL,
        scenes=1,
        strengths=[0, 10],
        small=11,
        progress=told.append,
    )
    assert folder.parent == Path("runs")
    assert json.loads((folder / "provenance.json").read_text())["strengths"] == [0.0, 10.0]
    assert told[0].startswith("1 scenes, 2 strengths, 1 pipelines: flat+none")


def test_calibrate_study_and_train_hand_their_options_to_their_rooms(monkeypatch):
    asked = {}

    def room(name):
        def called(*given, **options):
            asked[name] = given, options
            return Path("made") / name

        return called

    monkeypatch.setattr(run_calibration, "calibrate", room("calibrate"))
    monkeypatch.setattr(run_study, "study_recipe", room("study"))
    monkeypatch.setattr(run_training, "train", room("train"))
    monkeypatch.setattr(lift_training, "train_lift", room("lift"))
    recipe, progress, watch = neusee.load("train_small"), print, lambda *found: None
    store = neusee.Store("there")
    assert neusee.calibrate(recipe, store=store, out="o", progress=progress, draws=200) == Path(
        "made/calibrate"
    )
    assert asked["calibrate"] == (
        (recipe, store, Path("o"), (), progress, run_calibration.CalibrationOptions(64, "de", 200)),
        {},
    )
    assert neusee.study(recipe, kind="leave-out", store=store, out="o", progress=progress) == Path(
        "made/study"
    )
    assert asked["study"] == (("leave-out", recipe, store, Path("o"), (), progress), {})
    assert neusee.train(recipe, store=store, out="o", progress=progress, watch=watch) == Path(
        "made/train"
    )
    session = TrainingSession(store, Path("o"), progress, (), "cpu", watch)
    assert asked["train"] == ((recipe, session, tuple(recipe.training.learnt)), {})
    losses = []
    lift = neusee.load("train_lift")
    assert neusee.train(lift, store=store, watch=lambda *found: losses.append(found)) == Path(
        "made/lift"
    )
    asked["lift"][0][1].watch(0, 7, {"MRAE": 0.5})
    assert losses == [(0, 7, {"MRAE": 0.5})]


def test_an_unknown_kind_of_study_is_refused_with_those_there_are():
    with pytest.raises(
        ValueError, match="there is no study 'acuracy': write one of accuracy, stability, leave-out"
    ):
        neusee.study("laser_free", kind="acuracy")
