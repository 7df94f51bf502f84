"""The photon transfer of EMVA 1288: lit levels with their darks, the saturation point, and the ranges of fits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neusee.nodes.values import Levels

FloatArray = NDArray[np.float64]
SENSITIVITY = 0.7  #: share of saturation up to which gain and responsivity are fitted
LINEARITY = (0.05, 0.95)  #: shares of saturation between which the response is compared with a line
_PLATEAU = 0.5  #: a maximum of the variance below this share of the greatest one is noise of saturated levels


@dataclass(frozen=True)
class PhotonTransfer:
    """Lit levels (level,) in rising order of light, the dark of each, and all darks (dark,) in rising exposure."""

    photons: FloatArray  #: mu_p, per pixel and exposure
    exposure: FloatArray  #: s
    mean: FloatArray  #: mu_y, DN
    variance: FloatArray  #: sigma_y^2, DN2
    mean_dark: FloatArray  #: mu_y.dark of the nearest exposure, DN
    variance_dark: FloatArray  #: DN2
    dark_exposure: FloatArray  #: s
    dark_mean: FloatArray  #: DN
    dark_variance: FloatArray  #: DN2
    saturation: int  #: index of the lit level at saturation
    saturated: bool  #: False if the variance rises up to the brightest level, which then only bounds saturation

    @property
    def signal(self) -> FloatArray:
        """mu_y - mu_y.dark of each lit level, DN."""
        return np.asarray(self.mean - self.mean_dark)

    @property
    def excess(self) -> FloatArray:
        """sigma_y^2 - sigma_y.dark^2 of each lit level, DN2."""
        return np.asarray(self.variance - self.variance_dark)

    @property
    def fitted(self) -> NDArray[np.bool_]:
        """True for the lit levels from 0 to 70 % of saturation."""
        return np.asarray(self.signal <= SENSITIVITY * self.signal[self.saturation])

    @property
    def linear(self) -> NDArray[np.bool_]:
        """True for the lit levels from 5 to 95 % of saturation."""
        low, high = (share * self.signal[self.saturation] for share in LINEARITY)
        return np.asarray((self.signal >= low) & (self.signal <= high))


def photon_transfer(levels: Levels) -> PhotonTransfer:
    """Return the photon-transfer measurement of light levels, each lit level with the dark of the nearest exposure.

    Shapes: levels (level,).
    Units:  as in `PhotonTransfer`.
    Raises: ValueError without a dark level or without two lit levels.
    Source: EMVA Standard 1288, release 4.0 Linear.
    """
    photons, exposure, mean, variance = (
        np.asarray(x, dtype=np.float64) for x in (levels.photons, levels.exposure, levels.mean, levels.variance)
    )
    dark = np.flatnonzero(photons == 0)
    dark = dark[np.argsort(exposure[dark], kind="stable")]
    lit = np.flatnonzero(photons > 0)
    lit = lit[np.lexsort((exposure[lit], photons[lit]))]
    if not len(dark):
        raise ValueError("a sheet of EMVA 1288 needs dark frames: give a level without light")
    if len(lit) < 2:
        raise ValueError(f"a sheet of EMVA 1288 needs lit levels, and there is {len(lit)}: give two or more")
    below = dark[np.abs(exposure[lit, None] - exposure[dark]).argmin(1)]
    top = saturation_point(variance[lit])
    return PhotonTransfer(
        photons[lit],
        exposure[lit],
        mean[lit],
        variance[lit],
        mean[below],
        variance[below],
        exposure[dark],
        mean[dark],
        variance[dark],
        top,
        top < len(lit) - 1,
    )


def saturation_point(variance: FloatArray) -> int:
    """Return the index of saturation: from the brightest level, the first variance that exceeds the next two below it.

    A peak below half of the greatest variance is noise of levels that are saturated, and does not count.
    """
    top = len(variance) - 1
    for i in range(len(variance) - 2, -1, -1):
        if variance[i] >= variance[top]:
            top = i
        elif i == 0 or variance[i - 1] < variance[top]:
            break
    return top if variance[top] >= _PLATEAU * variance.max() else int(variance.argmax())


def slope_through_origin(x: FloatArray, y: FloatArray) -> float:
    """Return the slope of the line through the origin that fits (x, y) best, each point with equal weight."""
    return float(x @ y / (x @ x))


def line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return slope and value at 0 of the line that fits (x, y) best."""
    apart = x - x.mean()
    slope = float(apart @ y / (apart @ apart))
    return slope, float(y.mean() - slope * x.mean())


def relative_line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return slope and value at 0 of the line with the least squares of relative deviations, which is linear in y."""
    columns = np.stack([x / y, 1 / y], axis=1)
    solved: Any = np.linalg.lstsq(columns / np.linalg.norm(columns, axis=0), np.ones_like(y), rcond=None)[0]
    slope, start = solved / np.linalg.norm(columns, axis=0)
    return float(slope), float(start)
