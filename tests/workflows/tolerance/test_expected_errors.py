"""A plan foresees what well and converter cut off, so that a run seldom begins again."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from neusee.workflows import load
from neusee.workflows.engine.runner import run
from neusee.workflows.recipe.loading import changed
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import stricter_scale, with_substitutions
from neusee.workflows.tolerance.error_norm import error_of
from neusee.workflows.tolerance.error_propagation import expected_excess

sys.path.insert(0, str(Path(__file__).parents[1]))
import random_recipes

CAMERA = [
    "doe=vortex",
    "laser=none",
    "scene=china",
    "optics.samples=256",
    "optics.pitch=31.556 um",
    "~restore",
]
SIZES = ["optics.window=[256, 256]", "scene.shape=[256, 256]", "sensor.shape=[200, 200]"]
OUTPUTS = ["steps.restored_quality=null", "outputs=[raw, developed]"]


@pytest.fixture(scope="module")
def recipe():
    return load("first_light", [*CAMERA, *SIZES, *OUTPUTS, "tolerance=1e-2"])


def scale(recipe, *changes):
    return with_substitutions(changed(recipe, changes), recipe.outputs).tolerance_scale


def test_a_plan_is_stricter_by_what_well_and_converter_cut_off(recipe):
    """The brightest pixel has 0.7 wells at 0.1 s; 8 bits of 0.37 e- end at 94 e-, and 1000 s
    give 7000 wells.
    """
    assert scale(recipe) == 1.0
    few, long = scale(recipe, "sensor.bits=8"), scale(recipe, "sensor.exposure=1000 s")
    assert few < 0.1
    assert long < few
    assert scale(recipe, "sensor.bits=8", "sensor.gain=100 e-/DN") == 1.0
    # weaker light has more noise, and nothing is cut off
    assert 0.5 < scale(recipe, "sensor.exposure=50 ms") <= 1.0


def test_a_second_call_changes_nothing(recipe):
    planned = with_substitutions(changed(recipe, ["sensor.bits=8"]), recipe.outputs)
    assert with_substitutions(planned, planned.outputs) is planned
    assert (
        with_substitutions(planned, [*planned.outputs, "lsr[mask]"]).tolerance_scale
        == planned.tolerance_scale
    )
    assert expected_excess(planned, planned.outputs, 0.5) <= 1.0


def test_what_is_not_known_before_the_run_promises_nothing(recipe):
    poisson = with_substitutions(changed(recipe, ["sensor.arrivals=poisson"]), recipe.outputs)
    assert poisson.tolerance_scale == 1.0
    assert any(each.within for each in poisson.substitutions)
    assert expected_excess(replace(recipe, exact=True), recipe.outputs) == 0.0


@pytest.mark.slow
def test_a_run_whose_converter_clips_begins_once_and_is_within_its_tolerance(
    recipe, tmp_path, monkeypatch
):
    store, clipped = Store(tmp_path), changed(recipe, ["sensor.bits=8"])
    result = run(clipped, store)
    assert result.attempts == 1
    full = run(replace(clipped, exact=True), store)
    for name, value in full.values.items():
        assert (
            error_of(result[name], value)
            <= max(result.proof.held.get(name, clipped.tolerance), 1e-6)
            <= clipped.tolerance
        ), name
    monkeypatch.setattr("neusee.workflows.tolerance.cheaper_steps.expected_excess", lambda *_: 0.0)
    blind = run(clipped, Store(tmp_path / "blind"))
    assert blind.attempts > 1


@pytest.mark.parametrize("over", [1.01, 3.0, 1e3])
def test_a_second_attempt_never_keeps_a_cube_that_was_too_coarse(recipe, over):
    def limits(plan):
        return {
            name: step.params["within"]
            for name, step in plan.steps.items()
            if name.endswith(".mixture") and "within" in step.params
        }

    first = with_substitutions(recipe, recipe.outputs)
    scale = stricter_scale(first, over)
    second = with_substitutions(replace(recipe, tolerance_scale=scale), recipe.outputs)
    assert 0 < scale <= 0.8 / over
    assert limits(first)
    assert all(
        limits(second)[name] < within
        for name, within in limits(first).items()
        if name in limits(second)
    )


@pytest.mark.slow
def test_a_run_whose_cube_was_too_coarse_needs_no_third_attempt(tmp_path):
    """Points on black: the residual of the cube was 1.7 times too large, and was the same in the
    second attempt.
    """
    found = run(random_recipes.draw_large(2024), Store(tmp_path))
    assert found.attempts == 2
    assert not found.recipe.exact


@pytest.mark.slow
def test_the_plan_foresees_most_failures_of_random_cameras():
    """Of the seeds from 1000 to 1039, these began again when nothing was foreseen."""
    failed = [
        1005,
        1007,
        1012,
        1016,
        1017,
        1021,
        1022,
        1024,
        1026,
        1027,
        1030,
        1032,
        1034,
        1038,
        1039,
    ]
    held = [1000, 1002, 1003, 1006, 1008, 1009, 1010, 1011, 1013, 1020, 1023, 1028, 1029]
    plans = {seed: random_recipes.draw_large(seed) for seed in (*failed, *held)}
    stricter = {
        seed
        for seed, each in plans.items()
        if with_substitutions(each, each.outputs).tolerance_scale < 1.0
    }
    assert len(stricter & set(failed)) >= 13
    assert not stricter & set(held)
