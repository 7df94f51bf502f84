"""The worked recipes of `neusee safety` against SciPy integrals and roots that share no line with neusee."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from scipy.optimize import brentq
from scipy.special import j1

from neusee.workflows import load
from neusee.workflows.safety.run_safety import document
from neusee.workflows.safety.safety_estimate import estimate

PLANCK_LIGHT = 6.62607015e-34 * 299792458.0
KAPPA = 148 / (2330 * 710)  #: m2/s, of silicon


@dataclass(frozen=True)
class Situation:
    """A laser, its distance, a lens and a sensor, typed from the recipe once more."""

    nm: float
    emitted: float  #: W, or J of a pulse
    waist: float
    divergence: float
    distance: float
    focal: float
    diameter: float
    per_km: float = 0.0  #: extinction of the air

    def radius(self, distance: float) -> float:
        return math.hypot(self.waist, self.divergence * distance / 2)

    def air(self, distance: float) -> float:
        return math.exp(-self.per_km * distance / 1e3)

    def lens(self, distance: float) -> float:
        """Exposure on the axis: the Gaussian whose integral over the plane is the emitted light."""
        w = self.radius(distance)
        whole = quad(lambda r: math.exp(-2 * r * r / (w * w)) * 2 * math.pi * r, 0, 8 * w)[0]
        return self.emitted * self.air(distance) / whole

    def sensor(self, distance: float, diameter: float | None = None) -> float:
        """Peak exposure: the Fraunhofer integral of the field over the aperture, at the centre, through 0.9."""
        w = self.radius(distance)
        field = quad(lambda r: math.exp(-r * r / (w * w)) * 2 * math.pi * r, 0, (diameter or self.diameter) / 2)[0]
        return 0.9 * self.lens(distance) * (field / (self.nm * 1e-9 * self.focal)) ** 2

    def spot(self, distance: float) -> float:
        """1/e2 diameter of the Gaussian spot with the same heat in its centre as the diffraction pattern."""
        w, a = self.radius(distance), self.diameter / 2
        rho = np.linspace(0, a, 801)
        weight = np.exp(-((rho / w) ** 2)) * rho
        reach = 40 * self.nm * 1e-9 * self.focal / min(self.diameter, 2 * w)
        at = np.linspace(0, reach, 4001)
        from scipy.special import j0

        rows = np.array(
            [np.trapezoid(weight * j0(2 * math.pi * r * rho / (self.nm * 1e-9 * self.focal)), rho) for r in at]
        )
        line = np.trapezoid((rows / rows[0]) ** 2, at)
        return 2 * line / math.sqrt(math.pi / 8)

    def beyond(self, limit: float, aperture: float) -> float:
        """Distance where the mean over an aperture has fallen to a limit, in clear air."""

        def over(distance: float) -> float:
            w = self.radius(distance)
            inside = -math.expm1(-(aperture**2) / (2 * w * w))
            return math.log(self.emitted * inside / (math.pi * aperture**2 / 4) / limit)

        return brentq(over, 1e-3, 1e6)


def heat(diameter: float, seconds: float) -> float:
    """Warming of the centre of a Gaussian spot after a time, by integrating the heat kernel over time."""
    w = diameter / 2
    return quad(lambda root: 2 * w * w / (w * w + 8 * KAPPA * root * root), 0, math.sqrt(seconds), limit=400)[0]


def airy_share(spread: float) -> float:
    """Mean of the Airy pattern over the middle pixel, over its peak."""

    def airy(y: float, x: float) -> float:
        v = math.pi / spread * math.hypot(y, x)
        return 1.0 if v < 1e-9 else (2 * j1(v) / v) ** 2

    return 4 * dblquad(airy, 0, 0.5, 0, 0.5, epsabs=1e-9)[0]


def dazzling(
    spread: float, pixels: float, well: float, efficiency: float, seconds: float, pitch: float, nm: float
) -> float:
    """Peak irradiance on the sensor at which the mean wings of the Airy pattern fill a number of pixels."""
    joules = well / efficiency * PLANCK_LIGHT / (nm * 1e-9)
    full = joules / (pitch * pitch * seconds)
    radius = math.sqrt(pixels / math.pi)  # in pixels, where the mean wing equals saturation
    v = math.pi * radius / spread
    return full * math.pi * v**3 / 4


M2 = 2 * 532e-9 * 2 / (math.pi * 3e-3)
SITUATIONS = {
    "safety_pointer": Situation(532, 5e-3, 2 * 532e-9 / (math.pi * 1e-3), 1e-3, 100, 50e-3, 12e-3),
    "safety_car_lidar": Situation(905, 0.4e-6, 2.5e-3, 2e-3, 5, 6e-3, 3e-3),
    "safety_car_lidar_1550": Situation(1550, 5e-6, 2e-3, 1e-3, 3, 35e-3, 12.5e-3),
    "safety_drone_dazzler": Situation(532, 5.0, 5e-3, 1.5e-3, 500, 4.5e-3, 1.6e-3, 3.912 / 8 * (550 / 532) ** 1.3),
    "safety_laboratory": Situation(532, 1e-3, 3e-3, M2, 2, 25e-3, 9e-3),
    "safety_show": Situation(520, 5.0, 2e-3, 1.5e-3, 50, 5.4e-3, 3e-3),
}
#: continuous light: median of the published bracket, 10 to 100 kW/cm2, for a spot of 25.7 um, and the dwell in s
CONTINUOUS = {"safety_pointer": 1.0, "safety_drone_dazzler": 1.0, "safety_show": 2e-3}
#: limit of the eye in W/m2 or J/m2, and the diameter over which it is averaged: IEC 60825-1:2014, worked by hand
EYES = {
    "safety_pointer": (18 * 0.25**-0.25, 7e-3),
    "safety_car_lidar": (2e-3 * 10 ** (0.002 * 205) * 1e6**-0.25, 7e-3),
    "safety_car_lidar_1550": (1000 * 10 / 2e6, 1e-3),
    "safety_drone_dazzler": (18 * 0.25**-0.25, 7e-3),
    "safety_laboratory": (2e-3, 7e-3),
    "safety_show": (18 * 2e-3**-0.25, 7e-3),
}
#: share of the picture x pixels, full well, efficiency, exposure, pitch
FIELDS = {
    "safety_pointer": (0.1 * 1536 * 2048, 10500, 0.65, 10e-3, 3.45e-6),
    "safety_car_lidar": (0.01 * 1080 * 1920, 12000, 0.25, 5e-3, 3e-6),
    "safety_drone_dazzler": (0.01 * 3000 * 4000, 6000, 0.6, 1e-3, 1.55e-6),
    "safety_laboratory": (0.1 * 1536 * 2048, 10500, 0.65, 10e-3, 3.45e-6),
    "safety_show": (0.1 * 3000 * 4000, 6000, 0.7, 10e-3, 1.4e-6),
}
#: J/cm2 of each law of pulses, as published or as the table of examples says
PULSES = {
    "safety_car_lidar": [0.2, 100.0],
    "safety_car_lidar_1550": [1.0],
    "safety_laboratory": [0.1, 100.0, 78.9e-3, 241.9e-3, 2.0054],
}


@pytest.fixture(scope="module", params=SITUATIONS)
def worked(request):
    """The situation, and what neusee says behind the plain lens, without the mask, which takes time."""
    recipe = load(request.param, ["safety.protection.mask=null", "safety.draws=100", "optics.samples=512"])
    said = document(estimate(recipe))
    plain = [each for each in said["limits"] if each["protection"] == "plain lens"]
    return request.param, SITUATIONS[request.param], said, plain


def test_exposure_at_the_lens_and_on_the_sensor(worked):
    name, here, said, plain = worked
    assert said["distance"] == here.distance
    assert said["share_at_the_lens"] * here.emitted == pytest.approx(here.lens(here.distance), rel=1e-6)
    damage = [each for each in plain if each["effect"] == "damage"]
    assert len(damage) == len(PULSES.get(name, [0]))
    for each in damage:
        assert each["exposure"]["value"] == pytest.approx(here.sensor(here.distance), rel=1e-6)


def test_pulses_meet_the_fluences_of_their_laws_and_the_ends_are_roots(worked):
    name, here, _, plain = worked
    damage = [each for each in plain if each["effect"] == "damage" and each["quantity"] == "fluence"]
    assert len(damage) == len(PULSES.get(name, []))
    for joules, each in zip(PULSES.get(name, []), damage, strict=True):
        limit = joules * 1e4
        assert each["on_sensor"]["value"] == pytest.approx(limit)
        ratio = here.lens(here.distance) / here.sensor(here.distance)
        assert each["at_lens"]["value"] == pytest.approx(limit * ratio, rel=1e-6)
        if not each["zones"]:
            assert max(map(here.sensor, np.geomspace(0.1, 1e4, 60))) < limit
            continue
        end = brentq(lambda x, limit=limit: math.log(here.sensor(math.exp(x)) / limit), math.log(1), math.log(1e6))
        if each["zones"][-1]["ends_beyond"]:
            assert end > math.log(1e4)
        else:
            assert each["zones"][-1]["far"]["value"] == pytest.approx(math.exp(end), rel=2e-3)


def test_continuous_light_meets_the_published_bracket_by_equal_heat(worked):
    name, here, _, plain = worked
    damage = [each for each in plain if each["effect"] == "damage" and each["quantity"] == "irradiance"]
    assert len(damage) == (name in CONTINUOUS)
    for each in damage:
        seconds = CONTINUOUS[name]
        limit = 1e4 * math.sqrt(10e3 * 100e3) * heat(25.7e-6, seconds) / heat(here.spot(here.distance), seconds)
        assert each["on_sensor"]["value"] == pytest.approx(limit, rel=0.02)
        assert each["ratio"] == pytest.approx(here.sensor(here.distance) / limit, rel=0.02)


def test_dazzle_is_that_of_the_wings_of_the_airy_pattern(worked):
    name, here, said, plain = worked
    dazzle = [each for each in plain if each["effect"] == "dazzle"]
    if name not in FIELDS:
        assert dazzle == []
        assert any("no quantum efficiency" in line for line in said["not_said"])
        return
    pixels, well, efficiency, seconds, pitch = FIELDS[name]
    spread = here.nm * 1e-9 * here.focal / here.diameter / pitch
    limit = dazzling(spread, pixels, well, efficiency, seconds, pitch, here.nm)
    found = dazzle[0]
    assert found["on_sensor"]["value"] == pytest.approx(limit, rel=1e-3)
    in_frame = {"safety_car_lidar": 1e5, "safety_laboratory": 1 / seconds}.get(name, 1.0)
    assert found["exposure"]["value"] == pytest.approx(here.sensor(here.distance) * in_frame, rel=1e-6)


def test_the_eye_has_its_own_limit_and_distance(worked):
    name, here, said, _ = worked
    limit, aperture = EYES[name]
    assert said["eye"]["limit"] == pytest.approx(limit, rel=1e-3)
    assert said["eye"]["distance"]["value"] == pytest.approx(here.beyond(limit, aperture), rel=1e-3)


@pytest.mark.slow
def test_the_ends_of_the_show_have_the_interval_of_their_laws():
    """Far away the end of a zone is proportional to sqrt(power / limit) / divergence, all of them lognormal."""
    said = document(
        estimate(
            load(
                "safety_show",
                [
                    "safety.protection.mask=null",
                    "safety.draws=4000",
                    "safety.protection.stop=null",
                    "optics.samples=512",
                ],
            )
        )
    )
    far = said["limits"][0]["zones"][0]["far"]
    bracket = math.log(10 ** (0.5 / 1.6448536269514722))
    spread = math.sqrt((math.log(1.1) ** 2 + 2 * bracket**2) / 4 + math.log(1.2) ** 2)
    low, high = (far["value"] * math.exp(sign * 1.6448536 * spread) for sign in (-1, 1))
    assert (far["low"], far["high"]) == (pytest.approx(low, rel=0.08), pytest.approx(high, rel=0.08))


def test_a_filter_and_a_stop_move_the_limits_as_they_must():
    here = SITUATIONS["safety_laboratory"]
    said = document(
        estimate(load("safety_laboratory", ["safety.protection.mask=null", "safety.draws=100", "optics.samples=512"]))
    )
    first = {each["protection"]: each for each in reversed(said["limits"]) if each["limit"] == "damage: point"}
    plain, filtered, stopped = (
        first[name]["exposure"]["value"] for name in ("plain lens", "grey filter 0.0001", "stop 1 mm")
    )
    assert filtered == pytest.approx(1e-4 * plain)
    assert stopped == pytest.approx(here.sensor(here.distance, 1e-3), rel=1e-6)


def test_the_mask_divides_the_peak_by_its_ratio():
    recipe = load("safety_pointer", ["safety.draws=100", "optics.samples=512", "safety.dazzle=null"])
    found = estimate(recipe)
    result = recipe.run(outputs=[f"laser_lsr[{arm},pointer]" for arm in ("plain", "mask")])
    ratio = float(result["laser_lsr[mask,pointer]"].max() / result["laser_lsr[plain,pointer]"].max())
    at = found.at
    assert found.exposures.sensor["mask"][0, at] == pytest.approx(ratio * found.exposures.sensor["plain lens"][0, at])
    assert 1e-4 < ratio < 0.1
