"""What the laser does to an eye beside the camera: exposure limit and hazard distance, dazzle and dazzle distance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neusee.nodes import ParameterError
from neusee.nodes.laser import (
    LUMENS_PER_WATT,
    Beam,
    DazzleTask,
    dazzle_illuminance,
    eye_limit,
    eye_limit_source,
    luminous_efficiency,
    nominal_ocular_dazzle_distance,
    nominal_ocular_hazard_distance,
    unsteady,
)
from neusee.workflows.recipe.blocks.safety_block import EyeDazzle, Safety
from neusee.workflows.recipe.distributions.shapes import FloatArray
from neusee.workflows.safety.distance_zones import Spread
from neusee.workflows.safety.exposures import Exposures

DAZZLE_SOURCE = (
    "veil: CIE 146:2002, general disability glare equation; threshold: Adrian, Lighting Res. Technol. 21, 181 (1989); "
    "MDE and NODD as Williamson and McLin (Appl. Opt. 54, 1564, 2015) define them, not by their table"
)


@dataclass(frozen=True)
class EyeFinding:
    """The exposure limit of the eye, and the distance beyond which the laser does not exceed it."""

    duration: float  #: s
    limit: float  #: W/m2, or J/m2 of each pulse
    quantity: str
    exposure: Spread  #: at the distance of the recipe, on the axis
    distance: Spread  #: nominal ocular hazard distance, m
    source: str  #: names the rule that was computed


@dataclass(frozen=True)
class EyeDazzleRow:
    """The largest exposure that hides no target from an eye, for one light of the surroundings and one angle."""

    background: float  #: cd/m2
    angle: float  #: deg, from the laser to the target
    illuminance: float  #: lx of the laser at the eye; 0: the target is not seen without a laser
    limit: float  #: W/m2, maximum dazzle exposure (MDE)
    distance: Spread | None  #: m, nominal ocular dazzle distance (NODD); None without a limit
    dazzled: bool  #: whether the laser hides the target at the distance of the recipe


@dataclass(frozen=True)
class EyeDazzleFinding:
    """Dazzle of the eye for each light of the surroundings and each angle, or the reason why it is not judged."""

    rows: tuple[EyeDazzleRow, ...]
    reason: str  #: empty where it is judged
    efficiency: float  #: V(lambda)
    source: str = DAZZLE_SOURCE


def eye_finding(safety: Safety, exposures: Exposures) -> EyeFinding | str:
    """Return the exposure limit of the eye with its distance, or the sentence that says why there is none."""
    beam, at = exposures.beams[0], exposures.at(safety.laser.distance)
    duration = safety.settings.eye.exposure or (0.25 if beam.wavelength <= 700e-9 else 10.0)
    rule = safety.settings.eye.rule
    try:
        limit, source = eye_limit(beam, duration, rule), eye_limit_source(beam, duration, rule)
        reach = np.array([nominal_ocular_hazard_distance(each, duration, rule=rule) for each in exposures.beams])
    except ParameterError as error:
        return f"Nothing is said of the eye: {error}."
    quantity = "fluence" if beam.is_pulsed else "irradiance"
    here = exposures.emitted("fluence" if beam.is_pulsed else "irradiance")[:, 0] * exposures.lens[:, at]
    return EyeFinding(duration, limit, quantity, _spread(here), _spread(reach), source)


def eye_dazzle_finding(safety: Safety, exposures: Exposures) -> EyeDazzleFinding:
    """Return the dazzle of the eye, or the reason why it is not judged."""
    beam = exposures.beams[0]
    efficiency = luminous_efficiency(beam.wavelength)
    if efficiency <= 0:
        reason = f"{beam.wavelength * 1e9:.4g} nm is not visible (380 to 780 nm)"
        return EyeDazzleFinding((), reason, efficiency)
    if reason := unsteady(beam):
        return EyeDazzleFinding((), reason, efficiency)
    rows = [_row(task, safety, exposures) for task in _tasks(safety.settings.eye.dazzle)]
    return EyeDazzleFinding(tuple(rows), "", efficiency)


def _tasks(asked: EyeDazzle) -> Sequence[DazzleTask]:
    """Return each light of the surroundings with each angle."""
    viewer = {"contrast": asked.contrast, "age": asked.age, "pigmentation": asked.pigmentation, "margin": asked.margin}
    size = math.degrees(asked.size) * 60
    pairs = [(background, angle) for background in asked.backgrounds for angle in asked.angles]
    return [DazzleTask(math.degrees(angle), background, size=size, **viewer) for background, angle in pairs]


def _row(task: DazzleTask, safety: Safety, exposures: Exposures) -> EyeDazzleRow:
    lux = dazzle_illuminance(task)
    limits = [lux / (LUMENS_PER_WATT * value) if value > 0 else math.inf for value in _efficiencies(exposures.beams)]
    here = float(exposures.emitted("irradiance")[0, 0] * exposures.lens[0, exposures.at(safety.laser.distance)])
    reach = None
    if lux > 0:
        pairs = zip(exposures.beams, limits, strict=True)
        reach = _spread(np.array([nominal_ocular_dazzle_distance(beam, limit) for beam, limit in pairs]))
    return EyeDazzleRow(task.background, task.angle, lux, limits[0], reach, lux > 0 and here > limits[0])


def _efficiencies(beams: Sequence[Beam]) -> list[float]:
    """Return V(lambda) of the nominal beam and of each draw."""
    known = {wavelength: luminous_efficiency(wavelength) for wavelength in {beam.wavelength for beam in beams}}
    return [known[beam.wavelength] for beam in beams]


def _spread(values: FloatArray) -> Spread:
    """Return the nominal value, which comes first, with the interval of the draws after it."""
    return Spread.of(float(values[0]), values[1:])
