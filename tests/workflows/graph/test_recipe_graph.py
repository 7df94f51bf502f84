import pytest

from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Step, in_order, needed
from neusee.workflows.recipe.text.yaml_values import Value

CHAIN = 10_000

LENS = """\
arms:
  plain: {height: flat}
  mask: {height: bumps}
lasers:
  green: {wavelength: 532 nm, strength: 10}
  red: {wavelength: 638 nm, strength: 20}
steps:
  flat: {node: toy.height}
  bumps: {node: toy.height, with: {samples: 8}}
  pupil: {node: toy.pupil, each: arms, from: {height: "${item.height}"}, with: {pitch: 3 um}}
  psf: {node: toy.psf, each: arms, from: pupil}
  laser_psf:
    node: toy.psf
    each: [arms, lasers]
    from: pupil
    with: {wavelength: "${each.lasers.wavelength}"}
  spot:
    node: toy.spot
    each: [arms, lasers]
    from: laser_psf
    with: {strength: "${each.lasers.strength}"}
  raw:
    node: toy.gather
    each: arms
    from: {photons: flat, lasers: spot, ghosts: ghosts}
  all: {node: toy.gather, from: {photons: "raw[mask]", lasers: spot, ghosts: raw}}
  ghosts: null
outputs: [raw]
"""


def test_a_step_runs_after_its_sources_and_what_is_not_wanted_does_not_run():
    sources = {"a": [], "b": ["a"], "c": ["a", "b"], "d": ["c"], "e": ["b"]}
    order = in_order(sources, ["d"])
    assert order == ["a", "b", "c", "d"]
    assert in_order(sources, ["e", "d"]) == ["a", "b", "e", "c", "d"]


def test_a_chain_of_10000_steps_is_ordered(read):
    names = [f"s{n}" for n in range(CHAIN)]
    sources = {name: [f"s{n - 1}"] if n else [] for n, name in enumerate(names)}
    assert in_order(sources, [names[-1]]) == names


def _chain(toy, last):
    """The composed recipe of a chain, made without writing YAML."""
    from neusee.workflows.recipe.text.composition import Composed

    def value(data, *path):
        items = {k: value(v, *path, k) for k, v in data.items()} if isinstance(data, dict) else data
        items = (
            [value(v, *path, n) for n, v in enumerate(data)] if isinstance(data, list) else items
        )
        mark = Location("chain.yaml", 1 + len(path), 1)
        return Value(items, mark, mark, path)

    steps = {f"s{n}": {"node": "toy.add", "from": f"s{n - 1}"} for n in range(1, CHAIN)}
    steps["s0"] = last
    return Composed("chain", "", value({"steps": steps, "outputs": [f"s{CHAIN - 1}"]}), ())


def test_a_chain_of_10000_steps_is_bound_and_ordered(toy):
    from neusee.workflows.recipe.loading import check

    recipe = check(_chain(toy, {"node": "toy.height"}))
    assert len(needed(recipe, recipe.outputs)) == CHAIN


def test_a_loop_of_10000_steps_is_found_and_told_in_short(toy):
    from neusee.workflows.graph.errors import RecipeError
    from neusee.workflows.recipe.loading import check

    with pytest.raises(RecipeError, match=r"cycle: s\d+ -> .* \(9988 more\)") as caught:
        check(_chain(toy, {"node": "toy.add", "from": f"s{CHAIN - 1}"}))
    assert len(str(caught.value)) < 600


@pytest.mark.slow
def test_a_file_of_10000_steps_loads(read):
    lines = [f"  s{n}: {{node: toy.add, from: s{n - 1}}}\n" for n in range(1, CHAIN)]
    recipe = read(f"steps:\n  s0: {{node: toy.height}}\n{''.join(lines)}outputs: [s{CHAIN - 1}]\n")
    assert len(needed(recipe, recipe.outputs)) == CHAIN


def test_each_item_is_a_step_of_its_own(read):
    recipe = read(LENS)
    assert [name for name in recipe.steps if name.startswith("spot")] == [
        "spot[plain,green]",
        "spot[plain,red]",
        "spot[mask,green]",
        "spot[mask,red]",
    ]
    assert recipe.steps["laser_psf[mask,red]"].params["wavelength"] == pytest.approx(638e-9)
    assert recipe.outputs == ("raw[plain]", "raw[mask]")


def test_wires_run_item_by_item_and_a_step_without_each_receives_the_list(read):
    steps = read(LENS).steps
    assert steps["pupil[plain]"].wires == {"height": "flat", "dirt": None}
    assert steps["pupil[mask]"].wires == {"height": "bumps", "dirt": None}
    assert steps["laser_psf[mask,red]"].wires == {"pupil": "pupil[mask]"}
    assert steps["spot[plain,green]"].wires == {"psf": "laser_psf[plain,green]"}
    assert steps["raw[mask]"].wires["lasers"] == ("spot[mask,green]", "spot[mask,red]")
    assert steps["all"].wires["lasers"] == (
        "spot[plain,green]",
        "spot[plain,red]",
        "spot[mask,green]",
        "spot[mask,red]",
    )
    assert steps["all"].wires["photons"] == "raw[mask]"


def test_a_step_that_is_null_is_an_empty_list_or_nothing(read):
    recipe = read(LENS.replace('"${item.height}"}', '"${item.height}", dirt: ghosts}'))
    assert recipe.steps["raw[mask]"].wires["ghosts"] == ()
    assert recipe.steps["pupil[mask]"].wires["dirt"] is None
    assert recipe.absent == {"ghosts": "null (mine.yaml:27:11)"}
    assert "ghosts" not in recipe.steps


def test_no_laser_is_no_step_and_an_empty_list(read):
    recipe = read(LENS, "lasers={}")
    assert not [name for name in recipe.steps if name.startswith(("spot", "laser_psf"))]
    assert recipe.steps["raw[mask]"].wires["lasers"] == ()


def test_one_item_of_a_step_of_two_dimensions(read):
    text = LENS.replace("lasers: spot, ghosts: raw", "lasers: 'spot[mask]', ghosts: 'spot[red]'")
    recipe = read(text, "outputs=spot[mask]")
    assert recipe.outputs == ("spot[mask,green]", "spot[mask,red]")
    assert recipe.steps["all"].wires["lasers"] == ("spot[mask,green]", "spot[mask,red]")
    assert recipe.steps["all"].wires["ghosts"] == ("spot[plain,red]", "spot[mask,red]")


def test_only_what_the_outputs_need_is_ordered(read):
    recipe = read(LENS)
    assert needed(recipe, ["psf[mask]"]) == ["bumps", "pupil[mask]", "psf[mask]"]
    order = needed(recipe, recipe.outputs)
    assert "all" not in order
    assert all(
        order.index(s) < order.index(name) for name in order for s in recipe.steps[name].sources
    )


def test_a_step_knows_its_sources():
    step = Step("x", None, {}, {"a": "p", "b": ("q", "r"), "c": None}, Location("f", 1, 1), {})
    assert step.sources == ("p", "q", "r")
