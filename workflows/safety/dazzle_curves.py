"""How many pixels a laser fills behind each protection: at the distance of the recipe, and against the irradiance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.recipe.distributions.shapes import FloatArray
from neusee.workflows.safety.dazzled_area import Area
from neusee.workflows.safety.distance_zones import Spread
from neusee.workflows.safety.exposures import Exposures
from neusee.workflows.safety.sensor_limits import saturating
from neusee.workflows.safety.uncertain_values import SettingDraws

_SAMPLES = 300  #: irradiances of a curve
#: ends of a curve, times the irradiance that loses the stated share behind the plain lens, or behind any protection
_FAINT, _STRONG = 1e-6, 1e1


@dataclass(frozen=True)
class Dazzled:
    """The pixels that the laser fills behind one protection."""

    option: str
    masked: bool
    pixels: Spread  #: at the distance of the recipe
    share: float  #: of the picture
    times: float | None  #: pixels over those behind the plain lens; None where one of both is 0
    at_lens: FloatArray  #: (irradiance,) mean over the exposure at the lens, W/m2
    curve: FloatArray  #: (irradiance,) share of the picture


def dazzled(
    safety: Safety, draws: SettingDraws, exposures: Exposures, areas: Sequence[Area], mean: FloatArray
) -> tuple[Dazzled, ...]:
    """Return the filled pixels behind each protection; ``mean`` (1 + draw, 1) is the mean power in a frame in W."""
    if not areas:
        return ()
    full, at = saturating(safety, draws), exposures.at(safety.laser.distance)
    whole = safety.settings.sensor.shape[0] * safety.settings.sensor.shape[1]
    pixel = safety.settings.sensor.pixel_pitch**2
    here = float(mean[0, 0] * exposures.lens[0, at])
    filled = [full[:, None] * pixel / exposures.through[area.option.name][:, at : at + 1] for area in areas]
    levels = [float(area.level(exposures, draws, veiled=False)[0, at]) for area in areas]
    limits = [needed[0, 0] / level * exposures.lens[0, at] for needed, level in zip(filled, levels, strict=True)]
    lens = np.geomspace(_FAINT * limits[0], max(_STRONG * max(limits), 2 * here), _SAMPLES)
    found: list[Dazzled] = []
    for area, needed in zip(areas, filled, strict=True):
        count = np.minimum(area.saturated(exposures, draws, at, needed / mean)[:, 0], whole)
        pixels = Spread.of(float(count[0]), count[1:])
        plain = found[0].pixels if found else pixels
        times = pixels.value / plain.value if pixels.value > 0 and plain.value > 0 else None
        light = needed[:1] * exposures.lens[0, at] / lens[None]
        curve = np.minimum(area.saturated(exposures, draws, at, light)[0] / whole, 1.0)
        lost = pixels.value / whole
        found.append(Dazzled(area.option.name, area.option.masked, pixels, lost, times, lens, curve))
    return tuple(found)
