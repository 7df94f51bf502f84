"""Limits of exposure at the peak on the sensor: published and own thresholds of damage, and the onset of dazzle."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from neusee.nodes.laser import (
    PUBLISHED_DAMAGE,
    DamageLaw,
    DamagePart,
    LightInTime,
    damage_parts,
    veil_limit,
    widest_heated_diameter,
)
from neusee.nodes.sensor import saturation
from neusee.nodes.values import Bands
from neusee.workflows.recipe.blocks.safety_block import Dazzle, Safety
from neusee.workflows.recipe.distributions.shapes import FloatArray
from neusee.workflows.safety.dazzled_area import Area
from neusee.workflows.safety.exposures import Exposures, Option
from neusee.workflows.safety.first_channel import channel_saturation
from neusee.workflows.safety.uncertain_values import SettingDraws

_THIRD = 0.4307  #: quantile of the standard normal distribution at 2/3
_BRACKET = 999_983  #: stream of draws of the ends of brackets: all thresholds of one draw are at the same end
_FACTS = ("full_well", "offset", "quantum_efficiency", "exposure", "pixel_pitch")  #: of a sensor, that may be drawn
Quantity = Literal["irradiance", "fluence"]
_COUNTED = "pixels counted in the point-spread functions at several distances (nodes.laser.bright_pixels)"
_STRAY = ", with the light that the lens scatters (nodes.flare.stray_light)"
_ROUND = "integral over a clear round pupil at each distance (nodes.laser.round_pixels)"


@dataclass(frozen=True)
class Limit:
    """A limit of the exposure at the peak on the sensor, in W/m2 or J/m2, with draws of all that is uncertain in it."""

    name: str
    effect: Literal["damage", "dazzle"]
    quantity: Quantity
    values: FloatArray  #: (1 + draw, 1 or distance); row 0 has the nominal values
    devices: FloatArray  #: (1 + draw, 1) factor of the drawn device on ``values``; 1 in row 0
    factor: float | None  #: geometric standard deviation from device to device; None where it is not known
    source: str
    note: str = ""
    kind: str = ""  #: of damage, such as point; empty for dazzle
    part: str = ""  #: of the light that the limit judges: pulse, mean, accumulation or incubation
    open_below: bool = False  #: whether nothing is known of exposures below the limit
    reason: str = ""  #: why nothing is known of them


def damage_limits(safety: Safety, option: Option, exposures: Exposures, draws: SettingDraws) -> Iterator[Limit]:
    """Yield the limit of each part of the light that a law of damage judges, behind one option."""
    for part in limit_parts(safety, option, exposures, draws):
        if part.threshold is not None:
            yield _damage_limit(part, safety, exposures, draws)


def limit_parts(safety: Safety, option: Option, exposures: Exposures, draws: SettingDraws) -> tuple[DamagePart, ...]:
    """Return the parts of the light that have a row of their own, judged or not; none if damage is not asked for.

    Continuous light has one row, because its pulse, its mean and its accumulation are the same light.
    """
    if safety.settings.damage is None:
        return ()
    light = light_in_time(safety, option, exposures, draws)
    parts = damage_parts(light, safety.settings.damage.device, safety.laws)
    single = "incubation" if float(light.pulses.max()) <= 1 else ""
    if light.pulse_duration is None:
        return tuple(part for part in parts if part.part == "mean")
    return tuple(part for part in parts if part.part != single)


def light_in_time(safety: Safety, option: Option, exposures: Exposures, draws: SettingDraws) -> LightInTime:
    """Return what decides the thresholds of damage behind an option: nominal values first, then each draw."""
    damage, beams = safety.settings.damage, exposures.beams
    assert damage is not None
    exponent = draws.column("damage.small_spot_exponent", damage.small_spot_exponent)
    spot = _heated(option, exposures)
    plain = exponent.max() == 0 and all(spot.max() <= law.spot for law in _with_spot(safety))
    return LightInTime(
        wavelength=beams[0].wavelength,
        dwell=_narrow(draws.column("damage.dwell", damage.dwell)),
        pulse_duration=_of_beams([beam.pulse_duration for beam in beams]),
        repetition_rate=_of_beams([beam.repetition_rate for beam in beams]),
        spot=None if plain else torch.from_numpy(spot),
        small_spot_exponent=_narrow(exponent),
    )


def _with_spot(safety: Safety) -> list[DamageLaw]:
    """Return the laws of continuous light whose spot is known."""
    laws = (*safety.laws, *PUBLISHED_DAMAGE)
    return [law for law in laws if law.quantity == "irradiance" and law.spot is not None]


def _heated(option: Option, exposures: Exposures) -> FloatArray:
    """Return the diameter of the heated spot behind an option (1 + draw, distance), for a mask an upper bound of it."""
    spot = exposures.spot[option.name]
    if option.heated is not None:
        return spot * option.heated
    return spot if option.peak == 1 else spot * widest_heated_diameter(1.0, option.peak)


def _narrow(values: FloatArray) -> Tensor:
    """Return a column (1 + draw, 1), or (1, 1) where all draws are alike."""
    alike = bool((values == values[0]).all())
    return torch.from_numpy(np.ascontiguousarray(values[: 1 if alike else None, None]))


def _of_beams(values: Sequence[float | None]) -> Tensor | None:
    """Return a quantity of the nominal beam and of each draw as a column; None for a beam without it."""
    return None if values[0] is None else _narrow(np.array(values, np.float64))


def _damage_limit(part: DamagePart, safety: Safety, exposures: Exposures, draws: SettingDraws) -> Limit:
    """Return the limit of one part of the light, with draws of its bracket, or of devices and medians.

    A third of the draws each is at the lower end of a bracket, in its middle and at its upper end.
    """
    assert part.threshold is not None
    low, middle, high = (end.numpy() for end in (part.threshold.low, part.threshold.middle, part.threshold.high))
    devices = np.ones((1 + draws.count, 1))
    if part.law is not None:
        stream = 2 * safety.laws.index(part.law)  # the same devices behind every option
        values = middle * _scattered(part.law.median_factor, draws, stream)
        devices = _scattered(part.law.factor, draws, stream + 1)
    elif part.open_below:
        values = high + np.zeros_like(devices)
    else:
        place = np.concatenate([[0.0], draws.normal(_BRACKET)])[:, None]
        values = np.where(place > _THIRD, high, np.where(place < -_THIRD, low, middle))
    quantity, factor = _stated_as(part, exposures, safety, draws)
    return Limit(
        name=_limit_name(part),
        effect="damage",
        quantity=quantity,
        values=values * factor,
        devices=devices,
        factor=None if part.law is None else part.law.factor,
        source=part.source,
        note=part.note,
        kind=part.kind,
        part=part.part,
        open_below=part.open_below,
        reason=part.reason,
    )


def _limit_name(part: DamagePart) -> str:
    """Return the name of the limit of a part of the light; the first damage, a point, is not named."""
    return f"damage: {part.part}" + ("" if part.kind == "point" else f", {part.kind}")


def _stated_as(
    part: DamagePart, exposures: Exposures, safety: Safety, draws: SettingDraws
) -> tuple[Quantity, FloatArray]:
    """Return the quantity of a limit, and the factor that makes it a limit of the emitted power or pulse energy.

    The mean of a train that has several pulses in the dwell time is a mean power. With one pulse in the dwell time, the
    mean is a limit of the energy of this pulse.
    """
    damage, beams = safety.settings.damage, exposures.beams
    assert damage is not None
    if part.quantity == "fluence" or beams[0].pulse_duration is None:
        return part.quantity, np.ones((1, 1))
    rates = np.array([[beam.repetition_rate or 0.0] for beam in beams])
    durations = np.array([[beam.pulse_duration or 0.0] for beam in beams])
    dwell = draws.column("damage.dwell", damage.dwell)[:, None]
    pulses = np.maximum(rates, 1 / dwell) * np.minimum(1.0, dwell / durations)
    if rates[0, 0] * dwell[0, 0] > 1:
        return "irradiance", rates / pulses
    return "fluence", 1 / pulses


def _scattered(factor: float | None, draws: SettingDraws, stream: int) -> FloatArray:
    """Return draws (1 + draw, 1) of a lognormal factor around 1; all are 1 for a factor that is not known."""
    scattered = np.power(factor or 1.0, draws.normal(stream))
    return np.concatenate([[1.0], scattered])[:, None]


def dazzle_limits(safety: Safety, area: Area, draws: SettingDraws, exposures: Exposures) -> Iterator[Limit]:
    """Yield the limits of saturation and of veil over the share of the picture that may be lost, behind one option.

    A limit is the exposure at the peak at which the faintest of these pixels is lost, at each distance.
    """
    dazzle, sensor = safety.settings.dazzle, safety.settings.sensor
    if dazzle is None:
        return
    name = area.option.name
    full = saturating(safety, draws)[:, None]
    share = f"{100 * dazzle.share:g} % of the picture"
    part = veil_level(dazzle, area.option.scene_share(safety.settings.lens.diameter)) / sensor.fills
    found = [("saturated", 1.0)] + ([("veiled", part)] if 0 < part < 1 else [])
    for word, part in found:
        light = area.level(exposures, draws, word == "veiled")
        values = full * part * exposures.sensor[name] * sensor.pixel_pitch**2 / (exposures.through[name] * light)
        devices = np.ones((len(values), 1))
        yield Limit(f"{word}: {share}", "dazzle", "irradiance", values, devices, None, dazzle_source(safety, area))


def dazzle_source(safety: Safety, area: Area) -> str:
    """Return from what the light of the pixels is computed."""
    return (_ROUND if area.ranked is None else _COUNTED) + (_STRAY if safety.settings.lens.scatter else "")


def veil_level(dazzle: Dazzle, scene: float = 1.0) -> float:
    """Return the electrons a pixel of the laser's light above which the feature is lost.

    ``scene`` is the share of the scene's light that a filter or a stop leaves: the background has as much less.
    """
    background = torch.tensor(dazzle.background * scene, dtype=torch.float64)
    rest = {"feature": dazzle.feature, "threshold": dazzle.least, "read_noise": dazzle.read_noise}
    return float(veil_limit(background, contrast=dazzle.contrast, rule=dazzle.rule, **rest))


def saturating(safety: Safety, draws: SettingDraws) -> FloatArray:
    """Return the irradiance in W/m2 that fills a pixel within one exposure, nominal and of each draw (1 + draw,).

    It is that of the channel that saturates first, where the settings name a step of responses.
    """
    sensor = safety.settings.sensor
    nominal = {**{name: float(getattr(sensor, name)) for name in _FACTS}, "wavelength": safety.laser.wavelength}
    prefixes = {name: "laser" if name == "wavelength" else "sensor" for name in nominal}
    columns = [draws.column(f"{prefixes[name]}.{name}", value) for name, value in nominal.items()]
    rows, places = np.unique(np.stack(columns, 1), axis=0, return_inverse=True)
    known = [_saturation(safety, dict(zip(nominal, map(float, row), strict=True))) for row in rows]
    return np.array(known)[places.ravel()]


def _saturation(safety: Safety, values: dict[str, float]) -> float:
    """Return the irradiance in W/m2 that fills a pixel, for drawn values of the sensor and the laser."""
    sensor = safety.settings.sensor.model_copy(update={name: values.pop(name) for name in ("full_well", "offset")})
    wavelength = values.pop("wavelength")
    if safety.channels is not None:
        return channel_saturation(safety.channels, wavelength, sensor.fills, values)
    at = torch.tensor([wavelength], dtype=torch.float64)
    return float(saturation(Bands(at, at, at), full_well=sensor.fills, **values))
