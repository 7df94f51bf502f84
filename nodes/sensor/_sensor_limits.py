"""Largest signal-to-noise ratio and dynamic range of a sensor."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.sensor._room_for_light import refuse_without_room
from neusee.nodes.sensor._saturation import Efficiency, Well, photons_that_fill
from neusee.nodes.units import Electrons


class Limits(NamedTuple):
    """Limits of a sensor: photons that fill a pixel, largest signal-to-noise ratio, and dynamic range."""

    photons: Tensor  #: () float64, photons that fill a pixel
    snr: Tensor  #: () float64, signal-to-noise ratio at saturation
    dynamic_range: Tensor  #: () float64, dB


@node(rtol=1e-12)
def limits(*, full_well: Well, quantum_efficiency: Efficiency, read_noise: Electrons) -> Limits:
    """Compute the photons that fill a pixel, the signal-to-noise ratio at saturation, and the dynamic range.

    Shapes: -> three scalars, float64.
    Units:  photons; signal-to-noise ratio 1; dynamic range in dB, 20 log10(well / read noise).
    Error:  shot noise alone at the top and read noise alone at the bottom; a read noise under 1 e- counts as 1 e-.
    Source: EMVA Standard 1288, release 4.0 (SNR_max = sqrt(saturation capacity)).
    """
    decibels = 20.0 * math.log10(full_well / max(read_noise, 1.0))
    values = (photons_that_fill(full_well, quantum_efficiency), math.sqrt(full_well), decibels)
    return Limits(*(torch.tensor(v, dtype=torch.float64) for v in values))


@limits.preflight
def _(*, full_well: float, read_noise: float, **params: object) -> list[str]:
    refuse_without_room(full_well, read_noise=read_noise)
    return []


@limits.check
def _(result: Limits, **params: object) -> list[Check]:
    text = f"{float(result.photons):.0f} photons, SNR {float(result.snr):.1f}, {float(result.dynamic_range):.1f} dB"
    return [Check(text, float(result.dynamic_range) > 0)]
