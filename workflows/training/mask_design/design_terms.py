"""The loss function of a mask design and its terms, computed from the PSF of the mask."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import losses
from neusee.nodes.values import Bands, Psf, Pupil, Stop, band_names
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe, Step, needed
from neusee.workflows.recipe.blocks.mask_design_block import DesignError, MaskTraining, need_steps
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.mask_design.camera_laws import NOMINAL, CameraLaws, State
from neusee.workflows.training.mask_design.learnt_shade import LearntShade

_PRIME = 1_000_003
_FREE = "not limited"


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
        self.laws = CameraLaws.of(self.recipe, settings)
        self.shade = LearntShade.of(self.recipe, settings, store, device)
        self._learnt = [self.shade.step] if self.shade and self.shade.learnt else []
        free = [settings.height, self._bands, *self._learnt, *self.laws.free]
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

    def psf(
        self,
        height: Tensor,
        chosen: Sequence[int] | None = None,
        state: State = NOMINAL,
        stop: Tensor | None = None,
    ) -> Psf:
        """Return the PSF of a mask from its height map, for the spectral bands ``chosen`` or for all bands.

        ``state`` moves what is uncertain, in standard deviations. ``stop`` is the amplitude of a learnt stop.
        """
        bands = self.laws.moved(_some(self.bands, chosen), state)
        values: dict[str, Any] = {self.settings.height: height, self._bands: bands, **self.laws.values(state)}
        if self.shade is not None and self._learnt:
            values[self.shade.step] = self.shade.behind(stop)
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
        self,
        height: Tensor,
        chosen: Sequence[int] | None = None,
        number: int | None = None,
        stop: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Return the terms of the mask loss that have a weight above 0, by name, each as a mean over spectral bands.

        What is uncertain is drawn for the iteration ``number``; for None the terms are means over its laws, by a
        quadrature of 2 d + 1 points for d uncertain numbers. ``stop`` is the amplitude of a learnt stop.
        """
        points = self.laws.points() if number is None else [(self.laws.drawn(number), 1.0)]
        if self.laws.certain:
            points = [(NOMINAL, 1.0)]
        each = [(self._parts(height, chosen, state, stop), share) for state, share in points]
        return {name: torch.stack([share * part[name] for part, share in each]).sum() for name in each[0][0]}

    def _parts(
        self, height: Tensor, chosen: Sequence[int] | None, state: State, stop: Tensor | None
    ) -> dict[str, Tensor]:
        settings, weights, psf = self.settings, self.settings.weights, self.psf(height, chosen, state, stop)
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
                shared = {**self.exposure(), **self.passed(stop), "power": settings.power}
                terms[name] = getattr(losses, name)(psf, *self.seen(chosen), **shared)
        return terms

    def passed(self, stop: Tensor | None = None) -> dict[str, Any]:
        """Return the share of the light that a shade in front of the mask lets through, as a parameter of a loss."""
        return {} if self.shade is None else {"transmittance": self.shade.passed(stop)}

    def exposure(self) -> dict[str, Any]:
        """Return the parameters that `losses.filtered_error`, `losses.information` and `losses.best_stop` share."""
        s = self.settings
        return {"light": s.light, "read_noise": s.read_noise, "veil": s.veil, "limit": s.limit,
                "contrast": s.contrast_variance, "up_to": s.up_to}  # fmt: skip

    def seen(self, chosen: Sequence[int] | None = None) -> tuple[Tensor, Tensor, Bands]:
        """Return illuminant, responses and bands, for the spectral bands ``chosen`` or for all bands."""
        light, responses = (x if chosen is None else x[..., list(chosen)] for x in self._seen)
        return light, responses, _some(self.bands, chosen)

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


def _some(value: Any, chosen: Sequence[int] | None) -> Any:
    """Return the part of a PSF or other spectral value at the bands ``chosen``, or the whole value if None."""
    if chosen is None:
        return value
    rows = torch.tensor(list(chosen))
    changed = {name: getattr(value, name) for name in band_names(value)}
    return value._replace(**{name: x.index_select(0, rows.to(x.device)) for name, x in changed.items()})
