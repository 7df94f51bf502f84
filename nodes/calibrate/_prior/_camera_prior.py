"""The prior of a real camera's parameters, and the coordinates in which a sampler moves."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.calibrate._prior._free_parameters import FAULTS, Factor, Free, Known, Positive, Prior, believed, freed
from neusee.nodes.sensor._saturation import Efficiency
from neusee.nodes.units import Electrons, Gain, Real

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
    mixing: Known = "unknown",
    lag: Known = "unknown",
) -> Prior:
    """Collect the priors of the free parameters of a camera; a parameter without a prior is held at a fixed value.

    A prior is a median and a factor: [0.37, 2] means half to twice the median with a probability of two thirds. The
    priors of the dark signal and of the two terms of the response are a mean and a standard deviation. Mixing of
    neighbouring pixels and lag between frames are `none` for a camera that is known to have neither; else intervals
    include what of both may hide in the frames.

    Shapes: -> (10,).
    Units:  those of `camera`.
    Error:  exact.
    Raises: ValueError where no parameter is free, or where a median or width is not positive.
    Source: log-normal and normal distributions.
    """
    dark = (dark_signal, temporal_dark_noise, dark_current)
    pairs = (gain, quantum_efficiency, *dark, scatter, lamp, drift, bend, twist)
    return believed(dict(zip(CAMERA_NAMES, pairs, strict=True)), _LINEAR, mixing=mixing, lag=lag)


#: the parameters of `camera` that may be free
CAMERA_NAMES = tuple(n for n in inspect.signature(camera_prior.fn).parameters if n not in FAULTS)


@camera_prior.check
def _(result: Prior, **params: object) -> list[Check]:
    free = freed(CAMERA_NAMES, result)
    return [Check(f"{len(free)} free: {', '.join(free)}")]


@dataclass(frozen=True)
class CameraCoordinates(Free):
    """Coordinates of the free parameters of a camera: logarithms, or values of parameters that may be 0 or negative."""

    every: ClassVar[tuple[str, ...]] = CAMERA_NAMES
    linear: ClassVar[frozenset[str]] = _LINEAR
    widths: ClassVar[frozenset[str]] = frozenset({"scatter", "lamp", "drift"})

    @property
    def labels(self) -> tuple[str, ...]:
        """Return a readable name of each sampler coordinate."""
        return tuple(("" if name in self.linear else "ln ") + name.replace("_", " ") for name in self.names)

    def place(self, parameters: Mapping[str, float | Tensor]) -> Tensor:
        """Convert camera parameters to sampler coordinates (..., free parameter)."""
        return self.scaled({name: torch.as_tensor(parameters[name], dtype=torch.float64) for name in self.names})

    def parameters(self, place: Tensor) -> dict[str, Tensor]:
        """Convert sampler coordinates (..., free parameter) to camera parameters."""
        return self.unscaled(place)

    def log_prior(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return the log prior density per unit of the sampler coordinates, up to a constant."""
        return -0.5 * self.whitened(parameters).square().sum(-1)
