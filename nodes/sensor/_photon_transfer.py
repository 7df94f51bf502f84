"""Photon-transfer curve of a sensor, measured with simulated pairs of flat fields."""

from collections.abc import Collection, Mapping
from typing import Any

import torch
from torch import Generator, Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.sensor._digitization import Bits, Rounding, digitize, full_well
from neusee.nodes.sensor._noise import (
    Distribution,
    dark_current,
    dark_electrons,
    photon_noise,
    read_noise,
)
from neusee.nodes.sensor._saturation import Well, refuse_without_room, refuse_without_steps
from neusee.nodes.units import (
    Count,
    DarkCurrent,
    Efficiency,
    Electrons,
    ElectronsPerSecond,
    Exposure,
    Gain,
)

limit_to_well, add_read_noise = full_well, read_noise  # parameters below have the same names


@node()
def photon_transfer(
    *,
    full_well: Well,
    quantum_efficiency: Efficiency,
    gain: Gain,
    rounding: Rounding = "nearest",
    bits: Bits = 16,
    offset: Electrons,
    read_noise: Electrons,
    dark: DarkCurrent,
    exposure: Exposure | None = None,
    distribution: Distribution = "gaussian",
    levels: Count = 24,
    pixels: Count = 16384,
    rng: Generator,
) -> Tensor:
    """Simulate the photon-transfer curve: measured and predicted variance against the mean signal.

    Each level of illumination has two flat fields. The first level is dark. The other levels rise
    geometrically from one electron to 1.2 full wells. The frames are computed by the same nodes as
    a picture. The signal is the mean minus the dark mean. The prediction is K^2 sigma_d^2 +
    sigma_q^2 + K (mean - dark mean).

    Shapes: -> (level, 3) float64.
    Units:  gain K, DN/e-; dark e- of one exposure, or e-/s times exposure; result DN, DN2, DN2.
    Error:  sampling: the variance of a pair has a relative deviation of sqrt(2 / pixels), 1.1 % at
            16384. The prediction includes neither the full well nor the end of the converter, so
            the variances differ there.
    Source: EMVA Standard 1288, release 4.0 Linear (photon transfer method, difference of two
            frames).
    """

    dark_mean = dark_electrons(dark, exposure)

    def frame(photons: float) -> Tensor:
        flat_field = torch.full((pixels,), photons, dtype=torch.float64, device=rng.device)
        electrons = photon_noise(
            flat_field, quantum_efficiency=quantum_efficiency, distribution=distribution, rng=rng
        )
        electrons = add_read_noise(
            dark_current(electrons, mean=dark_mean, rng=rng),
            offset=offset,
            read_noise=read_noise,
            rng=rng,
        )
        electrons = limit_to_well(electrons, capacity=full_well)
        numbers: Tensor = digitize(electrons, gain=gain, rounding=rounding, bits=bits, rng=rng)
        return numbers

    photon_levels = _photon_levels(full_well / quantum_efficiency, 1.0 / quantum_efficiency, levels)
    pair_statistics = torch.tensor(
        [_mean_and_variance(frame(p), frame(p)) for p in photon_levels], dtype=torch.float64
    )
    signal = pair_statistics[:, 0] - pair_statistics[0, 0]
    # DN2: read noise, dark current, and rounding (1/12, or 1/6 with the dithered floor)
    dark_variance = gain**2 * (read_noise**2 + dark_mean) + (
        1.0 / 6.0 if rounding == "dithered_floor" else 1.0 / 12.0
    )
    # columns: signal, measured variance, predicted variance
    return torch.stack([signal, pair_statistics[:, 1], dark_variance + gain * signal], 1)


def _photon_levels(top: float, first: float, levels: int) -> list[float]:
    """Return the photons of each level: 0, then geometric steps from ``first`` to 1.2 times
    ``top``.
    """
    step_count = max(levels - 2, 1)
    ratio = 1.2 * top / first
    return [0.0, *(first * ratio ** (i / step_count) for i in range(levels - 1))]


def _mean_and_variance(first: Tensor, second: Tensor) -> tuple[float, float]:
    """Return the mean of two frames, and the temporal variance from the difference of the
    frames.
    """
    return float((first + second).mean() / 2), float((first - second).square().mean() / 2)


@photon_transfer.unused
def _(params: Mapping[str, Any]) -> Collection[str]:
    # only a dark current per second grows with the exposure
    return () if isinstance(params["dark"], ElectronsPerSecond) else ("exposure",)


@photon_transfer.preflight
def _(
    *,
    full_well: float,
    gain: float,
    bits: int,
    offset: float,
    read_noise: float,
    dark: float | ElectronsPerSecond,
    exposure: float | None = None,
    **params: object,
) -> list[str]:
    try:
        electrons = dark_electrons(dark, exposure)
    except ParameterError as error:
        raise ParameterError("dark", str(error)) from None
    refuse_without_room(full_well, offset=offset, read_noise=read_noise, dark=electrons)
    refuse_without_steps(full_well, gain=gain, bits=bits)
    return []


@photon_transfer.check
def _(result: Tensor, *, full_well: float, gain: float, **params: Any) -> list[Check]:
    in_range = (result[:, 0] > 0.02 * full_well * gain) & (result[:, 0] < 0.7 * full_well * gain)
    if not bool(in_range.any()):
        return [
            Check(
                "no flat field lies between 2 and 70 % of the full well, so the variance is not"
                " checked"
            )
        ]
    ratio = float((result[in_range, 1] / result[in_range, 2]).mean())
    return [
        Check(
            f"the measured variance is {ratio:.3f} times the predicted variance",
            abs(ratio - 1) < 0.1,
        )
    ]
