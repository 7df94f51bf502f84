"""Options of groups: they extend one another, and are found in the folders of the user before
the packaged ones.
"""

import os
import sys

import pytest

from neusee.workflows import load
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


def test_an_option_extends_others_and_its_own_keys_win(composed, write):
    write("defaults: [tele, laser: green]\nlens: {f: 1, coat: [2]}\n", "lens/mine.yaml")
    root, diagnostics = composed("lens=mine")
    assert not diagnostics
    assert root["lens"] == {"f": 3, "stop": 8, "coat": [2]}
    assert root["lasers"] == {"green": {"wavelength": "532 nm"}}


def test_later_options_come_over_earlier_ones_and_null_is_none(composed, write):
    write("defaults: [tele, wide, laser: null]\n", "lens/both.yaml")
    root, diagnostics = composed("lens=both", text="defaults: [lens: both]\nseed: 1\n")
    assert not diagnostics
    assert root["lens"] == {"f": 1, "stop": 2, "coat": [1, {"x": 2}]}


WRONG = [
    (
        "[mine]",
        "lens/mine.yaml:1:12 | lens: mine | options extend each other in a circle: {0} -> {0}",
    ),
    ("[tle]", "lens/mine.yaml:1:12 | lens: tle | no option tle in lens; did you mean tele?"),
    ("[lser: green]", "lens/mine.yaml:1:18 | lser: green | no group lser; did you mean laser?"),
    ("[tele, lens: tele]", "lens/mine.yaml:1:18 | defaults.lens | given twice, first in line 1"),
    (
        "tele",
        (
            "lens/mine.yaml:1:11 | defaults | must be a list of options of this group, such as"
            " `[small]`, not a string"
        ),
    ),
    (
        "[3]",
        (
            "lens/mine.yaml:1:12 | defaults.0 | must be an option of this group, such as `- small`,"
            " or one `group: option`"
        ),
    ),
]


@pytest.mark.parametrize(("defaults", "problem"), WRONG)
def test_a_mistake_in_an_option_is_located_in_its_file_once(composed, write, defaults, problem):
    write(f"defaults: {defaults}\nlens: {{f: 1}}\n", "lens/mine.yaml")
    assert composed("lens=mine")[1] == [problem.format("lens/mine.yaml")]


def test_a_circle_of_options_is_shown_whole(composed, write):
    write("defaults: [b]\n", "lens/a.yaml")
    write("defaults: [a]\n", "lens/b.yaml")
    [problem] = composed("lens=a")[1]
    assert problem.endswith("in a circle: lens/a.yaml -> lens/b.yaml -> lens/a.yaml")


@pytest.fixture
def places(tmp_path, monkeypatch):
    """Folders of the search: beside the recipe, two of the variable, and the folder of the user."""
    found = [tmp_path / name for name in ("beside", "one", "two", "home/neusee/recipes")]
    monkeypatch.setenv("NEUSEE_RECIPES", f"{found[1]}{os.pathsep}{found[2]}")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(sys, "platform", "linux")
    for folder in found:
        (folder / "sensor").mkdir(parents=True)
    return found


def test_options_are_found_in_order_and_what_is_hidden_is_said(places):
    beside, one, two, user = places
    recipe = beside / "mine.yaml"
    recipe.write_text("defaults: [sensor: small]\n")
    found = []
    for folder in (user, two, one, beside):
        (folder / "sensor" / "small.yaml").write_text(f"sensor: {{camera: {folder.name}}}\n")
        composed = compose("mine.yaml", (), beside)
        found.append(composed.root.plain["sensor"]["camera"])
        [note] = composed.notes
        assert note.startswith("sensor: small is ")
    assert found == ["recipes", "two", "one", "beside"]
    assert (
        note == f"sensor: small is sensor/small.yaml, which hides {one / 'sensor' / 'small.yaml'}"
    )


def test_an_option_that_extends_its_own_name_extends_the_next_folder(places):
    beside, one, _, user = places
    (beside / "mine.yaml").write_text("defaults: [sensor: small]\n")
    for folder, gain in ((beside, 1), (one, 2), (user, 3)):
        text = f"defaults: [small]\nsensor: {{gain: {gain} e-/DN, {folder.name}: true}}\n"
        (folder / "sensor" / "small.yaml").write_text(text)
    composed = compose("mine.yaml", (), beside)
    assert not composed.diagnostics
    sensor = composed.root.plain["sensor"]
    assert sensor["gain"] == "1 e-/DN"
    assert sensor["beside"]
    assert sensor["one"]
    assert sensor["recipes"]
    assert sensor["bits"] == 16


def test_a_packaged_recipe_sees_the_groups_of_the_working_folder(places):
    beside = places[0]
    (beside / "laser").mkdir()
    (beside / "laser" / "own.yaml").write_text("lasers: {a: {wavelength: 500 nm}}\n")
    composed = compose("first_light", ["laser=own"], beside)
    assert not composed.diagnostics
    assert list(composed.root.plain["lasers"]) == ["a"]


def test_a_recipe_of_the_user_is_found_by_its_name(places):
    beside, one, _, user = places
    (user / "night.yaml").write_text("# Night.\nseed: 1\n")
    (one / "first_light.yaml").write_text("# Mine.\nseed: 2\n")
    assert compose("night", (), beside).root.plain == {"seed": 1}
    composed = compose("first_light", (), beside)
    assert composed.notes == (
        f"first_light is {one / 'first_light.yaml'}, which hides the packaged recipe",
    )
    assert compose("laser_free", (), beside).notes == ()


def test_an_option_of_the_user_that_lacks_values_is_one_mistake_in_his_file(write, tmp_path):
    write("# Mine.\nsensor:\n  gain: 0.5 e-/DN\n  read_noise: 2 e-\n", "sensor/imx.yaml")
    with pytest.raises(RecipeError) as caught:
        load("first_light", ["sensor=imx"], tmp_path)
    [problem] = caught.value.diagnostics
    assert str(problem.mark) == "sensor/imx.yaml:2:1"
    assert problem.message.startswith(
        "lacks arrivals, background, bits, c1, c2, camera and 8 more, which steps need"
    )
    write(
        "# Mine.\ndefaults: [small]\nsensor:\n  gain: 0.5 e-/DN\n  read_noise: 2 e-\n",
        "sensor/imx.yaml",
    )
    recipe = load("first_light", ["sensor=imx"], tmp_path)
    assert recipe.steps["transfer"].params["gain"] == 2.0
    assert str(recipe.config["sensor.gain"].source) == "sensor/imx.yaml:4:9"
    assert recipe.config["sensor.bits"].value == 16


def test_a_block_of_a_recipe_that_lacks_values_is_one_mistake(read):
    used = "{node: toy.spot, with: {a: '${sensor.x}', b: '${sensor.y}', c: '${sensor.z}'}}"
    with pytest.raises(RecipeError) as caught:
        read(
            f"# Mine.\nsensor: {{}}\nsteps: {{a: {{node: toy.height}}, b: {used}}}\noutputs: [a]\n"
        )
    [problem] = [p for p in caught.value.diagnostics if p.path == "sensor"]
    assert str(problem.mark) == "mine.yaml:2:1"
    assert not [p for p in caught.value.diagnostics if "sensor." in p.message]
    assert problem.message.startswith("lacks x, y, z, which steps need: set these values, or name")
