"""The signal at which the pixels of a camera are full, from levels beyond saturation."""

from __future__ import annotations

import math
from typing import NamedTuple

from neusee.nodes.values import Levels

_FLAT = 0.5  #: share of the greatest variance below which a brighter level is full


class SaturationSignal(NamedTuple):
    """The mean signal of full pixels above the dark, and its standard uncertainty."""

    signal: float  #: DN
    uncertainty: float  #: DN


def saturation_signal(levels: Levels) -> SaturationSignal | None:
    """Return the signal of full pixels, or None where no level is full.

    The mean of a level rises with its light until its pixels are full, and its variance falls. The level of the
    greatest variance, where EMVA 1288 takes saturation, lies below by up to a step of the levels: pixels, and the light
    of a frame, are unequal, and the fullest ones end the rise of the variance. The brightest level is the fullest. It
    may still lack what the last two full levels differ by, or with one full level what it exceeds the greatest
    variance's by.

    Shapes: levels (level,) -> two scalars, or None.
    Units:  DN above the dark level of the nearest exposure.
    Error:  the standard uncertainty is that of a rectangular distribution from 0 to the missing signal.
    Source: EMVA Standard 1288, release 4.0 Linear, section 6.6; JCGM 100:2008 (GUM), section 4.3.7.
    """
    dark = levels.photons == 0
    if not bool(dark.any()) or not bool((~dark).any()):
        return None
    nearest = (levels.exposure[~dark, None] - levels.exposure[dark]).abs().argmin(1)
    order = levels.photons[~dark].argsort()
    signal = (levels.mean[~dark] - levels.mean[dark][nearest])[order]
    variance = levels.variance[~dark][order]
    peak = int(variance.argmax())
    full = [i for i in range(peak + 1, len(signal)) if float(variance[i]) < _FLAT * float(variance[peak])]
    if not full:
        return None
    before = full[-2] if len(full) > 1 else peak
    missing = abs(float(signal[full[-1]] - signal[before]))
    return SaturationSignal(float(signal[full[-1]]), missing / math.sqrt(3))
