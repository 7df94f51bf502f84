"""Nodes for tests of sweeps: imported as ``neusee.nodes.swept``. They count their calls and fail
when asked to.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes import ParameterError, node
from neusee.nodes.units import Count, Electrons, Real, Wavelength

CALLS: list[str] = []
__depends__ = ("unaffected:INTERRUPT",)
#: levels at which `noted` behaves as if someone pressed Ctrl-C, once each
INTERRUPT: set[float] = set()


class Quality(NamedTuple):
    mean: Tensor
    profile: Tensor


@node()
def source(*, level: Real = 1.0, count: Count = 4) -> Tensor:
    CALLS.append("source")
    return torch.full((count, count), level, dtype=torch.float64)


@node()
def coloured(image: Tensor, *, wavelength: Wavelength = 550e-9) -> Tensor:
    CALLS.append("coloured")
    return image * (wavelength * 1e9)


@node()
def noted(image: Tensor, *, read_noise: Electrons = 0.0, most: Real = 1e9) -> Tensor:
    CALLS.append("noted")
    if read_noise in INTERRUPT:
        INTERRUPT.discard(read_noise)
        raise KeyboardInterrupt
    if read_noise > most:
        raise ValueError(f"{read_noise:g} e- are too many")
    return image + read_noise


@noted.preflight
def _(*, read_noise: float, most: float) -> list[str]:
    if read_noise > 1e6:
        raise ParameterError("read_noise", "is beyond every sensor")
    return []


@node()
def quality(image: Tensor) -> Quality:
    CALLS.append("quality")
    return Quality(image.mean(), image.sum(0))
