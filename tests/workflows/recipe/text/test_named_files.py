"""Files that a recipe of a stranger names: those in its own folder alone, unless the reader
names them.
"""

import pytest

from neusee.workflows.evaluation.pipelines import EvaluationRefused, read_pipelines
from neusee.workflows.graph.errors import Location, RecipeError
from neusee.workflows.recipe.loading import load
from neusee.workflows.recipe.text.recipe_files import (
    NO_CODE_VARIABLE,
    packaged,
    refuse_outside,
    user_folder,
)

OUTSIDE = "is not in the folder of "


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder of a stranger, with the switch that says so."""
    monkeypatch.setenv(NO_CODE_VARIABLE, "1")
    (tmp_path / "his").mkdir()
    (tmp_path / "mine.csv").write_text("")
    (tmp_path / "his" / "link.csv").symlink_to(tmp_path / "mine.csv")
    return tmp_path / "his"


def mark(folder, file="r.yaml", line=3):
    return Location(file, line, 1, str(folder))


@pytest.mark.parametrize(
    "name", ["../mine.csv", "link.csv", "/etc/passwd", "../his/../mine.csv", ".."]
)
def test_a_file_outside_is_refused(place, name):
    with pytest.raises(
        ValueError, match=OUTSIDE + "r.yaml, and with NEUSEE_NO_CODE or --no-code a recipe reads no"
    ):
        refuse_outside(place / name, mark(place))


@pytest.mark.parametrize("name", ["a.csv", "deep/a.csv", "../his/a.csv", "deep/../a.csv"])
def test_a_file_inside_passes_there_or_not(place, name):
    refuse_outside(place / name, mark(place))


def test_what_the_reader_names_passes(place, monkeypatch):
    refuse_outside(place / "../mine.csv", mark(place, "argument 2", 0))
    refuse_outside(place / "../mine.csv", mark(place, "--mask", 0))
    refuse_outside(place / "../mine.csv", mark(packaged() / "sensor"))
    refuse_outside(place / "../mine.csv", mark(user_folder() / "sensor"))
    monkeypatch.delenv(NO_CODE_VARIABLE)
    refuse_outside(place / "../mine.csv", mark(place))


def test_words_that_a_recipe_passes_on_are_its_own(place):
    with pytest.raises(ValueError, match=OUTSIDE + "r.yaml"):
        refuse_outside(place / "../mine.csv", mark(place, "r.yaml:7:3", 0))


@pytest.mark.parametrize(
    ("change", "path"),
    [
        ("photographs: ../secret", "train.photographs"),
        ("photographs: linked", "train.photographs"),
        ("start: ../mine.csv", "train.start"),
        ("cameras: [['posterior=../mine.csv']]\n  learn: null", "posterior"),
    ],
)
def test_a_training_of_a_stranger_reads_his_files_alone(place, change, path):
    (place.parent / "secret").mkdir()
    (place / "linked").mkdir()
    (place / "linked" / "a.png").symlink_to(place.parent / "mine.csv")
    text = (packaged() / "train_small.yaml").read_text(encoding="utf-8")
    (place / "r.yaml").write_text(
        text.replace("train:\n", f"train:\n  {change}\n", 1), encoding="utf-8"
    )
    with pytest.raises(RecipeError) as refused:
        load(place / "r.yaml", (), place)
    assert [each.path for each in refused.value.diagnostics if OUTSIDE in each.message] == [path]


def test_pipelines_of_a_recipe_name_its_files_alone(place):
    with pytest.raises(
        EvaluationRefused, match=r"pixelwise@\.\./mine\.csv\+none: mine\.csv " + OUTSIDE
    ):
        read_pipelines("pixelwise@../mine.csv+none", place, mark(place, "evaluate.pipelines"))
    assert (
        read_pipelines("pixelwise@../mine.csv+none", place)[0].height_file == place / "../mine.csv"
    )


def test_a_pattern_is_judged_by_the_files_that_it_means(place):
    text = (
        "outputs: [raw]\nsteps:\n"
        "  bands: {node: spectra.bands, with: {start: 400 nm, stop: 700 nm, count: 4}}\n"
        "  raw: {node: spectra.reflectances, from: bands, with: {sets: [], files: '*.csv'}}\n"
    )
    (place / "r.yaml").write_text(text)
    with pytest.raises(RecipeError, match=OUTSIDE):
        load(place / "r.yaml", (), place)
