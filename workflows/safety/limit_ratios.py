"""How often a laser exceeds a limit: the exposure at the peak on the sensor over the limit there."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from neusee.nodes.laser import frame_power
from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.recipe.distributions.shapes import FloatArray
from neusee.workflows.safety.dazzled_area import Area
from neusee.workflows.safety.exposures import Exposures, Option
from neusee.workflows.safety.sensor_limits import Limit, damage_limits, dazzle_limits
from neusee.workflows.safety.uncertain_values import SettingDraws


def limits_behind(
    safety: Safety, draws: SettingDraws, option: Option, area: Area | None, exposures: Exposures
) -> Iterator[Limit]:
    """Yield each limit of damage behind a protection, and each limit of dazzle where its area is known."""
    yield from damage_limits(safety, option, exposures, draws)
    if area is not None:
        yield from dazzle_limits(safety, area, draws, exposures)


def limit_ratio(safety: Safety, option: str, limit: Limit, exposures: Exposures) -> FloatArray:
    """Return the exposure over the limit (1 + draw, distance) behind a protection; row 0 has the nominal values."""
    return emitted(safety, limit, exposures) * exposures.sensor[option] / (limit.values * limit.devices)


def emitted(safety: Safety, limit: Limit, exposures: Exposures) -> FloatArray:
    """Return power or pulse energy (1 + draw, 1); for dazzle the mean power of the light that reaches one frame."""
    if limit.effect == "damage":
        return exposures.emitted(limit.quantity)
    return mean_in_frame(exposures, safety.settings.sensor.exposure or 1.0)


def mean_in_frame(exposures: Exposures, exposure: float) -> FloatArray:
    """Return the mean power in W during an exposure in which at least one pulse of a pulsed laser falls."""
    rows = [frame_power(beam, exposure) for beam in exposures.beams]
    return np.array(rows, np.float64)[:, None]
