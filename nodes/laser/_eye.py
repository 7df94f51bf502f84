"""Laser safety of the human eye: exposure limits, hazard distances, and dazzle by a visible
laser.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple, get_args

from neusee.nodes import ParameterError
from neusee.nodes.laser._beam import Beam
from neusee.nodes.spectra._cie_tables import observer

# --- eye limits -----------------------------------------------------------------------------------

# Exposure limits of the human eye for a small source, and the distance at which a laser reaches
# them.
#
# The limits are those of IEC 60825-1:2014, Table A.1 (ICNIRP 2013, ANSI Z136.1-2014): a source that
# the eye sees under less than 1.5 mrad. They are written out here from the formulas, and are an
# estimate, no certificate. Ultraviolet light, pulses below 10 ps and extended sources are refused.
# Trains of pulses follow below.


BLINK = 0.25  #: s, duration of the aversion response to visible light
_SHORTEST_EXPOSURE, _LONGEST_EXPOSURE = 1e-11, 3e4  #: s, range of exposure durations
_SHORTEST_WAVELENGTH, _LONGEST_WAVELENGTH = 400e-9, 100e-6  #: m


def eye_mpe(wavelength: float, duration: float) -> float:
    """Return the maximum permissible exposure (MPE) of the eye in J/m2, for one exposure of a
    duration in s.

    Divided by the duration it is the maximum permissible irradiance. It is compared with the
    exposure averaged over the limiting aperture of `eye_aperture`.

    From 400 to 1400 nm (retina, small source): below 1050 nm 2e-3 C_A J/m2 up to 5 us, then 18 C_A
    t^0.75 up to 10 s; from 1050 nm 2e-2 C_C up to 13 us, then 90 C_C t^0.75 up to 10 s; beyond 10 s
    10 C_A C_C W/m2. C_A = 10^(0.002 (nm - 700)) from 700 nm and 5 from 1050 nm; C_C =
    10^(0.018 (nm - 1150)) from 1150 nm and 8 + 10^(0.04 (nm - 1250)) from 1200 nm. Below 500 nm and
    beyond 10 s the limit is at most 100 C_3 J/m2 up to 100 s, then C_3 W/m2, with C_3 =
    10^(0.02 (nm - 450)) from 450 nm (photochemical). From 700 nm it is at most the limit of the
    skin, which protects cornea and lens.

    From 1400 nm (cornea): 1e3 J/m2 up to 1 ms (1500 to 1800 nm 1e4 J/m2 up to 10 s; from 2600 nm
    100 J/m2 up to 0.1 us), then 5600 t^0.25 up to 10 s and 1000 W/m2.

    Raises ParameterError for a wavelength or a duration beyond these formulas.
    Source: IEC 60825-1:2014, Tables A.1 and A.5; ICNIRP, Health Phys. 105, 271 (2013).
    """
    return _strictest(wavelength, duration).limit


def eye_mpe_formula(wavelength: float, duration: float) -> str:
    """Return the formula, in J/m2, that `eye_mpe` uses, with its numbers inserted, such as
    ``18 * 1 * 0.25**0.75``.

    Raises ParameterError as `eye_mpe` does.
    """
    return _strictest(wavelength, duration).formula


class _Law(NamedTuple):
    """A limit of the radiant exposure in J/m2, and its formula with the numbers inserted."""

    limit: float
    formula: str


def _strictest(wavelength: float, duration: float) -> _Law:
    """Return the strictest limit of the exposure of the eye at a wavelength in m for a duration in
    s.
    """
    _refuse_unknown(wavelength, duration)
    nm = wavelength * 1e9
    if nm >= 1400:
        return _cornea(nm, duration)
    retina = _retina(nm, duration)
    return retina if nm < 700 else min(retina, _skin(nm, duration))


def _power_law(factor: float, weight: float, duration: float, exponent: float) -> _Law:
    """Return the limit factor x weight x duration^exponent in J/m2."""
    limit = factor * weight * math.pow(duration, exponent)
    return _Law(limit, f"{factor:g} * {weight:.7g} * {duration:.7g}**{exponent:g}")


def _constant_law(factor: float, weight: float, duration: float, full: float) -> _Law:
    """Return the limit factor x weight in J/m2; below a duration of ``full`` s it falls in
    proportion to the duration (a constant irradiance).
    """
    if duration >= full:
        return _Law(factor * weight, f"{factor:g} * {weight:.7g}")
    return _Law(
        factor * weight * duration / full, f"{factor:g} * {weight:.7g} * {duration:.7g} / {full:g}"
    )


def _refuse_unknown(wavelength: float, duration: float) -> None:
    """Raise ParameterError for a wavelength or a duration for which this module has no formula."""
    if not _SHORTEST_WAVELENGTH <= wavelength <= _LONGEST_WAVELENGTH:
        text = (
            f"no exposure limit of the eye at {wavelength * 1e9:g} nm: 400 nm to 100 um are known"
            " here"
        )
        raise ParameterError("wavelength", f"{text}; take the limit from the standard")
    if not _SHORTEST_EXPOSURE <= duration <= _LONGEST_EXPOSURE:
        text = f"no exposure limit of the eye for {duration:g} s: 10 ps to 30 000 s are known here"
        raise ParameterError("duration", f"{text}; take the limit from the standard")


def _infrared_factors(nm: float) -> tuple[float, float]:
    """Return the factors C_A and C_C of the standard at a wavelength in nm; both are 1 for visible
    light and raise the limit in the infrared, where less light reaches the retina.
    """
    c_a = 5.0
    if nm < 700:
        c_a = 1.0
    elif nm < 1050:
        c_a = math.pow(10, 0.002 * (nm - 700))
    if nm < 1150:
        return c_a, 1.0
    if nm < 1200:
        return c_a, math.pow(10, 0.018 * (nm - 1150))
    return c_a, 8 + math.pow(10, 0.04 * (nm - 1250))


def _retina(nm: float, duration: float) -> _Law:
    """Return the limit of the retina in J/m2 from 400 to 1400 nm, for a small source: thermal, and
    photochemical below 500 nm.
    """
    c_a, c_c = _infrared_factors(nm)
    if duration >= 10:
        # beyond 10 s: constant irradiances in W/m2 times the duration
        heat_limit = _power_law(10, c_a * c_c, duration, 1)
        photochemical_limit = _power_law(
            1, math.pow(10, 0.02 * max(0.0, nm - 450)), max(100.0, duration), 1
        )
        return heat_limit if nm >= 500 else min(heat_limit, photochemical_limit)
    if nm < 1050:
        return (
            _constant_law(2e-3, c_a, 1, 0)
            if duration <= 5e-6
            else _power_law(18, c_a, duration, 0.75)
        )
    return (
        _constant_law(2e-2, c_c, 1, 0) if duration <= 13e-6 else _power_law(90, c_c, duration, 0.75)
    )


def _skin(nm: float, duration: float) -> _Law:
    """Return the limit of the skin in J/m2 from 700 to 1400 nm."""
    c_a, _ = _infrared_factors(nm)
    if duration >= 10:
        return _power_law(2000, c_a, duration, 1)
    if duration >= 1e-7:
        return _power_law(1.1e4, c_a, duration, 0.25)
    return _constant_law(200, c_a, duration, 1e-9)


def _cornea(nm: float, duration: float) -> _Law:
    """Return the limit of the cornea in J/m2 from 1400 nm on."""
    if duration >= 10:
        return _power_law(1000, 1, duration, 1)
    flat_limit, flat_duration = 1e3, 1e-3
    if 1500 <= nm < 1800:
        flat_limit, flat_duration = 1e4, 10.0
    elif nm >= 2600:
        flat_limit, flat_duration = 100.0, 1e-7
    if duration <= flat_duration:
        return _constant_law(flat_limit, 1, duration, 1e-9)
    return _power_law(5600, 1, duration, 0.25)


def eye_aperture(wavelength: float, duration: float) -> float:
    """Return the diameter in m of the limiting aperture, over which an exposure of the eye is
    averaged.

    7 mm, the widest pupil, from 400 to 1400 nm; beyond, 1 mm up to 0.35 s, 1.5 t^(3/8) mm up to 10
    s, then 3.5 mm.
    Source: IEC 60825-1:2014, Table A.6.
    """
    _refuse_unknown(wavelength, duration)
    if wavelength < 1400e-9:
        return 7e-3
    return 1e-3 if duration <= 0.35 else 1e-3 * min(3.5, 1.5 * math.pow(duration, 0.375))


def hazard_distance(
    beam: Beam, limit: float, aperture: float = 0.0, transmittance: float = 1.0
) -> float:
    """Return the distance in m beyond which the exposure by a beam is below a limit; 0 if it is
    below it everywhere.

    ``limit`` is in W/m2 for a continuous beam and in J/m2 for each pulse of a pulsed one. The
    exposure is the mean over a round ``aperture`` in m, or that on the axis for 0. Both have a
    closed inverse: w^2 = 2 P T / (pi limit) on the axis, and w^2 = -(d^2 / 2) / ln(1 - pi d^2 limit
    / (4 P T)) through an aperture d, then R = 2 sqrt(w^2 - w0^2) / theta. ``transmittance`` is that
    of the optics or of air, the same at every distance.
    """
    power_or_energy = beam.power if beam.pulse_energy is None else beam.pulse_energy
    assert power_or_energy is not None  # `beam` guarantees one of the two
    power_or_energy *= transmittance
    if aperture == 0:
        radius_squared = 2 * power_or_energy / (math.pi * limit)
    else:
        aperture_share = eye_share(limit, aperture, power_or_energy)
        if aperture_share >= 1:
            # even the whole beam in the aperture stays below the limit
            return 0.0
        radius_squared = -(aperture**2) / 2 / math.log1p(-aperture_share)
    # w^2 = w0^2 + (theta R / 2)^2
    return 2 * math.sqrt(max(0.0, radius_squared - beam.waist**2)) / beam.divergence


def eye_share(limit: float, aperture: float, emitted: float) -> float:
    """Return the power that gives a limit when averaged over a round aperture, relative to the
    emitted power (or the same with energies).

    ``limit`` is in W/m2 or J/m2, ``aperture`` a diameter in m, ``emitted`` in W or J.
    """
    return math.pi * aperture**2 / 4 * limit / emitted


# --- eye trains -----------------------------------------------------------------------------------

# Exposure limits of the eye for beams and pulse trains, by one of two named rules, and the hazard
# distance.
#
# `eye_limit_source` names the rule by which a limit was computed.


TrainRule = Literal["IEC 60825-1:2014", "N^(-1/4)"]
TRAIN_RULES: tuple[TrainRule, ...] = get_args(TrainRule)

_COUNTED_TIME = 10.0  #: s, T2 of a small source: for C5, pulses are counted within this time
_FEW_PULSES = 600  #: pulses up to which C5 is 1
_LEAST_C5 = 0.4
_BRIEF_EXPOSURE = 0.25  #: s, exposure duration up to which C5 is 1


class TrainLimit(NamedTuple):
    """The maximum permissible radiant exposure of the eye by one pulse of a train, by each of three
    rules.
    """

    single: float  #: J/m2, limit of one pulse alone
    mean: float  #: J/m2, limit of the whole exposure divided by its number of pulses
    #: J/m2, limit by the rule for repeated pulses; infinite where the standard has no such rule
    repeated: float
    #: number of pulses in a group, which the rule for repeated pulses counts as one
    together: float
    groups: float  #: number of groups of pulses that the rule counts
    factor: float  #: factor C5 of the rule

    @property
    def limit(self) -> float:
        """Return the least of the three limits in J/m2."""
        return min(self.single, self.mean, self.repeated)

    @property
    def strictest(self) -> Literal["single pulse", "mean", "repeated pulses"]:
        """Return the name of the rule with the lowest limit."""
        if self.single <= min(self.mean, self.repeated):
            return "single pulse"
        return "mean" if self.mean <= self.repeated else "repeated pulses"


def eye_mpe_train(
    wavelength: float,
    pulse_duration: float,
    repetition_rate: float,
    duration: float,
    rule: TrainRule = "IEC 60825-1:2014",
) -> float:
    """Return the maximum permissible radiant exposure of the eye in J/m2 by each pulse of a train;
    see `train_limit`.

    Raises ParameterError for a pulse that is longer than the exposure or the period.
    """
    return train_limit(wavelength, pulse_duration, repetition_rate, duration, rule).limit


def train_limit(
    wavelength: float,
    pulse_duration: float,
    repetition_rate: float,
    duration: float,
    rule: TrainRule = "IEC 60825-1:2014",
) -> TrainLimit:
    """Return the exposure limits of the eye for each pulse of a train, by three rules, for an
    exposure of ``duration`` s.

    A pulse has to stay below the limit of one pulse alone, below that of the whole exposure over
    the number of pulses, and, up to 1400 nm, below that of one pulse times C5. Pulses within T_i, 5
    us below 1050 nm and 13 us from there, count as one pulse of T_i. ``rule`` names C5:

    - `IEC 60825-1:2014`, for a source below 5 mrad: 1 for pulses longer than T_i, for exposures up
      to 0.25 s and for up to 600 pulses; else 5 N^(-1/4), and at least 0.4. N is counted within 10
      s (T2 of a small source).
    - `N^(-1/4)`: N^(-1/4) for every train, where N is counted within the whole exposure. The
      edition of 2007 has this factor. Its table of single pulses is another one, which is not here.
      This rule is never less strict than the first.

    Raises ParameterError for a pulse that is longer than the exposure or the period.
    Source: IEC 60825-1:2014, 4.3 f), A.3 and Table 9, as two public programs write them out, which
            agree; the standard itself was not read for C5. The interpretation sheet ISH1:2017
            allows more for pulses below T_i; it is not used.
    """
    if not pulse_duration < min(duration, 1 / repetition_rate):
        text = (
            f"a pulse of {pulse_duration:g} s, every {1 / repetition_rate:g} s, in an exposure of"
            f" {duration:g} s"
        )
        raise ParameterError("pulse_duration", f"{text}: the pulse is too long")
    single = eye_mpe(wavelength, pulse_duration)
    mean = eye_mpe(wavelength, duration) / max(1.0, duration * repetition_rate)
    # beyond the wavelengths that reach the retina there is no rule for repeated pulses
    if wavelength >= 1400e-9:
        return TrainLimit(single, mean, math.inf, 1.0, max(1.0, duration * repetition_rate), 1.0)
    group_time = _summed_time(wavelength)
    counting_time = min(duration, _COUNTED_TIME) if rule == "IEC 60825-1:2014" else duration
    pulses = max(1.0, counting_time * repetition_rate)
    pulses_in_group = min(pulses, max(1.0, group_time * repetition_rate))
    groups = pulses / pulses_in_group
    factor = (
        _c5(groups, pulse_duration, duration, group_time)
        if rule == "IEC 60825-1:2014"
        else math.pow(groups, -0.25)
    )
    # several pulses within T_i count as one pulse of the duration T_i
    group_duration = max(group_time, pulse_duration) if pulses_in_group > 1 else pulse_duration
    group_limit = eye_mpe(wavelength, group_duration)
    return TrainLimit(
        single, mean, group_limit / pulses_in_group * factor, pulses_in_group, groups, factor
    )


def _summed_time(wavelength: float) -> float:
    """Return the time T_i in s within which pulses count as one."""
    return 5e-6 if wavelength < 1050e-9 else 13e-6


def _c5(groups: float, pulse_duration: float, duration: float, summed: float) -> float:
    """Return the factor C5 of the edition of 2014 for a source below 5 mrad, from the number of
    groups of pulses, the durations in s, and T_i (``summed``), the time in s within which pulses
    count as one.
    """
    if pulse_duration > summed or duration <= _BRIEF_EXPOSURE or groups <= _FEW_PULSES:
        return 1.0
    return min(1.0, max(_LEAST_C5, 5 * math.pow(groups, -0.25)))


def eye_limit(beam: Beam, duration: float, rule: TrainRule = "IEC 60825-1:2014") -> float:
    """Return the exposure limit of the eye for a beam: in W/m2 if it is continuous, in J/m2 per
    pulse if it is pulsed.

    ``rule`` is as in `train_limit`; it affects pulse trains only.
    """
    if beam.pulse_energy is None or beam.pulse_duration is None:
        return eye_mpe(beam.wavelength, duration) / duration
    if _is_single(beam, duration):
        return eye_mpe(beam.wavelength, beam.pulse_duration)
    assert beam.repetition_rate is not None
    return eye_mpe_train(beam.wavelength, beam.pulse_duration, beam.repetition_rate, duration, rule)


def eye_limit_source(beam: Beam, duration: float, rule: TrainRule = "IEC 60825-1:2014") -> str:
    """Return the rule by which `eye_limit` computes the limit of a beam, with its source, as text.

    Raises ParameterError as `eye_limit` does.
    """
    table = (
        "IEC 60825-1:2014, Table A.1, small source, as written out in neusee (nodes.laser.eye_mpe)"
    )
    if beam.pulse_energy is None or beam.pulse_duration is None:
        return f"{table}: continuous light for {duration:g} s"
    if _is_single(beam, duration):
        return f"{table}: one pulse"
    assert beam.repetition_rate is not None
    train = train_limit(beam.wavelength, beam.pulse_duration, beam.repetition_rate, duration, rule)
    if beam.wavelength >= 1400e-9:
        named = "one pulse, and the mean of the train"
    elif rule == "IEC 60825-1:2014":
        named = (
            f"one pulse, the mean of the train, and C5 = {train.factor:.3g} of the edition of 2014"
        )
    else:
        named = (
            f"one pulse, the mean of the train, and N^(-1/4) = {train.factor:.3g}, the factor of"
            " the edition of 2007"
        )
    return f"{table}: the least of {named}; {train.strictest} decides"


def _is_single(beam: Beam, duration: float) -> bool:
    """Return True if an exposure contains at most one pulse of a pulsed beam."""
    return beam.repetition_rate is None or duration * beam.repetition_rate <= 1


def nominal_ocular_hazard_distance(
    beam: Beam,
    duration: float = BLINK,
    transmittance: float = 1.0,
    rule: TrainRule = "IEC 60825-1:2014",
) -> float:
    """Return the nominal ocular hazard distance in m, beyond which a beam does not exceed the limit
    of the unaided eye.

    ``duration`` is the exposure in s: 0.25 s for visible light, with the aversion response, and 10
    s or 100 s for invisible light. The exposure is averaged over the limiting aperture. ``rule`` is
    as in `train_limit`. Optical instruments such as binoculars are not considered.
    """
    averaged = duration if beam.pulse_duration is None else beam.pulse_duration
    limit = eye_limit(beam, duration, rule)
    return hazard_distance(beam, limit, eye_aperture(beam.wavelength, averaged), transmittance)


# --- dazzle of the eye ----------------------------------------------------------------------------

# Light of a laser scatters inside the eye and causes a veiling luminance over the field around the
# laser, here by the CIE general disability glare equation (CIE 146:2002). A target is hidden if its
# luminance differs from the background by less than the threshold of Adrian (1989) at the luminance
# of background plus veil. The largest exposure at which the target stays visible is the maximum
# dazzle exposure (MDE), and the distance at which a laser causes this exposure is the nominal
# ocular dazzle distance (NODD): Williamson and McLin, Appl. Opt. 54, 1564 (2015), define both. The
# formulas here differ from theirs by another threshold and do not reproduce their tables.

LUMENS_PER_WATT = 683.0  #: at 555 nm
STEADY = 100.0  #: Hz; from this rate a pulse train looks steady: above the flicker fusion threshold
_VISIBLE = (380e-9, 780e-9)  #: m
_GLARE_ANGLES = (0.1, 100.0)  #: deg, range of the CIE general disability glare equation
_AGES = (23.0, 75.0)  #: years, range of Adrian's age factor
_TARGET_SIZES = (1.0, 60.0)  #: arc minutes, range of the size of a target
_VEIL_RANGE = (1e-6, 1e9)  #: range in which the veil is searched, in multiples of the background
_VEIL_HALVINGS = 80  #: of the logarithm of the veil


class DazzleTask(NamedTuple):
    """The visual task of a viewer near a laser: target, background and properties of the viewer."""

    angle: float  #: deg, between the laser and the target
    background: float  #: cd/m2, luminance behind the target
    contrast: float = 0.2  #: absolute Weber contrast of the target
    size: float = 10.0  #: arc minutes across the target
    age: float = 40.0  #: years
    pigmentation: float = 0.5  #: of the iris: 0 black, 0.5 brown, 1.0 to 1.2 light
    margin: float = 2.6  #: contrast that a viewer needs in practice, over the laboratory threshold


def luminous_efficiency(wavelength: float) -> float:
    """Return the luminous efficiency V(lambda) of the CIE 1924 photopic observer at a wavelength in
    m; 0 outside 380 to 780 nm.

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
    """Return the veiling luminance in cd/m2 per lux at the eye, at an angle in degrees from a light
    source.

    10 / a^3 + (5 / a^2 + 0.1 p / a) (1 + (age / 62.5)^4) + 0.0025 p: the CIE general disability
    glare equation, from 0.1 to 100 degrees.

    Raises ParameterError for another angle.
    Source: CIE 146:2002; Vos, Clin. Exp. Optom. 86, 363 (2003); read in public programs that agree.
    """
    if not _GLARE_ANGLES[0] <= angle <= _GLARE_ANGLES[1]:
        text = (
            f"{angle:g} deg: the glare equation of the CIE holds from {_GLARE_ANGLES[0]:g} to"
            f" {_GLARE_ANGLES[1]:g} deg"
        )
        raise ParameterError("angle", text)
    age_factor = 1 + (age / 62.5) ** 4
    return (
        10 / angle**3
        + (5 / angle**2 + 0.1 * pigmentation / angle) * age_factor
        + 0.0025 * pigmentation
    )


def threshold_luminance(background: float, size: float, age: float) -> float:
    """Return the threshold luminance difference in cd/m2 at which a target is just seen, if it is
    in view for 2 s or longer.

    (sqrt(phi) / size + sqrt(L))^2 x F(age): phi and L are functions of the background in cd/m2, for
    ``size`` in arc minutes. The target is brighter than the background.

    Raises ParameterError for a target beyond 1 to 60 arc minutes, and an age beyond 23 to 75 years.
    Source: Adrian, Lighting Res. Technol. 21, 181 (1989); read in two public programs that agree.
    """
    for name, value, (low, high), unit in (
        ("size", size, _TARGET_SIZES, "arc minutes"),
        ("age", age, _AGES, "years"),
    ):
        if not low <= value <= high:
            text = (
                f"{value:g} {unit}: the threshold of Adrian holds from {low:g} to {high:g} {unit}"
            )
            raise ParameterError(name, text)
    return (_ricco(background) / size + _weber(background)) ** 2 * _age_factor(age)


def _ricco(background: float) -> float:
    """Return the square root of Adrian's flux function for a background in cd/m2, which governs
    small targets (Ricco's law).
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
    """Return the square root of Adrian's luminance function for a background in cd/m2, which
    governs large targets (Weber's law).
    """
    log_background = math.log10(background)
    if background >= 0.6:
        return 0.05946 * math.pow(background, 0.466)
    if background > 0.00418:
        return math.pow(10, -1.256 + 0.319 * log_background)
    return math.pow(10, -0.891 + 0.5275 * log_background + 0.0227 * log_background**2)


def _age_factor(age: float) -> float:
    """Return Adrian's age factor on the threshold for an age in years; about 1 at 23 years."""
    if age <= 64:
        return (age - 19) ** 2 / 2160 + 0.99
    return (age - 56.6) ** 2 / 116.3 + 1.43


def dazzle_illuminance(task: DazzleTask) -> float:
    """Return the illuminance at the eye in lux at which the veil just hides a target; 0 if the
    target is not visible even without a laser.

    The luminance of the target differs from the background by contrast x background, with and
    without the veil. It must exceed the threshold at the luminance of background plus veil, times
    the margin.

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

    seen_veil, hiding_veil = _VEIL_RANGE
    if not is_seen(seen_veil):
        return 0.0
    # bisection of the logarithm of the veil, in units of the background
    for _ in range(_VEIL_HALVINGS):
        middle = math.sqrt(seen_veil * hiding_veil)
        seen_veil, hiding_veil = (middle, hiding_veil) if is_seen(middle) else (seen_veil, middle)
    return seen_veil * task.background / veil_of_lux


def maximum_dazzle_exposure(wavelength: float, task: DazzleTask) -> float:
    """Return the maximum dazzle exposure (MDE) in W/m2: the irradiance at the eye up to which a
    laser does not hide a target.

    MDE = lux / (683 V(lambda)); 0 if the target is not visible even without a laser.

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
    """Return the nominal ocular dazzle distance (NODD) in m, beyond which the irradiance on the
    axis is below a limit in W/m2.

    A pulse train counts with its mean power, because above the flicker fusion threshold it looks
    steady.

    Raises ParameterError for a beam without a mean power that looks steady: see `unsteady`.
    """
    if reason := unsteady(beam):
        raise ParameterError("repetition_rate", reason)
    steady = beam._replace(pulse_energy=None, pulse_duration=None, repetition_rate=None)
    return hazard_distance(steady, limit, transmittance=transmittance)


def unsteady(beam: Beam) -> str:
    """Return the reason why the light of a beam does not look steady; empty for light that does."""
    if not beam.is_pulsed:
        return ""
    if beam.repetition_rate is None:
        return "a single pulse dazzles as a flash, for which no model is here"
    if beam.repetition_rate < STEADY:
        flicker_text = f"pulses at {beam.repetition_rate:g} Hz flicker, for which no model is here"
        return f"{flicker_text} (from {STEADY:g} Hz on their mean counts)"
    return ""
