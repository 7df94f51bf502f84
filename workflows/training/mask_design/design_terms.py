"""The terms on which a mask is designed: its height map goes through the graph of a recipe, its PSF is judged."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import losses
from neusee.nodes.values import BAND_FIELDS, Bands, Psf, Pupil, Stop
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe, Step, needed
from neusee.workflows.recipe.blocks.mask_design_block import DesignError, MaskTraining, need_steps
from neusee.workflows.store.result_store import Store

_PRIME = 1_000_003
_FREE = "not limited"


@dataclass(frozen=True)
class Fabrication:
    """The limits of fabrication for which a mask is designed; `None` for no limit."""

    values: Mapping[str, Any]

    @classmethod
    def of(cls, recipe: Recipe, settings: MaskTraining) -> Fabrication:
        """Return the limits of the step `doe.fabricate` between mask and PSF, and the least feature."""
        steps = [recipe.steps[name] for name in needed(recipe, [settings.psf])]
        made = [step.params for step in steps if step.node.path == "doe.fabricate"]
        limits = {name: made[0][name] if made else None for name in ("levels", "max_height", "wrap_at")}
        return cls({**limits, "feature": settings.feature})

    def rows(self) -> list[tuple[str, str]]:
        """Return each limit in words."""
        words = {"levels": "levels", "max_height": "greatest height", "wrap_at": "wrapped at one wave of",
                 "feature": "least feature"}  # fmt: skip
        return [(words[name], _limit(name, value)) for name, value in self.values.items()]

    def __str__(self) -> str:
        said = [f"{name} {text}" for name, text in self.rows() if text != _FREE]
        return ", ".join(said) or "no limits"


def _limit(name: str, value: Any) -> str:
    if value is None:
        return _FREE
    return str(value) if name == "levels" else f"{value * 1e6:.4g} um"


class Terms:
    """The loss of a mask and its terms, on all bands of a recipe or some of them."""

    def __init__(self, recipe: Recipe, settings: MaskTraining, store: Store | None, device: str = "cpu") -> None:
        need_steps(recipe.steps, settings)
        self.settings = settings
        self.recipe = replace(recipe, exact=True)  # a bound of the mask's effect has no gradient
        self._bands = _bands_step(self.recipe, settings.psf)
        self._function = as_function(
            self.recipe, settings.height, self._bands, outputs=[settings.psf], store=store, device=device
        )
        seen = [settings.illuminant, settings.responses] if settings.weights.wiener else []
        stop = self.mask_step.wires.get("stop")
        stops = [stop] if isinstance(stop, str) else []
        done = run(self.recipe, store, [self._bands, settings.plain, *seen, *stops], device=device)
        self._seen: list[Tensor] = [done[name] for name in seen]
        self.bands: Bands = done[self._bands]
        self._plain: Psf = done[settings.plain]
        self._stop: Stop | None = done[stops[0]] if stops else None
        self.device = self._plain.intensity.device

    @property
    def fabrication(self) -> Fabrication:
        """Return the limits of fabrication."""
        return Fabrication.of(self.recipe, self.settings)

    @property
    def mask_step(self) -> Step:
        """Return the step of the mask that is replaced."""
        return self.recipe.steps[self.settings.height]

    @property
    def stop(self) -> Stop:
        """Return the stop, with the pupil grid, that the replaced step reads."""
        if self._stop is None:
            raise DesignError(f"height: {self.settings.height} has no stop: take a recipe whose mask is a doe")
        return self._stop

    @property
    def count(self) -> int:
        """Return the number of bands of the recipe."""
        return len(self.bands.centres)

    def psf(self, height: Tensor, chosen: Sequence[int] | None = None) -> Psf:
        """Return the PSF of a height map, for some bands or all."""
        bands = self.bands if chosen is None else _some(self.bands, chosen)
        found: Psf = self._function({self.settings.height: height, self._bands: bands})[self.settings.psf]
        return found

    def pupil(self, height: Tensor) -> Pupil:
        """Return the pupil of a height map."""
        name = self.recipe.steps[self.settings.psf].wires.get("pupil")
        if not isinstance(name, str):
            raise DesignError(f"psf: {self.settings.psf} has no pupil: name a step of optics.psf")
        function = as_function(self.recipe, self.settings.height, outputs=[name], device=str(self.device))
        found: Pupil = function({self.settings.height: height})[name]
        return found

    def plain(self, chosen: Sequence[int] | None = None) -> Psf:
        """Return the PSF of the lens without a mask."""
        return self._plain if chosen is None else _some(self._plain, chosen)

    def parts(self, height: Tensor, chosen: Sequence[int] | None = None) -> dict[str, Tensor]:
        """Return each term with a weight, by name, as a mean over the bands."""
        psf, plain, settings = self.psf(height, chosen), self.plain(chosen), self.settings
        weights = settings.weights
        found = {}
        if weights.lsr:
            found["lsr"] = self._suppression(psf)
        if weights.bsr:
            found["bsr"] = losses.background_loss(psf.intensity, plain.intensity)
        if weights.contrast:
            found["contrast"] = losses.contrast(psf, floor=settings.floor, up_to=settings.up_to)
        found = {name: term / len(psf.intensity) for name, term in found.items()}
        if weights.wiener:  # of channels, each of which sees all bands
            found["wiener"] = self._wiener_error(psf, chosen)
        return found

    def _suppression(self, psf: Psf) -> Tensor:
        """Return the suppression summed over bands, clamped where its mean over bands is low enough."""
        settings, count = self.settings, len(psf.intensity)
        found: Tensor = losses.suppression_loss(psf, power=settings.power, log=settings.log)
        if settings.enough is None:
            return found
        return found.clamp_min(count * (math.log(settings.enough) if settings.log else settings.enough))

    def _wiener_error(self, psf: Psf, chosen: Sequence[int] | None) -> Tensor:
        bands = self.bands if chosen is None else _some(self.bands, chosen)
        light, responses = self._seen
        if chosen is not None:
            light, responses = light[..., list(chosen)], responses[..., list(chosen)]
        settings = self.settings
        found: Tensor = losses.wiener(
            psf, light, responses, bands, noise=settings.noise_share, colour=settings.colour, up_to=settings.up_to
        )
        return found

    def total(self, parts: dict[str, Tensor]) -> Tensor:
        """Return the weighted sum of the terms."""
        return torch.stack([getattr(self.settings.weights, name) * term for name, term in parts.items()]).sum()

    def drawn(self, number: int) -> list[int] | None:
        """Return a random band of each stretch of the spectrum, so that all bands are seen in time."""
        wanted = self.settings.bands
        if wanted is None or wanted >= self.count:
            return None
        rng = torch.Generator().manual_seed(self.settings.seed * _PRIME + number)
        places = (torch.arange(wanted) + torch.rand(wanted, generator=rng)) * (self.count / wanted)
        return [min(int(place), self.count - 1) for place in places]

    def even(self) -> list[int] | None:
        """Return evenly spaced bands from the first to the last, always the same."""
        wanted = self.settings.bands
        if wanted is None or wanted >= self.count:
            return None
        return [round(float(place)) for place in torch.linspace(0, self.count - 1, wanted)]


def _bands_step(recipe: Recipe, psf: str) -> str:
    found = [name for name in needed(recipe, [psf]) if recipe.steps[name].node.path == "spectra.bands"]
    if len(found) != 1:
        raise DesignError(
            f"psf: {psf} depends on {len(found)} steps of spectra.bands ({', '.join(found)}); one is needed"
        )
    return found[0]


def _some(value: Any, chosen: Sequence[int]) -> Any:
    """Return some bands of a value that has one entry for each band."""
    rows = torch.tensor(list(chosen))
    changed = {name: getattr(value, name) for name in BAND_FIELDS[type(value)]}
    return value._replace(**{name: x.index_select(0, rows.to(x.device)) for name, x in changed.items()})
