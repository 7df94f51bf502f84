"""The prior of the scatter of a lens, and the coordinates in which a sampler moves."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.calibrate._priors import Factor, Free, Positive, Prior, Ridge, believed, freed
from neusee.nodes.calibrate._scatter_likelihood import Rings, share_of_light
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
    """Collect the priors of the scatter of a lens and of the source; a parameter without a prior is
    held fixed.

    A prior is a median and a factor: [0.4, 10] means a tenth to ten times the median with a
    probability of two thirds. The priors of ``s`` and ``background`` are a mean and a standard
    deviation.

    Shapes: -> (7,).
    Units:  those of `stray_light`.
    Error:  exact.
    Raises: ValueError where no parameter is free, or where a median or width is not positive.
    Source: log-normal and normal distributions.
    """
    return believed(
        dict(zip(SCATTER_NAMES, (b0, l, s, electrons, background, core, scatter), strict=True)),
        _LINEAR,
    )


#: the parameters of `stray_light` that may be free
SCATTER_NAMES = tuple(inspect.signature(stray_prior.fn).parameters)


@stray_prior.check
def _(result: Prior, **params: object) -> list[Check]:
    free = freed(SCATTER_NAMES, result)
    return [Check(f"{len(free)} free: {', '.join(free)}")]


class Sight(NamedTuple):
    """What a frame shows of a lens: the radii of the first and the last ring, and the scales of
    a pixel.
    """

    inner: float  #: pixels from the source
    outer: float  #: pixels from the source
    fringe: float  #: wavelength N in pixels
    scale: float  #: direction cosine of a pixel

    @classmethod
    def of(cls, rings: Rings, lens: Mapping[str, Any]) -> Sight:
        """Return what the rings of a frame show; ``lens`` are parameters of `stray_light`."""
        fringe = (
            lens["wavelength"] * lens["focal_length"] / (lens["diameter"] * lens["pixel_pitch"])
        )
        inner, outer = (
            float(rings.square[rings.ring == ring].mean()) ** 0.5
            for ring in (0, len(rings.mean) - 1)
        )
        return cls(inner, outer, fringe, lens["pixel_pitch"] / lens["focal_length"])


@dataclass(frozen=True)
class ScatterCoordinates(Free):
    """Coordinates of the scatter of a lens in which what a frame determines does not depend on what
    it leaves open.

    Where b0, l and s are free, their coordinates are ln l, the logarithm of the BSDF at a distance
    between those of the first and the last ring, and the logarithm of the negative slope of the
    BSDF there in double logarithms. Rings determine the last two, whatever l is. The coordinate of
    the electrons is the logarithm of the signal of the source in the first ring, and that of the
    background the whole signal in the last ring; without a ``sight`` they are the logarithm of the
    electrons, and the background. Other parameters are logarithms.
    """

    every: ClassVar[tuple[str, ...]] = SCATTER_NAMES
    linear: ClassVar[frozenset[str]] = _LINEAR
    bent: ClassVar[bool] = True
    sight: Sight | None = None

    def seen_by(self, rings: Rings, lens: Mapping[str, Any]) -> ScatterCoordinates:
        """Return the coordinates for the rings of a frame; ``lens`` are parameters of
        `stray_light`.
        """
        return replace(self, sight=Sight.of(rings, lens))

    @property
    def labels(self) -> tuple[str, ...]:
        """Return a readable name of each sampler coordinate."""
        label_of = {"b0": "ln BSDF", "s": "ln slope"} if self._joint else {}
        label_of |= {"electrons": "ln first ring", "background": "last ring"} if self.sight else {}
        return tuple(
            label_of.get(name, ("" if name in self.linear else "ln ") + name) for name in self.names
        )

    def place(self, parameters: Mapping[str, float | Tensor]) -> Tensor:
        """Convert parameters of the scatter to sampler coordinates (..., free parameter)."""
        values = {
            name: torch.as_tensor(parameters[name], dtype=torch.float64) for name in self.names
        }
        columns = dict(zip(self.names, self.scaled(values).unbind(-1), strict=True))
        if self._joint:
            squared_ratio = self._square(columns["l"])
            # ln BSDF = ln b0 + s/2 ln(1 + q), with q = (beta / l)^2 between the rings
            columns["b0"] = columns["b0"] + values["s"] / 2 * torch.log1p(squared_ratio)
            # the slope of ln BSDF over ln beta is s q / (1 + q)
            columns["s"] = (-values["s"]).log() + torch.log(squared_ratio / (1 + squared_ratio))
        if self.sight:
            share_in_first, share_in_last = self._shares(self.sight, values)
            if "background" in columns:
                columns["background"] = (
                    columns["background"] + self._of("electrons", values) * share_in_last
                )
            if "electrons" in columns:
                columns["electrons"] = columns["electrons"] + share_in_first.log()
        return torch.stack(torch.broadcast_tensors(*(columns[name] for name in self.names)), -1)  # type: ignore[no-untyped-call]

    def parameters(self, place: Tensor) -> dict[str, Tensor]:
        """Convert sampler coordinates (..., free parameter) to parameters of the scatter."""
        columns = dict(zip(self.names, place.unbind(-1), strict=True))
        if self._joint:
            squared_ratio = self._square(columns["l"])
            # the inverse of `place`
            columns["s"] = -columns["s"].exp() * (1 + squared_ratio) / squared_ratio
            columns["b0"] = columns["b0"] - columns["s"] / 2 * torch.log1p(squared_ratio)
        values = {name: x if name in self.linear else x.exp() for name, x in columns.items()}
        if self.sight:
            share_in_first, share_in_last = self._shares(self.sight, values)
            if "electrons" in values:
                values["electrons"] = values["electrons"] / share_in_first
            if "background" in values:
                values["background"] = (
                    values["background"] - self._of("electrons", values) * share_in_last
                )
        return values

    def log_prior(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return the log prior density per unit of the sampler coordinates, up to a constant.

        The coordinates of electrons and background are shifted by what the other parameters say,
        which leaves volumes as they are; that of s contributes the factor -s.
        """
        log_density = -0.5 * self.whitened(parameters).square().sum(-1)
        return log_density + (-parameters["s"]).log() if self._joint else log_density

    @property
    def _joint(self) -> bool:
        """Return True if b0, l and s are all free, so that their coordinates are mixed."""
        return {"b0", "l", "s"} <= set(self.names)

    def _of(self, name: str, values: Mapping[str, Tensor]) -> Tensor:
        """Return the value of a parameter, free or held."""
        return (
            values[name] if name in values else torch.tensor(self.held[name], dtype=torch.float64)
        )

    def _shares(self, sight: Sight, values: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return the shares of the light in a pixel of the first and of the last ring."""
        parameters = {name: self._of(name, values)[..., None] for name in ("b0", "l", "s", "core")}
        squared_radii = torch.tensor([sight.inner**2, sight.outer**2], dtype=torch.float64)
        share_in_first, share_in_last = share_of_light(
            parameters, squared_radii, sight.fringe, sight.scale
        ).unbind(-1)
        return share_in_first, share_in_last

    def _square(self, log_l: Tensor) -> Tensor:
        """Return (beta / l)**2 at the direction cosine beta between the rings, or in the middle
        of the prior of l.
        """
        if self.sight:
            # of the geometric mean of the radii of the first and the last ring
            log_cosine = math.log(self.sight.scale) + 0.5 * math.log(
                self.sight.inner * self.sight.outer
            )
            return (2 * (log_cosine - log_l)).exp()
        return (2 * (self.prior.centre[SCATTER_NAMES.index("l")] - log_l)).exp()

    def ridges(self, place: Tensor) -> list[Ridge]:
        """Return a much narrower and a much wider lobe with the same scatter outside and inside of
        it.

        Outside of l only b0 l**(-s) is seen, and inside of l only b0. The core keeps its
        brightness, if it is free.
        """
        if not {"b0", "l"} <= set(self.names):
            return []
        lobe_values = {
            **{name: torch.tensor(x) for name, x in self.held.items()},
            **self.parameters(place),
        }
        l, s = lobe_values["l"], lobe_values["s"]  # noqa: E741
        ridges = [
            Ridge(
                self._moved(lobe_values, 1.0, _FAR),
                {"l": "lower"},
                "l: only a lower limit, beyond the frame",
            )
        ]
        # the narrowest lobe that still scatters a moderate share of the light
        for factor in (_FAR, 10.0, 3.0):
            peak_factor = float(factor ** -float(s))
            if float(scattered_share(lobe_values["b0"] * peak_factor, l / factor, s)) < _MOST:
                text = "b0 and l only as b0 l^(-s): l lies within the saturated pixels"
                narrow_lobe = self._moved(lobe_values, peak_factor, 1 / factor)
                return [*ridges, Ridge(narrow_lobe, {"l": "upper", "b0": "lower"}, text)]
        return ridges

    def _moved(self, lobe_values: Mapping[str, Tensor], peak: float, width: float) -> Tensor:
        """Return the coordinates with b0 times ``peak`` and l times ``width``, where a free core,
        or else the electrons, keep the brightness of the core as before.
        """
        b0, l, s = lobe_values["b0"] * peak, lobe_values["l"] * width, lobe_values["s"]  # noqa: E741
        core, electrons = lobe_values["core"], lobe_values["electrons"]
        unscattered_before, unscattered_after = (
            1 - scattered_share(*x) for x in ((lobe_values["b0"], lobe_values["l"], s), (b0, l, s))
        )
        core_factor = unscattered_before / unscattered_after.clamp_min(1 - _MOST)
        if "core" in self.names:
            core = core * core_factor
        elif "electrons" in self.names:
            b0, electrons = b0 / core_factor, electrons * core_factor
        return self.place({**lobe_values, "b0": b0, "l": l, "core": core, "electrons": electrons})
