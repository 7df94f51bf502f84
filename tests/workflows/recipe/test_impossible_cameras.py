"""Cameras that cannot be, each refused before any work with a place and a reason."""

import random

import pytest

from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.recipe.loading import load
from tests.impossible_values import Case, cases, fault_of_run, outcome

CAMERAS = {
    "a well below the offset": (["sensor.full_well=100 e-"], "the offset of 390 e- "),
    "an offset above the well": (["sensor.offset=3e4 e-"], "a full well of 25500 e- without light"),
    "a dark current that fills the well": (
        ["sensor.dark_current=1e6 e-/s"],
        "the dark current of 100000 e- fills",
    ),
    "a read noise above the well": (
        ["sensor.read_noise=1e6 e-"],
        "no exposure could be told from the dark",
    ),
    "a single sample of the pupil": (["optics.samples=1"], "must be greater than or equal to 4"),
    "a lens below f/0.5": (["optics.diameter=500 mm"], "f/0.22: no lens in air is below f/0.5"),
    "a focal length below half the diameter": (
        ["optics.focal_length=3 mm"],
        "no lens in air is below f/0.5",
    ),
    "a converter that one electron fills": (
        ["sensor.gain=1e5 DN/e-"],
        "a single electron would clip a pixel",
    ),
    "a converter without a step": (["sensor.gain=1e-6 DN/e-"], "every picture would be 0 DN"),
    "a pixel of a metre": (["sensor.pixel_pitch=1 m"], "must be at most 10 mm"),
    "a pixel of an atom": (["sensor.pixel_pitch=0.1 nm"], "must be at least 100 nm"),
    "an exposure of a year": (["sensor.exposure=3.2e7 s"], "must be at most 1e+06 s"),
    "a sensor that sees nothing": (
        ["sensor.quantum_efficiency=1e-30"],
        "must be greater than or equal to 0.000001",
    ),
    "bits that are true": (["sensor.bits=true"], "true is not a value here"),
    "a laser brighter than any": (["lasers.green.strength=1e30"], "must be at most 1e+18"),
}


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_camera_that_cannot_be_is_refused_with_a_reason(camera):
    changes, reason = CAMERAS[camera]
    with pytest.raises(RecipeError) as caught:
        load("first_light", changes)
    messages = [problem.message for problem in caught.value.diagnostics]
    assert any(reason in message for message in messages), messages
    assert all(
        problem.mark.line or problem.mark.file.startswith("argument")
        for problem in caught.value.diagnostics
    )


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        (["+safety.sensor.offset=2e4 e-"], "leaves no room for light"),
        (["optics.diameter=300 mm"], "no lens in air is below f/0.5"),
        (["+lasers.pointer.m_squared=1e30"], "must be less than or equal to 1000000"),
        (["lasers.pointer.distance=1e30 m"], "must be at most 1e+09 m"),
    ],
)
def test_safety_refuses_the_same_cameras(changes, reason):
    with pytest.raises(RecipeError) as caught:
        load("safety_pointer", changes)
    assert any(reason in problem.message for problem in caught.value.diagnostics)


@pytest.mark.parametrize("text", ["0", "-1", ".nan", ".inf", "1e30", "red", "true", "[]"])
@pytest.mark.parametrize(
    "path", ["sensor.quantum_efficiency", "sensor.bits", "optics.bands", "lasers.green.strength"]
)
def test_a_number_that_cannot_be_is_refused_or_allowed_without_an_error(path, text):
    assert outcome(Case("first_light", path, text)).fault == ""


@pytest.mark.slow
def test_a_tenth_of_all_numbers_of_all_recipes_is_refused_or_allowed_without_an_error():
    drawn = cases(share=0.1, seed=20)
    assert len(drawn) > 500
    assert [(found.case, found.fault) for found in map(outcome, drawn) if found.fault] == []


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_a_number_that_is_allowed_gives_a_picture_of_finite_numbers(tmp_path):
    drawn = [case for case in cases(seed=21) if case.recipe == "first_light"]
    allowed = [case for case in drawn if not outcome(case).refusal]
    assert len(allowed) > 4
    tried = random.Random(21).sample(allowed, min(40, len(allowed)))
    faults = [(case.change, fault) for case in tried if (fault := fault_of_run(case, tmp_path))]
    assert faults == []
