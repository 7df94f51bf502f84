"""Absorption of light in silicon, and what it says of thresholds of damage at wavelengths without an experiment."""

from __future__ import annotations

import bisect
import math

SILICON_RANGE = (400e-9, 1100e-9)  #: m, wavelengths of the table below
DEPTH = 3e-6  #: m of silicon whose absorbed light warms a pixel
ABSORPTION_SOURCE = (
    "extinction of silicon at 300 K: Green, Sol. Energ. Mat. Sol. Cells 92, 1305 (2008), as tabulated in the "
    "refractiveindex.info database (CC0)"
)
_STEP = 10e-9  #: m, between two entries of the table
#: extinction coefficient k of silicon from 400 to 1100 nm
_EXTINCTION = (
    2.9600e-1, 2.2700e-1, 1.7600e-1, 1.3800e-1, 1.0700e-1, 8.6302e-2, 7.1381e-2, 6.2086e-2, 5.5004e-2, 4.9131e-2,
    4.4165e-2, 3.9367e-2, 3.6415e-2, 3.3108e-2, 3.0295e-2, 2.7968e-2, 2.5758e-2, 2.4131e-2, 2.2524e-2, 2.1081e-2,
    1.9934e-2, 1.8446e-2, 1.7367e-2, 1.6444e-2, 1.5432e-2, 1.4431e-2, 1.3498e-2, 1.2743e-2, 1.1905e-2, 1.1201e-2,
    1.0528e-2, 1.0057e-2, 9.6257e-3, 8.9461e-3, 8.3620e-3, 7.8185e-3, 7.1970e-3, 6.7402e-3, 6.3933e-3, 5.8340e-3,
    5.4113e-3, 4.9955e-3, 4.6134e-3, 4.2734e-3, 3.9439e-3, 3.6120e-3, 3.2781e-3, 2.9839e-3, 2.6821e-3, 2.4293e-3,
    2.1701e-3, 1.9625e-3, 1.7571e-3, 1.5467e-3, 1.3689e-3, 1.1793e-3, 1.0237e-3, 8.7225e-4, 7.4866e-4, 6.2238e-4,
    5.0930e-4, 4.1071e-4, 3.2386e-4, 2.4753e-4, 1.8704e-4, 1.3620e-4, 9.3631e-5, 6.8118e-5, 5.3285e-5, 4.0768e-5,
    3.0637e-5,
)  # fmt: skip


def silicon_absorption(wavelength: float) -> float:
    """Return the absorption coefficient 4 pi k / wavelength of silicon at 300 K in 1/m, from 400 to 1100 nm.

    The logarithm of k is interpolated between entries of the table that are 10 nm apart. Raises ValueError for another
    wavelength. Source: Green, Sol. Energ. Mat. Sol. Cells 92, 1305 (2008), band-to-band absorption.
    """
    first, last = SILICON_RANGE
    if not first <= wavelength <= last:
        raise ValueError(f"no absorption of silicon at {wavelength * 1e9:.5g} nm: the table has 400 to 1100 nm")
    entries = [first + _STEP * index for index in range(len(_EXTINCTION))]
    index = min(max(bisect.bisect(entries, wavelength) - 1, 0), len(_EXTINCTION) - 2)
    share = (wavelength - entries[index]) / _STEP
    logarithm = (1 - share) * math.log(_EXTINCTION[index]) + share * math.log(_EXTINCTION[index + 1])
    return 4 * math.pi * math.exp(logarithm) / wavelength


def absorbed_share(wavelength: float, depth: float = DEPTH) -> float:
    """Return the share of the light that enters silicon and is absorbed within a depth in m: 1 - exp(-alpha depth)."""
    return -math.expm1(-silicon_absorption(wavelength) * depth)


def absorption_bracket(wavelength: float, measured: float) -> tuple[float, float]:
    """Return the least and the largest factor on a threshold that was measured at another wavelength in m.

    The factor 1 means that the sensor absorbs as it does at the wavelength of the experiment: metal, filters and
    microlenses absorb beside the silicon. The other end means that 3 um of silicon alone absorb. Both are an
    extrapolation: the true factor is somewhere between, or outside where another mechanism damages.
    """
    alone = absorbed_share(measured) / absorbed_share(wavelength)
    return min(1.0, alone), max(1.0, alone)
