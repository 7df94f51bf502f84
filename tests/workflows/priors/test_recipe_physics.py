"""What `as_physics` refuses, with and without deepinv."""

import sys

import pytest

from neusee.workflows import as_physics, load
from neusee.workflows.priors import recipe_physics


def test_without_deepinv_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "deepinv", None)
    monkeypatch.setitem(sys.modules, "deepinv.optim", None)
    monkeypatch.delitem(sys.modules, "neusee.workflows.priors.deepinv_camera", raising=False)
    with pytest.raises(
        ModuleNotFoundError, match=r'as_physics needs deepinv.*: pip install "neusee\[deepinv\]"'
    ):
        as_physics(load("first_light"))


@pytest.mark.parametrize(
    ("recipe", "options", "said"),
    [
        ("first_light", {"arm": "masc"}, r"as_physics needs the step psf\[masc\]"),
        ("safety_pointer", {}, "as_physics needs the step"),
    ],
)
def test_a_recipe_without_these_steps_is_refused(recipe, options, said, monkeypatch):
    monkeypatch.setattr(recipe_physics, "_deepinv_camera", lambda: None)
    with pytest.raises(ValueError, match=said):
        as_physics(load(recipe), **options)


def test_a_sensor_as_the_paper_prints_is_refused(monkeypatch):
    monkeypatch.setattr(recipe_physics, "_deepinv_camera", lambda: None)
    with pytest.raises(ValueError, match="use `reading: coherent`"):
        as_physics(load("first_light", reading="as_printed", laser="none"))
