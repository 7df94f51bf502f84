"""The terms that a mask is designed on: a relief through the recipe's own graph, and what its PSF is worth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import losses
from neusee.nodes.optics import Stop, stop
from neusee.nodes.values import BAND_FIELDS, Bands, Psf, Pupil
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe, Step, needed
from neusee.workflows.recipe.blocks.mask_design_block import DesignError, MaskTraining, need_steps
from neusee.workflows.store.result_store import Store

_PRIME = 1_000_003
_FREE = "not limited"


@dataclass(frozen=True)
class Fabrication:
    """What a workshop can make, as a mask is designed for it; `None` where nothing is said."""

    values: Mapping[str, Any]

    @classmethod
    def of(cls, recipe: Recipe, how: MaskTraining) -> Fabrication:
        """The limits of the recipe's `doe.fabricate` between relief and PSF, and the least feature."""
        steps = [recipe.steps[name] for name in needed(recipe, [how.psf])]
        made = [step.params for step in steps if step.node.path == "doe.fabricate"]
        limits = {name: made[0][name] if made else None for name in ("levels", "max_height", "wrap_at")}
        return cls({**limits, "feature": how.feature})

    def rows(self) -> list[tuple[str, str]]:
        """Each limit in words."""
        words = {"levels": "levels", "max_height": "greatest height", "wrap_at": "wrapped at one wave of",
                 "feature": "least feature"}  # fmt: skip
        return [(words[name], _limit(name, value)) for name, value in self.values.items()]

    def __str__(self) -> str:
        said = [f"{name} {text}" for name, text in self.rows() if text != _FREE]
        return ", ".join(said) or "whatever is learnt: nothing is limited"


def _limit(name: str, value: Any) -> str:
    if value is None:
        return _FREE
    return str(value) if name == "levels" else f"{value * 1e6:.4g} um"


class Terms:
    """The loss of a relief and its parts, on all bands of a recipe or some of them."""

    def __init__(self, recipe: Recipe, how: MaskTraining, store: Store | None, device: str = "cpu") -> None:
        need_steps(recipe.steps, how)
        self.how, self.recipe = how, replace(recipe, exact=True)  # a bound of the relief's effect has no gradient
        self._bands = _bands_step(self.recipe, how.psf)
        self._function = as_function(
            self.recipe, how.height, self._bands, outputs=[how.psf], store=store, device=device
        )
        seen = [how.illuminant, how.responses] if how.weights.wiener else []
        done = run(self.recipe, store, [self._bands, how.plain, *seen], device=device)
        self._seen: list[Tensor] = [done[name] for name in seen]
        self.bands: Bands = done[self._bands]
        self._plain: Psf = done[how.plain]
        self.device = self._plain.intensity.device

    @property
    def fabrication(self) -> Fabrication:
        """What the relief is designed for."""
        return Fabrication.of(self.recipe, self.how)

    @property
    def mask_step(self) -> Step:
        """The step that is replaced."""
        return self.recipe.steps[self.how.height]

    @cached_property
    def stop(self) -> Stop:
        """The pupil's grid, as the step that is replaced has it."""
        params = self.mask_step.params
        if missing := [name for name in ("samples", "pitch", "diameter", "aperture") if name not in params]:
            raise DesignError(f"height: {self.how.height} has no {missing[0]}: take a recipe whose mask is a doe")
        return stop(*(params[name] for name in ("samples", "pitch", "diameter", "aperture")))

    @property
    def count(self) -> int:
        """Bands of the recipe."""
        return len(self.bands.centres)

    def psf(self, height: Tensor, chosen: Sequence[int] | None = None) -> Psf:
        """The PSF behind a relief, of some bands or all."""
        bands = self.bands if chosen is None else _some(self.bands, chosen)
        found: Psf = self._function({self.how.height: height, self._bands: bands})[self.how.psf]
        return found

    def pupil(self, height: Tensor) -> Pupil:
        """The pupil that a relief makes."""
        name = self.recipe.steps[self.how.psf].wires.get("pupil")
        if not isinstance(name, str):
            raise DesignError(f"psf: {self.how.psf} has no pupil: name a step of optics.psf")
        function = as_function(self.recipe, self.how.height, outputs=[name], device=str(self.device))
        found: Pupil = function({self.how.height: height})[name]
        return found

    def plain(self, chosen: Sequence[int] | None = None) -> Psf:
        """The PSF of the lens without a mask."""
        return self._plain if chosen is None else _some(self._plain, chosen)

    def parts(self, height: Tensor, chosen: Sequence[int] | None = None) -> dict[str, Tensor]:
        """Each term that counts, by name, as a mean over the bands."""
        psf, plain, weights, how = self.psf(height, chosen), self.plain(chosen), self.how.weights, self.how
        found = {}
        if weights.lsr:
            found["lsr"] = self._suppression(psf)
        if weights.bsr:
            found["bsr"] = losses.background_loss(psf.intensity, plain.intensity)
        if weights.contrast:
            found["contrast"] = losses.contrast(psf, floor=how.floor, up_to=how.up_to)
        found = {name: term / len(psf.intensity) for name, term in found.items()}
        if weights.wiener:  # of channels, each of which sees all bands
            found["wiener"] = self._left_wrong(psf, chosen)
        return found

    def _suppression(self, psf: Psf) -> Tensor:
        """The sum over bands, no less than what is enough of each in the mean."""
        how, count = self.how, len(psf.intensity)
        found: Tensor = losses.suppression_loss(psf, power=how.power, log=how.log)
        if how.enough is None:
            return found
        return found.clamp_min(count * (math.log(how.enough) if how.log else how.enough))

    def _left_wrong(self, psf: Psf, chosen: Sequence[int] | None) -> Tensor:
        bands = self.bands if chosen is None else _some(self.bands, chosen)
        light, responses = self._seen
        if chosen is not None:
            light, responses = light[..., list(chosen)], responses[..., list(chosen)]
        how = self.how
        found: Tensor = losses.wiener(
            psf, light, responses, bands, noise=how.noise_share, colour=how.colour, up_to=how.up_to
        )
        return found

    def total(self, parts: dict[str, Tensor]) -> Tensor:
        """The weighted sum."""
        return torch.stack([getattr(self.how.weights, name) * term for name, term in parts.items()]).sum()

    def drawn(self, number: int) -> list[int] | None:
        """The bands of an iteration: one of each stretch of the spectrum, by chance, so that in time all are seen."""
        wanted = self.how.bands
        if wanted is None or wanted >= self.count:
            return None
        rng = torch.Generator().manual_seed(self.how.seed * _PRIME + number)
        places = (torch.arange(wanted) + torch.rand(wanted, generator=rng)) * (self.count / wanted)
        return [min(int(place), self.count - 1) for place in places]

    def even(self) -> list[int] | None:
        """The same bands every time, from the first to the last."""
        wanted = self.how.bands
        if wanted is None or wanted >= self.count:
            return None
        return [round(float(place)) for place in torch.linspace(0, self.count - 1, wanted)]


def _bands_step(recipe: Recipe, psf: str) -> str:
    found = [name for name in needed(recipe, [psf]) if recipe.steps[name].node.path == "spectra.bands"]
    if len(found) != 1:
        raise DesignError(
            f"psf: {psf} hangs on {len(found)} steps of spectra.bands ({', '.join(found)}); one is needed"
        )
    return found[0]


def _some(value: Any, chosen: Sequence[int]) -> Any:
    """Some bands of what has one entry a band."""
    rows = torch.tensor(list(chosen))
    changed = {name: getattr(value, name) for name in BAND_FIELDS[type(value)]}
    return value._replace(**{name: x.index_select(0, rows.to(x.device)) for name, x in changed.items()})
