"""What is remembered of a graph never outlives what it hangs on: each answer is that of a fresh
process.
"""

import importlib.util
import sys
from pathlib import Path

import pytest

from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.recipe import loading, step_checks
from neusee.workflows.recipe.text import composition

RECIPE = """\
sensor: {gain: 2.0, noise: 5 e-}
lasers: {green: {strength: 1.0, of: bright}, red: {strength: 2.0, of: bright}}
steps:
  height: {node: toy.height}
  pupil: {node: toy.pupil, from: height, with: {pitch: 3 um}}
  bright: {node: toy.psf, from: pupil}
  dim: {node: toy.psf, from: pupil, with: {wavelength: 600 nm}}
  spot: {node: toy.spot, each: lasers, from: "${item.of}", with: {strength: "${item.strength}"}}
  light: {node: toy.gather, from: {photons: height, lasers: spot, ghosts: spot}}
  raw: {node: toy.digitize, from: light, with: {gain: "${sensor.gain}", sigma: "${sensor.noise}"}}
outputs: [raw]
"""


@pytest.fixture
def forget(monkeypatch):
    """Read as a fresh process would."""

    def forget():
        monkeypatch.setattr(step_checks, "_graphs", {})
        loading._checked.cache_clear()
        composition._merged.cache_clear()

    forget()
    return forget


def summary(recipe):
    steps = {
        n: (s.node, dict(s.params), dict(s.wires), s.mark, dict(s.param_marks))
        for n, s in recipe.steps.items()
    }
    return (
        steps,
        recipe.outputs,
        recipe.config.settings,
        recipe.notes,
        recipe.absent,
        recipe.expect,
        recipe.seed,
    )


@pytest.mark.parametrize(
    "changes",
    [
        ["sensor.gain=3"],
        ["lasers.red.strength=5"],
        ["lasers.red.of=dim"],
        ["+lasers.blue={strength: 3, of: dim}"],
        ["~lasers.red"],
        ["steps.raw.with.bits=8"],
        ["steps.light.from.ghosts=null"],
        ["steps.spot.each=null", "steps.spot.from=dim", "steps.spot.with.strength=1"],
        ["outputs=[light]", "steps.raw=null", "~sensor"],
        ["seed=3"],
    ],
)
def test_a_recipe_is_the_same_whether_its_graph_is_known_or_not(read, forget, changes):
    try:
        wanted = summary(read(RECIPE, *changes))
    except RecipeError as error:
        wanted = str(error)
    forget()
    read(RECIPE)
    read(RECIPE, "sensor.gain=7")
    try:
        found = summary(read(RECIPE, *changes))
    except RecipeError as error:
        found = str(error)
    assert found == wanted


@pytest.mark.parametrize(
    "change",
    ["lasers.red.of=dimm", "sensor.gains=3", "sensor.noise=5", "+lasers.blue={strength: 3}"],
)
def test_a_mistake_is_told_as_in_a_fresh_process(mistakes, read, forget, change):
    wanted = mistakes(RECIPE, change)
    forget()
    read(RECIPE)
    assert mistakes(RECIPE, change) == wanted


def test_the_graph_is_bound_once(read, forget, monkeypatch):
    asked = []
    declare = loading.declare
    monkeypatch.setattr(loading, "declare", lambda *args: asked.append(1) or declare(*args))
    for gain in range(1, 9):
        read(RECIPE, f"sensor.gain={gain}")
    assert len(asked) == 1


def test_nodes_that_were_edited_are_bound_again(read, toy, forget):
    read(RECIPE)
    spec = importlib.util.spec_from_file_location(
        toy.__name__, Path(__file__).parents[1] / "toy_nodes.py"
    )
    edited = importlib.util.module_from_spec(spec)
    sys.modules[toy.__name__] = edited
    spec.loader.exec_module(edited)
    assert read(RECIPE).steps["raw"].node is edited.digitize


def test_a_recipe_file_that_was_edited_is_read_again(read, forget):
    read(RECIPE)
    assert read(RECIPE.replace("pitch: 3 um", "pitch: 4 um")).steps["pupil"].params[
        "pitch"
    ] == pytest.approx(4e-6)


def test_promises_are_compared_with_the_recipe_as_it_is_now(read, forget):
    promised = RECIPE + "expect: {level: {step: raw, value: 1, rtol: 0.1}}\n"
    assert [e.name for e in read(promised, "sensor.gain=2").expect] == ["level"]
    assert read(promised, "sensor.gain=3").expect == ()
    edited = promised.replace("gain: 2.0", "gain: 3.0")
    assert [e.name for e in read(edited, "sensor.gain=3").expect] == ["level"]
    assert read(edited, "sensor.gain=2").expect == ()


def test_files_are_looked_at_every_time(read, write, forget):
    text = "steps: {photo: {node: toy.photograph, with: {file: data.txt}}}\noutputs: [photo]\n"
    file = write("something", "data.txt")
    read(text)
    file.unlink()
    with pytest.raises(RecipeError, match="no such file"):
        read(text)


def test_little_is_remembered(read, forget):
    for pitch in range(1, 60):
        read(RECIPE.replace("pitch: 3 um", f"pitch: {pitch} um"), "sensor.gain=2")
    sizes = (cache.cache_info().currsize for cache in (loading._checked, composition._merged))
    assert max(len(step_checks._graphs), *sizes) <= 16
