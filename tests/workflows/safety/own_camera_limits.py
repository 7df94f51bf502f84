"""Distances of damage, saturation and eye of a Gaussian beam and a plain lens, without a line of
the project.

With |U|^2 of `own_camera_spots` at v = pi D r / (lambda f), the sensor has for each watt of the
laser

    E(v) = tau T 2 / (pi w^2) (pi D^2 / (4 lambda f))^2 |U(v)|^2

Damage is expected where the peak reaches the published threshold, or where the hottest point is as
warm as under the published Gaussian spot at its threshold. A pixel is full where the mean over its
area fills it. All quantities are in SI units; every setting may be an array of draws.
"""

import math
from collections.abc import Mapping

import numpy as np

from tests.workflows.safety.own_camera_spots import Floats, Spots, envelope

Settings = Mapping[str, float | Floats]
PLANCK_LIGHT = 6.62607015e-34 * 299792458.0
DIFFUSIVITY = 8.8e-5  # m2/s of silicon
GREEN_SPOT, PULSE, STEADY = 25.7e-6, 1e3, 10**8.5  # m, J/m2 up to 10 ns, W/m2 from 10 us on
PLACES = (-1, 0, 1)  # lower end, middle and upper end of the published bracket
#: extinction of silicon (Green 2008) at 50 nm steps from 400 nm, and its end
SILICON = (0.296, 0.0863, 0.0442, 0.0280, 0.0199, 0.0144, 0.0105, 7.82e-3, 5.41e-3, 3.61e-3, 2.17e-3, 1.18e-3,
           5.09e-4, 1.36e-4, 3.06e-5)  # fmt: skip


def waist_of(given: Settings) -> float | Floats:
    """Return the 1/e2 radius where the beam leaves the laser."""
    if "waist" in given:
        return given["waist"]
    return 2 * given["wavelength"] / (math.pi * given["divergence"])


def beam_at(given: Settings, metres: Floats) -> tuple[Floats, Floats]:
    """Return the radius of the beam and the curvature of its wavefront."""
    waist = waist_of(given)
    rayleigh = 2 * waist / given["divergence"]
    return np.hypot(waist, given["divergence"] * metres / 2), metres / (metres**2 + rayleigh**2)


def haze(given: Settings, metres: Floats) -> Floats | float:
    """Return the transmittance of air by Kim's law."""
    if "visibility" not in given:
        return 1.0
    km = np.asarray(given["visibility"]) / 1e3
    laws = [1.6 + 0 * km, 1.3 + 0 * km, 0.16 * km + 0.34, km - 0.5]
    exponent = np.select([km > 50, km > 6, km > 1, km > 0.5], laws, 0.0)
    per_km = 3.912 / km * (np.asarray(given["wavelength"]) / 550e-9) ** -exponent
    return np.exp(-per_km * metres / 1e3)


def taper_and_defocus(given: Settings, metres: Floats) -> tuple[Floats, Floats]:
    """Return (D / 2 w)^2 and the waves of defocus at the rim, without their sign."""
    radius, curvature = beam_at(given, metres)
    fill = (given["diameter"] / (2 * radius)) ** 2
    if given["focus"] == 0:  # always on the laser
        return fill, np.zeros_like(fill)
    distance = curvature - 1 / given["focus"]
    waves = given["diameter"] ** 2 / (8 * given["wavelength"]) * distance
    return fill, np.abs(waves + given["defocus"] * 550e-9 / given["wavelength"])


def axis_unit(given: Settings, metres: Floats) -> Floats:
    """Return E over |U|^2 for each watt, 1/m2."""
    radius, _ = beam_at(given, metres)
    lens = math.pi * given["diameter"] ** 2 / (4 * given["wavelength"] * given["focal_length"])
    return given["transmittance"] * haze(given, metres) * 2 / (math.pi * radius**2) * lens**2


def absorbed(wavelength: float) -> float:
    """Return the share that 3 um of silicon absorb."""
    extinction = np.interp(wavelength * 1e9, np.arange(400, 1101, 50), np.log(SILICON))
    return float(-np.expm1(-4 * math.pi * np.exp(extinction) / wavelength * 3e-6))


def reach_of_heat(diameter: Floats | float, seconds: Floats | float) -> Floats:
    """Return the heat of a Gaussian spot for equal irradiance, in metres."""
    radius = np.asarray(diameter, float) / 2
    return radius * np.arctan(np.sqrt(8 * DIFFUSIVITY * np.asarray(seconds, float)) / radius)


def fluence(seconds: Floats | float, diameter: Floats, place: int) -> Floats:
    """Return the green threshold in J/m2: an end or the middle of the published bracket, for a
    heated spot.
    """
    time = np.asarray(seconds, float)

    def steady(when: Floats) -> Floats:
        wide = reach_of_heat(GREEN_SPOT, when) / reach_of_heat(
            np.maximum(diameter, GREEN_SPOT), when
        )
        return STEADY * when * wide

    join = steady(np.full_like(time, 1e-5))
    start = np.minimum(PULSE, join)
    share = np.clip(np.log10(np.minimum(time, 1e-5) / 1e-8) / 3, 0, None)
    curve = start * (join / start) ** share
    long = np.where(time >= 1e-5, steady(np.maximum(time, 1e-5)), 0.0)
    middle = np.where(time >= 1e-5, long, curve)
    if place == 0:
        return middle
    return np.maximum(curve * 40 ** (place / 2), steady(time) * 10 ** (place / 2))


def colour_factor(wavelength: float, place: int) -> float:
    """Return the factor of the wavelength on an end of the bracket."""
    alone = absorbed(532e-9) / absorbed(wavelength)
    return min(1.0, alone) if place < 0 else max(1.0, alone) if place > 0 else 1.0


def damage_ratios(given: Settings, metres: Floats, spots: Spots, place: int) -> dict[str, Floats]:
    """Return exposure over threshold of each part of the light, with the bracket at one of its
    places.
    """
    fill, waves = taper_and_defocus(given, metres)
    bound, unit = envelope(fill, waves), axis_unit(given, metres)
    peak = spots.peak * bound
    scale = given["wavelength"] * given["focal_length"] / (math.pi * given["diameter"])
    heated = 2 * math.sqrt(8 / math.pi) * scale * spots.heat / spots.peak
    colour = colour_factor(float(np.mean(given["wavelength"])), place)
    dwell = np.asarray(given["dwell"], float)
    steady = fluence(dwell, heated, place) * colour / dwell
    if "power" in given:
        return {"mean": given["power"] * unit * peak / steady}
    seconds = np.minimum(given["duration"], dwell)
    share = seconds / given["duration"]
    rate = np.maximum(given.get("rate", 0.0), 1 / dwell)
    dose = given["energy"] * unit * peak * share
    once = dose / (fluence(seconds, heated, place) * colour)
    mean = dose * rate / steady
    return {
        "pulse": once,
        "mean": mean,
        "accumulation": once * (1 - np.minimum(1, seconds * rate)) + mean,
    }


def saturation_ratio(given: Settings, metres: Floats, spots: Spots) -> Floats:
    """Return the electrons of the brightest pixel within one exposure over the full well."""
    fill, waves = taper_and_defocus(given, metres)
    core = spots.pixel * envelope(fill, waves) * axis_unit(given, metres) * (1 - given["scatter"])
    exposure = given["exposure"]
    if "power" in given:
        joule = given["power"] * exposure
    else:
        joule = given["energy"] * np.maximum(1.0, given.get("rate", 0.0) * np.asarray(exposure))
    photons = joule * core * given["pixel"] ** 2 * given["wavelength"] / PLANCK_LIGHT
    return photons * given["efficiency"] / given["well"]


def eye_exposure(wavelength: float, seconds: float) -> float:
    """Return the largest exposure in J/m2 by IEC 60825-1 of a small source, without its
    blue-light rule.
    """
    nm = wavelength * 1e9
    if nm >= 1400:
        return (
            1e4
            if 1500 <= nm < 1800
            else 5600 * max(seconds, 1e-3) ** 0.25
            if seconds > 1e-3
            else 1e3
        )
    infrared = 10 ** (0.002 * (nm - 700)) if nm > 700 else 1.0
    water = 10 ** (0.018 * (nm - 1150)) if nm > 1150 else 1.0
    if nm >= 1050:
        return 2e-2 * water if seconds <= 13e-6 else 90 * water * seconds**0.75
    return 2e-3 * infrared if seconds <= 5e-6 else 18 * infrared * seconds**0.75


def eye_distance(given: Settings) -> Floats | float:
    """Return the distance from which on an eye is safe in clear air, of continuous light or of a
    single pulse.
    """
    wavelength = float(np.mean(given["wavelength"]))
    visible = wavelength < 700e-9
    seconds = (0.25 if visible else 10.0) if "power" in given else float(np.mean(given["duration"]))
    limit = eye_exposure(wavelength, seconds)
    joule = given["power"] * seconds if "power" in given else given["energy"]
    aperture = (
        7e-3
        if wavelength < 1400e-9
        else 1e-3
        if seconds <= 0.35
        else 1.5e-3 * min(seconds, 10.0) ** 0.375
    )
    share = math.pi * aperture**2 / 4 * limit / np.asarray(joule, float)
    square = np.where(share < 1, -(aperture**2) / 2 / np.log1p(-np.minimum(share, 1 - 1e-15)), 0.0)
    return (
        2 / given["divergence"] * np.sqrt(np.maximum(square - np.asarray(waist_of(given)) ** 2, 0))
    )


def zones(metres: Floats, ratio: Floats) -> list[tuple[Floats, Floats]]:
    """Return the near and far ends of the intervals with a ratio above 1, for each row."""
    height, at, found = np.log(np.maximum(ratio, 1e-300)), np.log(metres), []
    for row in height:
        inside = np.concatenate([[False], row >= 0, [False]])
        first, last = (
            np.flatnonzero(inside[1:] & ~inside[:-1]),
            np.flatnonzero(inside[:-1] & ~inside[1:]) - 1,
        )
        near = [_between(at, row, k - 1, k) if k else at[0] for k in first]
        far = [_between(at, row, k, k + 1) if k < len(at) - 1 else at[-1] for k in last]
        found.append((np.exp(near), np.exp(far)))
    return found


def _between(at: Floats, row: Floats, low: int, high: int) -> float:
    return float(at[low] + (at[high] - at[low]) * row[low] / (row[low] - row[high]))
