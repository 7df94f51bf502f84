"""The node of the likelihood of calibration frames, given the parameters of a sensor."""

from __future__ import annotations

from typing import Any, Literal

import torch

from neusee.nodes import Check, node
from neusee.nodes.calibrate._likelihood._linear_sensor import Likelihood, Sensor, likelihood
from neusee.nodes.calibrate._likelihood._sufficient_statistics import Sufficient
from neusee.nodes.sensor._digitization import Bits, Rounding
from neusee.nodes.sensor._noise import Distribution, Spread
from neusee.nodes.sensor._saturation import Efficiency, Well
from neusee.nodes.units import Electrons, Exposure, Fraction, Gain


@node()
def density(
    levels: Sufficient,
    *,
    gain: Gain,
    quantum_efficiency: Efficiency,
    offset: Electrons,
    read_noise: Electrons,
    dark_current: Electrons,
    dark_exposure: Exposure,
    full_well: Well,
    arrivals: Distribution = "gaussian",
    mean_shift: Fraction = 0.0,
    spread: Spread = 1.0,
    mean: Literal["additive", "literal"] = "additive",
    drawn_in: Literal["electrons", "photons"] = "electrons",
    rounding: Rounding = "nearest",
    bits: Bits = 16,
    told: bool = True,
) -> Likelihood:
    """Compute the likelihood of measured light levels from the probability distributions of the nodes in `sensor`.

    Where numbers count as continuous, mean and variance are sufficient statistics of a level, so that the cost does not
    depend on the number of pixels. Numbers near the well and coarse numbers have the exact probabilities of the
    quantiser. Any of the seven numbers of the sensor may be a tensor (walker,), and all walkers are computed at
    once. ``told`` adds deviances and the rows of the Fisher information, which a sampler does not need.

    Shapes: levels -> log (walker,), deviance (walker, level), scaled (walker, row).
    Units:  gain K, DN/e-; dark_current e- in ``dark_exposure``; log in nats, for numbers of 1 DN.
    Error:  the signal is taken as Gaussian, except in coarse levels of up to 8 electrons: relative 1e-3 at 3 standard
            deviations of 100 Poisson electrons. All pixels are assumed alike; crosstalk of neighbours, lag and drift
            of the lamp, which real frames show, are neglected (see `camera`).
    Source: NeuSee, section Sensor Image; EMVA Standard 1288, release 4.0 Linear, section 3.
    """
    parameters = (gain, quantum_efficiency, offset, read_noise, dark_current, full_well, mean_shift, spread)
    columns = [torch.as_tensor(x, dtype=torch.float64)[..., None] for x in parameters]
    alike = torch.broadcast_tensors(*columns)  # type: ignore[no-untyped-call]
    k, efficiency, bias, read, dark, well, shift, c2 = alike
    kept = shift + (mean == "additive")
    variance = c2.square() * (efficiency if drawn_in == "electrons" else efficiency.square())
    whole = arrivals == "poisson" and (mean, drawn_in) == ("additive", "electrons")
    sensor = Sensor(
        gain=k,
        response=k * efficiency * kept,
        noise=k.square() * variance,
        offset=k * bias,
        read=k * read,
        dark=k * dark / dark_exposure,
        well=k * well,
        counted=whole and bool(((c2 == 1) & (shift == 0)).all()),
    )
    return likelihood(levels, sensor, rounding, bits, told)


@density.check
def _(result: Likelihood, *inputs: Sufficient, **params: Any) -> list[Check]:
    if not len(result.degrees_of_freedom):
        return []
    off, freedom = float(result.deviance.sum()), float(result.degrees_of_freedom.sum())
    return [Check(f"deviance {off:.4g} for {freedom:.0f} degrees of freedom")]
