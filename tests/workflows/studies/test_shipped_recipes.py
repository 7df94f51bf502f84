"""The stability study of every shipped recipe, in which no cell fails."""

import csv
from pathlib import Path

import pytest

from neusee.workflows import Store, load
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.studies.case_result import judge_step
from neusee.workflows.studies.extreme_cases import CASES, CaseRecipe
from neusee.workflows.studies.run_study import study_recipe

RECIPES = sorted(path.stem for path in (Path(__file__).parents[3] / "recipes").glob("*.yaml"))
#: with steps that no recipe has
CHANGED = ["first_light +damage=published", "first_light flare=dirty_stray_light"]


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """One store for all recipes, because they share most cells."""
    return Store(tmp_path_factory.mktemp("stability") / "store")


def failing(recipe, store, folder, **cases):
    """Return case, step, node and errors of each cell that fails."""
    name, *changes = recipe.split()
    found = study_recipe("stability", load(name, changes), store, folder, ["neusee"], **cases)
    with (found / "table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) > 5
    columns = ("case", "step", "node", "error", "bound", "gradient error", "gradient bound", "note")
    return [tuple(row[name] for name in columns) for row in rows if row["mark"] == "fail"]


@pytest.mark.long
@pytest.mark.parametrize("recipe", RECIPES + CHANGED)
def test_no_cell_of_a_shipped_recipe_fails(recipe, store, tmp_path):
    assert failing(recipe, store, tmp_path) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("recipe", "case", "step", "mark"),
    [
        # the gradient overflowed at scene pixels that are dark
        ("hdr_night", "gain / 1e4", "deconvolved", "pass"),
        # the difference of 1 and a sum in float32
        ("laser_free", "400 nm", "outside[plain]", "pass"),
        # a gradient of 0 in a loss of 1e4
        ("laser_free", "1 pixel", "loss background_loss of bsr[mask]", "pass"),
        ("plain_lens", "700 nm", "spectral", "pass"),  # PSFs in float32 that differ by 1e-6
        # a picture of 1e15 has no noise, so that the filter inverts lens and pixel: the covariance
        # lost 3.3e-5. The gradient is off by 1e-16 of the ratio of scene and noise, as stated,
        # which is more than itself
        ("plain_lens", "huge", "deconvolved", "warn"),
        # the slope of a maximum: a warning where its two largest elements are equal to rounding,
        # which depends on the optics and may depend on the machine
        ("axicon", "steps past pi", "level", "warn or pass"),
        ("train_small", "two levels", "laser_psf[mask,drawn]", "pass"),  # 2.1e-6 in speckle, once
        # counted as a dark pixel
        ("first_light +damage=published", "NaN", "dazzle[plain]", "pass"),
        # white exceeded float16
        ("first_light +damage=published", "float16", "dead[mask]", "pass"),
        # 0 beside 2e-57
        ("first_light flare=dirty_stray_light", "Inf", "stray_shares[plain]", "pass"),
    ],
)
def test_cells_that_failed_once(recipe, case, step, mark, tmp_path):
    extreme = next(each for each in CASES if each.name == case)
    name, *changes = recipe.split()
    chain = CaseRecipe.of(load(name, changes), extreme, Code(tmp_path / "code.json"))
    judged = judge_step(chain.steps[step], chain.inputs(step), extreme, chain.recipe.seed)
    assert judged.mark in mark.split(" or ")
