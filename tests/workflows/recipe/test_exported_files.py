"""The key `exports` of a recipe: which data files a run writes, and in which precision."""

from __future__ import annotations

import pytest

from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.recipe.global_settings import NAMES
from neusee.workflows.recipe.loading import load
from neusee.workflows.report import contents
from neusee.workflows.report.data_exports import data_files


def files(*words: str) -> list[str]:
    return [file.name for file in data_files(load("laser_free", list(words)))]


def test_the_names_are_those_of_the_files_of_a_run():
    assert set(NAMES) == {*contents.FILES, contents.OUTPUTS}


def test_a_recipe_says_which_files_there_are():
    assert files() == files("exports=all") == [*contents.FILES, contents.OUTPUTS]
    assert files("exports=none") == []
    assert files("exports=[outputs.safetensors, raw_mask.png]") == [
        "raw_mask.png",
        "outputs.safetensors",
    ]
    assert files("exports=raw_mask.png") == ["raw_mask.png"]


def test_half_floats_are_another_file_under_another_key():
    (half,), (full,) = (
        list(data_files(load("laser_free", [f"exports={n}"])))
        for n in ("psf_mask.exr@half", "psf_mask.exr")
    )
    assert half.name == full.name
    assert half.kind != full.kind


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("exports=[raw_maks.png]", "did you mean raw_mask.png"),
        ("exports=[raw_mask.png@half]", "only an .exr file"),
        ("exports=[psf_mask.exr@double]", "no file of a run"),
        ("exports={a: b}", "no file of a run"),
        ("exports=3", "no file of a run"),
    ],
)
def test_a_wrong_name_is_refused_before_the_run(words, why):
    with pytest.raises(RecipeError, match="exports") as error:
        load("laser_free", [words])
    assert why in str(error.value)
