"""An example of the dead pixels in a raw frame of the median device: points, lines, crosses and lost frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from neusee.nodes.laser import KINDS, SpotDamage, damaged_pixels
from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.recipe.distributions.scalar import FloatArray
from neusee.workflows.safety.damage_pattern import Spot
from neusee.workflows.safety.exposures import Exposures

if TYPE_CHECKING:
    from neusee.workflows.safety.safety_estimate import Finding

_HALF, _MOST = 24, 200  #: pixels from the spot to each edge of a picture, at least and at most
_WHITE, _GREY = 1000, 400  #: DN of a white pixel and of the evenly grey scene in the drawn frame


@dataclass(frozen=True)
class DeadPixels:
    """A part of the raw frame after the laser has hit the median device, around the spot."""

    option: str
    distance: float  #: m
    kinds: tuple[str, ...]  #: of damage that is reached
    pixels: int  #: that the light itself damages, without the lines and frames that go with them
    frame: FloatArray  #: (y, x) from 0 to 1; of a lost frame, what else is damaged, or all black


def damaged_frames(
    safety: Safety, spots: Sequence[Spot], findings: Sequence[Finding], exposures: Exposures
) -> Iterator[DeadPixels]:
    """Yield the frame behind each protection whose spot is known, at one distance for all; none if nothing is damaged.

    The distance is that of the recipe if the laser damages the median device there behind the plain lens, else the
    largest at which it does.
    """
    damage = [each for each in findings if each.limit.effect == "damage"]
    reached = {
        i for each in damage if each.option == "plain lens" for i in np.flatnonzero(_ratio(each, exposures) >= 1)
    }
    pitch = safety.settings.sensor.pixel_pitch
    if not reached:
        return
    here = exposures.at(safety.laser.distance)
    at = here if here in reached else max(reached)
    for spot in spots:
        if spot.pitch > pitch:  # samples that miss pixels say nothing of them
            continue
        maps = [(each, _above(spot, pitch, float(_ratio(each, exposures)[at]))) for each in damage
                if each.option == spot.option]  # fmt: skip
        hit = [(_kind(each), places) for each, places in maps if len(places)]
        half = int(np.clip(max((np.abs(places).max() for _, places in hit), default=0) * 3 // 2, _HALF, _MOST))
        yield _frame(spot.option, float(exposures.distances[at]), hit, half, safety.settings.damage.device)


def _ratio(finding: Finding, exposures: Exposures) -> FloatArray:
    """Return the nominal exposure over the limit of the median device (distance,)."""
    emitted = exposures.emitted(finding.limit.quantity)[0]
    ratio: FloatArray = emitted * exposures.lens[0] / finding.curve[0]
    return ratio


def _kind(finding: Finding) -> str:
    return finding.limit.name.removeprefix("damage: ").partition(" (")[0]


def _above(spot: Spot, pitch: float, ratio: float) -> FloatArray:
    """Return the places (pixel, (y, x)) from the spot of the pixels in which a sample exceeds the limit."""
    middle = np.array(spot.light.shape) // 2
    samples = np.argwhere(spot.light * ratio >= 1) - middle
    return np.unique(np.round(samples * spot.pitch / pitch).astype(int), axis=0)


def _frame(option: str, distance: float, hit: Sequence[tuple[str, FloatArray]], half: int, device: str) -> DeadPixels:
    pattern = torch.zeros(2 * half + 1, 2 * half + 1, dtype=torch.uint8)
    for kind, places in hit:
        if kind == "frame" and len(hit) > 1:  # a black picture would hide what else is damaged
            continue
        for y, x in places[(np.abs(places) <= half).all(1)] + half:
            pattern[y, x] |= 1 << KINDS.index(kind)
    none = torch.zeros(0, dtype=torch.float64)
    raw = torch.full((1, *pattern.shape), float(_GREY))
    damage = SpotDamage(none, none, none, none, none, none, pattern)
    drawn = damaged_pixels(raw, [damage], full_well=float(_WHITE), gain=1.0, bits=10, device=device)
    kinds = tuple(kind for kind in KINDS if kind in {kind for kind, _ in hit})
    return DeadPixels(option, distance, kinds, int((pattern > 0).sum()), drawn[0].double().numpy() / _WHITE)
