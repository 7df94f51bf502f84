"""What was called otherwise in 0.1: one located line says the new name, wherever the old one is
written.
"""

import functools
import json
import re
from pathlib import Path

import pytest

from neusee import recipes
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.recipe.loading import load
from neusee.workflows.recipe.node_families import families
from neusee.workflows.recipe.text.other_spellings import instead, new_name, old_names

RECIPES = ("first_light", "calibrate", "calibrate_camera")
#: by the block of a key, the recipe that has it; else first_light
BLOCKS = {"camera": "calibrate_camera"}
BLOCKS_OF_KEYS = ("sensor", "reading", "camera")
ELEMENT = [old for old in old_names() if "element" in old]  #: a block, a step, words of `train`
KEYS = [
    old for old in old_names() if old.count(".") == 1 and old.partition(".")[0] in BLOCKS_OF_KEYS
]
KEYS.remove("sensor.gather")  # a node of the family `sensor`, not a key of the block
KEYS += ["optics.start", "optics.stop"]
KEYS += [f"element.{name}" for name in ("material", "wrap_at", "levels", "max_height")]
LIFT = [old for old in old_names() if old.startswith("train_lift.")]
NODES = [old for old in old_names() if old.count(".") == 1 and old not in (*KEYS, *ELEMENT, *LIFT)]
GRID = [old for old in old_names() if instead(old) == instead("doe.flat.samples")]
PARAMETERS = [old for old in old_names() if old.count(".") == 2 and old not in (*ELEMENT, *GRID)]
ON_A_GRID = {  #: a step of 0.1 by its node, without the parameters of the pupil grid
    "doe.flat": {}, "doe.vortex": {"with": {"charge": 1}}, "doe.axicon": {"with": {"waves": 1}},
    "doe.spiral_axicon": {"with": {"waves": 1, "charge": 1}}, "doe.cubic": {"with": {"waves": 1}},
    "doe.half_rings": {"with": {"waves": [1]}}, "doe.zernike": {"with": {"coefficients": {4: "1 nm"}}},
    "doe.pixelwise": {}, "doe.unet": {}, "flare.dirt": {},
    "doe.smooth": {"from": {"height": "flat"}, "with": {"feature": "1 mm"}},
    "optics.pupil": {"from": {"height": "flat", "index": "index", "bands": "bands"}},
}  # fmt: skip


def refused(name, *arguments, folder=None):
    with pytest.raises(RecipeError) as caught:
        load(name, arguments, folder) if folder else load(name, arguments)
    return [(str(p.mark), p.path, p.message) for p in caught.value.diagnostics]


@functools.cache
def using(node):
    """A recipe that has a step of this node, and that step."""
    steps = ((name, step) for name in RECIPES for step in load(name).steps.values())
    return next(
        (name, step.name.partition("[")[0]) for name, step in steps if step.node.path == node
    )


def test_every_old_name_is_of_one_kind_and_is_one_no_more():
    kinds = (
        *(old for old in KEYS if not old.startswith("element.")),
        *NODES,
        *PARAMETERS,
        *GRID,
        *ELEMENT,
        *LIFT,
        "shading",
    )
    assert sorted(kinds) == sorted(old_names())
    assert sorted(ELEMENT) == [
        "element",
        "steps.element",
        "train.mask.kind=element",
        "train.rates.element",
    ]
    assert all(old.partition(".")[0] in families() for old in (*NODES, *PARAMETERS))
    assert not [old for old in old_names() if new_name(old) in old_names()]


@pytest.mark.parametrize("old", KEYS)
def test_an_old_key_in_an_argument(old):
    name = BLOCKS.get(old.partition(".")[0], "first_light")
    assert refused(name, f"{old}=1 e-") == [("argument 1", f"{old}=1 e-", instead(old))]


@pytest.mark.parametrize("old", KEYS)
def test_an_old_key_in_a_file(old, tmp_path):
    """Beside the new one, and in its place: in both cases the old one alone is the mistake."""
    block, _, key = old.partition(".")
    name = BLOCKS.get(block, "first_light")
    folder = Path(recipes.__path__[0])
    text = (folder / f"{name}.yaml").read_text().replace("samples/", f"{folder}/samples/")
    beside, there = re.subn(rf"\n{block}:.*\n", f"\n{block}:\n  {key}: 1 e-\n", text, count=1)
    beside += "" if there else f"{block}:\n  {key}: 1 e-\n"
    now = (new_name(old) or "").rpartition(".")[2]
    for n, written in enumerate(
        (beside, re.sub(rf"\n  {now}: .*", "", beside, count=1) if now not in ("", key) else beside)
    ):
        (tmp_path / f"{n}.yaml").write_text(written)
        ((where, path, message),) = refused(f"{n}.yaml", folder=tmp_path)
        assert where.startswith(f"{n}.yaml:")
        assert (path, message) == (old, instead(old))


@pytest.mark.parametrize("old", KEYS)
def test_an_old_key_that_a_reference_names(old):
    name = BLOCKS.get(old.partition(".")[0], "first_light")
    found = refused(name, f"seed=${{{old}}}")
    assert len(found) == 1
    assert found[0][0] == "argument 1"
    assert instead(old) in found[0][2]


def test_the_group_of_the_field_of_dirt_in_an_argument():
    assert refused("first_light", "+shading=estimated") == [
        ("argument 1", "shading", instead("shading"))
    ]


@pytest.mark.parametrize("old", NODES)
def test_an_old_node(old):
    found = refused("first_light", f"+steps.old={{node: {old}}}")
    assert [message for _, _, message in found] == [f"{old} {instead(old)}"]
    assert found[0][0] == "argument 1"


@pytest.mark.parametrize("old", PARAMETERS)
def test_an_old_parameter(old):
    node, _, parameter = old.rpartition(".")
    name, step = using(node)
    ((where, path, message),) = refused(name, f"+steps.{step}.with.{parameter}=1 e-")
    assert (where, path, message) == ("argument 1", f"steps.{step}.with.{parameter}", instead(old))


@pytest.mark.parametrize("old", [old for old in PARAMETERS if new_name(old)])
def test_an_old_parameter_in_place_of_the_new_one_is_one_mistake(old):
    node, _, parameter = old.rpartition(".")
    name, step = using(node)
    found = refused(
        name, f"~steps.{step}.with.{new_name(old)}", f"+steps.{step}.with.{parameter}=1 e-"
    )
    assert [message for _, _, message in found] == [instead(old)]


@pytest.mark.slow
@pytest.mark.parametrize("node", ON_A_GRID)
@pytest.mark.parametrize("new", [False, True], ids=["old", "with the new input"])
def test_a_step_with_its_own_pupil_grid_is_one_mistake(node, new):
    """However many parameters of the grid are given, and whether or not the step of the grid is
    wired.
    """
    assert {old.rpartition(".")[0] for old in GRID} == set(ON_A_GRID)
    grid = {"samples": 8, "pitch": "1 mm", "diameter": "8 mm", "aperture": "clipped"}
    step = ON_A_GRID[node]
    wires = {**step.get("from", {}), **({"stop": "stop"} if new else {})}
    for given in (grid, {"diameter": "8 mm"}):
        old = {"node": node, "from": wires, "with": {**step.get("with", {}), **given}}
        ((where, path, message),) = refused("first_light", f"+steps.old={json.dumps(old)}")
        assert (where, path) == ("argument 1", f"steps.old.with.{next(iter(given))}")
        assert message == instead(f"{node}.pitch")
        assert "stop: {node: optics.stop, with:" in message


@pytest.mark.parametrize("words", [("outputs=[element]",), ("steps.pupil.from.height=element",)])
def test_an_old_step(words):
    found = refused("first_light", *words)
    assert {message for _, _, message in found} == {"step element is called fabricated now"}
    assert {where for where, _, _ in found} == {"argument 1"}


def test_an_old_step_in_an_argument():
    word = "steps.element.with.levels=4"
    assert refused("first_light", word) == [
        ("argument 1", word, "is called steps.fabricated.with.levels now")
    ]


@pytest.mark.parametrize(
    ("word", "path", "message"),
    [
        ("+train.rates.element=1e-3", "train.rates.element", "is called train.rates.mask now"),
        ("train.mask.kind=element", "train.mask.kind", "element is called recipe_mask now"),
    ],
)
def test_an_old_word_of_training(word, path, message):
    assert refused("train_small", word) == [("argument 1", path, message)]


@pytest.mark.parametrize("old", LIFT)
def test_an_old_key_of_training_a_lift(old, tmp_path):
    assert refused("train_lift", f"{old}=1") == [("argument 1", f"{old}=1", instead(old))]
    text = (Path(recipes.__path__[0]) / "train_lift.yaml").read_text()
    key, now = old.rpartition(".")[2], new_name(old).rpartition(".")[2]
    (tmp_path / "lift.yaml").write_text(
        re.sub(rf"\n  {now}:", f"\n  {key}:", text)
        if f"\n  {now}:" in text
        else text.replace("train_lift:\n", f"train_lift:\n  {key}: 1\n")
    )
    ((where, path, message),) = refused("lift.yaml", folder=tmp_path)
    assert where.startswith("lift.yaml:")
    assert (path, message) == (old, instead(old))
