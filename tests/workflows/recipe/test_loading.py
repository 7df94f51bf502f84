import ast
import sys
from pathlib import Path

import numpy as np
import pytest

import neusee
from neusee.workflows.graph.errors import Location, RunError
from neusee.workflows.recipe import loading
from neusee.workflows.recipe.blocks import settings_block, train_block
from neusee.workflows.recipe.loading import groups, load, recipes
from neusee.workflows.recipe.text.yaml_values import parse
from neusee.workflows.store.result_store import Store

CAMERA = """\
# A camera of toys.
sensor: {gain: 0.37, read_noise: 10.5 e-, bits: 12, rounding: nearest}
optics:
  pitch: 3.74 um
  window: [8, 8]
lasers:
  green: {wavelength: 532 nm, strength: 1e3}
  red: {wavelength: 638 nm, strength: 2e3}
seed: 7
tolerance: 1e-3
steps:
  height: {node: toy.height}
  pupil: {node: toy.pupil, from: height, with: {pitch: "${optics.pitch}"}}
  psf: {node: toy.psf, each: lasers, from: pupil, with: {shape: "${optics.window}", wavelength: "${item.wavelength}"}}
  spot: {node: toy.spot, each: lasers, from: psf, with: {strength: "${item.strength}"}}
  sum: {node: toy.gather, from: {photons: height, lasers: spot, ghosts: null}}
  raw:
    node: toy.digitize
    from: sum
    with:
      gain: "${sensor.gain}"
      sigma: "${sensor.read_noise}"
      bits: "${sensor.bits}"
      rounding: "${sensor.rounding}"
outputs: [raw]
expect:
  peak: {step: "spot[green]", at: [2, 2], value: 1.5e-3, rtol: 0.03}
"""


def swap(old, new):
    assert CAMERA.count(old) == 1, old
    return CAMERA.replace(old, new)


def test_a_checked_recipe_has_everything_in_si(read):
    recipe = read(CAMERA)
    assert (recipe.name, recipe.title, recipe.seed, recipe.tolerance) == (
        "mine",
        "A camera of toys.",
        7,
        1e-3,
    )
    assert recipe.outputs == ("raw",)
    assert recipe.steps["raw"].params == {
        "gain": 0.37,
        "sigma": 10.5,
        "bits": 12,
        "rounding": "nearest",
    }
    assert recipe.steps["pupil"].params == {"pitch": pytest.approx(3.74e-6), "diameter": 1e-3}
    assert recipe.steps["psf[red]"].params["shape"] == (8, 8)
    assert recipe.steps["raw"].node.path == "toy.digitize"
    (peak,) = recipe.expect
    assert (peak.step, peak.at, peak.value, peak.rtol) == ("spot[green]", (2, 2), 1.5e-3, 0.03)


def test_a_step_and_its_parameters_know_where_they_stand(read):
    recipe = read(CAMERA, "sensor.gain=3")
    assert str(recipe.steps["raw"].mark) == "mine.yaml:17:3"
    assert str(recipe.steps["raw"].param_marks["sigma"]) == "mine.yaml:2:34"
    assert str(recipe.steps["raw"].param_marks["gain"]) == "argument 1"
    assert "diameter" not in recipe.steps["pupil"].param_marks


def test_a_step_whose_parameters_are_all_removed_is_written_with_its_defaults(read):
    given = swap("height: {node: toy.height}", "height: {node: toy.height, with: {samples: 8}}")
    text = read(given, "~steps.height.with.samples").config.to_yaml()
    assert "    with:\n      # samples: 4 " in text
    assert read(text).steps["height"].params == {"samples": 4}


def test_final_values_have_their_sources(read):
    config = read(
        CAMERA, "sensor.gain=3", "optics.window.0=16", "steps.raw.with.bits=8", "~sensor.bits"
    ).config
    assert (config["sensor.gain"].value, config["sensor.gain"].source) == (3, "argument 1")
    assert (config["optics.window"].value, config["optics.window"].source) == (
        [16, 8],
        "mine.yaml:5:11, argument 2",
    )
    assert config["steps.raw.with.bits"].source == "argument 3"
    assert config["lasers.red.wavelength"].source == "mine.yaml:8:21"
    assert (
        config["steps.pupil.with.diameter"].value,
        config["steps.pupil.with.diameter"].source,
    ) == (
        1e-3,
        "default of toy.pupil",
    )


def test_the_config_is_a_recipe_that_says_the_same(read, tmp_path, toy):
    first = read(CAMERA, "sensor.gain=3")
    (tmp_path / "again.yaml").write_text(first.config.to_yaml())
    again = load("again.yaml", folder=tmp_path)
    assert {n: (s.params, s.wires) for n, s in again.steps.items()} == {
        n: (s.params, s.wires) for n, s in first.steps.items()
    }
    assert (again.outputs, again.seed, again.tolerance) == (
        first.outputs,
        first.seed,
        first.tolerance,
    )
    assert "gain: 3" in first.config.to_yaml()
    assert "# argument 1" in first.config.to_yaml()


@pytest.mark.slow
def test_every_packaged_recipe_says_itself_again(tmp_path):
    """Steps that share their parameters by an alias once lost them."""
    for name in (titled.name for titled in recipes()):
        first = load(name)
        (tmp_path / f"{name}.yaml").write_text(first.config.to_yaml(), encoding="utf-8")
        again = load(f"{name}.yaml", folder=tmp_path)
        assert {n: (s.params, s.wires) for n, s in again.steps.items()} == {
            n: (s.params, s.wires) for n, s in first.steps.items()
        }
        for one, other in zip(again.cameras, first.cameras, strict=True):
            assert {n: (s.params, s.wires) for n, s in one.steps.items()} == {
                n: (s.params, s.wires) for n, s in other.steps.items()
            }


def test_references_keep_their_type_nest_and_paste(read):
    text = """
    a: {pitch: "${b.pitch}", shape: "${b.shape}", which: one, one: 3, unit: um}
    b: {pitch: "${a.${a.which}} ${a.unit}", shape: ["${a.one}", 4]}
    steps:
      height: {node: toy.height}
      pupil: {node: toy.pupil, from: height, with: {pitch: "${a.pitch}"}}
      psf: {node: toy.psf, from: pupil, with: {shape: "${a.shape}"}}
    outputs: [psf]
    """
    steps = read(text).steps
    assert steps["pupil"].params["pitch"] == pytest.approx(3e-6)
    assert steps["psf"].params["shape"] == (3, 4)


def test_a_reference_may_name_a_parameter_of_another_step(read):
    text = CAMERA.replace('bits: "${sensor.bits}"', 'bits: "${steps.height.with.samples}"').replace(
        ", bits: 12", ""
    )
    steps = read(text.replace("toy.height}", "toy.height, with: {samples: 5}}")).steps
    assert steps["raw"].params["bits"] == 5


def test_a_file_is_found_beside_the_yaml_that_names_it_and_an_argument_from_the_working_folder(
    write, toy, tmp_path
):
    write(
        "scene: {file: pictures/a.png}\nsteps: {scene: {node: toy.photograph, with: {file:"
        " '${scene.file}'}}}\n",
        "scene/a.yaml",
    )
    write("x", "scene/pictures/a.png")
    write("x", "elsewhere/b.png")
    write("defaults: [scene: a]\noutputs: [scene]\n")
    recipe = load("mine.yaml", folder=tmp_path)
    assert recipe.steps["scene"].params["file"] == tmp_path / "scene/pictures/a.png"
    assert recipe.config["scene.file"].value == str(tmp_path / "scene/pictures/a.png")
    recipe = load(tmp_path / "mine.yaml", ["scene.file=b.png"], tmp_path / "elsewhere")
    assert recipe.steps["scene"].params["file"] == tmp_path / "elsewhere/b.png"


def test_notes_come_once(read):
    text = CAMERA.replace("{pitch:", "{diameter: 11 mm, pitch:")
    text = text.replace(
        "  psf:",
        "  other: {node: toy.pupil, from: height, with: {pitch: 3 um, diameter: 11 mm}}\n  psf:",
    )
    assert read(text).notes == ("aperture 11.0 mm > pupil grid 8.08 mm: clipped",)


ON_A_GRID = """\
steps:
  height: {node: toy.height}
  late: {node: toy.stop_of, from: height}
  stop: {node: optics.stop, with: {samples: 4, pitch: 10 um, diameter: 40 um}}
  mask: {node: doe.pixelwise, from: stop, with: {file: mask.npy}}
  written: {node: doe.smooth, from: {height: mask, stop: stop}, with: {feature: 12 um}}
outputs: [written]
"""


def _heights(folder, side):
    np.save(folder / "mask.npy", np.zeros((side, side), np.float32))


def test_a_preflight_sees_an_input_that_parameters_alone_decide(
    read, mistakes, tmp_path, monkeypatch
):
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))
    _heights(tmp_path, 4)
    size, note = read(ON_A_GRID).notes
    assert size.startswith(
        "mask.npy states no pitch: its samples count as those of the pupil, 10 um apart"
    )
    assert note == "feature 12 um is less than 1.5 samples of 10 um: not resolved"
    assert read(ON_A_GRID, "steps.written.with.feature=15 um").notes == (size,)
    assert not (tmp_path / "cache").exists()  # nothing is stored
    _heights(tmp_path, 8)
    message = (
        "mask.npy is (8, 8), not the pupil grid (4, 4): state its pitch to resample it, or set"
        " samples to 8"
    )
    assert mistakes(ON_A_GRID) == [f"mine.yaml:5:56 | steps.mask.with.file = mask.npy | {message}"]
    assert read(ON_A_GRID, "steps.stop.with.samples=8", "steps.stop.with.diameter=80 um")


def test_a_preflight_without_its_input_leaves_the_question_to_the_run(read, tmp_path):
    store = Store(tmp_path / "store")
    _heights(tmp_path, 8)
    text = ON_A_GRID.replace("from: stop", "from: late").replace("stop: stop", "stop: late")
    recipe = read(text)
    assert recipe.notes == ()
    with pytest.raises(RunError, match=r"mask .*mask.npy is \(8, 8\), not the pupil grid \(4, 4\)"):
        neusee.run(recipe, store=store)
    _heights(tmp_path, 4)
    assert neusee.run(recipe, store=store)["written"].shape == (4, 4)


def test_an_input_with_wrong_parameters_is_one_mistake(mistakes, tmp_path):
    _heights(tmp_path, 8)
    for old, new, said in (
        ("diameter: 40 um", "diameter: 1 um", "holds no pupil sample"),
        ("samples: 4", "samples: -4", "must be greater than or equal to 4"),
    ):
        (problem,) = mistakes(ON_A_GRID.replace(old, new))
        assert "| steps.stop.with." in problem
        assert said in problem


def test_only_the_families_that_are_named_are_imported(read, monkeypatch):
    for name in [name for name in sys.modules if name.startswith("neusee.nodes.metrics")]:
        monkeypatch.delitem(sys.modules, name)
    read(CAMERA)
    assert "neusee.nodes.metrics" not in sys.modules


def test_a_value_that_only_an_absent_item_needs_is_not_unknown(read):
    assert read(
        CAMERA.replace("outputs: [raw]", "outputs: [raw]").replace('"spot[green]"', "raw"),
        "lasers={}",
    )


def _table():
    """The changes of mistakes.txt, each with the messages that it must get."""
    for block in (
        Path(__file__).with_name("mistakes.txt").read_text(encoding="utf-8").split("\n\n")[1:]
    ):
        change, *diagnostics = block.strip().split("\n")
        old, new = change.split(" => ")
        yield pytest.param(
            old, new, [f"mine.yaml:{problem.strip()}" for problem in diagnostics], id=change
        )


@pytest.mark.usefixtures("checked_both_ways")
@pytest.mark.parametrize(("old", "new", "diagnostics"), [*_table()])
def test_a_mistake_gets_its_message(mistakes, old, new, diagnostics):
    assert mistakes(swap(old, new)) == diagnostics


def test_a_node_cannot_be_any_python_function(mistakes):
    for name in ("os.system", "builtins.eval", "toy.torch", "toy._", "values.Bands", "_node.node"):
        (problem,) = mistakes(swap("toy.height", name))
        assert problem.startswith(
            f"mine.yaml:12:18 | steps.height.node | no {'node' if name[:3] == 'toy' else 'family'} "
        )


def test_two_dimensions_make_item_ambiguous(mistakes):
    text = CAMERA.replace("each: lasers, from: psf", "each: [lasers, arms], from: psf").replace(
        "seed: 7", "arms: {one: {}}\nseed: 7"
    )
    assert mistakes(text)[:1] == [
        "mine.yaml:7:31 | lasers.green.strength | unknown: no step refers to this value",
    ]
    assert "write ${each.lasers.strength} or ${each.arms.strength}" in "\n".join(mistakes(text))


def test_references_that_run_in_a_circle_are_told_with_their_way(mistakes):
    text = swap("3.74 um", '"${optics.a}"').replace(
        "  window", '  a: "${optics.b}"\n  b: "${optics.a}"\n  window'
    )
    assert mistakes(text) == [
        "mine.yaml:6:6 | optics.b | the value refers to itself: optics.a -> optics.b -> optics.a"
    ]


def test_all_mistakes_come_at_once_in_the_order_of_the_file(mistakes):
    text = (
        swap("gain: 0.37", "gian: 0.37").replace("3.74 um", "3.74").replace("toy.spot", "toy.spt")
    )
    text = text.replace("outputs: [raw]", "outputs: [rav]")
    got = mistakes(text, "sensor.bitts=3")
    assert [line.split(" | ")[0] for line in got] == [
        "argument 1",
        *(f"mine.yaml:{n}" for n in ("2:10", "4:10", "15:16", "25:11")),
    ]


def test_one_wrong_value_that_many_steps_use_is_one_mistake(mistakes):
    text = CAMERA.replace(
        "  psf:",
        '  other: {node: toy.pupil, from: height, with: {pitch: "${optics.pitch}"}}\n  psf:',
    )
    assert len(mistakes(text.replace("3.74 um", "3.74"))) == 1


def test_the_lines_are_aligned(read):
    from neusee.workflows.graph.errors import RecipeError

    with pytest.raises(RecipeError) as caught:
        read(swap("gain: 0.37", "gian: 0.37"), "sensor.bitts=3")
    assert (
        str(caught.value)
        == "argument 1       sensor.bitts=3   unknown; did you mean sensor.bits?\n"
        "mine.yaml:2:10   sensor.gian      unknown; did you mean gain? (needed at mine.yaml:21:13)"
    )


def test_the_packaged_recipes_have_titles_and_the_groups_options():
    titles = {r.name: r.title for r in recipes()}
    assert titles["first_light"].startswith("The paper's camera behind five half-rings")
    assert all(titles.values())
    options = groups()
    assert [o.name for o in options["reading"]] == ["as_printed", "coherent"]
    assert all(option.title for group in options.values() for option in group)


def test_one_own_groups_are_listed_beside_the_packaged(write, tmp_path):
    write("# Mine.\na: 1\n", "doe/mine.yaml")
    assert "mine" in [o.name for o in groups(tmp_path)["doe"]]


def test_an_override_of_a_value_is_parsed_as_yaml():
    assert parse("20 e-", Location("argument 1")).plain == "20 e-"


def test_the_settings_of_trainings_are_imported_for_recipes_that_have_one():
    """Their import takes 2 % of the processor time of a run that computes nothing."""
    tops = [
        part.module
        for part in ast.parse(Path(loading.__file__).read_text()).body
        if isinstance(part, ast.ImportFrom)
    ]
    assert "neusee.workflows.recipe.steps" in tops
    assert not [name for name in tops if ".blocks" in name]
    assert loading.BLOCKS == (
        train_block.KEY,
        train_block.LIFT_KEY,
        settings_block.KEY,
        loading.TRACED,
    )
