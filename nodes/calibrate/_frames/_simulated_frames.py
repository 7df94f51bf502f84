"""A node that simulates frames of a flat field by the same sensor steps as a picture."""

from __future__ import annotations

from typing import Any

import torch
from torch import Generator, Tensor

from neusee.nodes import Check, node
from neusee.nodes.calibrate._frames._frame_statistics import Photons
from neusee.nodes.sensor._digitization import Bits, Rounding, digitize
from neusee.nodes.sensor._digitization import full_well as well_of
from neusee.nodes.sensor._noise import Distribution, Spread, dark_current, photon_noise, read_noise
from neusee.nodes.sensor._room_for_light import refuse_without_room, refuse_without_steps
from neusee.nodes.sensor._saturation import Efficiency, Well
from neusee.nodes.units import Count, Electrons, Exposure, Fraction, Gain, Shape

dark_of, read_of = dark_current, read_noise  # parameters below have the same names


@node()
def expose(
    *,
    photons: Photons,
    exposure: Exposure,
    shape: Shape,
    frames: Count = 2,
    quantum_efficiency: Efficiency,
    dark_current: Electrons,
    dark_exposure: Exposure,
    offset: Electrons,
    read_noise: Electrons,
    full_well: Well,
    gain: Gain,
    rounding: Rounding = "nearest",
    bits: Bits = 16,
    distribution: Distribution = "gaussian",
    mean_shift: Fraction = 0.0,
    spread: Spread = 1.0,
    rng: Generator,
) -> Tensor:
    """Simulate frames of a flat field by the same sensor steps that simulate a picture.

    Shapes: -> (frame, y, x).
    Units:  result DN; photons per pixel and exposure; dark_current e- of one dark_exposure, in proportion to the
            exposure; offset, read_noise, full_well e-; gain K, DN/e-.
    Error:  the errors of the sensor steps. All pixels are alike: neither non-uniformity nor drift of the lamp.
    Source: NeuSee, section Sensor Image; EMVA Standard 1288, release 4.0 Linear (mathematical model).
    """
    flat = torch.full((frames, *shape), photons, device=rng.device)
    e = photon_noise(
        flat,
        quantum_efficiency=quantum_efficiency,
        distribution=distribution,
        mean_shift=mean_shift,
        spread=spread,
        rng=rng,
    )
    e = dark_of(e, mean=dark_current * exposure / dark_exposure, rng=rng)
    e = well_of(read_of(e, offset=offset, read_noise=read_noise, rng=rng), capacity=full_well)
    numbers: Tensor = digitize(e, gain=gain, rounding=rounding, bits=bits, rng=rng)
    return numbers


@expose.preflight
def _(
    *,
    exposure: float,
    dark_current: float,
    dark_exposure: float,
    offset: float,
    read_noise: float,
    full_well: float,
    gain: float,
    bits: int = 16,
    **params: object,
) -> list[str]:
    dark = dark_current * exposure / dark_exposure
    refuse_without_room(full_well, offset=offset, read_noise=read_noise, dark=dark)
    refuse_without_steps(full_well, gain=gain, bits=bits)
    return []


@expose.check
def _(result: Tensor, **params: Any) -> list[Check]:
    mean = float(result.sum(-1).sum(dtype=torch.float64)) / result.numel()
    return [Check(f"mean {mean:.5g} DN, pixels of {float(result.min()):g} to {float(result.max()):g} DN")]
