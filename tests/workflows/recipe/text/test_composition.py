from pathlib import Path

import pytest

from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.recipe.text.composition import compose

MINE = "# Mine.\ndefaults:\n  - lens: wide\n  - laser: null\nlens: {f: 3}\nseed: 1\noutputs: [a]\n"
WIDE = """\
lens: {f: 1, stop: 2}
steps:
  a: {node: toy.height, with: {samples: 3}}
  b: {node: toy.add, from: a, with: {amount: 1}}
"""


@pytest.fixture
def files(write, tmp_path):
    write(WIDE, "lens/wide.yaml")
    write("lens: {f: 9, stop: 8, coat: [1, {x: 2}]}\n", "lens/tele.yaml")
    write("lasers: {green: {wavelength: 532 nm}}\n", "laser/green.yaml")
    write(MINE)
    return tmp_path


@pytest.fixture
def composed(files):
    def composed(*arguments, text=None):
        if text is not None:
            (files / "mine.yaml").write_text(text)
        result = compose("mine.yaml", arguments, files)
        return result.root.plain, [
            " | ".join((str(p.mark), p.path, p.message)) for p in result.diagnostics
        ]

    return composed


def test_groups_come_in_order_and_the_recipe_over_them(composed):
    root, diagnostics = composed()
    assert not diagnostics
    assert root["lens"] == {"f": 3, "stop": 2}
    assert list(root) == ["lens", "steps", "seed", "outputs"]


def test_a_group_that_is_null_is_skipped(composed):
    assert "lasers" not in composed()[0]


def test_an_argument_swaps_a_group(composed):
    root, diagnostics = composed("lens=tele", "laser=green")
    assert not diagnostics
    assert root["lens"] == {"f": 3, "stop": 8, "coat": [1, {"x": 2}]}
    assert root["lasers"] == {"green": {"wavelength": "532 nm"}}


def test_a_group_can_be_added_and_taken_away(composed):
    root, diagnostics = composed("+scene=siemens", "~lens")
    assert not diagnostics
    assert set(root["scene"]) == {"shape"}  # from the packaged groups
    assert root["lens"] == {"f": 3}


def test_the_folder_beside_the_recipe_comes_before_the_packaged_one(composed, write):
    write("scene: {mine: 1}\n", "scene/siemens.yaml")
    assert composed("+scene=siemens")[0]["scene"] == {"mine": 1}


@pytest.mark.parametrize(
    ("argument", "path", "value"),
    [
        ("lens.f=4", ("lens", "f"), 4),
        ("lens.f=1e3", ("lens", "f"), 1000.0),
        ("lens.f=20 e-", ("lens", "f"), "20 e-"),
        ("lens.f=[1, 2]", ("lens", "f"), [1, 2]),
        ("lens.f={a: 1}", ("lens", "f"), {"a": 1}),
        ("lens.f=null", ("lens", "f"), None),
        ("lens.f=on", ("lens", "f"), "on"),
        ("lens.f=a=b", ("lens", "f"), "a=b"),
        ("lens.f=${lens.stop}", ("lens", "f"), "${lens.stop}"),
        ("+lens.new=4", ("lens", "new"), 4),
        ("+glass.n.d=1.5", ("glass", "n", "d"), 1.5),
        ("lens.coat.0=5", ("lens", "coat", 0), 5),
        ("lens.coat.1.x=5", ("lens", "coat", 1, "x"), 5),
        ("+lens.coat.2=5", ("lens", "coat", 2), 5),
        ("+lens.terms.7=50 nm", ("lens", "terms", 7), "50 nm"),
        ("seed=3", ("seed",), 3),
        ("tolerance=1e-2", ("tolerance",), 0.01),
        ("outputs=[b]", ("outputs",), ["b"]),
    ],
)
def test_an_argument_sets_a_value(composed, argument, path, value):
    root, diagnostics = composed("lens=tele", argument)
    assert not diagnostics
    for key in path:
        root = root[key]
    assert root == value
    assert type(root) is type(value)


def test_a_parameter_of_a_step_can_be_set_though_no_one_wrote_it(composed):
    root, diagnostics = composed(
        "steps.a.with.bits=12", "steps.a.each=lasers", "steps.a.with.samples=5"
    )
    assert not diagnostics
    assert root["steps"]["a"] == {
        "node": "toy.height",
        "each": "lasers",
        "with": {"samples": 5, "bits": 12},
    }


def test_a_value_can_be_taken_away(composed):
    root, diagnostics = composed("~lens.stop", "~steps.b", "~outputs.0")
    assert not diagnostics
    assert root["lens"] == {"f": 3}
    assert list(root["steps"]) == ["a"]
    assert root["outputs"] == []


def test_a_value_below_a_number_knows_its_place_as_the_file_has_it(files, write):
    """Written out again, `2` and `'2'` would be two keys."""
    write("steps:\n  a: {node: toy.height, with: {samples: 3}}\nlens: {2: {f: 1}}\n", "two.yaml")
    leaves = (
        compose("two.yaml", ["lens.2.f=5", "+lens.3=7", "+lens.2.g={h: 1}"], files)
        .root.items["lens"]
        .leaves()
    )
    assert {leaf.path: leaf.plain for leaf in leaves} == {
        ("lens", 2, "f"): 5,
        ("lens", 2, "g", "h"): 1,
        ("lens", 3): 7,
    }


def test_the_last_argument_wins(composed):
    assert composed("lens.f=4", "lens.f=5")[0]["lens"]["f"] == 5


def test_a_step_with_a_node_replaces_the_whole_step_and_without_one_changes_it(composed):
    root, _ = composed(text=MINE + "steps:\n  a: {with: {x: 1}}\n  b: {node: toy.psf}\n")
    assert root["steps"]["a"] == {"node": "toy.height", "with": {"samples": 3, "x": 1}}
    assert root["steps"]["b"] == {"node": "toy.psf"}


def test_a_step_that_is_null_is_absent(composed):
    assert composed(text=MINE + "steps: {b: null}\n")[0]["steps"]["b"] is None


@pytest.mark.parametrize(
    ("argument", "problem"),
    [
        ("lens.ff=1", "argument 1 | lens.ff=1 | unknown; did you mean lens.f?"),
        ("lense.f=1", "argument 1 | lense.f=1 | unknown; did you mean lens.f?"),
        ("stop=1", "argument 1 | stop=1 | unknown; did you mean steps?"),
        ("stopp=1", "argument 1 | stopp=1 | unknown; did you mean steps?"),
        ("qqq=1", "argument 1 | qqq=1 | unknown; the recipe has lens, steps, seed, outputs"),
        ("sed=1", "argument 1 | sed=1 | unknown; did you mean seed?"),
        ("tolerence=1", "argument 1 | tolerence=1 | unknown; did you mean tolerance?"),
        ("lasr=green", "argument 1 | lasr=green | unknown; did you mean laser?"),
        (
            "steps.aa.with.samples=1",
            "argument 1 | steps.aa.with.samples=1 | unknown; did you mean steps.a.with.samples?",
        ),
        ("~lens.stp", "argument 1 | ~lens.stp | unknown; did you mean lens.stop?"),
        ("+lens.f=1", "argument 1 | +lens.f=1 | exists already: remove the + to change the value"),
        ("+lens.f.x=1", "argument 1 | +lens.f.x=1 | lens.f is a single value, not a mapping"),
        ("outputs.4=b", "argument 1 | outputs.4=b | outputs has 1 values: 0 to 0"),
        ("lens=wde", "argument 1 | lens=wde | no option wde in lens; did you mean wide?"),
        (
            "lens=../mine",
            "argument 1 | lens=../mine | no option ../mine in lens; there are: tele, wide",
        ),
        ("+lens=tele", "argument 1 | +lens=tele | lens is already set to wide: remove the +"),
        (
            "scene=china",
            (
                "argument 1 | scene=china | this recipe has no group scene; to add the group, write"
                " +scene=china"
            ),
        ),
        ("~scene", "argument 1 | ~scene | is not a group of this recipe; there are: laser, lens"),
        ("lens.f", "argument 1 | lens.f | the argument has no value: write lens.f=VALUE"),
        (
            "lens.f=",
            (
                "argument 1 | lens.f= | the value is empty: write lens.f=VALUE, or lens.f=null for"
                " none"
            ),
        ),
        (
            "lens.f=[1,2",
            "argument 1 | lens.f=[1,2 | is not YAML: expected ',' or ']', but got '<stream end>'",
        ),
        (
            "~lens.f=1",
            "argument 1 | ~lens.f=1 | ~ removes a value and cannot set one: write ~lens.f",
        ),
        (
            "=1",
            (
                "argument 1 | =1 | is not an override: write path=value, +path=value, ~path or"
                " group=option"
            ),
        ),
        (
            "++lens.f=1",
            "argument 1 | ++lens.f=1 | write lens.f=1 to change a value, or +lens.f=1 to add one",
        ),
        (
            "lens..f=1",
            (
                "argument 1 | lens..f=1 | is not an override: write path=value, +path=value, ~path"
                " or group=option"
            ),
        ),
        ("--lens", "argument 1 | --lens | the argument has no value: write --lens=VALUE"),
    ],
)
def test_a_wrong_argument_is_shown_with_its_fix(composed, argument, problem):
    assert composed(argument)[1] == [problem]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (
            "defaults: {lens: wide}\n",
            "mine.yaml:1:11 | defaults | must be a list of `group: option`, not a mapping",
        ),
        (
            "defaults: [3]\n",
            (
                "mine.yaml:1:12 | defaults.0 | must be one `group: option`, such as `doe: axicon`,"
                " or the name of a recipe, such as `first_light`"
            ),
        ),
        (
            "defaults: [lens: wide, lens: tele]\n",
            "mine.yaml:1:24 | defaults.lens | given twice, first in line 1",
        ),
        (
            "defaults: [lens: wyde]\n",
            "mine.yaml:1:18 | lens: wyde | no option wyde in lens; did you mean wide?",
        ),
        (
            "defaults: [lans: wide]\n",
            "mine.yaml:1:18 | lans: wide | no group lans; did you mean lens?",
        ),
    ],
)
def test_a_wrong_group_is_located(composed, text, problem):
    assert composed(text=text)[1] == [problem]


def test_every_broken_file_is_reported(composed, write):
    write("a: [\n", "lens/wide.yaml")
    write("a: 1\na: 2\n", "laser/green.yaml")
    diagnostics = composed("laser=green", "lens.f=[")[1]
    assert [p.partition(" ")[0] for p in diagnostics] == [
        "argument",
        "lens/wide.yaml:2:1",
        "laser/green.yaml:2:1",
    ]


def test_an_unknown_recipe_gets_the_nearest(files):
    for name, hint in (
        ("first_lihgt", "first_light"),
        ("mine.yml", "mine.yaml"),
        ("../mine", "there are: "),
    ):
        with pytest.raises(RecipeError, match=hint):
            compose(name, (), files)


def test_a_value_knows_its_file_or_argument(files):
    root = compose("mine.yaml", ["lens.stop=7"], files, first=2).root
    assert str(root.items["lens"].items["f"].mark) == "mine.yaml:5:11"
    assert str(root.items["steps"].items["a"].items["node"].mark) == "lens/wide.yaml:3:13"
    assert str(root.items["lens"].items["stop"].mark) == "argument 2"
    assert Path(root.items["lens"].items["stop"].mark.folder) == files
    assert Path(root.items["steps"].items["a"].mark.folder) == files / "lens"
