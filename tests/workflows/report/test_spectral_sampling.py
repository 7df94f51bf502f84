"""The report of a run states the error by the number of bands beside the tolerance, and warns
where it is larger.
"""

import pytest

from neusee.workflows import load
from neusee.workflows.engine.runner import run
from neusee.workflows.engine.wanted_steps import wanted
from neusee.workflows.report import run_folder, run_page
from neusee.workflows.report.console import closing
from neusee.workflows.report.tolerance_spent import spectral_error
from neusee.workflows.store.result_store import Store

SMALL = [
    "optics.samples=128",
    "optics.pitch=60 um",
    "optics.window=[64, 64]",
    "sensor.shape=[48, 48]",
    "scene.shape=[64, 64]",
    "restore=null",
    "steps.restored_quality=null",
    "outputs=[lsr, outside, raw]",
    "optics.bands=5",
]


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("cache"))


def document(store, *changes):
    recipe = load("first_light", [*SMALL, *changes])
    return run_page.document(run(recipe, store, wanted(recipe)), ["neusee", "run"])


def test_an_error_larger_than_the_tolerance_is_a_warning(store):
    doc = document(store, "expect={}")
    errors = doc["spectral"]["errors"]
    assert set(errors) == {"of the PSF of a white point", "of a laser spot"}
    assert all(error > 1e-3 for error in errors.values())
    assert doc["spectral"]["larger"]
    line = next(line for line in closing(doc, "report.html", []) if line.startswith("bands"))
    assert (
        f"LOOK: error by the number of bands: {errors['of the PSF of a white point']:.1e} of"
        " the PSF" in line
    )
    assert "larger than the tolerance 0.001, which is relative to the bands of the recipe" in line
    assert "This error is larger than the tolerance of 0.001" in run_folder.page(doc, {})
    rows = {(step, index): number for step, _, index, number in doc["metrics"]}
    assert max(rows["spectral", i] for i in range(3)) == errors["of the PSF of a white point"]
    assert rows["outside[mask]", 0] > rows["outside[plain]", 0] > 0
    assert "outside" in doc["table"]["columns"]
    assert doc["table"]["rows"][0]["cells"][doc["table"]["columns"].index("outside")].endswith("%")


def test_a_smaller_error_is_a_number_beside_the_tolerance(store):
    doc = document(store, "expect={}", "tolerance=5", "laser=none", "lasers={}")
    assert not doc["spectral"]["larger"]
    assert set(doc["spectral"]["errors"]) == {"of the PSF of a white point"}
    line = next(line for line in closing(doc, "report.html", []) if line.startswith("bands"))
    assert "LOOK" not in line
    assert "tolerance 5, which is relative to the bands" in line
    assert "larger than the tolerance" not in run_folder.page(doc, {})


def test_a_recipe_without_these_steps_says_nothing():
    recipe = load("first_light", [*SMALL, "steps.spectral=null", "steps.laser_spectral=null"])
    assert spectral_error(recipe, {}, {}) == {}
