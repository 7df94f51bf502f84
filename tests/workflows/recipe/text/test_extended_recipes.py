"""Recipes that extend recipes, several and optional options of a group, and the place of the
values of a file itself; and what is said of habits of Hydra that are not those of a recipe.
"""

from types import SimpleNamespace

import pytest

from neusee.workflows.cli.app import main
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.graph.recipe_graph import needed
from neusee.workflows.keys.cache_key import key_of
from neusee.workflows.recipe.loading import load
from neusee.workflows.recipe.text.composition import compose
from neusee.workflows.recipe.text.yaml_values import read

FILES = {
    "base.yaml": "# Base.\ndefaults: [lens: wide, laser: null]\nlens: {f: 3}\nseed: 1\n",
    "lens/wide.yaml": "lens: {f: 1, stop: 2}\n",
    "lens/tele.yaml": "lens: {f: 9, stop: 8}\n",
    "laser/green.yaml": "lasers: {green: 532, of: green}\n",
    "laser/red.yaml": "lasers: {red: 638, of: red}\n",
    "other/base.yaml": "defaults: [laser: blue]\nglass: 1\n",
    "other/laser/blue.yaml": "lasers: {blue: 450}\n",
    "part.yaml": "seed: 5\noutputs: [a]\n",
}

COMPOSED = {
    # what extends the base: values of the result by their dotted path, or None for no such block
    "defaults: [base]": {"lens.f": 3, "lens.stop": 2, "seed": 1, "lasers": None},
    "defaults: [base.yaml]\nlens: {f: 4}": {"lens.f": 4, "lens.stop": 2},
    "defaults: [base, lens: tele]": {"lens.f": 3, "lens.stop": 8},
    "defaults: [base, lens: null]": {"lens.f": 3, "lens.stop": None},
    "defaults: [base, laser: red]": {"lasers.red": 638, "lasers.green": None},
    "defaults: [base, part]": {"seed": 5, "outputs": ["a"], "lens.f": 3},
    "defaults: [part, base]": {"seed": 1, "outputs": ["a"]},
    "defaults: [other/base.yaml]": {"lasers.blue": 450, "glass": 1},
    # several options, of which the last wins
    "defaults: [laser: [green, red]]": {"lasers.green": 532, "lasers.red": 638, "lasers.of": "red"},
    "defaults: [laser: [red, green]]": {"lasers.of": "green"},
    "defaults: [laser: []]": {"lasers": None},
    "defaults: [base, laser: [green, red]]": {"lasers.of": "red", "lens.f": 3},
    # options that need not be there
    "defaults: [optional laser: red]": {"lasers.red": 638},
    "defaults: [optional laser: blue]\nseed: 2": {"lasers": None, "seed": 2},
    "defaults: [optional nowhere: x]\nseed: 2": {"seed": 2},
    "defaults: [optional laser: [blue, red]]": {"lasers.red": 638},
    # the place of the values of the file itself
    "defaults: [lens: wide, _self_]\nlens: {f: 4}": {"lens.f": 4},
    "defaults: [_self_, lens: wide]\nlens: {f: 4}": {"lens.f": 1},
    "defaults: [lens: wide, _self_, laser: red]\nlens: {f: 4}\nlasers: {of: me}": {
        "lens.f": 4,
        "lasers.of": "red",
    },
    "defaults: [_self_, base]\nlens: {f: 4}\nseed: 2": {"lens.f": 3, "seed": 1},
    "defaults: [base, _self_, part]\nseed: 2": {"seed": 5},
}

REFUSED = {
    # what is refused: place, entry and message
    "[bass]": "2:12 | bass | no such recipe; did you mean base?",
    "[bass.yaml]": "2:12 | bass.yaml | no such file; did you mean base.yaml?",
    "[other]": "2:12 | other | is a group: write `other: OPTION`; there are: base, two",
    "[laser]": "2:12 | laser | is a group: write `laser: OPTION`; there are: ",
    "[mine]": "2:12 | mine | recipes extend each other in a circle: mine.yaml -> mine.yaml",
    "[./mine.yaml]": "2:12 | ./mine.yaml | recipes extend each other in a circle: mine.yaml -> mine",
    "[ring]": "ring.yaml:1:12 | mine | recipes extend each other in a circle: mine.yaml -> ring.yaml"
    " -> mine.yaml",
    "[base, base]": "2:18 | defaults.base | given twice, first in line 2",
    "[base, base.yaml]": "2:18 | base.yaml | is extended already, by mine.yaml:2:12: remove this",
    "[base, other/two.yaml]": "2:18 | other/two.yaml | contains the groups of an earlier recipe (lens,"
    " laser): extend only one of the two",
    "[laser: red, base]": "2:24 | base | contains the group laser too: write `laser: red` after base",
    "[base, optional lens: tele]": "2:33 | optional lens: tele | replaces lens: wide"
    " (base.yaml:2:18): write `lens: tele`",
    "[_self_, base, _self_]": "2:26 | defaults._self_ | given twice, first in line 2",
    "[lens: wide, lens: tele]": "2:24 | defaults.lens | given twice, first in line 2",
    "[laser: [red, red]]": "2:25 | laser: [red, red] | red is given twice",
    "[laser: [red, rde]]": "2:25 | laser: [red, rde] | no option rde in laser; did you mean red?",
    "[laser: [red, null]]": "2:25 | laser: [red, null] | must be the name of an option, a list of",
    "[laser: [[red]]]": "2:20 | laser: [[red]] | must be the name of an option, a list of names, or",
    "[laser: 'red,green']": "2:19 | laser: red,green | there is no option red,green in laser: write"
    " several options of one run as a list, [red,green], and use `neusee sweep` for several runs",
    "[3]": "2:12 | defaults.0 | must be one `group: option`, such as `doe: axicon`, or the name of a",
    "[null]": "2:12 | defaults.0 | must be one `group: option`",
    "[[base]]": "2:12 | defaults.0 | must be one `group: option`",
    "[{laser: red, lens: wide}]": "2:12 | defaults.0 | must be one `group: option`",
    "[laser: {a: 1}]": "2:12 | defaults.0 | must be one `group: option`",
    "base": "2:11 | defaults | must be a list of `group: option`, not a string",
    "[broken]": "broken.yaml:1:1 |  | the file contains a string: write a mapping, `key: value`",
    # habits of Hydra
    "[base, override lens: tele]": "2:18 | override lens: tele | write `lens: tele`: an option in"
    " this list replaces the option of an extended recipe",
    "[base, override optional lens: tele]": "2:18 | override optional lens: tele | write `lens: tele`",
    "[laser@of: red]": "2:12 | laser@of: red | a recipe has no packages: write `laser: red`",
    "[/laser: red]": "2:12 | /laser: red | the name of a group contains no path: write `laser: red`",
    "[a/laser: red]": "2:12 | a/laser: red | the name of a group contains no path: write `laser: red`",
    "[override hydra/launcher: joblib]": "2:12 | override hydra/launcher: joblib | a recipe has no"
    " settings of Hydra: remove this setting; ",
    "[base@of]": "2:12 | base@of | a recipe has no packages: write `base`",
    "[laser/red]": "2:12 | laser/red | write `laser: red` for an option of a group",
    "[/laser/red]": "2:12 | /laser/red | write `laser: red` for an option of a group",
    "[far/base]": "2:12 | far/base | write `far/base.yaml` for a recipe in another folder",
    "[optional base]": "2:12 | optional base | only a group can be optional: write `optional group:",
    "[base, laser: '${lens}']": "2:25 | laser: ${lens} | an entry of `defaults` cannot"
    " contain a reference: write the name of the option",
    "[laser: '???']": "2:19 | laser: ??? | write the name of an option, or null for none",
    "[]\nhydra: {run: {dir: x}}": "3:1 | hydra | a recipe has no settings of Hydra: remove this setting; ",
    "[]\nlens: {_target_: a.B, _partial_: true}": "3:8 | lens._target_ | a recipe contains no Python"
    " objects: write a step, `steps: {NAME: {node: family.name}}`",
    "[]\nlens: {_partial_: true}": "3:8 | lens._partial_ | a recipe contains no Python objects",
}

ARGUMENTS = {
    "++lens.f=4": "write lens.f=4 to change a value, or +lens.f=4 to add one",
    "laser@of=red": "a recipe has no packages: write laser=red",
    "hydra.run.dir=x": "a recipe has no settings of Hydra: remove this setting; `--out` names the folder",
    "hydra/launcher=x": "a recipe has no settings of Hydra: remove this setting; ",
    "laser=red,green": "there is no option red,green in laser: write several options of one run as",
    "+laser=red": "laser is already set to null: remove the +",
    "+lens=[tele]": "lens is already set to wide: remove the +",
    "lens=[tele, wdie]": "no option wdie in lens; did you mean wide?",
}


@pytest.fixture
def files(write, tmp_path):
    for name, text in FILES.items():
        write(text, name)
    write("defaults: [mine]\n", "ring.yaml")
    write("a:1\n", "broken.yaml")
    write("defaults: [lens: wide, laser: red]\n", "other/two.yaml")
    return tmp_path


def mistakes(recipe, arguments, folder):
    try:
        found = compose(recipe, arguments, folder).diagnostics
    except RecipeError as error:
        found = error.diagnostics
    return [" | ".join((str(p.mark), p.path, p.message)) for p in found]


def value_at(root, path):
    for key in path.split("."):
        root = (root or {}).get(key)
    return root


def test_a_recipe_is_composed_of_what_its_defaults_say(files, write):
    wrong = {}
    for text, expected in COMPOSED.items():
        write(text + "\n", "mine.yaml")
        composed = compose("mine.yaml", (), files)
        values = {path: value_at(composed.root.plain, path) for path in expected}
        if values != expected or composed.diagnostics:
            wrong[text] = values, composed.diagnostics
    assert not wrong


def test_a_wrong_entry_is_one_located_mistake(files, write):
    wrong = {}
    for defaults, expected in REFUSED.items():
        write(f"# Mine.\ndefaults: {defaults}\n", "mine.yaml")
        # an argument may change what an extended recipe has, and not what a missing option has
        arguments = ["seed=4"] if "no option" in expected else ["lens.f=4", "lens=tele"]
        messages = mistakes("mine.yaml", arguments, files)
        of_mine = "mine.yaml:" if expected[0].isdigit() else ""
        if len(messages) != 1 or not messages[0].startswith(of_mine + expected):
            wrong[defaults] = messages
    assert not wrong


def test_a_wrong_argument_is_one_mistake_with_what_to_write(files, write):
    write("defaults: [base]\n", "mine.yaml")
    wrong = {}
    for argument, expected in ARGUMENTS.items():
        messages = mistakes("mine.yaml", [argument], files)
        if len(messages) != 1 or f" | {argument} | {expected}" not in messages[0]:
            wrong[argument] = messages
    assert not wrong


@pytest.mark.parametrize("word", ["-m", "--multirun"])
def test_several_runs_are_a_sweep(word, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["run", word, "first_light", "laser=green,red"])
    assert stopped.value.code == 2
    assert "several values are a sweep: write `neusee sweep RECIPE" in capsys.readouterr().err


def test_an_argument_replaces_the_option_of_an_extended_recipe(files, write):
    write("defaults: [base]\nlens: {g: 1}\n", "mine.yaml")
    root = compose("mine.yaml", ["lens=tele", "laser=[green,red]", "+glass=x"], files).root.plain
    assert (root["lens"], root["lasers"]["of"]) == ({"f": 3, "stop": 8, "g": 1}, "red")
    write("lasers: {mine: 1}\n", "scene/siemens.yaml")
    root = compose("mine.yaml", ["+scene=siemens", "~lens"], files).root.plain
    assert root == {"lens": {"f": 3, "g": 1}, "seed": 1, "lasers": {"mine": 1}}


def test_an_optional_option_that_is_not_there_is_said(files, write):
    write("defaults: [optional laser: blue]\n", "mine.yaml")
    assert compose("mine.yaml", (), files).notes == (
        "laser: there is no option blue; the entry is optional, so it is ignored",
    )


def test_an_option_has_a_place_for_its_own_values(files, write):
    write("defaults: [_self_, tele, laser: [green, red]]\nlens: {f: 0, g: 5}\n", "lens/mine.yaml")
    write("defaults: [lens: mine]\n", "mine.yaml")
    root = compose("mine.yaml", (), files).root.plain
    assert root["lens"] == {"f": 9, "g": 5, "stop": 8}
    assert root["lasers"]["of"] == "red"


def test_a_recipe_that_extends_its_own_name_extends_that_of_the_next_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("NEUSEE_RECIPES", str(tmp_path))
    (tmp_path / "first_light.yaml").write_text("# Mine.\ndefaults: [first_light]\nseed: 9\n")
    composed = compose("first_light", (), tmp_path)
    assert not composed.diagnostics
    assert composed.title == "Mine."
    assert composed.root.plain["seed"] == 9
    assert composed.root.plain["tolerance"] == 1e-3
    assert composed.root.items["tolerance"].mark.file == "first_light.yaml"


def test_a_long_chain_of_recipes_is_refused(tmp_path):
    for number in range(60):
        (tmp_path / f"r{number}.yaml").write_text(f"defaults: [r{number + 1}]\n")
    [message] = mistakes("r0.yaml", (), tmp_path)
    assert message.endswith("more than 50 recipes extend each other: write them as one")


def test_a_stranger_extends_no_recipe_outside_of_his_folder(files, write, monkeypatch):
    monkeypatch.setenv("NEUSEE_NO_CODE", "1")
    (files / "other/link.yaml").symlink_to(files / "base.yaml")
    for name in ("../base.yaml", "link", "link.yaml", str(files / "base.yaml")):
        write(f"defaults: ['{name}']\n", "other/mine.yaml")
        [message] = mistakes("other/mine.yaml", (), files)
        assert "is not in the folder of mine.yaml, which NEUSEE_NO_CODE or --no-code" in message
    write("defaults: [laser_free]\n", "other/mine.yaml")
    assert not mistakes("other/mine.yaml", (), files)


def test_a_package_line_is_refused_where_it_stands(files, write):
    write("# Mine.\n# @package _global_\nseed: 1\n", "mine.yaml")
    with pytest.raises(RecipeError) as caught:
        read(files / "mine.yaml", "mine.yaml")
    [problem] = caught.value.diagnostics
    assert str(problem.mark) == "mine.yaml:2:1"
    assert problem.message.startswith("a recipe has no packages: remove this line")


def test_a_function_of_hydra_in_a_value_is_one_mistake(write, tmp_path):
    wrong = {}
    for text in ("${hydra:runtime.cwd}", "${oc.env:HOME}", "${now:%Y}", "${.gain}", "${..gain}"):
        write(f"defaults: [first_light]\nscene: {{shape: '{text}'}}\n", "mine.yaml")
        with pytest.raises(RecipeError) as caught:
            load("mine.yaml", (), tmp_path)
        messages = [problem.message for problem in caught.value.diagnostics]
        if len(messages) != 1 or "write " not in messages[0]:
            wrong[text] = messages
    assert not wrong


FLAT = """\
defaults: [camera: neusee, scene: china, illuminant: daylight, lift: lmmse, laser: red,
           optics: small, sensor: small, doe: axicon, flare: clean, restore: wiener,
           rival: grey_filter, reading: coherent]
seed: 7
tolerance: 1e-3
reading: {strength: irradiance}
sensor: {read_noise: 5 e-}
outputs: [raw, restored]
"""
SHORT = """\
defaults: [first_light, {laser: red}, {doe: axicon}]
sensor: {read_noise: 5 e-}
outputs: [raw, restored]
"""

CODE = SimpleNamespace(of=lambda node, classes=(): f"code of {node.path}")


def keys_of(recipe):
    keys = {}
    for name in needed(recipe, recipe.outputs):
        keys[name], _ = key_of(recipe.steps[name], keys, recipe.seed, CODE)
    return keys


def test_a_recipe_in_short_has_the_keys_of_the_same_one_written_out(write, tmp_path):
    write(FLAT, "flat.yaml")
    write(SHORT, "short.yaml")
    flat, short = (load(name, (), tmp_path) for name in ("flat.yaml", "short.yaml"))
    by_arguments = load(
        "first_light",
        ["laser=red", "doe=axicon", "sensor.read_noise=5 e-", "outputs=[raw,restored]"],
        tmp_path,
    )
    assert keys_of(flat) == keys_of(short) == keys_of(by_arguments)
    assert len(keys_of(flat)) > 30


def test_expected_numbers_that_an_extending_recipe_changes_are_not_compared(write, tmp_path):
    extended = load("first_light", (), tmp_path)
    write("defaults: [first_light, {laser: red}]\n", "red.yaml")
    write("defaults: [first_light, {doe: axicon}]\n", "axicon.yaml")
    red, axicon = (load(name, (), tmp_path) for name in ("red.yaml", "axicon.yaml"))
    assert red.expect == extended.expect
    assert {e.step for e in axicon.expect} == {"psf[plain]", "lsr[plain]"}
    [note] = [note for note in axicon.notes if note.startswith("not compared")]
    assert "LSR of the mask at 400 nm" in note


def test_a_value_of_an_extended_recipe_for_an_option_that_is_replaced_is_noted(write, tmp_path):
    write("defaults: [first_light]\ndoe: {orientation: 10 deg}\n", "base.yaml")
    write("defaults: [base.yaml, {doe: axicon}]\n", "mine.yaml")
    notes = load("mine.yaml", (), tmp_path).notes
    assert "doe.orientation (base.yaml:2:20) is not used with doe: axicon" in notes
