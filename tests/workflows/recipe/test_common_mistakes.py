"""Twenty mistakes that people make with the packaged camera, and what each is told, from
arguments and from files.
"""

import subprocess
import sys
import time

import pytest

from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.recipe.loading import load

pytestmark = pytest.mark.usefixtures("checked_both_ways")

MINE = """\
# My camera.
defaults:
  - camera: neusee
  - scene: siemens
  - illuminant: daylight
  - lift: lmmse
  - laser: green
  - optics: small
  - sensor: small
  - doe: five_half_rings
  - flare: clean
  - restore: wiener
  - reading: coherent
outputs: [raw]
"""


@pytest.fixture
def refused(write, tmp_path):
    """Lines that a changed recipe is refused with."""

    def refused(*arguments, more="", old="", new=""):
        assert old in MINE
        write(MINE.replace(old, new) + more)
        with pytest.raises(RecipeError) as caught:
            load("mine.yaml", arguments, tmp_path)
        return [
            " | ".join(filter(None, (str(p.mark), p.path, p.message)))
            for p in caught.value.diagnostics
        ]

    return refused


@pytest.fixture
def accepted(write, tmp_path):
    def accepted(*arguments, more=""):
        write(MINE + more)
        return load("mine.yaml", arguments, tmp_path)

    return accepted


def test_without_a_mistake_it_loads(accepted):
    recipe = accepted()
    assert recipe.outputs == ("raw[plain]", "raw[mask]")
    assert recipe.title == "My camera."


def test_1_a_misspelt_key(refused):
    assert refused(more="sensor: {quantum_eficiency: 0.6}\n") == [
        "mine.yaml:15:10 | sensor.quantum_eficiency | unknown; did you mean quantum_efficiency?"
    ]
    assert refused("sensor.gian=3") == [
        "argument 1 | sensor.gian=3 | unknown; did you mean sensor.gain?"
    ]


def test_2_a_misspelt_group_or_option(refused):
    assert refused(old="scene:", new="scen:") == [
        "mine.yaml:4:11 | scen: siemens | no group scen; did you mean scene?"
    ]
    assert refused("laser=gren") == [
        "argument 1 | laser=gren | no option gren in laser; did you mean green?"
    ]


def test_3_a_misspelt_node(refused):
    more = (
        "steps: {dark: {node: NODE, each: arms, from: charge, with: {mean:"
        " '${sensor.dark_current}'}}}\n"
    )
    for node in ("sensor.dark_curent", "optics.dark_current", "sensr.dark_current"):
        (problem,) = refused(more=more.replace("NODE", node))
        assert problem.startswith("mine.yaml:15:22 | steps.dark.node | no ")
        assert problem.endswith("; did you mean sensor.dark_current?")


def test_4_a_misspelt_step(refused):
    assert refused(old="[raw]", new="[rwa]") == [
        "mine.yaml:14:11 | outputs.0 | no step rwa; did you mean raw?"
    ]
    assert refused("steps.drak.with.mean=1 e-") == [
        "argument 1 | steps.drak.with.mean=1 e- | unknown; did you mean steps.dark.with.mean?"
    ]


def test_5_a_wrong_unit(refused):
    assert refused("sensor.pixel_pitch=3 s") == [
        "argument 1 | sensor.pixel_pitch = 3 s | has the wrong unit 's': write one of m, cm, mm,"
        " um, µm, μm, nm, km"
    ]


def test_6_no_unit(refused):
    assert refused(more="sensor: {pixel_pitch: 2.9}\n") == [
        "mine.yaml:15:23 | sensor.pixel_pitch = 2.9 | needs a unit: write 2.9 um (one of m, cm, mm,"
        " um, µm, μm, nm, km)"
    ]


def test_7_a_negative_number(refused):
    assert refused("sensor.read_noise=-10.5 e-") == [
        "argument 1 | sensor.read_noise = -10.5 e- | must be greater than or equal to 0"
    ]


def test_8_a_number_out_of_range(refused):
    assert refused("sensor.quantum_efficiency=56") == [
        "argument 1 | sensor.quantum_efficiency = 56 | must be less than or equal to 1"
    ]
    assert refused("lasers.green.wavelength=532 um") == [
        "argument 1 | lasers.green.wavelength = 532 um | must be at most 20 um"
    ]


def test_9_a_wrong_type(refused):
    assert refused("sensor.bits=twelve") == [
        "argument 1 | sensor.bits = twelve | must be a whole number"
    ]
    assert refused("reading.rounding=down")[0].startswith(
        "argument 1 | reading.rounding = down | must be 'nearest',"
    )


def test_10_a_missing_file(refused, tmp_path):
    (problem,) = refused("scene=china", "scene.file=chnia.jpg")
    assert (
        problem == f"argument 2 | scene.file = chnia.jpg | no such file: {tmp_path / 'chnia.jpg'}"
    )


def test_11_a_picture_that_is_none(refused, tmp_path):
    (tmp_path / "broken.exr").write_bytes(b"not an EXR")
    (problem,) = refused("scene=night", "scene.file=broken.exr")
    assert problem.startswith("argument 2 | scene.file = broken.exr | ")


def test_12_a_picture_of_the_wrong_depth(refused, tmp_path):
    import numpy as np
    from skimage.io import imsave

    imsave(tmp_path / "four.png", np.full((4, 4, 4), 128, np.uint8), check_contrast=False)
    (problem,) = refused("scene=china", "scene.file=four.png")
    assert problem.startswith("argument 2 | scene.file = four.png | ")
    assert "has transparency" in problem


def test_13_a_cycle(refused):
    more = (
        "steps:\n  dark: {node: sensor.dark_current, each: arms, from: well, with: {mean:"
        " '${sensor.dark_current}'}}\n"
    )
    (problem,) = refused(more=more)
    assert problem.startswith("camera/neusee.yaml:")
    assert " | steps | cycle: read -> well -> dark -> read (" in problem
    assert "mine.yaml:16" in problem


def test_14_a_missing_producer(refused):
    more = "steps: {psf: {from: glass}, laser_psf: {from: psf}}\n"
    diagnostics = refused(more=more)
    assert diagnostics == [
        (
            "mine.yaml:15:21 | steps.psf.from.pupil | no step glass; check the name; steps"
            " returning a Pupil: pupil[plain], pupil[mask], laser_pupil[plain,green],"
            " laser_pupil[mask,green]"
        ),
        (
            "mine.yaml:15:47 | steps.laser_psf.from.pupil | optics.psf needs a Pupil; psf returns a"
            " Psf; steps returning a Pupil: pupil[plain], pupil[mask], laser_pupil[plain,green],"
            " laser_pupil[mask,green]"
        ),
    ]


def test_15_an_output_that_is_switched_off(refused):
    (problem,) = refused("outputs=[raw, ghosts]")
    assert problem.startswith("argument 1 | outputs.1 | step ghosts is null (flare/clean.yaml:2:")


def test_16_a_key_that_stands_twice(refused):
    assert refused(more="seed: 1\nseed: 2\n") == [
        "mine.yaml:16:1 | seed | given twice, first in line 15"
    ]


def test_17_an_aperture_beyond_the_grid_stretches_the_grid_until_it_carries_no_window(
    accepted, refused
):
    recipe = accepted("optics.diameter=11 mm")
    assert any(
        "aperture 11 mm" in note and "the pitch becomes 20.37 um" in note for note in recipe.notes
    )
    lines = refused("optics.diameter=110 mm")
    assert all("a pupil pitch of 203.7 um" in line for line in lines)
    # no note where nothing is changed
    assert not any("aperture" in note for note in accepted().notes)


def test_18_no_light_of_the_laser_is_legal_and_no_exposure_is_not(accepted, refused):
    assert accepted("lasers.green.strength=0").steps["spot[mask,green]"].params["strength"] == 0
    assert refused("sensor.exposure=0 s") == [
        "argument 1 | sensor.exposure = 0 s | must be greater than 0"
    ]


def test_19_one_pixel_is_legal_and_none_is_not(accepted, refused):
    assert accepted("sensor.shape=[1, 1]").steps["raw[mask]"].params["shape"] == (1, 1)
    assert refused("sensor.shape=[0, 1]") == [
        "argument 1 | sensor.shape.0 = 0 | must be greater than or equal to 1"
    ]


def test_19_one_wavelength_is_no_range(refused):
    (problem,) = refused("optics.shortest=550 nm", "optics.longest=550 nm")
    assert problem.startswith(
        "argument 1 | optics.shortest = 550 nm | start 550 nm must be below stop 550 nm"
    )


def test_20_a_steep_element_is_legal_before_the_run(accepted):
    assert accepted("doe.waves=[120, 180, 240, 300, 360]").steps["height"].params["waves"][0] == 120


def test_all_at_once_and_nothing_is_run(refused):
    diagnostics = refused(
        "sensor.gian=3",
        "seed=x",
        more="sensor: {pixel_pitch: 2.9, bits: 0, quantum_eficiency: 1}\n",
        old="[raw]",
        new="[raw, lrs]",
    )
    assert [p.split(" | ")[1] for p in diagnostics] == [
        "sensor.gian=3",
        "seed = x",
        "outputs.1",
        "sensor.pixel_pitch = 2.9",
        "sensor.bits = 0",
        "sensor.quantum_eficiency",
    ]


def test_without_a_group_only_what_is_sure_is_told(refused):
    assert refused("laser=gren", "sensor.bits=0", "sensor.gian=3", old="[raw]", new="[rwa]") == [
        "argument 1 | laser=gren | no option gren in laser; did you mean green?",
        "argument 2 | sensor.bits = 0 | must be greater than or equal to 1",
        "argument 3 | sensor.gian=3 | unknown; did you mean sensor.gain?",
    ]


def test_a_mistake_is_told_as_fast_as_a_right_recipe_is_read(refused):
    work = {"right": [], "wrong": []}
    for _ in range(5):
        start = time.process_time()
        load("first_light", ["sensor.gain=3 e-/DN"])
        middle = time.process_time()
        refused("sensor.gian=3")
        work["right"].append(middle - start)
        work["wrong"].append(time.process_time() - middle)
    assert min(work["wrong"]) < 5 * min(work["right"])


def test_a_mistake_in_the_text_is_told_without_torch():
    code = (
        "import sys; from neusee.workflows.recipe.text.yaml_values import read; assert 'torch' not"
        " in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
