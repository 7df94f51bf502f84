"""Nodes for tests of the study of accuracy: imported as ``neusee.nodes.measured``. Their errors
are closed forms.
"""

import time
from typing import Literal

import torch
from torch import Generator, Tensor

from neusee.nodes import node
from neusee.nodes.units import Count, PositiveLength, Real, Shape
from neusee.nodes.values import Bands, Psf

CALLS: list[str] = []
__depends__ = ("unaffected:STOP_AT",)
#: counts of bands at which `bands` behaves as if someone pressed Ctrl-C, once each
STOP_AT: set[int] = set()


@node()
def bands(*, count: Count) -> Bands:
    CALLS.append(f"bands {count}")
    if count in STOP_AT:
        STOP_AT.discard(count)
        raise KeyboardInterrupt
    middle = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    return Bands(middle, torch.full_like(middle, 1 / count), torch.ones_like(middle))


@node()
def pupil(*, samples: Count, pitch: PositiveLength) -> Tensor:
    if samples < 5:
        raise ValueError(f"{samples} samples are too few")
    return torch.full((samples, samples), pitch * samples, dtype=torch.float64)


@node()
def spread(
    pupil: Tensor, bands: Bands, *, shape: Shape, precision: Literal["single", "double"] = "single"
) -> Psf:
    kind = torch.float64 if precision == "double" else torch.float32
    one = torch.full((len(bands.centres), *shape), 1 / 3, dtype=kind)
    return Psf(one, bands.centres)


@node(bands={"psf": 0, "return": 0})
def weighed(psf: Psf) -> Tensor:
    time.sleep(0.01)
    return psf.intensity * psf.clear_peak[:, None, None].square().to(psf.intensity)


@weighed.reference
def _(psf: Psf) -> Tensor:
    CALLS.append(f"reference {tuple(psf.intensity.shape)}")
    return psf.intensity.double() * psf.clear_peak[:, None, None].square()


@node()
def together(cube: Tensor) -> Tensor:
    """The mean over the bands of a third of x squared: a third of 1/3 - 1/(12 n^2)."""
    time.sleep(0.01)
    return cube.mean(0)


@together.propagate_error
def _(cube, *, result):
    return cube.rms


@node()
def glow(image: Tensor, *, amount: Real) -> Tensor:
    """Add to every element ``amount`` of the largest."""
    return image * (1 + amount)


@glow.skip_bound
def _(image, *, amount):
    return abs(amount)


@glow.propagate_error
def _(image, *, result, amount):
    return image.rms * (1 + amount)


@node()
def noise(image: Tensor, *, sigma: Real, rng: Generator) -> Tensor:
    CALLS.append("noise")
    return image * (1 + sigma * torch.randn((), generator=rng, dtype=torch.float64).to(image))


@noise.propagate_error
def _(image, *, result, sigma):
    return image.rms * (1 + 5 * sigma)
