"""The command that an evaluation prints gives its numbers: it is run, and its numbers are
compared to the last bit.
"""

import csv
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from neusee.workflows import load
from neusee.workflows.cli.app import app
from neusee.workflows.evaluation.evaluation_points import (
    EvaluationPoints,
    PointCommands,
    PointRequest,
)
from neusee.workflows.evaluation.evaluation_scenes import photographs, scenes
from neusee.workflows.evaluation.pipelines import (
    CASES,
    NamedRecipe,
    Pipeline,
    compose_pipelines,
    named_apart,
    protect,
    read_pipelines,
)
from neusee.workflows.protection.equal_rivals import EqualProtection
from neusee.workflows.store.result_store import Store

SMALL = ["optics.samples=96", "optics.pitch=84.15 um", "optics.bands=3", "optics.window=[24, 24]"]
SMALL += ["scene.shape=[32, 32]", "sensor.shape=[24, 24]"]
LAW = ["sensor.offset=uniform(350 e-, 400 e-)"]

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("store"))


@pytest.fixture
def folder(tmp_path, monkeypatch, store):
    """Photographs that are larger and smaller than a scene, in a folder whose name a shell would
    split.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NEUSEE_CACHE", str(store.root))
    place = tmp_path / "my photographs"
    place.mkdir()
    rng = np.random.default_rng(2)
    for name, size in (("a.png", (60, 70)), ("it's.png", (20, 24))):
        Image.fromarray(rng.integers(0, 256, (*size, 3), dtype=np.uint8)).save(place / name)
    return place


def numbers_of(command):
    """Run a command as a shell would, and return the numbers that it writes."""
    done = CliRunner().invoke(app, [*shlex.split(command)[1:], "--quiet"])
    assert done.exit_code == 0, done.stderr
    with (Path(done.stdout.strip()).parent / "metrics.csv").open() as file:
        return {(row["step"], row["field"]): float(row["value"]) for row in csv.DictReader(file)}


def assert_same(pipeline, found, run):
    quality = pipeline.pipeline.quality
    assert {name: run[quality, name] for name in ("l1", "psnr", "ssim")} == {
        name: found[name] for name in ("l1", "psnr", "ssim")
    }
    assert run["saturated[mask]", "pixels"] == found["saturated"]
    assert run["peak[mask]", "irradiance"] == pytest.approx(found["peak"], rel=1e-7)


#: of a photograph that is larger than a scene, and of a smaller one
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "law", "place"), [("five_half_rings+none", [], 0), ("flat+wiener", LAW, 1)]
)
def test_the_command_of_a_point_gives_its_numbers(store, folder, name, law, place):
    changes = [*SMALL, *law]
    each = compose_pipelines(
        NamedRecipe("first_light", changes, folder.parent), read_pipelines(name, folder)
    )
    shown, _ = scenes(load("first_light", changes), store, folder, 2, list(CASES))
    bench = EvaluationPoints(store, 16)
    listed = PointCommands(NamedRecipe("first_light", changes, folder.parent), bench).commands(
        each, shown, (0.0, 1e4)
    )
    found = bench.point(each[0], PointRequest(shown[place], 1e4))
    assert_same(each[0], found, numbers_of(listed[each[0].name][place][1e4]))
    commands = [command for scene in listed[each[0].name] for command in scene.values()]
    assert len(set(commands)) == 4


@pytest.mark.slow
def test_the_command_behind_a_filter_of_equal_protection_has_its_filter_and_its_exposure(
    store, folder
):
    bare = compose_pipelines(
        NamedRecipe("first_light", SMALL, folder.parent), read_pipelines("flat+none", folder)
    )
    each = protect(
        NamedRecipe("first_light", SMALL, folder.parent),
        bare,
        EqualProtection(0.01, "filter"),
        store,
        print,
    )
    shown, _ = scenes(load("first_light", SMALL), store, None, 1, list(CASES))
    bench = EvaluationPoints(store, 16)
    listed = PointCommands(NamedRecipe("first_light", SMALL, folder.parent), bench).commands(
        each, shown, (1e4,)
    )
    found = bench.point(each[0], PointRequest(shown[0], 1e4))
    assert_same(each[0], found, numbers_of(listed[each[0].name][0][1e4]))


def test_where_a_random_part_of_the_camera_has_the_seed_of_the_evaluation_there_is_no_wrong_command(
    store, folder
):
    """Grease on the window is the same in all scenes: a run with the seed of a scene would have
    another window.
    """
    dirty = [*SMALL, "flare=dirty_windshield"]
    each = compose_pipelines(
        NamedRecipe("first_light", dirty, folder.parent), read_pipelines("flat+none", folder)
    )
    shown, _ = scenes(load("first_light", dirty), store, folder, 2, list(CASES))
    listed = PointCommands(
        NamedRecipe("first_light", dirty, folder.parent), EvaluationPoints(store, 16)
    )
    first, second = listed.commands(each, shown, (1e4,))[each[0].name]
    assert first[1e4].startswith("neusee run first_light ")
    assert second[1e4] == ""


# --- names ----------------------------------------------------------------------------------------


def test_two_files_of_one_name_are_two_masks(tmp_path):
    """Optics and filters are kept by the name of a mask, which two files in different folders
    must not share.
    """
    for below in ("a", "b"):
        (tmp_path / below).mkdir()
        np.save(tmp_path / below / "m.npy", np.zeros((4, 4)))
    text = "pixelwise@a/m.npy+none, pixelwise@b/m.npy+wiener, pixelwise@b/m.npy+none"
    found = read_pipelines(text, tmp_path)
    assert [p.front for p in found] == [
        "pixelwise@a/m.npy",
        "pixelwise@b/m.npy",
        "pixelwise@b/m.npy",
    ]
    assert [p.name for p in found][2] == "pixelwise@b/m.npy+none"
    (alone,) = named_apart([Pipeline("pixelwise", "none", tmp_path / "a" / "m.npy")])
    assert alone.front == "pixelwise@m.npy"
    other = replace(alone, height_file=tmp_path / "a" / ".." / "a" / "m.npy")
    assert [p.front for p in named_apart([alone, other])] == ["pixelwise@m.npy"] * 2


def test_equal_photographs_count_as_one_whatever_their_names(store, folder):
    (folder / "copy.png").write_bytes((folder / "a.png").read_bytes())
    shown, _ = scenes(load("first_light", SMALL), store, folder, None, list(CASES))
    names = [scene.name for scene in shown]
    owners = dict(zip(names, photographs(shown), strict=True))
    assert owners["a.png"] == owners["copy.png"] != owners["it's.png"]


def test_a_changed_file_or_code_is_another_point_and_a_renamed_file_is_the_same(
    store, folder, tmp_path
):
    np.save(tmp_path / "m.npy", np.full((96, 96), 1e-7))

    def key(name="m.npy"):
        text = f"pixelwise@{tmp_path / name}+none"
        (pipeline,) = compose_pipelines(
            NamedRecipe("first_light", SMALL, folder.parent), read_pipelines(text, folder)
        )
        shown, _ = scenes(load("first_light", SMALL), store, folder, 1, list(CASES))
        return EvaluationPoints(store, 16).key(pipeline, PointRequest(shown[0], 1e4))

    first = key()
    (tmp_path / "m.npy").rename(tmp_path / "n.npy")
    assert key("n.npy") == first
    np.save(tmp_path / "n.npy", np.full((96, 96), 2e-7))
    second = key("n.npy")
    assert second != first
    for path in folder.iterdir():
        with Image.open(path) as image:
            other = image.point(lambda x: 255 - x)
        other.save(path)
    assert key("n.npy") != second
