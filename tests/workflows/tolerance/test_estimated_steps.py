"""Cheaper steps whose error is estimated: used where they may be, forbidden by a word, and
within the tolerance.
"""

from dataclasses import replace

import pytest

from neusee.workflows import load
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.recipe.loading import changed
from neusee.workflows.report.tolerance_spent import said_of_economies, said_of_errors, spent
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import with_substitutions
from neusee.workflows.tolerance.error_norm import error_of

CAMERA = [
    "outputs=[raw, developed]",
    "optics.samples=256",
    "optics.pitch=31.556 um",
    "optics.window=[256, 256]",
    "scene.shape=[256, 256]",
    "sensor.shape=[200, 200]",
    "doe=vortex",
    "~restore",
    "steps.restored_quality=null",
    "lasers.green.angle=[0.1 mrad, 0 mrad]",
]


@pytest.fixture(scope="module")
def recipe():
    return load("first_light", [*CAMERA, "tolerance=1e-2"])


def few_of(recipe, *more):
    found = with_substitutions(recipe, [*recipe.outputs, *more])
    return {each.step for each in found.substitutions if each.instead.endswith(".checked")}


def test_a_psf_that_only_an_image_reads_is_computed_for_few_bands(recipe):
    assert few_of(recipe) == {"psf[plain]", "psf[mask]"}
    assert few_of(recipe, "psf[mask]") == {"psf[plain]"}
    assert few_of(recipe, "lsr[plain]") == {"psf[mask]"}
    assert few_of(recipe, "image[mask]") == {"psf[plain]"}
    found = with_substitutions(recipe, recipe.outputs)
    assert found.steps["psf[mask]"] == recipe.steps["psf[mask]"]
    assert (
        found.steps["psf[mask].choice"].params["within"]
        > found.steps["image[mask].channels"].params["within"]
    )
    optimised = with_substitutions(recipe, recipe.outputs, pinned=["height"])
    assert "psf[mask].few" not in optimised.steps
    assert "psf[plain].few" in optimised.steps


def test_a_word_in_the_recipe_and_an_exact_run_forbid_estimates(recipe):
    for other in (
        changed(recipe, ["estimates=false"]),
        replace(recipe, exact=True),
        replace(recipe, tolerance=0.0),
    ):
        assert few_of(other) == set()
    proved = changed(recipe, ["estimates=false"])
    assert not proved.estimates
    assert not changed(proved, ["seed=3"]).estimates
    found = with_substitutions(proved, proved.outputs)
    assert found.limit("raw[mask]") == 1e-3  # the colours have no proved bound
    assert recipe.limit("raw[mask]") == 1e-2
    with pytest.raises(RecipeError, match=r"estimates = 5.*must be true or false"):
        load("first_light", ["estimates=5"])


@pytest.mark.parametrize("tolerance", [1e-3, pytest.param(1e-4, marks=pytest.mark.slow)])
def test_the_error_is_within_the_tolerance_and_the_account_says_what_is_estimated(
    recipe, tolerance, tmp_path
):
    store, loose = Store(tmp_path), replace(recipe, tolerance=tolerance)
    full = run(replace(loose, exact=True), store)
    result = run(loose, store)
    for name, value in full.values.items():
        assert error_of(result[name], value) <= max(result.proof.held[name], 1e-6) <= tolerance, (
            name
        )
    account = spent(result)
    plain = next(each for each in account["economies"] if each["step"] == "psf[plain]")
    assert plain["estimated"]
    assert 0 < plain["bound"] <= tolerance
    assert "compared with the next finer choice" in plain["what"]
    assert {"raw[plain]", "developed[mask]"} <= set(account["estimated"])
    assert f"psf[plain] (estimated {plain['bound']:.1e})" in said_of_economies(account)
    worst = max((row for row in account["outputs"]), key=lambda row: row["error"])
    assert {row["kind"] for row in account["outputs"]} == {"estimated"}
    assert (
        f"{worst['error']:.1e} in {worst['output']}, an estimate that 95% of errors"
        in said_of_errors(account)
    )


def test_a_looser_tolerance_takes_no_more_bands(recipe, tmp_path):
    counts = []
    for tolerance in (1e-4, 1e-3, 1e-2, 3e-2):
        found = with_substitutions(replace(recipe, tolerance=tolerance), recipe.outputs)
        counts.append(
            len(run(found, Store(tmp_path), ["psf[plain].choice"])["psf[plain].choice"].used)
        )
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] < counts[0] < 31
