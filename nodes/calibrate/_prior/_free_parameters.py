"""The priors of free parameters, and the common base of the coordinates in which a sampler moves."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

import torch
from pydantic import Field
from torch import Tensor

Factor = Annotated[float, Field(gt=1, le=1e6)]  #: one standard deviation of the logarithm, as a ratio
Positive = Annotated[float, Field(ge=1e-12, le=1e12)]
Pair = tuple[float, float]
Known = Literal["unknown", "none"]  #: what is known of a fault of the frames before any frame
FAULTS = ("mixing", "lag", "pattern")  #: faults that may hide in frames: each changes the variance in proportion


class Ridge(NamedTuple):
    """Parameters far from a fit that may fit the same data as well, and what is known if they do."""

    place: Tensor  #: (free,) coordinates
    kinds: Mapping[str, str]  #: from a parameter to "upper" or "lower", the limit that is known
    text: str  #: a sentence


class Prior(NamedTuple):
    """Independent normal distributions, one for each parameter of a sensor; NaN stands for a fixed parameter."""

    centre: Tensor  #: (parameter,) float64, mean of the logarithm, or of a linear parameter itself
    width: Tensor  #: (parameter,) float64, standard deviation of the same quantity
    hidden: Tensor = torch.ones(len(FAULTS), dtype=torch.float64)  #: 1 for each of `FAULTS` that may hide, 0 for none

    @property
    def may_hide(self) -> tuple[str, ...]:
        """Return the names of the faults that may hide in the frames."""
        return tuple(fault for fault, may in zip(FAULTS, self.hidden.tolist(), strict=True) if may)


def believed(pairs: Mapping[str, Pair | None], linear: frozenset[str], **known: Known) -> Prior:
    """Build a prior from a pair of numbers for each free parameter, and None for each fixed parameter.

    The pair is median and factor, or mean and standard deviation for a parameter in ``linear``. A fault of the frames
    that is ``known`` to be "none" cannot hide in them.
    """
    normals = [_normal(name, pair, name in linear) for name, pair in pairs.items()]
    if all(math.isnan(width) for _, width in normals):
        raise ValueError(f"no parameter is free: give a prior of at least one of {', '.join(pairs)}")
    centre, width = torch.tensor(normals, dtype=torch.float64).unbind(1)
    hidden = [float(known.get(fault, "unknown") == "unknown") for fault in FAULTS]
    return Prior(centre, width, torch.tensor(hidden, dtype=torch.float64))


def freed(names: tuple[str, ...], prior: Prior) -> tuple[str, ...]:
    """Return the names of the parameters that have a prior; ``names`` are the names of all parameters."""
    return tuple(name for name, width in zip(names, prior.width.tolist(), strict=True) if not math.isnan(width))


def _normal(name: str, pair: Pair | None, linear: bool) -> Pair:
    if pair is None:
        return math.nan, math.nan
    if not pair[1] > 0 or not (linear or pair[0] > 0):
        raise ValueError(f"{name}: [{pair[0]:g}, {pair[1]:g}] is not a prior: median and width must be positive")
    return pair if linear else (math.log(pair[0]), math.log(pair[1]))


@dataclass(frozen=True)
class Free:
    """Free parameters and their prior; each subclass defines the coordinates for a sampler."""

    every: ClassVar[tuple[str, ...]]  #: the names of all parameters, free or held
    linear: ClassVar[frozenset[str]]  #: the parameters that may be 0 or negative
    widths: ClassVar[frozenset[str]] = frozenset()  #: the parameters that are widths of the noise of the levels
    edged: ClassVar[frozenset[str]] = frozenset()  #: the parameters that rounded numbers
    #: constrain by edges and not by a slope: the last row of `Likelihood.scaled` describes the free one of these

    bent: ClassVar[bool] = False  #: True if data may leave a posterior that is long, bent, or in several parts

    names: tuple[str, ...]  #: names of the free parameters
    prior: Prior
    held: Mapping[str, float]  #: values of the held parameters

    @classmethod
    def of(cls, prior: Prior, nominal: Mapping[str, float]) -> Self:
        """Build sampler coordinates for the free parameters of a prior; others keep the ``nominal`` values."""
        free = freed(cls.every, prior)
        return cls(free, prior, {name: float(nominal[name]) for name in cls.every if name not in free})

    def draw(self, count: int, rng: torch.Generator) -> dict[str, Tensor]:
        """Draw ``count`` values of each free parameter from the prior."""
        return self.from_whitened(torch.randn(count, len(self.names), generator=rng, dtype=torch.float64))

    def whitened(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Convert parameters to distances from the prior's centre, in standard deviations of the prior."""
        return (self.scaled(parameters) - self._normals.centre) / self._normals.width

    def from_whitened(self, z: Tensor) -> dict[str, Tensor]:
        """Convert distances from the prior's centre, in standard deviations of the prior, to parameters."""
        return self.unscaled(self._normals.centre + self._normals.width * z)

    def scaled(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return the logarithm of each free parameter, or the value of a parameter that may be 0 or negative."""
        values = ((name, parameters[name]) for name in self.names)
        return torch.stack([x if name in self.linear else x.log() for name, x in values], -1)

    def unscaled(self, values: Tensor) -> dict[str, Tensor]:
        """Return the free parameters from logarithms, or from the values of parameters that may be 0 or negative."""
        pairs = zip(self.names, values.unbind(-1), strict=True)
        return {name: x if name in self.linear else x.exp() for name, x in pairs}

    def ridges(self, place: Tensor) -> list[Ridge]:
        """Return parameters far from ``place`` (free,) that some data cannot distinguish from it; by default none."""
        return []

    @cached_property
    def _normals(self) -> Prior:
        free = self.prior.width.isfinite()
        return Prior(self.prior.centre[free], self.prior.width[free], self.prior.hidden)
