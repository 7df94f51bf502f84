"""Saturation by the channel that saturates first: a run and an estimate of safety count the same
pixels.
"""

import math

import numpy as np
import pytest

import neusee
from neusee.workflows import RecipeError, Store, load
from neusee.workflows.safety.exposure_limits import saturating, with_channels
from neusee.workflows.safety.exposures import draw_settings
from neusee.workflows.safety.safety_estimate import estimate, prepare, settings_of

pytestmark = pytest.mark.usefixtures("without_remedies")
PLANCK, LIGHT = 6.62607015e-34, 299792458.0
WELL, OFFSET, GAIN, BITS, EXPOSURE, PITCH = 25500.0, 390.0, 1 / 0.37, 16, 0.1, 2.9e-6
SMALL = [
    "laser=pointer", "lasers.pointer.angle=[0 mrad, 0 mrad]", "+safety=camera", "safety.draws=100", "doe=flat",
    "optics.samples=256", "optics.bands=3", "optics.window=[96, 96]", "scene.shape=[160, 160]",
    "sensor.shape=[160, 160]", "sensor.background=1e-4", "expect={}", "outputs=[saturated]",
]  # fmt: skip
EFFICIENCIES = """wavelength (nm),red QE (1),green QE (1),blue QE (1)
400,0.02,0.05,0.4
500,0.03,0.5,0.3
600,0.5,0.2,0.01
700,0.4,0.002,0.001
"""
MONO = "wavelength (nm),QE (%)\n400,30\n550,70\n1000,5\n"
CAMERAS = {"own.csv": EFFICIENCIES, "mono.csv": MONO}


def words(folder, camera, nanometres, *more):
    if camera in CAMERAS:
        (folder / camera).write_text(CAMERAS[camera])
    mono = ["camera=mono"] if camera == "mono.csv" else []
    return [
        *SMALL,
        *mono,
        f"sensor.camera={camera}",
        f"lasers.pointer.wavelength={nanometres} nm",
        *more,
    ]


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("store"))


def counted(folder, store, changes):
    """Return the saturated pixels behind the plain lens by a run, and by an estimate."""
    recipe = load("first_light", changes, folder)
    found = estimate(recipe, store)
    (plain,) = [each for each in found.dazzled if each.option == "plain lens"]
    return float(
        neusee.run(recipe, store=store, outputs=["saturated[plain]"])["saturated[plain]"].pixels
    ), plain.pixels.value


@pytest.mark.slow
@pytest.mark.parametrize(
    ("camera", "nanometres", "power"),
    [("CIE 1931", 638, "0.02 mW"), ("Nikon 5100", 680, "1 mW"), ("own.csv", 690, "0.02 mW"),
     ("mono.csv", 600, "0.02 mW")],
)  # fmt: skip
def test_a_run_and_an_estimate_count_the_same_saturated_pixels(
    tmp_path, store, camera, nanometres, power
):
    """In a dark scene; with the quantum efficiency of the sensor alone they differ by 20 to 1000
    %.
    """
    run, estimated = counted(
        tmp_path, store, words(tmp_path, camera, nanometres, f"lasers.pointer.power={power}")
    )
    assert 300 < run < 12000
    assert estimated == pytest.approx(run, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("bits", [8, 12])
def test_the_end_of_the_converter_counts_in_both(tmp_path, store, bits):
    """A converter of 8 bits that ends at a half, and one of 12 bits that ends at a tenth of the
    well.
    """
    gain = {8: "50 e-/DN", 12: "0.62 e-/DN"}[bits]
    more = ["lasers.pointer.power=0.02 mW", f"sensor.bits={bits}", f"sensor.gain={gain}"]
    run, estimated = counted(tmp_path, store, words(tmp_path, "CIE 1931", 532, *more))
    assert estimated == pytest.approx(run, rel=0.01)


def efficiency(nanometres):
    """Return the largest efficiency of a channel of the own table, interpolated by NumPy."""
    rows = np.array([[float(x) for x in line.split(",")] for line in EFFICIENCIES.splitlines()[1:]])
    return max(np.interp(nanometres, rows[:, 0], column) for column in rows[:, 1:].T)


def filled(nanometres, electrons, exposure=EXPOSURE):
    """Return the irradiance in W/m2 that frees a number of electrons in a pixel of the best
    channel.
    """
    joules = PLANCK * LIGHT / (nanometres * 1e-9)
    return electrons / efficiency(nanometres) * joules / (exposure * PITCH**2)


def drawn_limits(changes, folder):
    """Return the draws, and the irradiance that fills a pixel, nominal and of each draw."""
    recipe = load("first_light", changes, folder)
    safety = with_channels(recipe, settings_of(recipe), None)
    draws = draw_settings(recipe, safety)
    return draws, saturating(safety, draws)


@pytest.mark.parametrize("nanometres", [430, 532, 560, 640])
def test_the_saturation_irradiance_is_that_of_the_best_channel_of_an_absolute_table(
    tmp_path, nanometres
):
    changes = words(
        tmp_path, "own.csv", nanometres, "lasers.pointer.fwhm=0.01 nm", "sensor.gain=0.5 e-/DN"
    )
    _, found = drawn_limits(changes, tmp_path)
    assert found[0] == pytest.approx(filled(nanometres, WELL - OFFSET), rel=1e-4)


@pytest.mark.slow
def test_what_is_drawn_stays_drawn(tmp_path):
    """The table of absolute efficiencies does not change with that of the sensor; relative
    responses do.
    """
    laws = [
        "sensor.quantum_efficiency=lognormal(0.4, 1.2)",
        "sensor.exposure=lognormal(0.1 s, 1.1)",
        "lasers.pointer.wavelength=normal(532 nm, 5 nm)",
    ]
    found = {}
    for camera in ("own.csv", "CIE 1931"):
        for law in laws:
            draws, limits = drawn_limits([*words(tmp_path, camera, 532), law], tmp_path)
            (drawn,) = draws.values.values()
            found[camera, law] = drawn, limits[1:]
    for camera in ("own.csv", "CIE 1931"):
        drawn, limits = found[camera, laws[1]]
        np.testing.assert_allclose(limits * drawn, limits[0] * drawn[0], rtol=1e-9)
        drawn, limits = found[camera, laws[2]]
        assert limits.std() > 0.005 * limits.mean()
    drawn, limits = found["CIE 1931", laws[0]]
    np.testing.assert_allclose(limits * drawn, limits[0] * drawn[0], rtol=1e-9)
    drawn, limits = found["own.csv", laws[0]]
    np.testing.assert_allclose(limits, limits[0], rtol=1e-9)


@pytest.mark.slow
def test_a_laser_that_no_channel_sees_is_not_judged_and_not_called_safe(tmp_path):
    found = estimate(load("first_light", words(tmp_path, "Nikon 5100", 740), tmp_path))
    assert not found.dazzled
    assert not [each for each in found.findings if each.limit.effect == "dazzle"]
    assert any("no channel of the camera detects 740 nm" in text for text in found.unsaid)


@pytest.mark.parametrize(
    ("change", "message"),
    [("safety.sensor.responses=lost", "no step 'lost'"), ("safety.sensor.responses=line", "name a step of spectra"),
     ("safety.sensor.responses=responses", "does not read a laser line"),
     ("safety.sensor.offset=30000 e-", "leaves no room for light")],
)  # fmt: skip
def test_a_step_of_another_kind_is_refused(tmp_path, change, message):
    with pytest.raises(RecipeError, match=message):
        prepare(load("first_light", [*words(tmp_path, "CIE 1931", 532), change], tmp_path), None)


def test_without_a_step_of_responses_the_efficiency_is_that_of_the_settings(tmp_path):
    recipe = load(
        "safety_pointer", ["safety.draws=100", "safety.protection.mask=null", "optics.samples=256"]
    )
    prepared = prepare(recipe, None)
    joules = PLANCK * LIGHT / 532e-9
    wanted = 10500 / 0.65 * joules / (10e-3 * 3.45e-6**2)
    assert math.isclose(saturating(prepared.safety, prepared.draws)[0], wanted, rel_tol=1e-6)
