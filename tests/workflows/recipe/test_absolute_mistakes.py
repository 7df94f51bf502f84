"""Mistakes about lasers in watts, scenes in lux and dark currents by time: each is one located
message.
"""

import pytest

from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.recipe.loading import load

pytestmark = pytest.mark.usefixtures("checked_both_ways")

MINE = """\
# My camera.
defaults: [camera: neusee, scene: siemens, illuminant: daylight, lift: lmmse, optics: small, sensor: small, doe: flat,
           flare: clean, restore: wiener, reading: coherent]
outputs: [raw]
lasers:
  mine: {wavelength: 532 nm, fwhm: 1 nm, angle: [0 mrad, 0 mrad], LIGHT}
"""
GOOD = "power: 5 mW, divergence: 1 mrad, distance: 100 m"
TRAIN = (
    "pulse_energy: 1 uJ, pulse_duration: 5 ns, repetition_rate: 10 kHz, divergence: 1 mrad,"
    " distance: 100 m"
)


@pytest.fixture
def refused(write, tmp_path):
    """Mistakes of the recipe with a laser, as lines of place, path and message."""

    def refused(light=GOOD, *arguments, more=""):
        write(MINE.replace("LIGHT", light) + more)
        with pytest.raises(RecipeError) as caught:
            load("mine.yaml", arguments, tmp_path)
        return [
            " | ".join(filter(None, (str(p.mark), p.path, p.message)))
            for p in caught.value.diagnostics
        ]

    return refused


@pytest.mark.parametrize(
    "light", [GOOD, TRAIN, "strength: 100", f"{GOOD}, visibility: 5 km, haze: kim"]
)
def test_what_is_whole_loads(light, write, tmp_path):
    write(MINE.replace("LIGHT", light))
    assert load("mine.yaml", (), tmp_path).outputs == ("raw[plain]", "raw[mask]")


LASERS = {
    "no light": ("waist: 1 mm", "waist = 1 mm | the light of this laser is not known: give strength, or power"),
    "nothing at all": ("", "wavelength = 532 nm | the light of this laser is not known"),
    "no distance": ("power: 5 mW, divergence: 1 mrad", "power = 5 mW | a laser in watts needs its distance"),
    "no width": ("power: 5 mW, distance: 100 m", "power = 5 mW | the width of the beam is not known: give divergence"),
    "a negative power": ("power: -5 mW, divergence: 1 mrad, distance: 1 m", "power = -5 mW | must be greater than 0"),
    "a negative divergence": (GOOD.replace("1 mrad", "-1 mrad"), "divergence = -1 mrad | must be greater than 0"),
    "a negative distance": (GOOD.replace("100 m", "-100 m"), "distance = -100 m | must be greater than 0"),
    "a distance of 0": (GOOD.replace("100 m", "0 m"), "distance = 0 m | must be greater than 0"),
    "power without a unit": (GOOD.replace("5 mW", "5"), "power = 5 | needs a unit: write 5 mW"),
    "power in joules": (GOOD.replace("5 mW", "5 mJ"), "power = 5 mJ | has the wrong unit 'mJ': write one of W"),
    "divergence in metres": (GOOD.replace("1 mrad", "1 mm"), "divergence = 1 mm | has the wrong unit 'mm'"),
    "waist against divergence": (f"{GOOD}, waist: 0.1 mm", "divergence = 1 mrad | waist 0.0001 m and divergence"),
    "waist, divergence and M2": (f"{GOOD}, waist: 1 mm, m_squared: 9", "m_squared = 9 | waist 0.001 m and divergence"),
    "M2 below 1": (f"{GOOD}, m_squared: 0.5", "m_squared = 0.5 | must be greater than or equal to 1"),
    "another convention": (f"{GOOD}, convention: FWHM", "convention = FWHM | must be '1/e2' or '1/e'"),
    "strength and power": (f"{GOOD}, strength: 10", "strength = 10 | a strength states the light of the laser at the"),
    "strength and distance": ("strength: 10, distance: 9 m", "distance states its light in absolute units"),
    "no duration": (TRAIN.replace("pulse_duration: 5 ns, ", ""), "pulse_energy = 1 uJ | a pulse needs its duration"),
    "a pulse longer than its period": (
        TRAIN.replace("5 ns", "1 ms"), "pulse_duration = 1 ms | a pulse of 0.001 s does not fit into the period"),
    "power against energy x rate": (f"{TRAIN}, power: 1 W", "power = 1 W | pulse energy 1e-06 J x repetition rate"),
    "power of one pulse": (
        TRAIN.replace("repetition_rate: 10 kHz", "power: 1 W"), "power = 1 W | a single pulse has no mean power"),
    "air twice": (f"{GOOD}, visibility: 5 km, haze: kim, air_transmittance: 0.5", "air_transmittance = 0.5 | the air"),
    "haze without a law": (f"{GOOD}, visibility: 5 km", "visibility = 5 km | laws of haze differ twentyfold"),
    "a law without haze": (f"{GOOD}, haze: kim", "haze = kim | a law of haze needs the visibility"),
    "a law of one's own": (f"{GOOD}, visibility: 5 km, haze: mie", "haze = mie | must be 'kruse' or 'kim'"),
    "air above 1": (f"{GOOD}, air_transmittance: 1.5", "air_transmittance = 1.5 | must be less than or equal to 1"),
    "a negative delay": (f"{TRAIN}, pulse_delay: -1 ms", "pulse_delay = -1 ms | must be greater than or equal to 0"),
}  # fmt: skip


@pytest.mark.parametrize("case", LASERS)
def test_a_mistake_about_a_laser_is_one_line_at_the_laser(refused, case):
    light, told = LASERS[case]
    (line,) = refused(light)
    assert line.startswith("mine.yaml:6:")
    assert f"lasers.mine.{told}" in line or told in line


def test_a_misspelt_key_gets_the_name_of_the_key_that_no_laser_gives(refused):
    lines = refused(GOOD.replace("divergence", "divergance"))
    told = {line.partition(" | ")[2].split(":")[0] for line in lines}
    assert told == {
        "lasers.mine.divergance | unknown; did you mean divergence?",
        "lasers.mine.power = 5 mW | the width of the beam is not known",
    }


def test_a_strength_at_a_wavelength_that_no_channel_sees_is_refused_at_the_strength(refused):
    words = "lasers.mine.wavelength=1064 nm", "sensor.camera=Nikon 5100"
    (line,) = refused("strength: 10", *words)
    assert line.startswith("mine.yaml:6:")
    assert (
        "strength = 10 | no channel of the camera sees 1064 nm, so no strength can saturate one:"
        " give power" in line
    )


def test_the_strength_of_the_paper_needs_no_channel_that_sees_the_laser(write, tmp_path):
    write(MINE.replace("LIGHT", "strength: 10"))
    words = (
        "lasers.mine.wavelength=1064 nm",
        "sensor.camera=Nikon 5100",
        "reading.strength=irradiance",
    )
    recipe = load("mine.yaml", words, tmp_path)
    assert any("no channel of Nikon 5100 sees 5 of 5 bands" in note for note in recipe.notes)


SCENES = {
    "lux beside a background": ("scene: {illuminance: 100 lx}", "background = 0.7 | the brightness of the scene is"),
    "lux and cd/m2": ("scene: {illuminance: 1 lx, luminance: 1 cd/m2}", "luminance = 1 cd/m2 | the brightness of"),
    "no brightness": ("sensor: {background: null}", "background = None | the brightness of the scene is not known"),
    "negative lux": ("scene: {illuminance: -1 lx}", "illuminance = -1 lx | must be greater than or equal to 0"),
    "lux without a unit": ("scene: {illuminance: 5}", "scene.illuminance = 5 | needs a unit: write 5 lx"),
    "lux in watts": ("scene: {illuminance: 5 W}", "scene.illuminance = 5 W | has the wrong unit 'W'"),
    "a lens that amplifies": ("optics: {transmittance: 1.2}", "transmittance = 1.2 | must be less than or equal to 1"),
    "a dark current by hour": ("sensor: {dark_current: 5 e-/h}", "dark_current = 5 e-/h | has the wrong unit 'e-/h'"),
    "a negative dark current": ("sensor: {dark_current: -1 e-/s}", "dark_current = -1 e-/s | the dark current must be"),
    "lux of each band": ("scene: {illuminance: 9 lx}\nsensor: {background: null}\nreading: {level: per_band}",
                         "level = per_band | lux and cd/m2 are sums over the bands"),
    "another meaning": ("reading: {strength: peak}", "strength = peak | must be 'first_channel' or 'irradiance'"),
}  # fmt: skip


@pytest.mark.parametrize("case", SCENES)
def test_a_mistake_about_the_light_of_the_scene_is_one_line(refused, case):
    more, told = SCENES[case]
    lines = refused(more=more + "\n")
    assert len(lines) == 1, lines
    assert told in lines[0]
