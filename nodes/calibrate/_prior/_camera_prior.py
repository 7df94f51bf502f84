"""The prior of a real camera's parameters, and the coordinates in which a sampler moves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.calibrate._prior._free_parameters import Factor, Free, Positive, Prior, believed, freed
from neusee.nodes.sensor._saturation import Efficiency
from neusee.nodes.units import Electrons, Gain, Real

CAMERA_NAMES = (
    "gain",
    "quantum_efficiency",
    "dark_signal",
    "temporal_dark_noise",
    "dark_current",
    "scatter",
    "lamp",
    "drift",
    "bend",
    "twist",
)  #: the parameters of `camera` that may be free
_LINEAR = frozenset({"dark_signal", "bend", "twist"})


@node()
def camera_prior(
    *,
    gain: tuple[Gain, Factor] | None = None,
    quantum_efficiency: tuple[Efficiency, Factor] | None = None,
    dark_signal: tuple[Real, Positive] | None = None,
    temporal_dark_noise: tuple[Electrons, Factor] | None = None,
    dark_current: tuple[Electrons, Factor] | None = None,
    scatter: tuple[Positive, Factor] | None = None,
    lamp: tuple[Positive, Factor] | None = None,
    drift: tuple[Positive, Factor] | None = None,
    bend: tuple[Real, Positive] | None = None,
    twist: tuple[Real, Positive] | None = None,
) -> Prior:
    """State the prior of each free parameter of a camera; a parameter without a prior is held.

    A prior is a median and a factor: [0.37, 2] means half to twice the median with a probability of two thirds. The
    priors of the dark signal and of the two terms of the response are a mean and a standard deviation.

    Shapes: -> (10,).
    Units:  those of `camera`.
    Error:  exact.
    Raises: ValueError where no parameter is free, or where a median or width is not positive.
    Source: log-normal and normal distributions.
    """
    dark = (dark_signal, temporal_dark_noise, dark_current)
    pairs = (gain, quantum_efficiency, *dark, scatter, lamp, drift, bend, twist)
    return believed(dict(zip(CAMERA_NAMES, pairs, strict=True)), _LINEAR)


@camera_prior.check
def _(result: Prior, **params: object) -> list[Check]:
    free = freed(CAMERA_NAMES, result)
    return [Check(f"{len(free)} free: {', '.join(free)}")]


@dataclass(frozen=True)
class CameraCoordinates(Free):
    """One coordinate for each free parameter: the logarithm, or the value itself if 0 or negative values may occur."""

    linear: ClassVar[frozenset[str]] = _LINEAR

    @classmethod
    def of(cls, prior: Prior, nominal: Mapping[str, float]) -> CameraCoordinates:
        """Build coordinates from ``nominal``, all of `CAMERA_NAMES` in the units of `camera`."""
        free = freed(CAMERA_NAMES, prior)
        return cls(free, prior, {name: float(nominal[name]) for name in CAMERA_NAMES if name not in free})

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the name of each coordinate."""
        plain = {name: name.replace("_", " ") for name in self.names}
        return tuple(plain[name] if name in self.linear else f"ln {plain[name]}" for name in self.names)

    def place(self, parameters: Mapping[str, float | Tensor]) -> Tensor:
        """Return the coordinates (..., free) of parameters."""
        given = {name: torch.as_tensor(parameters[name], dtype=torch.float64) for name in self.names}
        return torch.stack([self._walked(name, x) for name, x in given.items()], -1)

    def parameters(self, place: Tensor) -> dict[str, Tensor]:
        """Return the free parameters at coordinates (..., free)."""
        return {n: x if n in self.linear else x.exp() for n, x in zip(self.names, place.unbind(-1), strict=True)}

    def log_prior(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return the log density (...) per unit of the coordinates, up to a constant."""
        return -0.5 * self.whitened(parameters).square().sum(-1)
