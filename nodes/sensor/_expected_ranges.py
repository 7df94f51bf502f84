"""Expected ranges of the results of the sensor nodes, from which a plan predicts what full well and
converter clip.

Before a run no image is known. Its brightest pixel therefore counts as 1, and irradiance is in
photons of the brightest channel per second and square metre. The weights of the bands and the
responses of the channels cancel between `sensor.level` and `sensor.expose`, so they are left out.
"""

import math
from collections.abc import Iterable
from itertools import chain
from typing import Any

from neusee.nodes import TensorStats
from neusee.nodes.sensor._digitization import crop, digitize, full_well
from neusee.nodes.sensor._exposure import add_photons, expose, level
from neusee.nodes.sensor._noise import dark_current, dark_electrons, photon_noise, read_noise
from neusee.nodes.sensor._saturation import photons_that_fill
from neusee.nodes.units import ElectronsPerSecond

_SIGMAS = 4.0  #: deviation of the brightest of many pixels from its mean, in standard deviations
Range = tuple[float, float]


@level.expected_range
def _(
    *inputs: Any,
    strength: float | None,
    full_well: float,
    quantum_efficiency: float,
    pixel_pitch: float,
    exposure: float,
    **params: Any,
) -> Range:
    if strength is None:
        raise LookupError("the irradiance of a white surface is known with the spectra only")
    level = (
        strength * photons_that_fill(full_well, quantum_efficiency) / (exposure * pixel_pitch**2)
    )
    return level, level


@expose.expected_range
def _(
    irradiance: TensorStats,
    bands: Any,
    responses: Any,
    level: TensorStats | None = None,
    *,
    pixel_pitch: float,
    exposure: float,
) -> Range:
    # photons per unit of the image; `level` has the same value in all bands here
    photons = (1.0 if level is None else level.max) * exposure * pixel_pitch**2
    return irradiance.min * photons, irradiance.max * photons


@add_photons.expected_range
def _(photons: TensorStats, *added: Iterable[TensorStats] | None) -> Range:
    others = list(chain.from_iterable(filter(None, added)))
    return photons.min, math.fsum(light.max for light in (photons, *others))


@photon_noise.expected_range
def _(
    photons: TensorStats,
    *,
    quantum_efficiency: float,
    mean_shift: float,
    spread: float,
    mean: str,
    **params: Any,
) -> Range:
    counts = photons.max * quantum_efficiency
    mean_factor = mean_shift + (mean == "additive")
    return 0.0, max(0.0, mean_factor * counts + _SIGMAS * spread * math.sqrt(counts))


@dark_current.expected_range
def _(
    electrons: TensorStats,
    *,
    mean: float | ElectronsPerSecond,
    exposure: float | None,
    **params: Any,
) -> Range:
    total = dark_electrons(mean, exposure)
    return electrons.min, electrons.max + total + _SIGMAS * math.sqrt(total)


@read_noise.expected_range
def _(electrons: TensorStats, *, offset: float, read_noise: float, **params: Any) -> Range:
    return (
        electrons.min + offset - _SIGMAS * read_noise,
        electrons.max + offset + _SIGMAS * read_noise,
    )


@full_well.expected_range
def _(electrons: TensorStats, *, capacity: float) -> Range:
    return min(electrons.min, capacity), min(electrons.max, capacity)


@digitize.expected_range
def _(electrons: TensorStats, *, gain: float, bits: int, **params: Any) -> Range:
    low, high = (min(max(end * gain, 0.0), 2.0**bits - 1) for end in (electrons.min, electrons.max))
    return low, high


@crop.expected_range
def _(image: TensorStats, **params: Any) -> Range:
    return image.min, image.max
