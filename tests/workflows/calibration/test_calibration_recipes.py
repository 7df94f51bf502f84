"""Calibration as recipes: the packaged one, and measurements in files, which count by their
content.
"""

import numpy as np
import pytest
from PIL import Image

from neusee.workflows.cli.catalogue import node_lines
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.recipe.loading import load
from neusee.workflows.report.checked_recipe import recipe_text
from neusee.workflows.simulation.simulate_recipe import simulate
from neusee.workflows.store.result_store import Store

SMALL = ["flats.shape=[64, 64]"]
FILES = """\
# Frames in files.
measured:
  dark: {files: dark, photons: 0}
  dim: {files: "dim/*.png", photons: 100}
  bright: {files: [bright/a.png, bright/b.png], photons: 200}
  full: {files: [full], photons: 400}
steps:
  frames: {node: calibrate.frames, each: measured, with: {files: "${item.files}"}}
  level:
    node: calibrate.reduce
    each: measured
    from: frames
    with: {photons: "${item.photons}", exposure: 1 ms, scatter: temporal}
  levels: {node: calibrate.levels, from: level}
  camera: {node: calibrate.least_squares, from: levels}
outputs: [levels, camera]
"""
LEVELS = {"dark": 0, "dim": 100, "bright": 200, "full": 400}


def frame(path, photons, seed):
    rng = np.random.default_rng(seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    electrons = 0.5 * photons + rng.normal(0, np.sqrt(0.5 * photons + 25), (48, 64))
    Image.fromarray(np.round(1000 + 40 * electrons).clip(0, 65535).astype(np.uint16)).save(path)


@pytest.fixture
def measured(tmp_path):
    for i, (name, photons) in enumerate(LEVELS.items()):
        frame(tmp_path / name / "a.png", photons, 2 * i)
        frame(tmp_path / name / "b.png", photons, 2 * i + 1)
    (tmp_path / "mine.yaml").write_text(FILES)
    return tmp_path


def states(result):
    return {name: done.state for name, done in result.done.items()}


def test_the_packaged_sensor_comes_back_from_its_frames(tmp_path):
    result = run(load("calibrate"), Store(tmp_path))
    found = result.values["least_squares"]
    for name, truth in {"gain": 1 / 0.37, "efficiency": 0.56, "temporal_dark_noise": 10.5}.items():
        got, error = (float(found._asdict()[n]) for n in (name, f"{name}_error"))
        assert abs(got - truth) < 4 * error
        assert error < 0.005 * truth
    levels = result.values["levels"]
    assert len(levels.mean) == 15
    # only what fills the well is counted number by number
    assert set(levels.cell_level.tolist()) == {14}
    again = run(load("calibrate"), Store(tmp_path))
    assert states(again)["least_squares"] == "cached"
    assert "run" not in states(again).values()


def test_one_level_changed_is_one_level_taken_again(tmp_path):
    run(load("calibrate", SMALL), Store(tmp_path))
    result = run(load("calibrate", [*SMALL, "levels.flat_714.photons=720"]), Store(tmp_path))
    assert [name for name, state in states(result).items() if state == "run" and "[" in name] == [
        "exposed[flat_714]",
        "level[flat_714]",
    ]


def test_the_run_has_a_page_without_an_empty_table(tmp_path):
    done = simulate(
        load("calibrate"), Store(tmp_path / "store"), tmp_path / "runs", ["neusee", "run"]
    )
    page = (done.folder / "report.html").read_text()
    assert done.document["table"]["rows"] == []
    assert [e["ok"] for e in done.document["expected"]] == [True] * 3
    assert 'class="result"' not in page
    assert "Expected numbers" in page


def test_values_of_packaged_options_that_no_step_asks_for_are_left_out():
    recipe = load("calibrate")
    assert "sensor.gain" in recipe.config.settings
    assert "sensor.pixel_pitch" not in recipe.config.settings
    assert "pixel_pitch" not in recipe_text(recipe)


@pytest.mark.parametrize(
    "change", ["sensor.pixel_pitch=3 um", "+sensor.color=3", "reading.level=per_band"]
)
def test_but_none_may_be_changed_in_vain(change):
    with pytest.raises(RecipeError, match="unknown"):
        load("calibrate", [change])


def test_files_are_found_beside_the_recipe_and_give_the_camera(measured):
    recipe = load("mine.yaml", folder=measured)
    assert recipe.steps["frames[dark]"].params["files"] == (
        measured / "dark/a.png",
        measured / "dark/b.png",
    )
    assert recipe.steps["frames[dim]"].params["files"] == (
        measured / "dim/a.png",
        measured / "dim/b.png",
    )
    assert recipe.steps["frames[bright]"].params["files"] == (
        measured / "bright/a.png",
        measured / "bright/b.png",
    )
    assert recipe.config["measured.bright.files"].value == [
        str(measured / f"bright/{n}.png") for n in "ab"
    ]
    found = run(recipe, Store(measured / "store")).values["camera"]
    assert abs(float(found.gain) - 40) < 4 * float(found.gain_error)
    assert float(found.gain_error) < 2


@pytest.mark.parametrize("name", ["dark", "dim", "bright", "full"])
def test_one_number_in_one_file_changes_its_level_alone(measured, name):
    store = Store(measured / "store")
    run(load("mine.yaml", folder=measured), store)
    numbers = np.asarray(Image.open(measured / name / "b.png")).copy()
    numbers[3, 5] ^= 1
    Image.fromarray(numbers).save(measured / name / "b.png")
    again = states(run(load("mine.yaml", folder=measured), store))
    assert {n for n, state in again.items() if state == "run"} >= {
        f"level[{name}]",
        "levels",
        "camera",
    }
    assert not [n for n, s in again.items() if s == "run" and "[" in n and f"[{name}]" not in n]


def test_a_file_more_in_a_folder_is_another_level(measured):
    before = load("mine.yaml", folder=measured).steps["frames[dark]"].params["files"]
    frame(measured / "dark/c.png", 0, 99)
    after = load("mine.yaml", folder=measured).steps["frames[dark]"].params["files"]
    assert after == (*before, measured / "dark/c.png")


def test_the_recipe_of_a_run_finds_its_files_from_elsewhere(measured):
    recipe = load("mine.yaml", folder=measured)
    elsewhere = measured / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "recipe.yaml").write_text(recipe_text(recipe))
    again = load("recipe.yaml", folder=elsewhere)
    for name in ("frames[dark]", "frames[dim]", "frames[bright]"):
        assert again.steps[name].params == recipe.steps[name].params


def test_missing_files_are_told_with_their_place(measured):
    (measured / "mine.yaml").write_text(FILES.replace("bright/b.png", "bright/z.png"))
    with pytest.raises(RecipeError) as caught:
        load("mine.yaml", folder=measured)
    (problem,) = caught.value.diagnostics
    assert (problem.mark.file, problem.mark.line) == ("mine.yaml", 5)
    assert "no such file" in problem.message
    assert "z.png" in problem.message


@pytest.mark.parametrize(
    ("node", "line"),
    [
        ("calibrate.descriptor", "  file     a file; required"),
        (
            "calibrate.frames",
            (
                "  files    files: a path, a folder, a pattern such as dark/*.png, or a list of"
                " these; required"
            ),
        ),
    ],
)
def test_the_catalogue_says_what_files_are(node, line):
    assert line in node_lines(node)
