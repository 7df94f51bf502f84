"""Limits of exposure at the peak on the sensor: published and own thresholds of damage, and the onset of dazzle."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from neusee.nodes.laser import (
    Beam,
    DamageLaw,
    damage_threshold,
    matching_laws,
    veil_limit,
)
from neusee.nodes.sensor import saturation
from neusee.nodes.values import Bands
from neusee.workflows.recipe.blocks.safety_block import Dazzle, Safety
from neusee.workflows.recipe.distributions.scalar import FloatArray
from neusee.workflows.safety.dazzled_area import Area
from neusee.workflows.safety.exposures import Exposures, Option
from neusee.workflows.safety.uncertain_values import SettingDraws

_SPOTS = 64  #: diameters between which a threshold is interpolated
Quantity = Literal["irradiance", "fluence"]
_COUNTED = "pixels counted in the point-spread function (nodes.laser.bright_pixels)"
_STRAY = ", with the light that the lens scatters"
_AIRY = "Airy pattern of a clear round pupil, derived in neusee (nodes.laser.dazzle_exposure_limit)"


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


def quantities(beam: Beam) -> tuple[tuple[Quantity, float | None], ...]:
    """Return the quantities of damage that count for a laser, each with the duration of a pulse, None for the dwell."""
    if not beam.is_pulsed:
        return (("irradiance", None),)
    pulse: tuple[Quantity, float | None] = ("fluence", beam.pulse_duration)
    return (pulse,) if beam.power is None else (pulse, ("irradiance", None))


def damage_limits(safety: Safety, option: Option, exposures: Exposures, draws: SettingDraws) -> Iterator[Limit]:
    """Yield the limit of each law of damage that holds for the laser and the sensor, behind one option."""
    chosen, beam = safety.settings.damage, safety.laser.beam()
    laws = safety.laws
    said: dict[str, int] = {}
    for quantity, pulse in quantities(beam):
        duration = chosen.dwell if pulse is None else pulse
        for law in matching_laws(laws, chosen.device, beam.wavelength, duration, quantity):
            values, note = _threshold(law, safety, option, exposures)
            stream = 2 * laws.index(law)  # the same devices behind every option
            medians = _scattered(law.median_factor, draws, stream)
            devices = _scattered(law.factor, draws, stream + 1)
            said[law.damage] = said.get(law.damage, 0) + 1
            name = f"damage: {law.damage}" + (f" ({said[law.damage]})" if said[law.damage] > 1 else "")
            yield Limit(name, "damage", quantity, values * medians, devices, law.factor, law.source, note)


def _scattered(factor: float | None, draws: SettingDraws, stream: int) -> FloatArray:
    """Return draws (1 + draw, 1) of a lognormal factor around 1; all are 1 for a factor that is not known."""
    scattered = np.power(factor or 1.0, draws.normal(stream))
    return np.concatenate([[1.0], scattered])[:, None]


def _threshold(law: DamageLaw, safety: Safety, option: Option, exposures: Exposures) -> tuple[FloatArray, str]:
    """Return the threshold (1 + draw or 1, distance or 1) of the median device, and for which spot it is."""
    if law.quantity == "fluence" or law.spot is None:
        return np.array([[law.median]]), "as published, for any spot"
    if safety.settings.damage.spot == "published" or option.peak != 1.0:
        return np.array([[law.median]]), f"for the published spot of {law.spot * 1e6:.3g} um"
    spots = exposures.spot[option.name]
    known = np.geomspace(spots.min(), spots.max() * (1 + 1e-9), _SPOTS)
    limits = [damage_threshold(law, float(spot), safety.settings.damage.dwell) for spot in known]
    here = float(spots[0, exposures.at(safety.laser.distance)])
    note = f"for the spot of {here * 1e6:.3g} um, from the published {law.spot * 1e6:.3g} um by equal heat"
    return np.exp(np.interp(np.log(spots), np.log(known), np.log(limits))), note


def dazzle_limits(safety: Safety, area: Area, draws: SettingDraws) -> Iterator[Limit]:
    """Yield the limits of saturation and of veil over the share of the picture that may be lost, behind one option."""
    dazzle, sensor = safety.settings.dazzle, safety.settings.sensor
    if dazzle is None:
        return
    pixels = dazzle.share * sensor.shape[0] * sensor.shape[1]
    full = saturating(safety, draws)
    share = f"{100 * dazzle.share:g} % of the picture"
    part = veil_level(dazzle) / (sensor.full_well or 1.0)
    source = _AIRY if area.ranked is None else _COUNTED + (_STRAY if area.ranked.stray else "")
    found = [("saturated", 1.0)] + ([("veiled", part)] if 0 < part < 1 else [])
    for word, part in found:
        times = area.limit(pixels, word == "veiled")
        if times is not None:
            values = (full * times * part)[:, None]
            yield Limit(f"{word}: {share}", "dazzle", "irradiance", values, np.ones_like(values), None, source)


def veil_level(dazzle: Dazzle) -> float:
    """Return the electrons a pixel of the laser's light above which the feature is lost."""
    background = torch.tensor(dazzle.background, dtype=torch.float64)
    rest = {"feature": dazzle.feature, "threshold": dazzle.least, "read_noise": dazzle.read_noise}
    return float(veil_limit(background, contrast=dazzle.contrast, rule=dazzle.rule, **rest))


def saturating(safety: Safety, draws: SettingDraws) -> FloatArray:
    """Return the irradiance in W/m2 that fills a pixel within one exposure, nominal and of each draw (1 + draw,)."""
    sensor = safety.settings.sensor
    at = torch.tensor([safety.laser.wavelength], dtype=torch.float64)
    names = ("full_well", "quantum_efficiency", "exposure", "pixel_pitch")
    columns = [draws.column(f"sensor.{name}", float(getattr(sensor, name))) for name in names]
    rows = np.unique(np.stack(columns, 1), axis=0, return_inverse=True)
    known = [float(saturation(Bands(at, at, at), **dict(zip(names, map(float, row), strict=True)))) for row in rows[0]]
    return np.array(known)[rows[1].ravel()]
