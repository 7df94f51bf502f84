"""The prior of the scatter of a lens, and the coordinates in which a sampler moves."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.calibrate._prior._free_parameters import Factor, Free, Positive, Prior, Ridge, believed, freed
from neusee.nodes.flare._harvey_shack import scattered_share
from neusee.nodes.units import Electrons, Real

_FAR = 30.0  #: factor on l at which a fit is compared
_MOST = 0.3  #: share of scattered light up to which a narrower lobe is compared
_LINEAR = frozenset({"s", "background"})


@node()
def stray_prior(
    *,
    b0: tuple[Positive, Factor] | None = None,
    l: tuple[Positive, Factor] | None = None,  # noqa: E741 (the symbol of the literature)
    s: tuple[Real, Positive] | None = None,
    electrons: tuple[Electrons, Factor] | None = None,
    background: tuple[Real, Positive] | None = None,
    core: tuple[Positive, Factor] | None = None,
    scatter: tuple[Positive, Factor] | None = None,
) -> Prior:
    """Collect the priors of the scatter of a lens and of the source; a parameter without a prior is held fixed.

    A prior is a median and a factor: [0.4, 10] means a tenth to ten times the median with a probability of two thirds.
    The priors of ``s`` and ``background`` are a mean and a standard deviation.

    Shapes: -> (7,).
    Units:  those of `stray_light`.
    Error:  exact.
    Raises: ValueError where no parameter is free, or where a median or width is not positive.
    Source: log-normal and normal distributions.
    """
    return believed(dict(zip(SCATTER_NAMES, (b0, l, s, electrons, background, core, scatter), strict=True)), _LINEAR)


SCATTER_NAMES = tuple(inspect.signature(stray_prior.fn).parameters)  #: the parameters of `stray_light` that may be free


@stray_prior.check
def _(result: Prior, **params: object) -> list[Check]:
    free = freed(SCATTER_NAMES, result)
    return [Check(f"{len(free)} free: {', '.join(free)}")]


@dataclass(frozen=True)
class ScatterCoordinates(Free):
    """Coordinates of the scatter of a lens, in which frames determine few combinations of b0, l and s.

    Where all three are free, the coordinates are ln l, the logarithm of the BSDF at the middle of the prior of l, and
    the logarithm of the negative slope of the BSDF there in double logarithms. Frames of rings determine the last two,
    whatever l is. Other parameters are logarithms, and the background is itself.
    """

    every: ClassVar[tuple[str, ...]] = SCATTER_NAMES
    linear: ClassVar[frozenset[str]] = _LINEAR

    @property
    def labels(self) -> tuple[str, ...]:
        """Return a readable name of each sampler coordinate."""
        joint = {"b0": "ln BSDF", "s": "ln slope"} if self._joint else {}
        return tuple(joint.get(name, ("" if name in self.linear else "ln ") + name) for name in self.names)

    def place(self, parameters: Mapping[str, float | Tensor]) -> Tensor:
        """Convert parameters of the scatter to sampler coordinates (..., free parameter)."""
        values = {name: torch.as_tensor(parameters[name], dtype=torch.float64) for name in self.names}
        columns = dict(zip(self.names, self.scaled(values).unbind(-1), strict=True))
        if self._joint:
            q = self._square(columns["l"])
            columns["b0"] = columns["b0"] + values["s"] / 2 * torch.log1p(q)
            columns["s"] = (-values["s"]).log() + torch.log(q / (1 + q))
        return torch.stack([columns[name] for name in self.names], -1)

    def parameters(self, place: Tensor) -> dict[str, Tensor]:
        """Convert sampler coordinates (..., free parameter) to parameters of the scatter."""
        if not self._joint:
            return self.unscaled(place)
        columns = dict(zip(self.names, place.unbind(-1), strict=True))
        q = self._square(columns["l"])
        columns["s"] = -columns["s"].exp() * (1 + q) / q
        columns["b0"] = columns["b0"] - columns["s"] / 2 * torch.log1p(q)
        return self.unscaled(torch.stack([columns[name] for name in self.names], -1))

    def log_prior(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return the log prior density per unit of the sampler coordinates, up to a constant."""
        log = -0.5 * self.whitened(parameters).square().sum(-1)
        return log + (-parameters["s"]).log() if self._joint else log

    @property
    def _joint(self) -> bool:
        return {"b0", "l", "s"} <= set(self.names)

    def _square(self, log_l: Tensor) -> Tensor:
        """Return (beta / l)**2 at the direction cosine beta in the middle of the prior of l."""
        return (2 * (self.prior.centre[SCATTER_NAMES.index("l")] - log_l)).exp()

    def ridges(self, place: Tensor) -> list[Ridge]:
        """Return a much narrower and a much wider lobe with the same scatter outside and inside of it.

        Outside of l only b0 l**(-s) is seen, and inside of l only b0. The core keeps its brightness, if it is free.
        """
        if not {"b0", "l"} <= set(self.names):
            return []
        known = {**{name: torch.tensor(x) for name, x in self.held.items()}, **self.parameters(place)}
        l, s = known["l"], known["s"]  # noqa: E741
        found = [Ridge(self._moved(known, 1.0, _FAR), {"l": "lower"}, "l: only a lower limit, beyond the frame")]
        for factor in (_FAR, 10.0, 3.0):
            rise = float(factor ** -float(s))
            if float(scattered_share(known["b0"] * rise, l / factor, s)) < _MOST:
                text = "b0 and l only as b0 l^(-s): l lies within the saturated pixels"
                narrow = self._moved(known, rise, 1 / factor)
                return [*found, Ridge(narrow, {"l": "upper", "b0": "lower"}, text)]
        return found

    def _moved(self, known: Mapping[str, Tensor], peak: float, width: float) -> Tensor:
        """Return the coordinates with b0 and l multiplied, and the brightness of core and scatter as before."""
        b0, l, s = known["b0"] * peak, known["l"] * width, known["s"]  # noqa: E741
        core, electrons = known["core"], known["electrons"]
        before, after = (1 - scattered_share(*x) for x in ((known["b0"], known["l"], s), (b0, l, s)))
        rise = before / after.clamp_min(1 - _MOST)
        if "core" in self.names:
            core = core * rise
        elif "electrons" in self.names:
            b0, electrons = b0 / rise, electrons * rise
        return self.place({**known, "b0": b0, "l": l, "core": core, "electrons": electrons})
