"""Pattern of damage on the sensor: the spot of a laser over the limit of damage, behind lens and mask."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from neusee.nodes.laser import heated_spot
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.diagnostics import Diagnostic, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe, unknown_step
from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.recipe.distributions.shapes import FloatArray
from neusee.workflows.safety.exposures import Option
from neusee.workflows.store.result_store import Store

if TYPE_CHECKING:
    from neusee.workflows.safety.safety_estimate import Finding

OPTIONS = {"plain": "plain lens", "mask": "mask"}  #: protection by the name of its spot in the settings
_FAINT, _DIM = 1e-4, 0.03  #: of the peak; a picture ends where the spot is fainter everywhere, by how strong it is
_LEAST = 12  #: samples from the peak to each edge of a picture, at least


@dataclass(frozen=True)
class Spot:
    """The spot of a laser behind one protection, of which the brightest sample is 1."""

    option: str
    light: FloatArray  #: (y, x)
    pitch: float  #: m
    heated: float  #: m, 1/e2 diameter of the Gaussian spot of equal peak that heats as much or more


@dataclass(frozen=True)
class DamagePattern:
    """The spot of a laser over the limit of one kind of damage."""

    option: str
    limit: str
    ratio: FloatArray  #: (y, x) exposure over limit, cut to what is bright
    width: float  #: m, of the cut
    peak: float
    area: float  #: um2 in which the limit is exceeded, in the whole window


def spots_of(recipe: Recipe, safety: Safety, store: Store | None) -> tuple[Spot, ...]:
    """Return the spots that the settings name; raise `RecipeError` for a step that does not exist."""
    named = {name: step for name, step in safety.settings.protection.spots if step is not None}
    steps = {name: step_of(recipe, safety, f"protection.spots.{name}", step, name) for name, step in named.items()}
    found: Any = run(recipe, store, list(steps.values())) if steps else {}
    return tuple(_spot(OPTIONS[name], found[step].intensity, recipe.steps[step].params) for name, step in steps.items())


def step_of(recipe: Recipe, safety: Safety, setting: str, step: str, arm: str) -> str:
    """Return the name of a step, completed by the arm and the laser if the step has copies for these.

    Raises `RecipeError` at the setting for a step that does not exist.
    """
    found = next((name for name in (step, f"{step}[{arm},{safety.name}]") if name in recipe.steps), None)
    if found is None:
        value = safety.values[setting]
        raise RecipeError([Diagnostic(value.mark, value.name, unknown_step(step, recipe.steps))])
    return found


def _spot(option: str, intensity: FloatArray, params: Mapping[str, float]) -> Spot:
    light, pitch = np.asarray(intensity, np.float64).sum(0), params["pixel_pitch"]
    heated = heated_spot(torch.from_numpy(light), pitch, lost=max(0.0, 1 - float(light.sum())))
    return Spot(option, light / light.max(), pitch, heated or 0.0)


def with_heated_spots(options: Sequence[Option], spots: Sequence[Spot]) -> tuple[Option, ...]:
    """Return the options, of which masked ones know how much wider their heated spot is than that of the clear lens."""
    heated = {spot.option: spot.heated for spot in spots}
    plain, mask = heated.get(OPTIONS["plain"]), heated.get(OPTIONS["mask"])
    if not plain or not mask:
        return tuple(options)
    return tuple(replace(option, heated=mask / plain) if option.masked else option for option in options)


def damage_patterns(spots: Sequence[Spot], findings: Sequence[Finding]) -> Iterator[DamagePattern]:
    """Yield the pattern of the most sensitive kind of damage behind each protection whose spot is known."""
    for spot in spots:
        known = [each for each in findings if each.option == spot.option and each.limit.effect == "damage"]
        if not known:
            continue
        worst = max(known, key=lambda each: each.ratio)
        ratio = spot.light * worst.ratio
        area = float((ratio >= 1).sum()) * (spot.pitch * 1e6) ** 2
        cut = _cut(spot.light, max(_FAINT, min(_DIM, 0.1 / worst.ratio)))
        width = cut.shape[0] * spot.pitch
        yield DamagePattern(spot.option, worst.limit.name, cut * worst.ratio, width, worst.ratio, area)


def _cut(light: FloatArray, faint: float) -> FloatArray:
    """Return the square around the middle of the window that holds everything brighter than ``faint``."""
    middle = np.array(light.shape) // 2
    bright = np.argwhere(light >= faint)
    reach = int(np.clip(np.abs(bright - middle).max(), _LEAST, min(middle) - 1))
    y, x = middle
    return light[y - reach : y + reach + 1, x - reach : x + reach + 1]
