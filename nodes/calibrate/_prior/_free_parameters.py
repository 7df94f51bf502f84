"""Free parameters: the prior of each parameter, and the coordinates in which a sampler moves."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

Factor = Annotated[float, Field(gt=1, allow_inf_nan=False)]  #: one standard deviation of the logarithm, as a ratio
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Pair = tuple[float, float]


class Prior(NamedTuple):
    """Independent normal distributions in an agreed order, with NaN for a held parameter."""

    centre: Tensor  #: (parameter,) float64, mean of the logarithm, or of a linear parameter itself
    width: Tensor  #: (parameter,) float64, standard deviation of the same quantity


def believed(given: Mapping[str, Pair | None], linear: frozenset[str]) -> Prior:
    """Build a prior from medians and factors, or means and standard deviations if linear; None holds a parameter."""
    laws = [_law(name, pair, name in linear) for name, pair in given.items()]
    if all(math.isnan(width) for _, width in laws):
        raise ValueError(f"no parameter is free: give a prior of one of {', '.join(given)}")
    centre, width = torch.tensor(laws, dtype=torch.float64).unbind(1)
    return Prior(centre, width)


def freed(names: tuple[str, ...], prior: Prior) -> tuple[str, ...]:
    """Return the parameters of ``names`` that are free in a prior."""
    return tuple(name for name, width in zip(names, prior.width.tolist(), strict=True) if not math.isnan(width))


def _law(name: str, pair: Pair | None, linear: bool) -> Pair:
    if pair is None:
        return math.nan, math.nan
    if not pair[1] > 0 or not (linear or pair[0] > 0):
        raise ValueError(f"{name}: [{pair[0]:g}, {pair[1]:g}] is not a prior: median and width must be positive")
    return pair if linear else (math.log(pair[0]), math.log(pair[1]))


@dataclass(frozen=True)
class Free:
    """Free parameters and their prior; each subclass defines the coordinates."""

    linear: ClassVar[frozenset[str]]  #: the parameters that may be 0 or negative
    edged: ClassVar[frozenset[str]] = frozenset()  #: the parameters that rounded numbers
    #: constrain by edges and not by a slope: the last row of `Likelihood.scaled` describes the free one of these

    names: tuple[str, ...]  #: names of the free parameters
    prior: Prior
    held: Mapping[str, float]  #: values of the held parameters

    def draw(self, count: int, rng: torch.Generator) -> dict[str, Tensor]:
        """Draw parameters from the prior: (count,)."""
        return self.from_whitened(torch.randn(count, len(self.names), generator=rng, dtype=torch.float64))

    def whitened(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return parameters, (..., free), as distances from the prior's centre in standard deviations of the prior."""
        value = torch.stack([self._walked(name, parameters[name]) for name in self.names], -1)
        return (value - self._centre) / self._width

    def from_whitened(self, z: Tensor) -> dict[str, Tensor]:
        """Invert `whitened`."""
        found = (self._centre + self._width * z).unbind(-1)
        return {name: x if name in self.linear else x.exp() for x, name in zip(found, self.names, strict=True)}

    def _walked(self, name: str, value: Tensor) -> Tensor:
        return value if name in self.linear else value.log()

    @cached_property
    def _centre(self) -> Tensor:
        return self.prior.centre[self.prior.width.isfinite()]

    @cached_property
    def _width(self) -> Tensor:
        return self.prior.width[self.prior.width.isfinite()]
