"""A recipe that is checked after others of its graph is the recipe that is checked alone, with
the same mistakes.
"""

import random
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from neusee import recipes
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.graph.step_shapes import alike
from neusee.workflows.recipe import step_checks
from neusee.workflows.recipe.loading import check
from neusee.workflows.recipe.text.composition import Composer, compose

CHANGES = {
    "sensor.read_noise": ["5 e-", "6 e-", "normal(5 e-, 1 e-)", "5 nm"],
    "sensor.gain": ["0.37 e-/DN", "-1 e-/DN"],
    "sensor.shape": ["[64, 64]", "[640, 640]", "[64, 65.5]"],
    "lasers.green.wavelength": ["532 nm", "550 nm", "5 nm"],
    "lasers.green.strength": ["1e3", "${sensor.bits}", "${sensor.nothing}"],
    "optics.bands": ["5", "31", "0"],
    "doe": ["axicon", "five_half_rings"],
    "flare": ["clean", "dirty"],
    "steps.read.device": ["cpu", "abacus"],
    "scene.file": ["no_such_file.png"],
    "tolerance": ["1e-3", "1e-2"],
    "outputs": ["[saturated]", "[raw, restored]", "[nothing]"],
    "sensor.unheard": ["1"],
}


def told(words, recipe="first_light"):
    """What a check says of first_light with overrides: all of the recipe, or every mistake."""
    try:
        recipe = check(compose(recipe, words, Path.cwd()))
    except RecipeError as error:
        return [str(each) for each in error.diagnostics]
    steps = {
        name: (s.node.path, dict(s.params), dict(s.wires), s.device, s.mark)
        for name, s in recipe.steps.items()
    }
    known = [recipe.seed, recipe.tolerance, recipe.outputs, recipe.notes, recipe.expect]
    return [*steps.items(), *known, *recipe.config.settings.items()]


def drawn(seed):
    draw = random.Random(seed)
    changed = draw.sample(sorted(CHANGES), draw.choice([0, 1, 1, 2, 3]))
    return [f"{name}={draw.choice(CHANGES[name])}" for name in changed]


@pytest.fixture(autouse=True)
def no_graph(monkeypatch):
    monkeypatch.setattr(step_checks, "_graphs", {})


@pytest.mark.slow
def test_a_check_after_others_says_what_a_check_alone_says(monkeypatch):
    words = [drawn(seed) for seed in range(40)]
    after = [told(each) for each in words]
    assert any(len(each) < 20 for each in after)
    assert sum(len(each) > 20 for each in after) > 10
    for each, found in zip(words, after, strict=True):
        step_checks._graphs.clear()
        assert repr(told(each)) == repr(found), each


def test_a_recipe_that_is_composed_after_others_is_the_recipe_composed_alone():
    composer = Composer("first_light", Path.cwd())
    changes = [
        *(drawn(seed) for seed in range(40)),
        ["doe=axicn", "sensor.bits"],
        ["+doe=axicon"],
        ["~flare"],
        [],
    ]
    for words in [*changes, *changes]:
        found, alone = composer.compose(words), compose("first_light", words, Path.cwd())
        assert found.root.plain == alone.root.plain
        assert [str(each) for each in found.diagnostics] == [
            str(each) for each in alone.diagnostics
        ]
        assert replace(found, root=alone.root, diagnostics=()) == replace(alone, diagnostics=())


def test_a_step_is_checked_again_only_where_a_value_that_it_reads_has_changed(monkeypatch):
    checked = []
    remember = step_checks.Attempt.remember
    monkeypatch.setattr(
        step_checks.Attempt,
        "remember",
        lambda self, name, *rest: (checked.append(name), remember(self, name, *rest)),
    )
    for noise in ("5 e-", "6 e-"):
        told([f"sensor.read_noise={noise}"])
    checked.clear()
    told(["sensor.read_noise=7 e-"])
    assert {"read[plain]", "read[mask]"} <= set(checked)
    assert {"bands", "psf[mask]", "spot[mask,green]", "digital[mask]"}.isdisjoint(checked)
    assert "scene" in checked  # its file may have changed


def test_a_file_that_is_removed_between_two_checks_is_missed(tmp_path, write):
    packaged = Path(recipes.__path__[0])
    picture = tmp_path / "picture.jpg"
    shutil.copy(packaged / "samples/china.jpg", picture)
    text = (packaged / "first_light.yaml").read_text(encoding="utf-8")
    path = str(write(f"{text}\nscene: {{file: picture.jpg}}\n"))
    good = [told([], path) for _ in range(3)]
    assert len(good[0]) == len(good[2]) > 20
    picture.unlink()
    assert "no such file" in told([], path)[0]


def test_forms_are_alike_where_they_tell_the_same():
    few, many = torch.arange(3.0), torch.empty(9, 9, device="meta")
    assert alike(few, few.clone())
    assert alike([few, None, many], [few.clone(), None, torch.empty(9, 9, device="meta")])
    assert not alike(few, few + 1)
    assert not alike(few, few.double())
    assert not alike(few, few.to("meta"))
    assert not alike(many, torch.empty(9, 8, device="meta"))
    assert not alike([few], [few, few])
    assert not alike(1, 1.0)
    assert not alike(None, few)
