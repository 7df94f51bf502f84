"""Optional references: a value that nobody gave leaves the default of the node in force."""

import pytest

from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.recipe.loading import load

TEXT = """\
# Two targets.
scene: {shape: [8, 8]LOW}
items:
  one: {kind: flat}
  two: {kind: edge, low: 0.25}
steps:
  all: {node: scene.targets, with: {kind: edge, shape: "${scene.shape}", low: "${scene.low?}"}}
  each: {node: scene.targets, each: items, with: {kind: "${item.kind}", shape: "${scene.shape}", low: "${item.low?}"}}
outputs: [all, each]
"""


def targets(write, tmp_path, text):
    write(text)
    return load("mine.yaml", (), tmp_path).steps


def mistakes(write, tmp_path, text):
    with pytest.raises(RecipeError) as caught:
        targets(write, tmp_path, text)
    return [f"{p.mark} | {p.path} | {p.message}" for p in caught.value.diagnostics]


@pytest.mark.parametrize(("given", "low"), [("", 0.0), (", low: 0.5", 0.5)])
def test_a_value_that_nobody_gave_is_the_default_of_the_node(write, tmp_path, given, low):
    steps = targets(write, tmp_path, TEXT.replace("LOW", given))
    assert steps["all"].params["low"] == low
    assert [steps[f"each[{name}]"].params["low"] for name in ("one", "two")] == [0.0, 0.25]


def test_a_misspelt_optional_value_is_told_its_name(write, tmp_path):
    assert mistakes(write, tmp_path, TEXT.replace("LOW", ", lows: 0.5")) == [
        "mine.yaml:2:24 | scene.lows | unknown; did you mean low?"
    ]


def test_an_optional_reference_stands_alone(write, tmp_path):
    text = TEXT.replace("LOW", "").replace('"${scene.low?}"', '"0.${scene.low?}"')
    (line,) = mistakes(write, tmp_path, text)
    assert line.endswith("the optional reference ${scene.low?} must be the whole value")


def test_a_reference_that_is_not_optional_still_needs_its_value(write, tmp_path):
    (line,) = mistakes(write, tmp_path, TEXT.replace("LOW", "").replace("scene.low?", "scene.low"))
    assert "${scene.low} is unknown" in line
