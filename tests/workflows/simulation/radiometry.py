"""Radiometry by SciPy alone: electrons of a laser in watts and of a white wall in lux, from
text-book integrals.

Nothing of neusee is imported, so that a test compares two computations that share no line.
"""

import math

import numpy as np
from scipy import integrate, special

PLANCK, LIGHT = 6.62607015e-34, 299792458.0
LENS = {"diameter": 540 * 14.96e-6, "focal": 0.11, "transmittance": 0.9}
PIXEL = 2.9e-6


def beam_at_lens(wavelength, laser):
    """1/e2 radius and curvature radius of the beam at the lens, by the complex beam parameter of
    the embedded beam.
    """
    stretch = math.sqrt(2) if laser.get("convention") == "1/e" else 1.0
    quality, least = laser.get("m_squared", 1.0), wavelength / math.pi
    waist, divergence = laser.get("waist"), laser.get("divergence")
    half = None if divergence is None else divergence * stretch / 2
    waist = quality * least / half if waist is None else waist * stretch
    half = quality * least / waist if half is None else half
    rayleigh = waist / half
    q = laser["distance"] + 1j * rayleigh
    return waist * abs(q) / rayleigh, 1 / (1 / q).real


def mean_power(laser, exposure):
    """Power of a laser, mean over an exposure, by counting pulses one by one."""
    if "pulse_duration" not in laser:
        return laser["power"]
    energy = laser.get("pulse_energy", laser.get("power", 0.0) / laser.get("repetition_rate", 1.0))
    delay, duration, rate = (
        laser.get("pulse_delay", 0.0),
        laser["pulse_duration"],
        laser.get("repetition_rate"),
    )
    numbers = [0] if rate is None else range(-2, int(exposure * rate) + 3)
    caught = 0.0
    for number in numbers:
        begin = delay + (number / rate if rate else 0.0)
        caught += max(0.0, min(exposure, begin + duration) - max(0.0, begin)) / duration
    return energy * caught / exposure


def haze(wavelength, laser):
    """Transmittance of the air: as given, or by Koschmieder with the exponents of Kruse or Kim."""
    if "visibility" not in laser:
        return laser.get("air_transmittance", 1.0)
    km = laser["visibility"] / 1e3
    q = 1.3 if km > 6 else 0.585 * km ** (1 / 3) if laser["haze"] == "kruse" else 0.16 * km + 0.34
    return 10 ** (
        -3.912
        / math.log(10)
        / laser["visibility"]
        * (wavelength / 550e-9) ** -q
        * laser["distance"]
    )


def irradiance(wavelength, laser, radii, exposure, points=600):
    """Irradiance on the sensor in W/m2 at distances from the middle of the spot: the Hankel
    integral of the pupil.
    """
    w, curvature = beam_at_lens(wavelength, laser)
    axis = 2 * mean_power(laser, exposure) * haze(laser["wavelength"], laser) / (math.pi * w**2)
    node, weight = special.roots_legendre(points)
    a = LENS["diameter"] / 2
    rho, weight = a * (node + 1) / 2, weight * a / 2
    k = 2 * math.pi / wavelength
    field = (
        np.sqrt(axis) * np.exp(-((rho / w) ** 2) + 1j * k * rho**2 / (2 * curvature)) * rho * weight
    )
    bessel = special.j0(k * np.outer(radii, rho) / LENS["focal"])
    return (
        LENS["transmittance"]
        * np.abs(2 * math.pi * bessel @ field / (wavelength * LENS["focal"])) ** 2
    )


def sampled_irradiance(wavelength, laser, y, x, exposure, samples=540):
    """Irradiance on the sensor in W/m2 at the places (y, x) by a sum over the samples of the pupil
    inside its rim.

    The rim is a staircase, whose samples stand for the area of the disc.
    """
    w, curvature = beam_at_lens(wavelength, laser)
    axis = 2 * mean_power(laser, exposure) * haze(laser["wavelength"], laser) / (math.pi * w**2)
    at = (np.arange(samples) - (samples - 1) / 2) * LENS["diameter"] / samples
    square = at[:, None] ** 2 + at**2
    inside = square <= LENS["diameter"] ** 2 / 4
    field = inside * np.exp(-square / w**2 + 1j * math.pi / wavelength * square / curvature)
    rows, columns = (
        np.exp(-2j * math.pi / (wavelength * LENS["focal"]) * np.outer(to, at)) for to in (y, x)
    )
    step = math.pi * LENS["diameter"] ** 2 / 4 / inside.sum() * (LENS["diameter"] / samples) ** 2
    return (
        LENS["transmittance"]
        * axis
        * step
        * np.abs(rows @ field @ columns.T / (wavelength * LENS["focal"])) ** 2
    )


def electrons(laser, radii, exposure, efficiency):
    """Electrons of a pixel at its centre, at distances from the middle of the spot."""
    return line_electrons(
        laser, exposure, efficiency, lambda nm: irradiance(nm, laser, radii, exposure)
    )


def line_electrons(laser, exposure, efficiency, light, nodes=9):
    """Electrons of pixels: the Gaussian line times photons per joule times quantum efficiency."""
    sigma = laser["fwhm"] / (2 * math.sqrt(2 * math.log(2)))
    x, weight = special.roots_hermitenorm(nodes)
    wavelengths = laser["wavelength"] + x * sigma
    return sum(
        share * efficiency(nm) * nm / (PLANCK * LIGHT) * light(nm) * exposure * PIXEL**2
        for nm, share in zip(wavelengths, weight / weight.sum(), strict=True)
    )


def white_electrons(lux, spectrum, luminous, efficiency, band, exposure):
    """Electrons of a pixel on the image of a white wall: lux to candela, to watts through 683
    lm/W, to the sensor.
    """
    nm = np.arange(360, 831) * 1e-9
    watts = lux / math.pi / (683 * integrate.trapezoid(spectrum(nm) * luminous(nm), nm))
    fine = np.linspace(*band, 6001)
    solid = math.pi * LENS["diameter"] ** 2 / 4 / LENS["focal"] ** 2
    photons = (
        watts
        * spectrum(fine)
        * fine
        / (PLANCK * LIGHT)
        * solid
        * LENS["transmittance"]
        * exposure
        * PIXEL**2
    )
    return integrate.trapezoid(photons * efficiency(fine), fine)
