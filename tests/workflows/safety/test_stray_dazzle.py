"""Dazzle of a camera whose lens scatters, against Airy's pattern of SciPy with Harvey and
Shack's law.
"""

import math

import numpy as np
import pytest
from scipy.special import j1

from neusee.workflows import Store, load
from neusee.workflows.safety.run_safety import document
from neusee.workflows.safety.safety_estimate import estimate, scatter_text

pytestmark = pytest.mark.usefixtures("without_remedies")
SAMPLES, SENSOR, SCENE = 256, 96, 128
FOCAL, DIAMETER, PITCH, WAVELENGTH = 0.11, SAMPLES * 31.55e-6, 2.9e-6, 532e-9
SHARE, WELL, EFFICIENCY, EXPOSURE = 0.5, 25500, 0.56, 0.1
B0, WIDTH, SLOPE = 3e4, 5e-4, -2.2
CAMERA = ["laser=pointer", "lasers.pointer.angle=[0 mrad, 0 mrad]", "+safety=camera", "safety.draws=100",
          f"safety.dazzle.share={SHARE}", f"optics.samples={SAMPLES}", "optics.pitch=31.55 um",
          "optics.bands=3", "optics.window=[96, 96]", f"sensor.shape=[{SENSOR}, {SENSOR}]",
          f"scene.shape=[{SCENE}, {SCENE}]",
          # the stated efficiency
          "safety.sensor.responses=null", "safety.sensor.gain=null", "safety.sensor.bits=null",
          "safety.sensor.offset=0 e-", "sensor.sampling=point"]  # fmt: skip
SCATTERS = [
    *CAMERA,
    "flare=stray_light",
    f"stray_light.surfaces.lens={{b0: {B0}, l: {WIDTH}, s: {SLOPE}}}",
    f"stray_light.wavelength={WAVELENGTH * 1e9} nm",
]


NONE = "safety.lens.scatter=null"


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("store"))


def limit(found, protection):
    (one,) = (f for f in found.findings if f.option == protection and f.limit.effect == "dazzle")
    return one.at_lens.value


def expected(scatters):
    """Irradiance at the lens that fills the pixels, from the light at the middle of each pixel
    of the sensor.
    """
    at = np.arange(SENSOR) - SENSOR // 2
    away = np.hypot(at[:, None], at)
    spread = WAVELENGTH * FOCAL / DIAMETER / PITCH
    v = np.where(away > 0, away, 1) * math.pi / spread
    light = np.where(away > 0, (2 * j1(v) / v) ** 2, 1.0) * math.pi / (4 * spread**2)
    if scatters:
        law = (WIDTH**2 + 1) ** ((SLOPE + 2) / 2) - WIDTH ** (SLOPE + 2)
        total = 2 * math.pi * B0 * law / (WIDTH**SLOPE * (SLOPE + 2))
        veil = (
            B0 * (1 + (away * PITCH / (FOCAL * WIDTH)) ** 2) ** (SLOPE / 2) * (PITCH / FOCAL) ** 2
        )
        light = (1 - total) * light + veil
    faintest = np.sort(light.ravel())[::-1][round(SHARE * SENSOR**2) - 1]
    photon = 6.62607015e-34 * 299792458.0 / WAVELENGTH
    return WELL / EFFICIENCY * photon / EXPOSURE / faintest / (math.pi * DIAMETER**2 / 4)


@pytest.mark.slow
def test_the_light_that_a_lens_scatters_lowers_the_limit_of_dazzle_and_not_that_of_damage(store):
    clear, veiled = (
        estimate(load("first_light", changes), store) for changes in ([*CAMERA, NONE], SCATTERS)
    )
    for found, scatters in ((clear, False), (veiled, True)):
        assert limit(found, "plain lens") == pytest.approx(expected(scatters), rel=0.03)
        assert (document(found)["scattered_share"] is not None) is scatters
        assert not document(found)["scattered_share_is_assumed"]
        sources = [f.limit.source for f in found.findings if f.limit.effect == "dazzle"]
        assert all(
            ("with the light that the lens scatters" in source) is scatters for source in sources
        )
        assert scatter_text(found.veil).startswith("Lens scatter") is scatters
    assert limit(veiled, "plain lens") < 0.8 * limit(clear, "plain lens")
    assert limit(veiled, "mask") < limit(clear, "mask")
    plain, again = (
        [f.ratio for f in found.findings if (f.option, f.limit.effect) == ("plain lens", "damage")]
        for found in (clear, veiled)
    )
    assert plain == again != []
