"""Exposure limits of sensor and eye, and the ratio of the laser's exposure to them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from neusee.nodes import ParameterError
from neusee.nodes.laser import (
    LUMENS_PER_WATT,
    PUBLISHED_DAMAGE,
    Beam,
    DamageLaw,
    DamagePart,
    DazzleTask,
    LightInTime,
    damage_parts,
    dazzle_illuminance,
    eye_limit,
    eye_limit_source,
    frame_power,
    luminous_efficiency,
    nominal_ocular_dazzle_distance,
    nominal_ocular_hazard_distance,
    unsteady,
    veil_limit,
    widest_heated_diameter,
)
from neusee.nodes.sensor import line_saturation, saturation
from neusee.nodes.values import Bands
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import Diagnostic, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe, Step, unknown_step
from neusee.workflows.recipe.blocks.safety_block import Dazzle, EyeDazzle, LaserChannels, Safety
from neusee.workflows.recipe.distributions.shapes import FloatArray
from neusee.workflows.safety.dazzled_area import Area
from neusee.workflows.safety.exposures import Exposures, Option, SettingDraws, Spread
from neusee.workflows.store.result_store import Store

# --- first channel --------------------------------------------------------------------------------

# The colour channel that a laser saturates first, from the spectral responses that a step of the
# recipe computes.


_SETTING = "sensor.responses"
_LINE, _RESPONSES = "spectra.line", "spectra.responses"  #: nodes of the two steps
_UNSEEN = 1e-3  #: relative response below which a channel counts as insensitive to a laser


def with_channels(recipe: Recipe, safety: Safety, store: Store | None) -> Safety:
    """Return the settings with the channels' responses at the laser, if the settings name a step of
    responses.

    Raises `RecipeError` for a step that does not exist or is of another node.
    """
    step_name = safety.settings.sensor.responses
    if step_name is None:
        return safety
    step = _step(recipe, safety, step_name)
    line_step = recipe.steps[str(step.wires["bands"])]
    if line_step.node.path != _LINE:
        raise _refused(
            safety, f"the step {step.name} does not read a laser line: name a step that reads one"
        )
    result = run(recipe, store, [step.name])
    largest = float(result[step.name].max())
    return replace(
        safety, channels=LaserChannels(line_step, step, largest, str(result.keys[step.name]))
    )


def _step(recipe: Recipe, safety: Safety, named: str) -> Step:
    """Return the step of responses named in the settings; a step with a copy for each laser has the
    laser in its name.
    """
    name = next(
        (
            candidate
            for candidate in (named, f"{named}[{safety.name}]")
            if candidate in recipe.steps
        ),
        None,
    )
    if name is None:
        raise _refused(safety, unknown_step(named, recipe.steps))
    step = recipe.steps[name]
    if step.node.path != _RESPONSES:
        raise _refused(
            safety, f"the step {name} has the node {step.node.path}: name a step of {_RESPONSES}"
        )
    return step


def _refused(safety: Safety, text: str) -> RecipeError:
    """Return an error located at the recipe's setting of the responses."""
    value = safety.values[_SETTING]
    return RecipeError([Diagnostic(value.mark, value.name, text)])


def sees(channels: LaserChannels | None) -> bool:
    """Return True unless the responses are known and no channel responds to the laser."""
    return channels is None or channels.largest >= _UNSEEN


def channel_saturation(
    channels: LaserChannels, wavelength: float, electrons: float, sensor: Mapping[str, float]
) -> float:
    """Return the irradiance in W/m2 at which the most responsive channel saturates, for a laser of
    a given wavelength.

    ``sensor`` has the quantum efficiency, the pixel pitch and the exposure.
    """
    laser_bands: Bands = channels.line.node(**{**channels.line.params, "wavelength": wavelength})
    params = {**channels.responses.params}
    if params.get("quantum_efficiency") is not None:  # an absolute table is divided by this value
        params["quantum_efficiency"] = sensor["quantum_efficiency"]
    return line_saturation(
        laser_bands, channels.responses.node(laser_bands, **params), electrons=electrons, **sensor
    )


# --- sensor limits --------------------------------------------------------------------------------

# Limits of exposure at the peak on the sensor: published and user-supplied damage thresholds, and
# the onset of dazzle.


_THIRD = 0.4307  #: quantile of the standard normal distribution at 2/3
#: stream of random numbers that picks the lower end, middle or upper end of brackets: all
#: thresholds of one draw are at the same end
_BRACKET = 999_983
#: sensor values that may be uncertain
_FACTS = ("full_well", "offset", "quantum_efficiency", "exposure", "pixel_pitch")
Quantity = Literal["irradiance", "fluence"]
_COUNTED = (
    "pixels counted in the point-spread functions at several distances (nodes.laser.bright_pixels)"
)
_STRAY = ", with the light that the lens scatters (nodes.flare.stray_light)"
_ROUND = "integral over a clear round pupil at each distance (nodes.laser.round_pixels)"


@dataclass(frozen=True)
class Limit:
    """A limit of the exposure at the peak on the sensor, in W/m2 or J/m2, with draws of its
    uncertainty.
    """

    name: str
    effect: Literal["damage", "dazzle"]
    quantity: Quantity
    values: FloatArray  #: (1 + draw, 1 or distance); row 0 has the nominal values
    devices: FloatArray  #: (1 + draw, 1) factor of the drawn device on ``values``; 1 in row 0
    #: geometric standard deviation from device to device; None where it is not known
    factor: float | None
    source: str
    note: str = ""
    kind: str = ""  #: of damage, such as point; empty for dazzle
    #: part of the light that the limit judges: pulse, mean, accumulation or incubation
    part: str = ""
    open_below: bool = False  #: whether nothing is known of exposures below the limit
    reason: str = ""  #: why nothing is known of them


def damage_limits(
    safety: Safety, option: Option, exposures: Exposures, draws: SettingDraws
) -> Iterator[Limit]:
    """Yield a limit for each part of the light that has a damage threshold, behind one option."""
    for damage_part in limit_parts(safety, option, exposures, draws):
        if damage_part.threshold is not None:
            yield _damage_limit(damage_part, safety, exposures, draws)


def limit_parts(
    safety: Safety, option: Option, exposures: Exposures, draws: SettingDraws
) -> tuple[DamagePart, ...]:
    """Return the parts of the light that get a row of their own, judged or not; empty if the recipe
    has no damage settings.

    Continuous light has one row, because its pulse, its mean and its accumulation are the same
    light.
    """
    if safety.settings.damage is None:
        return ()
    light = light_in_time(safety, option, exposures, draws)
    parts = damage_parts(light, safety.settings.damage.device, safety.laws)
    # one pulse in the dwell time has no incubation by many
    needless = "incubation" if float(light.pulses.max()) <= 1 else ""
    if light.pulse_duration is None:
        return tuple(damage_part for damage_part in parts if damage_part.part == "mean")
    return tuple(damage_part for damage_part in parts if damage_part.part != needless)


def light_in_time(
    safety: Safety, option: Option, exposures: Exposures, draws: SettingDraws
) -> LightInTime:
    """Return the temporal properties of the light that determine the damage thresholds behind an
    option: nominal values first, then each draw.
    """
    damage, beams = safety.settings.damage, exposures.beams
    assert damage is not None
    exponent = draws.column("damage.small_spot_exponent", damage.small_spot_exponent)
    spot = _heated(option, exposures)
    # the spot matters only if it is wider than the spot of a published law, or if narrow spots get
    # a bonus
    spot_without_effect = exponent.max() == 0 and all(
        spot.max() <= law.spot for law in _with_spot(safety)
    )
    return LightInTime(
        wavelength=beams[0].wavelength,
        dwell=_narrow(draws.column("damage.dwell", damage.dwell)),
        pulse_duration=_of_beams([beam.pulse_duration for beam in beams]),
        repetition_rate=_of_beams([beam.repetition_rate for beam in beams]),
        spot=None if spot_without_effect else torch.from_numpy(spot),
        small_spot_exponent=_narrow(exponent),
    )


def _with_spot(safety: Safety) -> list[DamageLaw]:
    """Return the damage laws of continuous light that state the diameter of their spot."""
    laws = (*safety.laws, *PUBLISHED_DAMAGE)
    return [law for law in laws if law.quantity == "irradiance" and law.spot is not None]


def _heated(option: Option, exposures: Exposures) -> FloatArray:
    """Return the diameter of the heated spot behind an option (1 + draw, distance); an upper bound
    for a mask.
    """
    spot = exposures.spot[option.name]
    if option.heated is not None:
        return spot * option.heated
    return spot if option.peak == 1 else spot * widest_heated_diameter(1.0, option.peak)


def _narrow(values: FloatArray) -> Tensor:
    """Return values as a column (1 + draw, 1), or (1, 1) if all draws are equal."""
    alike = bool((values == values[0]).all())
    return torch.from_numpy(np.ascontiguousarray(values[: 1 if alike else None, None]))


def _of_beams(values: Sequence[float | None]) -> Tensor | None:
    """Return a quantity of the nominal beam and of each draw as a column; None if the beam lacks
    it.
    """
    return None if values[0] is None else _narrow(np.array(values, np.float64))


def _damage_limit(
    damage_part: DamagePart, safety: Safety, exposures: Exposures, draws: SettingDraws
) -> Limit:
    """Return the limit of one part of the light, with draws of its bracket, or of its median and of
    the device.

    A third of the draws each is at the lower end of a bracket, in its middle and at its upper end.
    """
    assert damage_part.threshold is not None
    low, middle, high = (
        bracket_part.numpy()
        for bracket_part in (
            damage_part.threshold.low,
            damage_part.threshold.middle,
            damage_part.threshold.high,
        )
    )
    devices = np.ones((1 + draws.count, 1))
    if damage_part.law is not None:
        # two streams a law: its median, and its devices
        stream = 2 * safety.laws.index(damage_part.law)  # the same devices behind every option
        values = middle * _scattered(damage_part.law.median_factor, draws, stream)
        devices = _scattered(damage_part.law.factor, draws, stream + 1)
    elif damage_part.open_below:
        values = high + np.zeros_like(devices)
    else:
        normal_draws = np.concatenate([[0.0], draws.normal(_BRACKET)])[:, None]
        # below the quantile at 1/3, above that at 2/3, or between both
        values = np.where(
            normal_draws > _THIRD, high, np.where(normal_draws < -_THIRD, low, middle)
        )
    quantity, factor = _stated_as(damage_part, exposures, safety, draws)
    return Limit(
        name=_limit_name(damage_part),
        effect="damage",
        quantity=quantity,
        values=values * factor,
        devices=devices,
        factor=None if damage_part.law is None else damage_part.law.factor,
        source=damage_part.source,
        note=damage_part.note,
        kind=damage_part.kind,
        part=damage_part.part,
        open_below=damage_part.open_below,
        reason=damage_part.reason,
    )


def _limit_name(damage_part: DamagePart) -> str:
    """Return the name of the limit of a part of the light; the kind of damage is added unless it is
    a point, the first damage.
    """
    return f"damage: {damage_part.part}" + (
        "" if damage_part.kind == "point" else f", {damage_part.kind}"
    )


def _stated_as(
    damage_part: DamagePart, exposures: Exposures, safety: Safety, draws: SettingDraws
) -> tuple[Quantity, FloatArray]:
    """Return the quantity of a limit, and the factor that turns its threshold into a limit of
    emitted power or pulse energy.

    The mean of a train that has several pulses in the dwell time is a mean power. With one pulse in
    the dwell time, the mean is a limit of the energy of this pulse.
    """
    damage, beams = safety.settings.damage, exposures.beams
    assert damage is not None
    if damage_part.quantity == "fluence" or beams[0].pulse_duration is None:
        return damage_part.quantity, np.ones((1, 1))
    rates = np.array([[beam.repetition_rate or 0.0] for beam in beams])
    durations = np.array([[beam.pulse_duration or 0.0] for beam in beams])
    dwell = draws.column("damage.dwell", damage.dwell)[:, None]
    # mean irradiance over the energy of a pulse, in 1/s: pulses in a second (at least one in the
    # dwell time) times the share of a pulse within the dwell time
    per_pulse_energy = np.maximum(rates, 1 / dwell) * np.minimum(1.0, dwell / durations)
    if rates[0, 0] * dwell[0, 0] > 1:
        # mean power = rate x energy
        return "irradiance", rates / per_pulse_energy
    return "fluence", 1 / per_pulse_energy


def _scattered(factor: float | None, draws: SettingDraws, stream: int) -> FloatArray:
    """Return draws (1 + draw, 1) of a lognormal factor around 1; all 1 if its width is unknown."""
    drawn_factors = np.power(factor or 1.0, draws.normal(stream))
    return np.concatenate([[1.0], drawn_factors])[:, None]


def dazzle_limits(
    safety: Safety, area: Area, draws: SettingDraws, exposures: Exposures
) -> Iterator[Limit]:
    """Yield the limits of saturation and of veiling light behind one option, for the share of the
    picture that may be lost.

    A limit is the exposure at the peak at which the faintest of these pixels is lost, at each
    distance.
    """
    dazzle, sensor = safety.settings.dazzle, safety.settings.sensor
    if dazzle is None:
        return
    name = area.option.name
    full_irradiance = saturating(safety, draws)[:, None]
    share = f"{100 * dazzle.share:g} % of the picture"
    well_share = (
        veil_level(dazzle, area.option.scene_share(safety.settings.lens.diameter)) / sensor.fills
    )
    shares_of_well = [("saturated", 1.0)] + ([("veiled", well_share)] if 0 < well_share < 1 else [])
    for effect, well_share in shares_of_well:
        faintest_share = area.level(exposures, draws, effect == "veiled")
        # peak exposure at which the faintest of these pixels is full: peak over light per pixel
        values = (
            full_irradiance
            * well_share
            * exposures.sensor[name]
            * sensor.pixel_pitch**2
            / (exposures.through[name] * faintest_share)
        )
        devices = np.ones((len(values), 1))
        yield Limit(
            f"{effect}: {share}",
            "dazzle",
            "irradiance",
            values,
            devices,
            None,
            dazzle_source(safety, area),
        )


def dazzle_source(safety: Safety, area: Area) -> str:
    """Return a text on how the light of the pixels is computed."""
    return (_ROUND if area.ranked is None else _COUNTED) + (
        _STRAY if safety.settings.lens.scatter else ""
    )


def veil_level(dazzle: Dazzle, scene: float = 1.0) -> float:
    """Return the laser light in electrons per pixel above which the feature can no longer be seen.

    ``scene`` is the share of the scene's light that a filter or a stop transmits; it scales the
    background.
    """
    background = torch.tensor(dazzle.background * scene, dtype=torch.float64)
    options = {
        "feature": dazzle.feature,
        "threshold": dazzle.least,
        "read_noise": dazzle.read_noise,
    }
    return float(veil_limit(background, contrast=dazzle.contrast, rule=dazzle.rule, **options))


def saturating(safety: Safety, draws: SettingDraws) -> FloatArray:
    """Return the irradiance in W/m2 that saturates a pixel within one exposure, (1 + draw,):
    nominal, then each draw.

    It is that of the channel that saturates first, where the settings name a step of responses.
    """
    sensor = safety.settings.sensor
    nominal = {
        **{name: float(getattr(sensor, name)) for name in _FACTS},
        "wavelength": safety.laser.wavelength,
    }
    prefixes = {name: "laser" if name == "wavelength" else "sensor" for name in nominal}
    columns = [draws.column(f"{prefixes[name]}.{name}", value) for name, value in nominal.items()]
    # equal draws are computed once
    unique_rows, row_of_draw = np.unique(np.stack(columns, 1), axis=0, return_inverse=True)
    irradiances = [
        _saturation(safety, dict(zip(nominal, map(float, row), strict=True))) for row in unique_rows
    ]
    return np.array(irradiances)[row_of_draw.ravel()]


def _saturation(safety: Safety, values: dict[str, float]) -> float:
    """Return the irradiance in W/m2 that saturates a pixel, for given values of sensor and
    laser.
    """
    sensor = safety.settings.sensor.model_copy(
        update={name: values.pop(name) for name in ("full_well", "offset")}
    )
    wavelength = values.pop("wavelength")
    if safety.channels is not None:
        return channel_saturation(safety.channels, wavelength, sensor.fills, values)
    centre = torch.tensor([wavelength], dtype=torch.float64)
    return float(saturation(Bands(centre, centre, centre), full_well=sensor.fills, **values))


# --- limit ratios ---------------------------------------------------------------------------------

# The ratio of the exposure at the peak on the sensor to the limit there.


def limits_behind(
    safety: Safety, draws: SettingDraws, option: Option, area: Area | None, exposures: Exposures
) -> Iterator[Limit]:
    """Yield each damage limit behind a protection, and each dazzle limit if the dazzled area is
    known.
    """
    yield from damage_limits(safety, option, exposures, draws)
    if area is not None:
        yield from dazzle_limits(safety, area, draws, exposures)


def limit_ratio(safety: Safety, option: str, limit: Limit, exposures: Exposures) -> FloatArray:
    """Return the ratio of exposure to limit (1 + draw, distance) behind a protection; row 0 is
    nominal.
    """
    return (
        emitted(safety, limit, exposures)
        * exposures.sensor[option]
        / (limit.values * limit.devices)
    )


def emitted(safety: Safety, limit: Limit, exposures: Exposures) -> FloatArray:
    """Return the emitted power or pulse energy (1 + draw, 1); for dazzle the mean power during one
    frame.
    """
    if limit.effect == "damage":
        return exposures.emitted(limit.quantity)
    return mean_in_frame(exposures, safety.settings.sensor.exposure or 1.0)


def mean_in_frame(exposures: Exposures, exposure: float) -> FloatArray:
    """Return the mean power in W during an exposure; of a pulsed laser at least one pulse falls
    into it.
    """
    rows = [frame_power(beam, exposure) for beam in exposures.beams]
    return np.array(rows, np.float64)[:, None]


# --- eye findings ---------------------------------------------------------------------------------

# Effect of the laser on an eye next to the camera: exposure limit and hazard distance, dazzle
# exposure and dazzle distance.


DAZZLE_SOURCE = (
    "veil: CIE 146:2002, general disability glare equation; threshold: Adrian, Lighting Res."
    " Technol. 21, 181 (1989); MDE and NODD as defined by Williamson and McLin (Appl. Opt. 54,"
    " 1564, 2015), not from their table"
)


@dataclass(frozen=True)
class EyeFinding:
    """The exposure limit of the eye, and the distance beyond which the laser stays below it."""

    duration: float  #: s
    limit: float  #: W/m2, or J/m2 of each pulse
    quantity: str
    exposure: Spread  #: at the distance of the recipe, on the axis
    distance: Spread  #: nominal ocular hazard distance, m
    source: str  #: names the rule that was computed


@dataclass(frozen=True)
class EyeDazzleRow:
    """The largest exposure at which a target stays visible to an eye, for one ambient luminance and
    one angle.
    """

    background: float  #: cd/m2
    angle: float  #: deg, from the laser to the target
    illuminance: float  #: lx of the laser at the eye; 0: the target is not seen without a laser
    limit: float  #: W/m2, maximum dazzle exposure (MDE)
    distance: Spread | None  #: m, nominal ocular dazzle distance (NODD); None without a limit
    dazzled: bool  #: whether the laser hides the target at the distance of the recipe


@dataclass(frozen=True)
class EyeDazzleFinding:
    """Dazzle of the eye for each ambient luminance and angle, or the reason why it is not
    judged.
    """

    rows: tuple[EyeDazzleRow, ...]
    reason: str  #: empty where it is judged
    efficiency: float  #: V(lambda)
    source: str = DAZZLE_SOURCE


def eye_finding(safety: Safety, exposures: Exposures) -> EyeFinding | str:
    """Return the exposure limit of the eye with its distance, or a sentence that says why there is
    none.
    """
    beam, index = exposures.beams[0], exposures.at(safety.laser.distance)
    # default: the blink reflex (0.25 s) in visible light, else 10 s
    duration = safety.settings.eye.exposure or (0.25 if beam.wavelength <= 700e-9 else 10.0)
    rule = safety.settings.eye.rule
    try:
        limit, source = eye_limit(beam, duration, rule), eye_limit_source(beam, duration, rule)
        hazard_distances = np.array(
            [
                nominal_ocular_hazard_distance(drawn_beam, duration, rule=rule)
                for drawn_beam in exposures.beams
            ]
        )
    except ParameterError as error:
        return f"No statement about the eye: {error}."
    quantity = "fluence" if beam.is_pulsed else "irradiance"
    exposure_here = (
        exposures.emitted("fluence" if beam.is_pulsed else "irradiance")[:, 0]
        * exposures.lens[:, index]
    )
    return EyeFinding(
        duration, limit, quantity, _spread(exposure_here), _spread(hazard_distances), source
    )


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
    """Return a task for each ambient luminance with each angle."""
    viewer = {
        "contrast": asked.contrast,
        "age": asked.age,
        "pigmentation": asked.pigmentation,
        "margin": asked.margin,
    }
    size = math.degrees(asked.size) * 60
    pairs = itertools.product(asked.backgrounds, asked.angles)
    return [
        DazzleTask(math.degrees(angle), background, size=size, **viewer)
        for background, angle in pairs
    ]


def _row(task: DazzleTask, safety: Safety, exposures: Exposures) -> EyeDazzleRow:
    """Return the dazzle of the eye for one task: the maximum dazzle exposure (MDE), its distance
    with the interval of the draws, and whether the laser hides the target at the distance of the
    recipe.
    """
    illuminance = dazzle_illuminance(task)
    limits = [
        # 683 lm/W times V(lambda)
        illuminance / (LUMENS_PER_WATT * efficiency) if efficiency > 0 else math.inf
        for efficiency in _efficiencies(exposures.beams)
    ]
    irradiance_here = float(
        exposures.emitted("irradiance")[0, 0]
        * exposures.lens[0, exposures.at(safety.laser.distance)]
    )
    dazzle_distance = None
    if illuminance > 0:
        pairs = zip(exposures.beams, limits, strict=True)
        dazzle_distance = _spread(
            np.array([nominal_ocular_dazzle_distance(beam, limit) for beam, limit in pairs])
        )
    return EyeDazzleRow(
        task.background,
        task.angle,
        illuminance,
        limits[0],
        dazzle_distance,
        illuminance > 0 and irradiance_here > limits[0],
    )


def _efficiencies(beams: Sequence[Beam]) -> list[float]:
    """Return V(lambda) of the nominal beam and of each draw."""
    efficiencies = {
        wavelength: luminous_efficiency(wavelength)
        for wavelength in {beam.wavelength for beam in beams}
    }
    return [efficiencies[beam.wavelength] for beam in beams]


def _spread(values: FloatArray) -> Spread:
    """Return the nominal value, which comes first, with the interval of the draws after it."""
    return Spread.of(float(values[0]), values[1:])
