"""A reported multiple of I_sat belongs to the exposure of the recipe, and a narrowed lens is
said.
"""

import pytest

import neusee
from neusee.workflows import Store, load

SMALL = [
    "optics.samples=64",
    "optics.pitch=126.2 um",
    "optics.bands=3",
    "optics.window=[32, 32]",
    "scene.shape=[32, 32]",
    "sensor.shape=[32, 32]",
    "doe=flat",
    "expect={}",
    "outputs=[peak]",
]
IN_WATTS = ["laser=pointer", "lasers.pointer.angle=[0 mrad, 0 mrad]"]
BY_STRENGTH = ["lasers.green.angle=[0 mrad, 0 mrad]"]


@pytest.mark.parametrize("laser", [IN_WATTS, BY_STRENGTH], ids=["in watts", "by strength"])
def test_the_peak_of_the_same_light_grows_with_the_exposure(tmp_path, laser):
    """1, 10 and 100 ms gave one number; the W/m2 of the laser do not change."""
    found = [
        neusee.run(
            load("first_light", [*SMALL, *laser, f"sensor.exposure={ms} ms"]), store=Store(tmp_path)
        )["peak[plain]"]
        for ms in (1, 10, 100)
    ]
    first = float(found[0].irradiance)
    assert [float(peak.irradiance) / first for peak in found] == pytest.approx(
        [1, 10, 100], rel=1e-4
    )
    assert [float(peak.laser) for peak in found] == pytest.approx(
        [float(found[0].laser)] * 3, rel=1e-6
    )
    assert float(found[0].laser) > 0


def test_a_lens_that_a_reading_narrows_is_said_where_it_scatters_too():
    wide = ["optics.diameter=25 mm", "flare=stray_light"]
    recipe = load("first_light", [*SMALL, *wide, "reading.aperture=inscribed"])
    assert any(
        "scatters as one of 25 mm, and its pupil has 8.077 mm" in note for note in recipe.notes
    )
    assert any("inscribed, a disc of 8.077 mm" in note for note in recipe.notes)
    usual = load("first_light", [*SMALL, "flare=stray_light"])
    assert not any("aperture" in note or "scatters" in note for note in usual.notes)
