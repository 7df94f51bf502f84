"""Dazzle of the human eye by a visible laser: the veil inside the eye, and the exposure at which it
hides a target.

Light of a laser scatters inside the eye and lays a veil over everything beside the laser. The veil
is that of the CIE general disability glare equation (CIE 146:2002). A target is hidden where its
luminance differs from the background by less than the threshold of Adrian (1989) at the luminance
of background and veil together. The largest exposure that hides no target is the maximum dazzle
exposure (MDE), and the distance where a laser has this exposure the nominal ocular dazzle distance
(NODD): Williamson and McLin, Appl. Opt. 54, 1564 (2015), define both. The formulas here are not
theirs: they have another threshold, so that their tables are not reproduced.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from neusee.nodes import ParameterError
from neusee.nodes.laser._beam import Beam
from neusee.nodes.laser._eye_limits import hazard_distance
from neusee.nodes.spectra._cie_tables import observer

LUMENS_PER_WATT = 683.0  #: at 555 nm
STEADY = 100.0  #: Hz, from which a train of pulses looks steady: above the fusion of flicker
_VISIBLE = (380e-9, 780e-9)  #: m
_GLARE = (0.1, 100.0)  #: deg, of the CIE general disability glare equation
_AGES = (23.0, 75.0)  #: years, of Adrian's factor of age
_SIZES = (1.0, 60.0)  #: arc minutes of a target
_VEILS = (1e-6, 1e9)  #: least and largest veil that is looked for, times the background
_HALVINGS = 80  #: of the logarithm of the veil


class DazzleTask(NamedTuple):
    """What a viewer has to see beside a laser, and who sees it."""

    angle: float  #: deg, between the laser and the target
    background: float  #: cd/m2, luminance behind the target
    contrast: float = 0.2  #: Weber contrast of the target, without the sign
    size: float = 10.0  #: arc minutes across the target
    age: float = 40.0  #: years
    pigmentation: float = 0.5  #: of the iris: 0 black, 0.5 brown, 1.0 to 1.2 light
    margin: float = 2.6  #: contrast that the viewer needs, over the threshold of the laboratory


def luminous_efficiency(wavelength: float) -> float:
    """Return V(lambda) of the CIE 1924 photopic observer at a wavelength in m; 0 beyond 380 to 780
    nm.

    Source: CIE 1931 2 degree observer of colour-science, whose second function it is; linear
            between 1 nm.
    """
    if not _VISIBLE[0] <= wavelength <= _VISIBLE[1]:
        return 0.0
    import torch

    wavelengths = torch.tensor([wavelength], dtype=torch.float64)
    # the second of the three colour-matching functions is V(lambda)
    return float(observer().at(wavelengths)[1, 0])


def veil_per_lux(angle: float, age: float, pigmentation: float) -> float:
    """Return the veiling luminance in cd/m2 for each lux at the eye, at an angle in degrees from a
    source of light.

    10 / a^3 + (5 / a^2 + 0.1 p / a) (1 + (age / 62.5)^4) + 0.0025 p: the CIE general disability
    glare equation, from 0.1 to 100 degrees.

    Raises ParameterError for another angle.
    Source: CIE 146:2002; Vos, Clin. Exp. Optom. 86, 363 (2003); read in public programs that agree.
    """
    if not _GLARE[0] <= angle <= _GLARE[1]:
        text = (
            f"{angle:g} deg: the glare equation of the CIE holds from {_GLARE[0]:g} to"
            f" {_GLARE[1]:g} deg"
        )
        raise ParameterError("angle", text)
    age_factor = 1 + (age / 62.5) ** 4
    return (
        10 / angle**3
        + (5 / angle**2 + 0.1 * pigmentation / angle) * age_factor
        + 0.0025 * pigmentation
    )


def threshold_luminance(background: float, size: float, age: float) -> float:
    """Return the difference of luminance in cd/m2 at which a target is just seen, in sight for 2 s
    or longer.

    (sqrt(phi) / size + sqrt(L))^2 x F(age): phi and L are functions of the background in cd/m2, for
    ``size`` in arc minutes. The target is brighter than the background.

    Raises ParameterError for a target beyond 1 to 60 arc minutes, and an age beyond 23 to 75 years.
    Source: Adrian, Lighting Res. Technol. 21, 181 (1989); read in two public programs that agree.
    """
    for name, value, (low, high), unit in (
        ("size", size, _SIZES, "arc minutes"),
        ("age", age, _AGES, "years"),
    ):
        if not low <= value <= high:
            text = (
                f"{value:g} {unit}: the threshold of Adrian holds from {low:g} to {high:g} {unit}"
            )
            raise ParameterError(name, text)
    return (_ricco(background) / size + _weber(background)) ** 2 * _age_factor(age)


def _ricco(background: float) -> float:
    """Return the square root of the flux function of Adrian for a background in cd/m2, which rules
    small targets (law of Ricco).
    """
    log_background = math.log10(background)
    if background >= 0.6:
        return math.log10(4.1925 * math.pow(background, 0.1556)) + 0.1684 * math.pow(
            background, 0.5867
        )
    if background > 0.00418:
        return math.pow(10, -0.072 + 0.3372 * log_background + 0.0866 * log_background**2)
    return math.pow(10, 0.028 + 0.173 * log_background)


def _weber(background: float) -> float:
    """Return the square root of the luminance function of Adrian for a background in cd/m2, which
    rules large targets (law of Weber).
    """
    log_background = math.log10(background)
    if background >= 0.6:
        return 0.05946 * math.pow(background, 0.466)
    if background > 0.00418:
        return math.pow(10, -1.256 + 0.319 * log_background)
    return math.pow(10, -0.891 + 0.5275 * log_background + 0.0227 * log_background**2)


def _age_factor(age: float) -> float:
    """Return how much larger the threshold is at an age in years than at 23."""
    if age <= 64:
        return (age - 19) ** 2 / 2160 + 0.99
    return (age - 56.6) ** 2 / 116.3 + 1.43


def dazzle_illuminance(task: DazzleTask) -> float:
    """Return the illuminance of the eye in lux at which the veil just hides a target, or 0 for one
    that is never seen.

    The target differs by contrast x background, with and without the veil. Its threshold is that at
    the luminance of background and veil together, times the margin.

    Raises ParameterError as `veil_per_lux` and `threshold_luminance`, and for a background that is
    not above 0.
    """
    if not task.background > 0:
        raise ParameterError("background", f"{task.background:g} cd/m2: give a background above 0")
    veil_of_lux = veil_per_lux(task.angle, task.age, task.pigmentation)
    difference = task.contrast * task.background

    def is_seen(veil: float) -> bool:
        total_luminance = task.background * (1 + veil)
        return difference >= task.margin * threshold_luminance(total_luminance, task.size, task.age)

    seen_veil, hiding_veil = _VEILS
    if not is_seen(seen_veil):
        return 0.0
    # bisection of the logarithm of the veil, in units of the background
    for _ in range(_HALVINGS):
        middle = math.sqrt(seen_veil * hiding_veil)
        seen_veil, hiding_veil = (middle, hiding_veil) if is_seen(middle) else (seen_veil, middle)
    return seen_veil * task.background / veil_of_lux


def maximum_dazzle_exposure(wavelength: float, task: DazzleTask) -> float:
    """Return the irradiance of the eye in W/m2 up to which a laser does not hide a target (MDE); 0:
    never seen.

    E = lux / (683 V(lambda)).

    Raises ParameterError for a wavelength that the eye does not see, and as `dazzle_illuminance`.
    """
    efficiency = luminous_efficiency(wavelength)
    if efficiency <= 0:
        text = (
            f"{wavelength * 1e9:g} nm is not visible: dazzle of the eye is known from 380 to 780 nm"
        )
        raise ParameterError("wavelength", text)
    return dazzle_illuminance(task) / (LUMENS_PER_WATT * efficiency)


def nominal_ocular_dazzle_distance(beam: Beam, limit: float, transmittance: float = 1.0) -> float:
    """Return the distance in m beyond which the irradiance on the axis is below a limit in W/m2
    (NODD), or 0.

    A train of pulses counts with its mean power: above the fusion of flicker it looks as steady as
    its mean.

    Raises ParameterError for a beam without a mean power that looks steady: see `unsteady`.
    """
    if reason := unsteady(beam):
        raise ParameterError("repetition_rate", reason)
    steady = beam._replace(pulse_energy=None, pulse_duration=None, repetition_rate=None)
    return hazard_distance(steady, limit, transmittance=transmittance)


def unsteady(beam: Beam) -> str:
    """Return why the light of a beam does not look steady, or an empty text for light that does."""
    if not beam.is_pulsed:
        return ""
    if beam.repetition_rate is None:
        return "a single pulse dazzles as a flash, for which no model is here"
    if beam.repetition_rate < STEADY:
        flicker_text = f"pulses at {beam.repetition_rate:g} Hz flicker, for which no model is here"
        return f"{flicker_text} (from {STEADY:g} Hz on their mean counts)"
    return ""
