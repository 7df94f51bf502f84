"""Each packaged recipe whose laser has a strength says which strength it means, so that its
numbers stay.
"""

import re
from pathlib import Path

import pytest

from neusee.workflows import load

RECIPES = Path(__file__).parents[3] / "recipes"


def options(path):
    """Option of each group that a recipe names."""
    return dict(re.findall(r"^\s+- (\w+): (\w+)", path.read_text(encoding="utf-8"), re.MULTILINE))


LASERS = {
    path.stem: path
    for path in sorted(RECIPES.glob("*.yaml"))
    if (laser := options(path).get("laser"))
    and "strength:" in (RECIPES / "laser" / f"{laser}.yaml").read_text(encoding="utf-8")
}


def test_the_recipes_with_a_strength_are_found():
    assert {"first_light", "paper_table1", "six_lasers", "train"} <= set(LASERS)
    assert not {"pointer", "laser_free", "calibrate"} & set(LASERS)


@pytest.mark.parametrize("name", LASERS)
def test_a_packaged_recipe_says_which_strength_it_means(name):
    assert re.search(
        r"^reading: \{strength: irradiance\}",
        LASERS[name].read_text(encoding="utf-8"),
        re.MULTILINE,
    )


@pytest.mark.parametrize(
    ("words", "meaning"),
    [((), "irradiance"), (("reading.strength=first_channel",), "first_channel")],
)
def test_the_meaning_reaches_every_spot(words, meaning):
    recipe = load("first_light", words)
    assert {recipe.steps[f"spot[{arm},green]"].params["meaning"] for arm in ("plain", "mask")} == {
        meaning
    }
