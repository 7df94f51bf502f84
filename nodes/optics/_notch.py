"""The share of the light that notch filters let through at each wavelength of a pupil."""

import math

import torch
from torch import Tensor

from neusee.nodes.values import Pupil


def passed_by_notches(pupil: Pupil) -> Tensor:
    """Return the share of the light that the notch filters of a pupil let through: (band,) float64.

    A notch of depth d and full width at half maximum w about the centre c passes 1 - d exp(-4 ln 2 ((x - c) / w)**2)
    at the wavelength x. Each band is evaluated at its centre.
    """
    if not len(pupil.notches):
        return torch.ones_like(pupil.wavelengths, dtype=torch.float64)
    centres, widths, depths = pupil.notches.to(pupil.wavelengths).unbind(1)
    away = (pupil.wavelengths[:, None] - centres) / widths
    passed: Tensor = (1.0 - depths * torch.exp(-4.0 * math.log(2.0) * away.square())).prod(1)
    return passed
