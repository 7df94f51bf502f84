"""The stability study of every shipped recipe, in which no cell fails."""

import csv
from pathlib import Path

import pytest

from neusee.workflows import Store, load
from neusee.workflows.studies.stability.stability_study import study

RECIPES = sorted(path.stem for path in (Path(__file__).parents[4] / "recipes").glob("*.yaml"))


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """One store for all recipes, because they share most cells."""
    return Store(tmp_path_factory.mktemp("stability") / "store")


def failing(recipe, store, folder, **cases):
    """Return case, step, node and errors of each cell that fails."""
    found = study(load(recipe), store, folder, ["neusee"], lambda line: None, **cases)
    with (found / "table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) > 5
    columns = ("case", "step", "node", "error", "bound", "gradient error", "gradient bound", "note")
    return [tuple(row[name] for name in columns) for row in rows if row["mark"] == "fail"]


@pytest.mark.long
@pytest.mark.parametrize("recipe", RECIPES)
def test_no_cell_of_a_shipped_recipe_fails(recipe, store, tmp_path):
    assert failing(recipe, store, tmp_path) == []
