"""The likelihood of the electrons that a sensor measures: photon noise, read noise and clipped
pixels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Generator, Tensor

from neusee.nodes.restore._electrons_and_colour import electrons
from neusee.nodes.sensor._digitization import digitize, full_well
from neusee.nodes.sensor._noise import dark_current, dark_electrons, photon_noise, read_noise

#: standard deviations: with the clip level this far below the expectation, a pixel clips with a
#: probability that rounds to 1
_CERTAIN_DEVIATIONS = -12.0


@dataclass(frozen=True)
class MeasuringSensor:
    """A sensor that measures expected electrons: Poisson-Gaussian noise, offset, full well and
    converter.

    The measured electrons of a pixel that is not clipped have a normal distribution with the
    expectation as mean and the total noise variance. A clipped pixel is censored: it is only known
    to have reached the clip level.

    Error:  a normal distribution in place of the Poisson distribution: right above about 20 e-.
            Rounding of the converter counts as noise of variance 1/12 DN2. Numbers below 0 DN are
            not counted as clipped.
    Source: EMVA Standard 1288, release 4.0 (variances); Tobin, Econometrica 26, 24 (1958) (censored
            measurements).
    """

    well: float  #: e-
    gain: float  #: DN/e-
    bits: int
    offset: float  #: e-
    read_noise: float  #: e- rms
    dark: float  #: e-, mean dark electrons of one exposure
    distribution: str  #: of the photons: ``poisson`` or ``gaussian``
    spread: float  #: photon noise over the square root of the electrons

    @property
    def level(self) -> float:
        """Return the clip level in e-: the smallest signal, after subtraction of the offset, that
        `restore.clipped` marks.
        """
        largest_number: int = max(1, min(2**self.bits - 1, int(self.well * self.gain - 0.5)))
        # rounding: values from 0.5 DN below the largest number are rounded up to it
        return (largest_number - 0.5) / self.gain - self.offset

    def variance(self, expected: Tensor, floor: float = 0.0) -> Tensor:
        """Return the variance (e-2) of the measured electrons; an expectation below ``floor``
        counts as ``floor``.
        """
        # read noise, and rounding with the variance 1 / 12 DN2
        constant_variance = self.read_noise**2 + 1.0 / (12.0 * self.gain**2)
        return self.spread**2 * expected.clamp_min(floor) + constant_variance

    def surprise(
        self, expected: Tensor, measured: Tensor, unsaturated: Tensor, floor: float = 0.0
    ) -> Tensor:
        """Return the negative log-likelihood of each pixel.

        Shapes: expected, measured and unsaturated broadcast against one another; the result has the
                common shape.
        Units:  e-, with the dark electrons and without the offset; unsaturated 0 where a pixel
                clipped; result nats.
        """
        variance = self.variance(expected, floor)
        normal = (measured - expected).square() / variance + (2.0 * math.pi * variance).log()
        return torch.where(
            unsaturated > 0,
            0.5 * normal,
            -torch.special.log_ndtr(-self._distance(expected, variance)),
        )

    def surprise_slope(
        self, expected: Tensor, measured: Tensor, unsaturated: Tensor, floor: float = 0.0
    ) -> Tensor:
        """Return the derivative of `surprise` with respect to the expected electrons, in
        nats/e-.
        """
        variance = self.variance(expected, floor)
        # relative change of the variance per electron
        relative_growth = self.spread**2 * (expected > floor).to(expected) / variance
        error = measured - expected
        normal = -error / variance + 0.5 * relative_growth * (1.0 - error.square() / variance)
        distance = self._distance(expected, variance)
        distance_slope = -variance.rsqrt() - 0.5 * distance * relative_growth
        return torch.where(unsaturated > 0, normal, _hazard(distance) * distance_slope)

    def measured(self, expected: Tensor, rng: Generator) -> Tensor:
        """Return a simulated measurement in e-, without the offset, for expected electrons without
        dark electrons.
        """
        charge = photon_noise(
            expected,
            quantum_efficiency=1.0,
            distribution=self.distribution,
            spread=self.spread,
            rng=rng,
        )
        warm = dark_current(charge, mean=self.dark, rng=rng)
        noisy = read_noise(warm, offset=self.offset, read_noise=self.read_noise, rng=rng)
        raw = digitize(full_well.fn(noisy, capacity=self.well), gain=self.gain, bits=self.bits)
        result: Tensor = electrons(raw, gain=self.gain, offset=self.offset)
        return result

    def _distance(self, expected: Tensor, variance: Tensor) -> Tensor:
        """Return the distance from the expectation up to the clip level, in standard deviations."""
        return (self.level - expected) * variance.rsqrt()


def _hazard(z: Tensor) -> Tensor:
    """Return the hazard of the standard normal distribution at z: its density over the probability
    above z.
    """
    hazard: Tensor = math.sqrt(2.0 / math.pi) / torch.special.erfcx(
        z.clamp_min(_CERTAIN_DEVIATIONS) * math.sqrt(0.5)
    )
    return hazard


def measuring_sensor(
    charge: Mapping[str, Any],
    dark: Mapping[str, Any],
    read: Mapping[str, Any],
    well: Mapping[str, Any],
    digital: Mapping[str, Any],
    signal: Mapping[str, Any],
) -> MeasuringSensor:
    """Return the sensor with the parameters of `photon_noise`, `dark_current`, `read_noise`,
    `full_well`, `digitize` and `electrons`.

    Raises ValueError for readings of the paper in which the mean of a measurement differs from the
    expected electrons.
    """
    settings = {
        "mean": (charge["mean"], "additive"),
        "mean_shift": (charge["mean_shift"], 0.0),
        "drawn_in": (charge["drawn_in"], "electrons"),
        "rounding": (digital["rounding"], "nearest"),
        "offset_subtracted": (signal["offset_subtracted"], True),
    }
    bad_settings = [
        f"{name} {setting!r} (must be {right!r})"
        for name, (setting, right) in settings.items()
        if setting != right
    ]
    if bad_settings:
        raise ValueError(
            f"the likelihood is not that of a sensor with {', '.join(bad_settings)}: use `reading:"
            " coherent`"
        )
    return MeasuringSensor(
        well=well["capacity"],
        gain=digital["gain"],
        bits=digital["bits"],
        offset=read["offset"],
        read_noise=read["read_noise"],
        dark=dark_electrons(dark["mean"], dark["exposure"]),
        distribution=charge["distribution"],
        spread=charge["spread"],
    )
