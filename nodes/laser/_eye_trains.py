"""Exposure limits of the eye for beams and trains of pulses, by two rules that have names, and the hazard distance.

`eye_limit_source` names the rule that a limit was computed by.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple, get_args

from neusee.nodes import ParameterError
from neusee.nodes.laser._beam import Beam
from neusee.nodes.laser._eye_limits import BLINK, eye_aperture, eye_mpe, hazard_distance

TrainRule = Literal["IEC 60825-1:2014", "N^(-1/4)"]
TRAIN_RULES: tuple[TrainRule, ...] = get_args(TrainRule)

_COUNTED = 10.0  #: s, T2 of a small source: pulses are counted within this time for C5
_FEW = 600  #: pulses up to which C5 is 1
_LEAST_C5 = 0.4
_BRIEF = 0.25  #: s, an exposure up to which C5 is 1


class TrainLimit(NamedTuple):
    """The largest permissible radiant exposure of the eye by one pulse of a train, by each of three rules."""

    single: float  #: J/m2, limit of one pulse alone
    mean: float  #: J/m2, limit of the whole exposure over the number of its pulses
    repeated: float  #: J/m2, limit by the rule for repeated pulses; infinite where the standard has no such rule
    together: float  #: number of pulses that the rule for repeated pulses counts as one
    groups: float  #: number of pulses, or of groups that count as one, that the rule counts
    factor: float  #: C5 of the rule

    @property
    def limit(self) -> float:
        """Return the least of the three limits in J/m2."""
        return min(self.single, self.mean, self.repeated)

    @property
    def strictest(self) -> Literal["single pulse", "mean", "repeated pulses"]:
        """Return the name of the rule whose limit is the least."""
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
    """Return the largest permissible radiant exposure of the eye in J/m2 by each pulse of a train: see `train_limit`.

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
    """Return the limits of the eye for each pulse of a train in an exposure of ``duration`` s, by three rules.

    A pulse has to stay below the limit of one pulse alone, below that of the whole exposure over the number of pulses,
    and, up to 1400 nm, below that of one pulse times C5. Pulses within T_i, 5 us below 1050 nm and 13 us from there,
    count as one pulse of T_i. ``rule`` names C5:

    - `IEC 60825-1:2014`, for a source below 5 mrad: 1 for pulses longer than T_i, for exposures up to 0.25 s and for up
      to 600 pulses; else 5 N^(-1/4), and at least 0.4. N is counted within 10 s (T2 of a small source).
    - `N^(-1/4)`: N^(-1/4) for every train, where N is counted within the whole exposure. The edition of 2007 has this
      factor. Its table of single pulses is another one, which is not here. This rule is never less strict than the
      first.

    Raises ParameterError for a pulse that is longer than the exposure or the period.
    Source: IEC 60825-1:2014, 4.3 f), A.3 and Table 9, as two public programs write them out, which agree; the standard
    itself was not read for C5. The interpretation sheet ISH1:2017 allows more for pulses below T_i; it is not used.
    """
    if not pulse_duration < min(duration, 1 / repetition_rate):
        text = f"a pulse of {pulse_duration:g} s, every {1 / repetition_rate:g} s, in an exposure of {duration:g} s"
        raise ParameterError("pulse_duration", f"{text}: the pulse is too long")
    single = eye_mpe(wavelength, pulse_duration)
    mean = eye_mpe(wavelength, duration) / max(1.0, duration * repetition_rate)
    if wavelength >= 1400e-9:
        return TrainLimit(single, mean, math.inf, 1.0, max(1.0, duration * repetition_rate), 1.0)
    summed = _summed_time(wavelength)
    counted = min(duration, _COUNTED) if rule == "IEC 60825-1:2014" else duration
    pulses = max(1.0, counted * repetition_rate)
    together = min(pulses, max(1.0, summed * repetition_rate))
    groups = pulses / together
    factor = _c5(groups, pulse_duration, duration, summed) if rule == "IEC 60825-1:2014" else math.pow(groups, -0.25)
    one = eye_mpe(wavelength, max(summed, pulse_duration) if together > 1 else pulse_duration)
    return TrainLimit(single, mean, one / together * factor, together, groups, factor)


def _summed_time(wavelength: float) -> float:
    """Return T_i in s: pulses within this time count as one."""
    return 5e-6 if wavelength < 1050e-9 else 13e-6


def _c5(groups: float, pulse_duration: float, duration: float, summed: float) -> float:
    """Return C5 of the edition of 2014 for a source below 5 mrad."""
    if pulse_duration > summed or duration <= _BRIEF or groups <= _FEW:
        return 1.0
    return min(1.0, max(_LEAST_C5, 5 * math.pow(groups, -0.25)))


def eye_limit(beam: Beam, duration: float, rule: TrainRule = "IEC 60825-1:2014") -> float:
    """Return the limit of the eye for a beam: W/m2 if it is continuous, J/m2 for each pulse if it is pulsed.

    ``rule`` is that of `train_limit` for a train of pulses; the other beams do not need a rule.
    """
    if beam.pulse_energy is None or beam.pulse_duration is None:
        return eye_mpe(beam.wavelength, duration) / duration
    if _is_single(beam, duration):
        return eye_mpe(beam.wavelength, beam.pulse_duration)
    assert beam.repetition_rate is not None
    return eye_mpe_train(beam.wavelength, beam.pulse_duration, beam.repetition_rate, duration, rule)


def eye_limit_source(beam: Beam, duration: float, rule: TrainRule = "IEC 60825-1:2014") -> str:
    """Return the name of the rule by which `eye_limit` computes the limit of a beam, with its source.

    Raises ParameterError as `eye_limit` does.
    """
    table = "IEC 60825-1:2014, Table A.1, small source, as written out in neusee (nodes.laser.eye_mpe)"
    if beam.pulse_energy is None or beam.pulse_duration is None:
        return f"{table}: continuous light for {duration:g} s"
    if _is_single(beam, duration):
        return f"{table}: one pulse"
    assert beam.repetition_rate is not None
    train = train_limit(beam.wavelength, beam.pulse_duration, beam.repetition_rate, duration, rule)
    if beam.wavelength >= 1400e-9:
        named = "one pulse, and the mean of the train"
    elif rule == "IEC 60825-1:2014":
        named = f"one pulse, the mean of the train, and C5 = {train.factor:.3g} of the edition of 2014"
    else:
        named = (
            f"one pulse, the mean of the train, and N^(-1/4) = {train.factor:.3g}, the factor of the edition of 2007"
        )
    return f"{table}: the least of {named}; {train.strictest} decides"


def _is_single(beam: Beam, duration: float) -> bool:
    """Return True if at most one pulse of a pulsed beam falls within an exposure."""
    return beam.repetition_rate is None or duration * beam.repetition_rate <= 1


def nominal_ocular_hazard_distance(
    beam: Beam, duration: float = BLINK, transmittance: float = 1.0, rule: TrainRule = "IEC 60825-1:2014"
) -> float:
    """Return the distance in m beyond which a beam does not exceed the limit of the unaided eye for an exposure in s.

    The exposure is averaged over the limiting aperture. Use 0.25 s for visible light that a person turns away from,
    and 10 s or 100 s for invisible light. ``rule`` is that of `train_limit`. Optical instruments such as binoculars are
    not part of it.
    """
    averaged = duration if beam.pulse_duration is None else beam.pulse_duration
    limit = eye_limit(beam, duration, rule)
    return hazard_distance(beam, limit, eye_aperture(beam.wavelength, averaged), transmittance)
