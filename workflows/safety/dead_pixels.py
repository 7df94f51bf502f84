"""An example of the dead pixels in a raw frame of the median device: points, lines, crosses and lost frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from neusee.nodes.laser import KINDS, SpotDamage, damaged_pixels
from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.recipe.distributions.shapes import FloatArray
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
    damage = [finding for finding in findings if finding.limit.effect == "damage"]
    reached = _reached(damage, exposures)
    if safety.settings.damage is None or not reached:
        return
    here = exposures.at(safety.laser.distance)
    at = here if here in reached else max(reached)
    pitch = safety.settings.sensor.pixel_pitch
    for spot in spots:
        if spot.pitch > pitch:  # samples that miss pixels say nothing of them
            continue
        hit = _hit(spot, pitch, damage, exposures, at)
        yield _frame(spot.option, float(exposures.distances[at]), hit, _half_width(hit), safety.settings.damage.device)


def _hit(
    spot: Spot, pitch: float, damage: Sequence[Finding], exposures: Exposures, at: int
) -> list[tuple[str, FloatArray]]:
    """Return the kinds of damage that are reached behind one protection at a distance, with the places of each."""
    behind = [finding for finding in damage if finding.option == spot.option]
    places = [_above(spot, pitch, float(_ratio(finding, exposures)[at])) for finding in behind]
    kinds = [finding.limit.kind for finding in behind]
    return [(kind, pixels) for kind, pixels in zip(kinds, places, strict=True) if len(pixels)]


def _half_width(hit: Sequence[tuple[str, FloatArray]]) -> int:
    """Return the pixels from the spot to each edge of a picture that holds all damaged places."""
    farthest = max((np.abs(places).max() for _, places in hit), default=0)
    return int(np.clip(farthest * 3 // 2, _HALF, _MOST))


def _reached(damage: Sequence[Finding], exposures: Exposures) -> set[int]:
    """Return the indices of the distances at which a limit of damage is exceeded behind the plain lens."""
    plain = [each for each in damage if each.option == "plain lens"]
    indices = [np.flatnonzero(_ratio(each, exposures) >= 1) for each in plain]
    return set(np.concatenate(indices).tolist()) if indices else set()


def _ratio(finding: Finding, exposures: Exposures) -> FloatArray:
    """Return the nominal exposure over the limit of the median device (distance,)."""
    emitted = exposures.emitted(finding.limit.quantity)[0]
    ratio: FloatArray = emitted * exposures.lens[0] / finding.curve[0]
    return ratio


def _above(spot: Spot, pitch: float, ratio: float) -> FloatArray:
    """Return the places (pixel, (y, x)) from the spot of the pixels in which a sample exceeds the limit."""
    middle = np.array(spot.light.shape) // 2
    samples = np.argwhere(spot.light * ratio >= 1) - middle
    return np.unique(np.round(samples * spot.pitch / pitch).astype(int), axis=0)


def _frame(option: str, distance: float, hit: Sequence[tuple[str, FloatArray]], half: int, device: str) -> DeadPixels:
    pattern = torch.zeros(2 * half + 1, 2 * half + 1, dtype=torch.uint8)
    others = any(kind != "frame" for kind, _ in hit)
    for kind, places in hit:
        if kind == "frame" and others:  # a black picture would hide what else is damaged
            continue
        for y, x in places[(np.abs(places) <= half).all(1)] + half:
            pattern[y, x] |= 1 << KINDS.index(kind)
    none = torch.zeros(0, dtype=torch.float64)
    raw = torch.full((1, *pattern.shape), float(_GREY))
    damage = SpotDamage._make([*[none] * 8, pattern])
    drawn = damaged_pixels(raw, [damage], full_well=float(_WHITE), gain=1.0, bits=10, device=device)
    kinds = tuple(kind for kind in KINDS if kind in {kind for kind, _ in hit})
    return DeadPixels(option, distance, kinds, int((pattern > 0).sum()), drawn[0].double().numpy() / _WHITE)
