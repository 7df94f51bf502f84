"""Restorers that are told optics or laser with an error: the camera stays, and what the filter
knows moves.
"""

import csv
from pathlib import Path

import pytest

import neusee
from neusee.workflows import load
from neusee.workflows.engine.runner import run
from neusee.workflows.evaluation.evaluation_points import (
    EvaluationPoints,
    PointRequest,
    errors_of,
    mistold,
)
from neusee.workflows.evaluation.evaluation_result import told_with_errors
from neusee.workflows.evaluation.evaluation_scenes import scenes
from neusee.workflows.evaluation.pipelines import (
    CASES,
    NamedRecipe,
    compose_pipelines,
    read_pipelines,
)
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.graph.recipe_graph import TOLD
from neusee.workflows.recipe.blocks.settings_block import Mismatch
from neusee.workflows.store.result_store import Store

SMALL = [
    "optics.samples=96",
    "optics.pitch=84.15 um",
    "optics.bands=5",
    "optics.window=[24, 24]",
    "scene.shape=[32, 32]",
    "sensor.shape=[24, 24]",
    "scene=siemens",
]
HERE = Path()
HALF = 0.5 * 2.9e-6 / 0.11


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("mistold"))


def composed(text, *more):
    return compose_pipelines(
        NamedRecipe("first_light", [*SMALL, *more], HERE), read_pipelines(text, HERE)
    )


def green(*more, light="strength: 1e4"):
    line = f"wavelength: 532 nm, fwhm: 10 nm, {light}, angle: [0.1 mrad, 0.2 mrad]"
    return load("first_light", [*SMALL, f"lasers={{beam: {{{line}}}}}", *more])


BY_HAND = {
    "direction 0.5 px off": f"lasers.beam.angle=[{1e-4 + HALF!r} rad, {2e-4 + HALF!r} rad]",
    "wavelength 2 nm off": "lasers.beam.wavelength=534 nm",
    "defocus 0.1 waves off": "optics.defocus=0.1 waves",
}


@pytest.mark.slow
def test_the_camera_stays_and_the_filter_is_told_what_another_camera_would_know(store):
    """Each error is that of a recipe written by hand with this parameter, of which only the
    knowledge is taken.
    """
    recipe = green()
    errors = errors_of(recipe, Mismatch())
    assert list(errors) == list(BY_HAND)
    true = run(recipe, store, ["raw[mask]", "restored"])
    for text, error in errors.items():
        wrong = mistold(recipe, error)
        names = {wire for wire in wrong.steps["deconvolved"].sources if wire.startswith(TOLD)}
        assert names == ({f"{TOLD}psf[mask]"} if "defocus" in text else set()) | {
            f"{TOLD}laser_photons[mask,beam]"
        }
        found = run(wrong, store, ["raw[mask]", "restored", *names])
        other = run(green(BY_HAND[text]), store, [name.removeprefix(TOLD) for name in names])
        assert bool((found["raw[mask]"] == true["raw[mask]"]).all())
        assert not bool((found["restored"] == true["restored"]).all())
        for name in names:
            mine, hand = (
                getattr(x, "intensity", x) for x in (found[name], other[name.removeprefix(TOLD)])
            )
            assert float((mine - hand).abs().max()) <= 1e-6 * float(hand.abs().max())


@pytest.mark.slow
@pytest.mark.parametrize(
    "error", [{"line[beam].wavelength": 20e-9}, {"direction[beam].angle": (HALF, HALF)}]
)
def test_a_laser_in_watts_that_is_mistold_is_that_of_a_recipe_by_hand(error, store):
    """A Gaussian beam without a stated divergence: how much light the lens collects depends on
    the wavelength.
    """
    light = "power: 5 mW, waist: 1 mm, distance: 100 m"
    recipe, (place, by) = green(light=light), *error.items()
    hand = {
        "line[beam].wavelength": "lasers.beam.wavelength=552 nm",
        "direction[beam].angle": BY_HAND["direction 0.5 px off"],
    }
    name = "laser_photons[mask,beam]"
    wrong = mistold(recipe, {place: by})
    told = run(wrong, store, [TOLD + name, name])
    expected = run(green(hand[place], light=light), store, [name])[name]
    assert float((told[TOLD + name] - expected).abs().max()) <= 1e-6 * float(expected.max())
    assert float((told[TOLD + name] - told[name]).abs().max()) > 1e-3 * float(expected.max())
    if "wavelength" in place:
        collected, told_power = (
            run(wrong, store, [step])[step] for step in ("light[beam]", f"{TOLD}light[beam]")
        )
        assert collected != told_power


def test_dirt_is_not_told_and_ghosts_stay_those_of_the_camera(store):
    recipe = green("flare=dirty_windshield")
    errors = errors_of(recipe, Mismatch(pixels=0, wavelength="0 nm", defocus="0 waves"))
    assert list(errors) == ["dirt not told"]
    wrong = mistold(recipe, errors["dirt not told"])
    assert wrong.steps[f"{TOLD}pupil[mask]"].wires["dirt"] is None
    assert wrong.steps["pupil[mask]"].wires["dirt"] == "dirt"
    assert not any("ghost" in name for name in wrong.steps if name.startswith(TOLD))


def test_who_knows_nothing_cannot_be_told_wrongly():
    gone = ("restored", "deconvolved", "restored_quality")
    recipe = green(*(f"steps.{name}=null" for name in gone), "outputs=[raw]")
    assert errors_of(recipe, Mismatch()) == {}


def test_what_is_copied_is_what_the_error_changes():
    """And no more: the raw picture, its true glare and its colour keep their steps."""
    recipe = green()
    for text, error in errors_of(recipe, Mismatch()).items():
        wrong = mistold(recipe, error)
        copies = {
            name.removeprefix(TOLD).partition("[")[0]
            for name in wrong.steps
            if name.startswith(TOLD)
        }
        glare = {"laser_psf", "spot", "laser_photons"}
        line = {"line", "light", "wavefront", "laser_index", "laser_pupil", "laser_responses"}
        own = {
            "direction": {"direction"},
            "wavelength": line,
            "defocus": {"pupil", "psf", "laser_pupil"},
        }
        assert copies == glare | own[text.partition(" ")[0]]
        assert {
            name: step
            for name, step in wrong.steps.items()
            if name in recipe.steps and name != "deconvolved"
        } == {name: step for name, step in recipe.steps.items() if name != "deconvolved"}


@pytest.mark.slow
def test_points_are_those_of_the_recipe_with_the_error(store):
    """The direction that a scene draws, moved by half a pixel, and the strength of the point."""
    (pipeline,) = composed(
        "flat+wiener", "+evaluate.mismatch={wavelength: 0 nm, defocus: 0 waves, scenes: 1}"
    )
    shown, _ = scenes(load("first_light", SMALL), store, None, 2, list(CASES))
    bench = EvaluationPoints(store, 16)
    (found,) = told_with_errors(bench, [pipeline], shown, (0.0, 1e5), lambda _: None)
    assert found.true == bench.point(pipeline, PointRequest(shown[0], 1e5))
    assert found.wrong["psnr"] != found.true["psnr"]
    angle = shown[0].angle(pipeline.recipe("violet"))
    line = (
        f"wavelength: 405 nm, fwhm: 10 nm, strength: 1e5, angle: [{angle[0]!r} rad, {angle[1]!r}"
        " rad]"
    )
    by_hand = load(
        "first_light", [*SMALL, "doe=flat", f"lasers={{beam: {{{line}}}}}", f"seed={shown[0].seed}"]
    )
    wrong = mistold(by_hand, {"direction[beam].angle": (HALF, HALF)})
    expected = run(wrong, store, ["restored_quality"])["restored_quality"]
    assert found.wrong["psnr"] == pytest.approx(float(expected.psnr), abs=1e-3)


@pytest.mark.slow
def test_an_evaluation_has_the_rows_and_a_recipe_can_leave_them_out(store, tmp_path):
    run_it = {"scenes": 1, "strengths": [1e4], "store": store, "out": tmp_path}
    run_it["pipelines"] = read_pipelines("flat+none, flat+wiener", HERE)
    folder = neusee.evaluate("first_light", changes=SMALL, **run_it)
    rows = list(csv.DictReader((folder / "mistold.csv").read_text().splitlines()))
    assert [(row["pipeline"], row["told"]) for row in rows] == [
        ("flat+wiener", told)
        for told in (
            "exactly",
            "direction 0.5 px off",
            "wavelength 2 nm off",
            "defocus 0.1 waves off",
        )
    ]
    assert "What the restorer is not told" in next(folder.glob("*.html")).read_text()
    without_rows = [*SMALL, "+evaluate.mismatch=null"]
    folder = neusee.evaluate("first_light", changes=without_rows, **run_it)
    assert "What the restorer is not told" not in next(folder.glob("*.html")).read_text()


@pytest.mark.parametrize(
    ("text", "said"),
    [("{pixel: 1}", "pixels"), ("{wavelength: -2 nm}", "greater than"), ("{scenes: 0}", "greater")],
)
def test_a_mistake_in_the_block_is_told_with_its_place(text, said):
    with pytest.raises(RecipeError, match=said):
        load("first_light", [*SMALL, f"+evaluate.mismatch={text}"])
