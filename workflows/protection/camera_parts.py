"""The parts of a recipe's camera that the protection study needs: lens, mask, sensor, light, and their nodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Node, metrics, optics
from neusee.nodes.doe import shade
from neusee.nodes.flare import dirt, stray_light
from neusee.nodes.metrics import PixelNoise
from neusee.nodes.values import Bands, Psf, Pupil, Stop
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.protection.unknown_conditions import Condition
from neusee.workflows.store.result_store import Store

_NEEDED = ("psf[mask]", "pupil[mask]", "pupil[plain]", "illuminant", "responses", "read[mask]", "well[mask]")
_LEAST_MASK = 0.9  #: laser suppression ratio above which a recipe has no mask to compare


@dataclass(frozen=True)
class ProtectionCamera:
    """Lens, mask and sensor of a recipe, as values and parameters from which PSFs of any shade are computed."""

    recipe: Recipe
    height: Tensor
    flat: Tensor
    stop: Stop
    bands: Bands  #: a few bands of the recipe, from end to end, for the scene
    laser_bands: Bands  #: all bands of the recipe, for a laser that may have any wavelength
    illuminant: Tensor
    responses: Tensor
    keys: tuple[str, ...]  #: cache keys of these values

    @classmethod
    def of(cls, recipe: Recipe, store: Store, count: int) -> ProtectionCamera:
        """Return the camera of a recipe with ``count`` of its bands; raise ValueError for an unsuitable recipe."""
        _refuse_unsuitable(recipe)
        pupil, plain = (recipe.steps[f"pupil[{arm}]"].wires for arm in ("mask", "plain"))
        names = [str(w) for w in (pupil["height"], plain["height"], pupil["stop"], pupil["bands"])]
        names += ["illuminant", "responses"]
        result = run(recipe, store, dict.fromkeys(names))
        height, flat, stop, bands, illuminant, responses = (result.values[name] for name in names)
        which = torch.linspace(0, len(bands.centres) - 1, min(count, len(bands.centres))).round().long()
        few = Bands(*(one[which] for one in bands))
        keys = tuple(result.keys[name] for name in names)
        return cls(recipe, height, flat, stop, few, bands, illuminant[which], responses[:, which], keys)

    @property
    def lens(self) -> Mapping[str, Any]:
        """Return the parameters of the recipe's PSF."""
        step = self.recipe.steps["psf[mask]"]
        if step.node.path == "flare.stray_light":
            step = self.recipe.steps[str(step.wires["psf"])]
        return step.params

    @property
    def noise(self) -> Mapping[str, float]:
        """Return the read noise and the full well of the recipe's sensor, in e-."""
        read, well = (self.recipe.steps[name].params for name in ("read[mask]", "well[mask]"))
        return {"read_noise": float(read["read_noise"]), "full_well": float(well["capacity"])}

    def pixel(self, prnu: float, residual_glare: float) -> PixelNoise:
        """Return the noise of a pixel of the recipe's sensor."""
        return PixelNoise(**self.noise, prnu=prnu, residual_glare=residual_glare)

    def psf(self, masked: bool, diameter: float, bands: Bands, condition: Condition | None = None, **more: Any) -> Psf:
        """Return the PSF with or without the mask, in a stop of a relative ``diameter``, under a condition."""
        notches = {name: more.pop(name) for name in ("notches", "depth") if name in more}
        found: Psf = optics.psf(self._front(masked, diameter, bands, condition, **notches), **{**self.lens, **more})
        return found

    def laser_psf(self, masked: bool, diameter: float, line: Bands, condition: Condition, **more: Any) -> Psf:
        """Return the PSF of a laser from the ``angle`` of its direction, with the light that the lens scatters."""
        notches = {name: more.pop(name) for name in ("notches", "depth") if name in more}
        front, lens = self._front(masked, diameter, line, condition, **notches), {**self.lens, **more}
        sizes = {name: lens[name] for name in ("focal_length", "pixel_pitch", "angle")}
        whole = float(self.stop.diameter)
        found: Psf = stray_light(optics.psf(front, **lens), front, surfaces=condition.surfaces, diameter=whole, **sizes)
        return found

    def _front(self, masked: bool, diameter: float, bands: Bands, condition: Condition | None, **notches: Any) -> Pupil:
        pupil = self.recipe.steps["pupil[mask]"]
        index = self.recipe.steps[str(pupil.wires["index"])]
        height = self.height if masked else self.flat
        given = dict(pupil.params)
        film = None
        if condition is not None:
            given["defocus"] = float(given.get("defocus", 0.0)) + condition.defocus
            film = self._film(condition)
        shaded = shade(self.stop, diameter=diameter, **notches)
        found: Pupil = optics.pupil(
            height, index.node(bands, **index.params), bands, self.stop, film, shade=shaded, **given
        )
        return found

    def _film(self, condition: Condition) -> Any:
        if not condition.grease:
            return None
        return dirt(self.stop, grease=condition.grease, rng=torch.Generator().manual_seed(condition.seed))

    def laser_line(self, wavelength: float) -> Bands:
        """Return one narrow band at the wavelength of a laser."""
        one = torch.ones(1, dtype=torch.float64)
        return Bands(one * wavelength, one * 1e-9, one)

    def laser_colour(self, line: Bands) -> Tensor:
        """Return the response of each channel to a laser relative to the channel that responds most: (channel,)."""
        step = self.recipe.steps["responses"]
        found: Tensor = step.node(line, **step.params)[:, 0].double()
        return found / found.max() if float(found.max()) > 0 else torch.ones_like(found)

    @property
    def nodes(self) -> tuple[Node, ...]:
        """Return the nodes whose code determines a PSF, or a measure of it."""
        index = self.recipe.steps[str(self.recipe.steps["pupil[mask]"].wires["index"])].node
        own = (
            optics.psf,
            optics.pupil,
            shade,
            dirt,
            stray_light,
            metrics.lsr,
            metrics.heat_ratio,
            metrics.filtered_picture,
        )
        return (*own, index, self.recipe.steps["responses"].node)


def _refuse_unsuitable(recipe: Recipe) -> None:
    """Raise ValueError where the recipe lacks a step, or its mask is shaded already."""
    missing = [name for name in _NEEDED if name not in recipe.steps]
    if missing:
        raise ValueError(
            f"the recipe {recipe.name} has no step {missing[0]}: study a recipe of the camera with the arms plain and "
            "mask, such as five_half_rings"
        )
    if recipe.steps["pupil[mask]"].wires.get("shade"):
        raise ValueError(
            "the mask of this recipe is shaded already: choose the mask alone, such as doe=axicon, because the study "
            "adds filters and stops itself"
        )


def refuse_no_mask(lsr: float) -> None:
    """Raise ValueError for a mask that lowers the peak too little to compare."""
    if lsr > _LEAST_MASK:
        raise ValueError(
            f"the mask of this recipe lowers the peak of a laser to {lsr:.3g} only: choose a mask, such as doe=axicon"
        )
