"""Dazzle behind a mask in an estimate: against a Hankel integral and roots of SciPy, and what is
said without it.
"""

import math
import re

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.special import j0

from neusee.workflows import Store, load
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.safety.run_safety import document
from neusee.workflows.safety.safety_estimate import estimate

pytestmark = pytest.mark.usefixtures("without_remedies")
#: a window of 243 pixels of the pointer's camera, and a pupil fine enough for 0.2 % of the picture
SMALL = [
    "safety.dazzle.share=0.002",
    "wide.window=[729, 729]",
    "optics.samples=512",
    "optics.window=[96, 96]",
    "doe=axicon",
    "doe.waves=5",
    "safety.protection.filter=null",
    "+safety.lens.focus=laser",
    "+safety.lens.scatter=null",
]
PIXELS = 0.002 * 1536 * 2048
WAVELENGTH, FOCAL, DIAMETER, PITCH = 532e-9, 50e-3, 12e-3, 3.45e-6


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("store"))


@pytest.fixture(scope="module")
def said(store, without_remedies):
    return document(estimate(load("safety_pointer", [*SMALL, "safety.draws=1000"]), store))


def dazzle(said, protection):
    return next(
        each
        for each in said["limits"]
        if each["protection"] == protection and each["effect"] == "dazzle"
    )


def silica(wavelength):
    """Malitson's index of fused silica."""
    x = (wavelength * 1e6) ** 2
    poles = ((0.6961663, 0.0684043), (0.4079426, 0.1162414), (0.8974794, 9.896161))
    return math.sqrt(1 + sum(b * x / (x - c * c) for b, c in poles))


def axicon_at_the_lens():
    """Irradiance at the lens that fills the pixels: the Hankel integral of the axicon over 5 x 5
    points of each.
    """
    waves = 5 * 550e-9 / WAVELENGTH * (silica(WAVELENGTH) - 1) / (silica(550e-9) - 1)
    spread, half, points = WAVELENGTH * FOCAL / DIAMETER / PITCH, 60, 5
    at, weights = np.polynomial.legendre.leggauss(500)
    radius = (at + 1) / 2
    table = np.linspace(0, 1.5 * half, 6000)
    field = np.concatenate(
        [
            j0(np.outer(np.pi / spread * part, radius))
            @ (radius * weights * np.exp(2j * np.pi * waves * radius))
            for part in np.array_split(table, 20)
        ]
    )
    inside = (np.arange(points) - (points - 1) / 2) / points
    side = (np.arange(-half, half + 1)[:, None] + inside).ravel()
    light = np.interp(np.hypot(side[:, None], side), table, np.abs(field) ** 2)
    pixels = light.reshape(2 * half + 1, points, 2 * half + 1, points).mean((1, 3))
    faintest = np.sort(pixels.ravel())[::-1][round(PIXELS) - 1] * math.pi / (4 * spread**2)
    photon = 6.62607015e-34 * 299792458.0 / WAVELENGTH
    watts = 10500 / 0.65 * photon / 10e-3  # in one pixel
    return watts / faintest / (0.9 * math.pi * DIAMETER**2 / 4)


def test_the_limit_of_dazzle_behind_a_mask_is_that_of_its_own_integral(said):
    assert dazzle(said, "mask")["at_lens"]["value"] == pytest.approx(axicon_at_the_lens(), rel=0.02)
    assert "bright_pixels" in dazzle(said, "mask")["source"]
    assert "clear round pupil" in dazzle(said, "plain lens")["source"]
    assert not any(line.startswith("No statement about dazzle") for line in said["not_said"])


def test_the_zone_of_dazzle_behind_a_mask_ends_at_its_root_with_the_interval_of_the_laws(said):
    waist = 2 * WAVELENGTH / (math.pi * 1e-3)

    def sensor(distance):  # at the peak of the clear lens, from 5 mW
        w = math.hypot(waist, 0.5e-3 * distance)
        field = quad(lambda r: math.exp(-r * r / (w * w)) * 2 * math.pi * r, 0, DIAMETER / 2)[0]
        return 5e-3 * 2 / (math.pi * w * w) * (field / (WAVELENGTH * FOCAL)) ** 2

    limit = axicon_at_the_lens() * (math.pi * DIAMETER**2 / 4 / (WAVELENGTH * FOCAL)) ** 2
    (zone,) = dazzle(said, "mask")["zones"]
    end = brentq(lambda x: math.log(sensor(math.exp(x)) / limit), math.log(20), math.log(1e6))
    # half of the 2 % of the limit
    assert zone["far"]["value"] == pytest.approx(math.exp(end), rel=0.012)
    spread = math.hypot(math.log(1.1) / 2, math.log(1.2))  # of sqrt(power) / divergence
    for name, sign in (("low", -1), ("high", 1)):
        assert zone["far"][name] == pytest.approx(
            zone["far"]["value"] * math.exp(sign * 1.645 * spread), rel=0.06
        )
    assert dazzle(said, "plain lens")["zones"][0]["far"]["value"] < zone["far"]["value"]


@pytest.mark.slow
@pytest.mark.parametrize("window", [183, 99])
def test_an_area_beyond_the_window_has_a_safe_limit_and_is_said_with_the_way_out(window, store):
    """The ring of the axicon lies at 33 pixels: the larger window holds it, the smaller one the
    core alone.
    """
    found = estimate(
        load("safety_pointer", [*SMALL, "safety.draws=100", f"wide.window=[{window}, {window}]"]),
        store,
    )
    (limit,) = (
        each for each in found.findings if each.option == "mask" and each.limit.effect == "dazzle"
    )
    assert limit.at_lens.value < axicon_at_the_lens()
    (line,) = (line for line in found.unsaid if "behind the mask" in line)
    assert "Choose a larger window" in line


@pytest.mark.parametrize(
    ("changes", "place", "fix"),
    [
        (
            ["safety.protection.pixels.mask=wide_psf"],
            "safety.protection.pixels.mask",
            "name a step of laser.bright_pix",
        ),
        (
            ["steps.laser_pixels.with.pixel_pitch=1.15 um"],
            "pixels.mask",
            "set its sensor to safety.sensor.pixel_pitch",
        ),
        (["safety.protection.pixels.mask=laser_pixel"], "pixels.mask", "laser_pixels"),
    ],
)
def test_a_step_that_does_not_rank_the_pixels_of_the_sensor_is_refused_before_the_run(
    store, changes, place, fix
):
    with pytest.raises(RecipeError) as caught:
        estimate(load("safety_pointer", [*SMALL, *changes]), store)
    (one,) = caught.value.diagnostics
    assert place in one.path
    assert re.search(re.escape(fix), one.message)
