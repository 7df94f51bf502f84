"""How many pixels a laser fills behind each protection: at the distance of the recipe, and against the irradiance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.recipe.distributions.scalar import FloatArray
from neusee.workflows.safety.dazzled_area import Area
from neusee.workflows.safety.distance_zones import Spread
from neusee.workflows.safety.exposures import Exposures
from neusee.workflows.safety.sensor_limits import saturating
from neusee.workflows.safety.uncertain_values import SettingDraws

_SAMPLES = 200  #: irradiances of a curve
_FAINT, _STRONG = 1e-6, 1e1  #: ends of a curve, times the irradiance that loses the stated share behind the plain lens


@dataclass(frozen=True)
class Dazzled:
    """The pixels that the laser fills behind one protection."""

    option: str
    masked: bool
    pixels: Spread | None  #: at the distance of the recipe; None where the window of the PSF does not hold them
    share: float | None  #: of the picture
    times: float | None  #: pixels over those behind the plain lens; None where one of both is 0 or not known
    at_lens: FloatArray  #: (irradiance,) mean over the exposure at the lens, W/m2
    curve: FloatArray  #: (irradiance,) share of the picture; NaN where the window does not hold the pixels


def dazzled(
    safety: Safety, draws: SettingDraws, exposures: Exposures, areas: Sequence[Area], mean: FloatArray
) -> tuple[Dazzled, ...]:
    """Return the filled pixels behind each protection; ``mean`` (1 + draw, 1) is the mean power in a frame in W."""
    if not areas:
        return ()
    full, at = saturating(safety, draws), exposures.at(safety.laser.distance)
    whole = safety.settings.sensor.shape[0] * safety.settings.sensor.shape[1]
    gains = [exposures.sensor[area.option.name][0, at] / exposures.lens[0, at] for area in areas]
    lost = areas[0].limit((safety.settings.dazzle.share if safety.settings.dazzle else 1.0) * whole, veiled=False)
    centre = (lost or 1e6) * full[0] / gains[0]
    here = float(mean[0, 0] * exposures.lens[0, at])
    lens = np.geomspace(_FAINT * centre, max(_STRONG * centre, 2 * here), _SAMPLES)
    found: list[Dazzled] = []
    for area, gain in zip(areas, gains, strict=True):
        count = np.minimum(area.saturated(mean[:, 0] * exposures.sensor[area.option.name][:, at] / full), whole)
        pixels = None if np.isnan(count[0]) else Spread.of(float(count[0]), count[1:])
        plain = found[0].pixels if found else pixels
        times = pixels.value / plain.value if pixels and plain and pixels.value > 0 and plain.value > 0 else None
        curve = np.minimum(area.saturated(lens * gain / full[0]) / whole, 1.0)
        share = None if pixels is None else pixels.value / whole
        found.append(Dazzled(area.option.name, area.option.masked, pixels, share, times, lens, curve))
    return tuple(found)
