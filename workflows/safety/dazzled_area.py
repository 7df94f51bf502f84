"""The dazzled area behind each protection: from pixels ranked by their light where a step gives them, else closed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from neusee.nodes.laser import dazzle_strength, dazzled_pixels, peak_light, pixel_share, spot_in_pixels
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.diagnostics import Diagnostic, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.recipe.distributions.scalar import FloatArray
from neusee.workflows.safety.damage_pattern import step_of
from neusee.workflows.safety.exposures import Option
from neusee.workflows.store.result_store import Store

_RIM = 0.01  #: largest share of the rim of a window whose pixels count, for a window that holds the area
_STRAY = "flare.stray_light"


@dataclass(frozen=True)
class Ranked:
    """The pixels of the sensor behind lens or mask by how bright they are, in shares of the clear pupil's light."""

    arm: str  #: ``plain`` or ``mask``
    count: FloatArray  #: (rank,) number of pixels
    level: FloatArray  #: (rank,) light in the faintest of these pixels
    smooth: FloatArray  #: (rank,) the same of the mean over the feature of `Dazzle`
    held: int  #: number of the first ranks for which the window holds all pixels that are as bright
    stray: bool  #: whether the light that the lens scatters is in it

    def light_at(self, pixels: float, smooth: bool = False) -> float | None:
        """Return the light of the faintest of a number of pixels; None where the window does not hold them all."""
        if not 1 <= pixels <= self.count[self.held - 1]:
            return None
        level = self.smooth if smooth else self.level
        return float(np.exp(np.interp(math.log(pixels), np.log(self.count), np.log(np.maximum(level, 1e-300)))))

    def pixels_above(self, light: FloatArray) -> FloatArray:
        """Return the number of pixels with at least each of several lights; NaN where the window does not hold them."""
        rising = np.log(np.maximum(self.level[::-1], 1e-300))
        found = np.exp(np.interp(np.log(light), rising, np.log(self.count[::-1])))
        beyond = np.where(light < self.level[self.held - 1], np.nan, found)
        return np.where(light > self.level[0], 0.0, beyond)


@dataclass(frozen=True)
class Area:
    """The dazzled area of a laser behind one protection, against the exposure at the peak on the sensor."""

    option: Option
    spread: float  #: wavelength times f-number over pixel pitch, of the aperture
    ranked: Ranked | None  #: None: the closed form of a clear round pupil

    @property
    def _clear(self) -> float:
        """Return the share of the light in a pixel at the peak of the clear, focused lens."""
        return peak_light(self.spread) * self.option.peak

    def limit(self, pixels: float, veiled: bool) -> float | None:
        """Return the peak exposure, in multiples of saturation, that dazzles a number of pixels; None: not known."""
        if self.ranked is None:
            return dazzle_strength(pixels, self.spread) / pixel_share(self.spread)
        light = self.ranked.light_at(pixels, smooth=veiled)
        return None if light is None else self._clear / light

    def saturated(self, peak: FloatArray) -> FloatArray:
        """Return the number of pixels that peak exposures, in multiples of saturation, fill; NaN: not known."""
        if self.ranked is not None:
            return self.ranked.pixels_above(self._clear / np.maximum(peak, 1e-300))
        share = pixel_share(self.spread)
        return np.array([dazzled_pixels(float(x) * share, self.spread) for x in peak.ravel()]).reshape(peak.shape)


def ranked_of(recipe: Recipe, safety: Safety, store: Store | None) -> tuple[Ranked, ...]:
    """Return the ranked pixels of the steps that the settings name; raise `RecipeError` for a step of another kind."""
    protection = safety.settings.protection
    named = {
        arm: step for arm, step in protection.pixels if step is not None and (arm, protection.mask) != ("mask", None)
    }
    if safety.settings.dazzle is None or not named:
        return ()
    steps = {arm: _step(recipe, safety, arm, step) for arm, step in named.items()}
    found: Any = run(recipe, store, list(steps.values()))
    return tuple(_ranked(arm, found[step], _scatters(recipe, step)) for arm, step in steps.items())


def _step(recipe: Recipe, safety: Safety, arm: str, named: str) -> str:
    """Return the name of a step of ranked pixels; raise `RecipeError` for another node, and for another sensor."""
    setting, sensor = f"protection.pixels.{arm}", safety.settings.sensor
    step = step_of(recipe, safety, setting, named, arm)
    given, params = recipe.steps[step], recipe.steps[step].params
    value, text = safety.values[setting], ""
    if given.node.path != "laser.bright_pixels":
        text = f"the step {step} is of the node {given.node.path}: name a step of laser.bright_pixels"
    elif not math.isclose(params["pixel_pitch"], sensor.pixel_pitch) or tuple(params["shape"]) != sensor.shape:
        text = f"the step {step} has another sensor: give it safety.sensor.pixel_pitch and safety.sensor.shape"
    if text:
        raise RecipeError([Diagnostic(value.mark, value.name, text)])
    return step


def _scatters(recipe: Recipe, step: str) -> bool:
    """Return True if stray light of the lens is in the result of a step."""
    waiting, seen = [step], set[str]()
    while waiting:
        name = waiting.pop()
        if recipe.steps[name].node.path == _STRAY:
            return True
        seen.add(name)
        waiting += [source for source in recipe.steps[name].sources if source not in seen]
    return False


def _ranked(arm: str, found: Any, stray: bool) -> Ranked:
    count, level, smooth, rim = (np.asarray(x, np.float64) for x in found)
    wide = np.flatnonzero(rim > _RIM)
    return Ranked(arm, count, level, smooth, int(wide[0]) if wide.size else len(count), stray)


def area_of(safety: Safety, option: Option, ranked: Sequence[Ranked]) -> Area | str:
    """Return the dazzled area behind an option, or the reason why it is not known."""
    lens, pitch = safety.settings.lens, safety.settings.sensor.pixel_pitch
    diameter = min(option.diameter or np.inf, lens.diameter)
    spread = spot_in_pixels(safety.laser.wavelength, lens.focal_length, diameter, pitch)
    arms = {each.arm: each for each in ranked}
    if option.masked:
        if "mask" in arms:
            return Area(option, spread, arms["mask"])
        return (
            "the recipe does not compute it. Add `- safety: masked_dazzle` to its defaults, or name a step of "
            "laser.bright_pixels in safety.protection.pixels.mask"
        )
    plain = arms.get("plain")
    if plain is None or option.diameter is None:
        return Area(option, spread, plain)
    if plain.stray:
        return "the closed form for a stop has no stray light, which the other rows count"
    return Area(option, spread, None)
