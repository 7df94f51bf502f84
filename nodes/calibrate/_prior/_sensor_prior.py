"""The prior of a sensor's parameters, and the coordinates that frames constrain independently."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.calibrate._prior._free_parameters import FAULTS, Factor, Free, Known, Positive, Prior, believed, freed
from neusee.nodes.sensor._saturation import Efficiency, Well
from neusee.nodes.units import Electrons, Gain

_LINEAR = "offset"  #: the only parameter that may be 0 or negative


@node()
def prior(
    *,
    gain: tuple[Gain, Factor] | None = None,
    offset: tuple[Electrons, Electrons] | None = None,
    read_noise: tuple[Electrons, Factor] | None = None,
    dark_current: tuple[Electrons, Factor] | None = None,
    full_well: tuple[Well, Factor] | None = None,
    quantum_efficiency: tuple[Efficiency, Factor] | None = None,
    spread: tuple[Positive, Factor] | None = None,
    mixing: Known = "unknown",
    lag: Known = "unknown",
    pattern: Known = "unknown",
) -> Prior:
    """Collect the priors of the free parameters of a sensor; a parameter without a prior is held at a fixed value.

    A prior is a median and a factor: [0.37, 2] means half to twice the median with a probability of two thirds. The
    prior of the offset is a mean and a standard deviation. Mixing of neighbouring pixels, lag between frames and
    patterns of unequal pixels are `none` for a sensor that is known to have none of it, such as a simulated one; else
    intervals include what may hide in the frames.

    Shapes: -> (7,).
    Units:  those of `density`.
    Error:  exact.
    Raises: ValueError where no parameter is free, or where a median or width is not positive.
    Source: log-normal and normal distributions.
    """
    pairs = (gain, offset, read_noise, dark_current, full_well, quantum_efficiency, spread)
    return believed(dict(zip(NAMES, pairs, strict=True)), frozenset({_LINEAR}), mixing=mixing, lag=lag, pattern=pattern)


#: the parameters of `density` that may be free
NAMES = tuple(n for n in inspect.signature(prior.fn).parameters if n not in FAULTS)


@prior.check
def _(result: Prior, **params: object) -> list[Check]:
    free = freed(NAMES, result)
    return [Check(f"{len(free)} free: {', '.join(free)}")]


@dataclass(frozen=True)
class Coordinates(Free):
    """Coordinates of the free parameters of a sensor, in digital numbers, which frames constrain independently.

    Frames constrain the slope of the photon-transfer curve, the offset in DN, the dark variance, the response and the
    saturation level independently. Frames constrain gain, offset in electrons, read noise and well only jointly, with a
    correlation of 1 - 1e-3. All coordinates except the offset in DN are logarithms.
    """

    every: ClassVar[tuple[str, ...]] = NAMES
    linear: ClassVar[frozenset[str]] = frozenset({_LINEAR})
    edged: ClassVar[frozenset[str]] = frozenset({"full_well"})

    @property
    def labels(self) -> tuple[str, ...]:
        """Return a readable name of each sampler coordinate."""
        of = {"gain": "ln slope of the photon-transfer curve", "offset": "offset, DN", "spread": "ln spread"}
        return tuple(of.get(name, f"ln {name.replace('_', ' ')} in numbers") for name in self.names)

    def place(self, parameters: Mapping[str, float | Tensor]) -> Tensor:
        """Convert sensor parameters to sampler coordinates (..., free parameter)."""
        full = {name: torch.as_tensor(parameters.get(name, self.held.get(name)), dtype=torch.float64) for name in NAMES}
        slope = full["gain"].log()
        return torch.stack([self._coordinate(name, full, slope) for name in self.names], -1)

    def parameters(self, place: Tensor) -> dict[str, Tensor]:
        """Convert sampler coordinates (..., free parameter) to sensor parameters."""
        at = dict(zip(self.names, place.unbind(-1), strict=True))
        held = {name: math.log(self.held[name]) for name in ("gain", "spread") if name in self.held}
        logs = {name: torch.tensor(x, dtype=torch.float64) for name, x in held.items()} | at
        slope = logs["gain"] - 2.0 * logs["spread"] if "gain" in at else logs["gain"]
        parameters = {}
        for name, x in at.items():
            if name == "gain":
                parameters[name] = slope.exp()
            elif name == _LINEAR:
                parameters[name] = x * (-slope).exp()
            else:
                parameters[name] = (x if name == "spread" else x - slope).exp()
        return parameters

    def log_prior(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return the log prior density per unit of the sampler coordinates, up to a constant."""
        total = -0.5 * self.whitened(parameters).square().sum(-1)
        if _LINEAR in self.names and "gain" in self.names:
            total = total - parameters["gain"].log()  # Jacobian from offset in DN to electrons
        return total

    def _coordinate(self, name: str, full: Mapping[str, Tensor], slope: Tensor) -> Tensor:
        if name == "gain":
            return slope + 2.0 * full["spread"].log()
        if name == _LINEAR:
            return full[name] * slope.exp()
        return full[name].log() + (0.0 if name == "spread" else slope)
