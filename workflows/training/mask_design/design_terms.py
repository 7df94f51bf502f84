"""The loss function of a mask design and its terms, computed from the PSF of the mask."""

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
_HERMITE = [(-(3**0.5), 1 / 6), (0.0, 2 / 3), (3**0.5, 1 / 6)]  #: standard deviations and weights of a normal law


@dataclass(frozen=True)
class Fabrication:
    """The fabrication limits of a designed mask, such as its greatest height, by name; None stands for no limit."""

    values: Mapping[str, Any]

    @classmethod
    def of(cls, recipe: Recipe, settings: MaskTraining) -> Fabrication:
        """Return the fabrication limits of a mask from the `doe.fabricate` step of the recipe and from the settings."""
        steps = (recipe.steps[name] for name in needed(recipe, [settings.psf]))
        params = next((step.params for step in steps if step.node.path == "doe.fabricate"), {})
        limits = {name: params.get(name) for name in ("levels", "max_height", "wrap_at")}
        return cls({**limits, "feature": settings.feature})

    def rows(self) -> list[tuple[str, str]]:
        """Return the name and the value of each fabrication limit of a mask as text."""
        words = {"levels": "levels", "max_height": "greatest height", "wrap_at": "wrapped at one wave of",
                 "feature": "least feature"}  # fmt: skip
        texts = {name: _FREE if x is None else f"{x * 1e6:.4g} um" for name, x in self.values.items()}
        if (levels := self.values["levels"]) is not None:
            texts["levels"] = str(levels)
        return [(words[name], text) for name, text in texts.items()]

    def __str__(self) -> str:
        return ", ".join(f"{name} {text}" for name, text in self.rows() if text != _FREE) or "no limits"


class Terms:
    """The loss function of a mask design and its terms, for all spectral bands of a recipe or for chosen bands."""

    def __init__(self, recipe: Recipe, settings: MaskTraining, store: Store | None, device: str = "cpu") -> None:
        need_steps(recipe.steps, settings)
        self.settings = settings
        self.fabrication = Fabrication.of(recipe, settings)
        self.recipe = replace(recipe, exact=True)  # because the error bound of a cheaper step has no gradient
        self._bands = _bands_step(self.recipe, settings.psf)
        self._defocus = _defocus_of(self.recipe, settings)
        free = [settings.height, self._bands, *self._defocus]
        self._function = as_function(self.recipe, *free, outputs=[settings.psf], store=store, device=device)
        seen = [settings.illuminant, settings.responses] if settings.weights.coloured else []
        stop = self.mask_step.wires.get("stop")
        stops = [stop] if isinstance(stop, str) else []
        done = run(self.recipe, store, [self._bands, settings.plain, *seen, *stops], device=device)
        self._seen: list[Tensor] = [done[name] for name in seen]
        self.bands: Bands = done[self._bands]
        self._plain: Psf = done[settings.plain]
        self._stop: Stop | None = done[stops[0]] if stops else None
        self.device = self._plain.intensity.device

    @property
    def mask_step(self) -> Step:
        """Return the step of the recipe whose height map is replaced by the designed mask."""
        return self.recipe.steps[self.settings.height]

    @property
    def stop(self) -> Stop:
        """Return the aperture stop with the pupil grid on which the mask is computed."""
        if self._stop is None:
            raise DesignError(f"height: the step {self.settings.height} has no input `stop`: name the step of a mask")
        return self._stop

    def psf(self, height: Tensor, chosen: Sequence[int] | None = None, further: float = 0.0) -> Psf:
        """Return the PSF of a mask from its height map, for the spectral bands ``chosen`` or for all bands.

        ``further`` is added to the defocus of the recipe, in standard deviations.
        """
        values: dict[str, Any] = {self.settings.height: height, self._bands: _some(self.bands, chosen)}
        values |= {name: at + further * self.settings.defocus_spread for name, at in self._defocus.items()}
        psf: Psf = self._function(values)[self.settings.psf]
        return psf

    def pupil(self, height: Tensor) -> Pupil:
        """Return the pupil function of a mask from its height map."""
        name = self.recipe.steps[self.settings.psf].wires.get("pupil")
        if not isinstance(name, str):
            raise DesignError(f"psf: the step {self.settings.psf} has no input `pupil`: name an optics.psf step")
        function = as_function(self.recipe, self.settings.height, outputs=[name], device=str(self.device))
        pupil: Pupil = function({self.settings.height: height})[name]
        return pupil

    def plain(self, chosen: Sequence[int] | None = None) -> Psf:
        """Return the PSF of the lens without a mask, for the spectral bands ``chosen`` or for all bands."""
        psf: Psf = _some(self._plain, chosen)
        return psf

    def parts(
        self, height: Tensor, chosen: Sequence[int] | None = None, number: int | None = None
    ) -> dict[str, Tensor]:
        """Return the terms of the mask loss that have a weight above 0, by name, each as a mean over spectral bands.

        If the defocus is uncertain, it is drawn for the iteration ``number``; for None the terms are means over the law
        of the defocus, by Gauss-Hermite quadrature of three points.
        """
        if not self._defocus:
            return self._parts(self.psf(height, chosen), chosen)
        points = [(self._drawn_defocus(number), 1.0)] if number is not None else _HERMITE
        each = [(self._parts(self.psf(height, chosen, at), chosen), share) for at, share in points]
        return {name: torch.stack([share * part[name] for part, share in each]).sum() for name in each[0][0]}

    def _parts(self, psf: Psf, chosen: Sequence[int] | None) -> dict[str, Tensor]:
        settings, weights = self.settings, self.settings.weights
        sums = {}
        if weights.lsr:
            sums["lsr"] = self._suppression(psf)
        if weights.bsr:
            sums["bsr"] = losses.background_loss(psf)
        if weights.contrast:
            sums["contrast"] = losses.contrast(psf, floor=settings.floor, up_to=settings.up_to)
        terms = {name: term / len(psf.intensity) for name, term in sums.items()}
        if weights.wiener:  # not a sum over bands, because each channel depends on all bands
            terms["wiener"] = losses.wiener(
                psf, *self.seen(chosen), noise=settings.noise_share, colour=settings.colour, up_to=settings.up_to
            )
        for name in ("filtered_error", "information"):
            if getattr(weights, name):
                terms[name] = getattr(losses, name)(psf, *self.seen(chosen), **self.exposure(), power=settings.power)
        return terms

    def exposure(self) -> dict[str, Any]:
        """Return the parameters that `losses.filtered_error`, `losses.information` and `losses.best_stop` share."""
        s = self.settings
        return {"light": s.light, "read_noise": s.read_noise, "veil": s.veil, "limit": s.limit,
                "contrast": s.contrast_variance, "up_to": s.up_to}  # fmt: skip

    def seen(self, chosen: Sequence[int] | None = None) -> tuple[Tensor, Tensor, Bands]:
        """Return illuminant, responses and bands, for the spectral bands ``chosen`` or for all bands."""
        light, responses = (x if chosen is None else x[..., list(chosen)] for x in self._seen)
        return light, responses, _some(self.bands, chosen)

    def _drawn_defocus(self, number: int) -> float:
        rng = torch.Generator().manual_seed(self.settings.seed * _PRIME - number - 1)
        return float(torch.randn((), generator=rng, dtype=torch.float64))

    def _suppression(self, psf: Psf) -> Tensor:
        """Return the laser suppression loss summed over bands, which is constant below the setting ``enough``."""
        settings, count = self.settings, len(psf.intensity)
        loss: Tensor = losses.suppression_loss(psf, power=settings.power, log=settings.log)
        if settings.enough is None:
            return loss
        return loss.clamp_min(count * (math.log(settings.enough) if settings.log else settings.enough))

    def total(self, parts: dict[str, Tensor]) -> Tensor:
        """Return the loss of a mask, which is the weighted sum of its terms."""
        return torch.stack([getattr(self.settings.weights, name) * term for name, term in parts.items()]).sum()

    def drawn(self, number: int) -> list[int] | None:
        """Sample the spectral bands of an iteration, one in each equal part of the spectrum; None stands for all."""
        count, all_bands = self.settings.bands, len(self.bands.centres)
        if count is None or count >= all_bands:
            return None
        rng = torch.Generator().manual_seed(self.settings.seed * _PRIME + number)
        positions = (torch.arange(count) + torch.rand(count, generator=rng)) * (all_bands / count)
        return [min(int(position), all_bands - 1) for position in positions]

    def even(self) -> list[int] | None:
        """Return the indices of evenly spaced spectral bands, or None for all bands."""
        count, all_bands = self.settings.bands, len(self.bands.centres)
        if count is None or count >= all_bands:
            return None
        return [round(float(position)) for position in torch.linspace(0, all_bands - 1, count)]


def _bands_step(recipe: Recipe, psf: str) -> str:
    names = [name for name in needed(recipe, [psf]) if recipe.steps[name].node.path == "spectra.bands"]
    if len(names) != 1:
        text = f"{psf} depends on {len(names)} steps of spectra.bands ({', '.join(names)}), not on one step"
        raise DesignError(f"psf: {text}")
    return names[0]


def _defocus_of(recipe: Recipe, settings: MaskTraining) -> dict[str, float]:
    """Return the parameter with the defocus of the mask's pupil and its value, or nothing if the defocus is certain."""
    if not settings.defocus_spread:
        return {}
    name = recipe.steps[settings.psf].wires.get("pupil")
    if not isinstance(name, str) or "defocus" not in recipe.steps[name].params:
        raise DesignError(f"defocus_spread: the pupil of {settings.psf} has no defocus: remove it, or name another psf")
    return {f"{name}.defocus": float(recipe.steps[name].params["defocus"])}


def _some(value: Any, chosen: Sequence[int] | None) -> Any:
    """Return the part of a PSF or other spectral value at the bands ``chosen``, or the whole value if None."""
    if chosen is None:
        return value
    rows = torch.tensor(list(chosen))
    changed = {name: getattr(value, name) for name in BAND_FIELDS[type(value)]}
    return value._replace(**{name: x.index_select(0, rows.to(x.device)) for name, x in changed.items()})
