"""Distances at which the spot of a laser is computed anew: dense where its shape changes, none where it does not."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from neusee.nodes.laser import Beam, beam_radius, defocus_at
from neusee.workflows.recipe.blocks.safety_block import Lens
from neusee.workflows.recipe.distributions.shapes import FloatArray

FAR_FILL, FAR_WAVES = 0.02, 0.03  #: largest fill and defocus of a spot that is taken as that of a distant laser
UNFOCUSED_WAVES = 0.002  #: the same for a lens that is out of focus far away, where each wave counts at first order
FOLLOWED_WAVES = 2.0  #: defocus up to which rungs follow how the middle of a spot turns bright and dark
_DEFOCUS = 550e-9  #: m; the wavelength in which waves of defocus are counted


def far_distance(beam: Beam, diameter: float, waves: float = FAR_WAVES) -> float:
    """Return the distance in m from which the beam overfills a lens and its wavefront is plane.

    The fill (D / (2 w))^2 is then at most 0.02, which lowers the spot by 2 %, and the curvature at most 0.03 waves,
    which lowers the spot of a lens in focus by 0.3 %; the power into the lens is exact at every distance.
    """
    width = diameter / (2 * math.sqrt(FAR_FILL))
    filled = 2 * math.sqrt(max(width**2 - beam.waist**2, 0.0)) / beam.divergence
    plane = diameter**2 / (8 * beam.wavelength * waves)
    return max(filled, plane)


def focus_of(lens: Lens) -> float:
    """Return the distance in m on which a lens is focused; infinity for a lens that follows the laser."""
    return math.inf if isinstance(lens.focus, str) else lens.focus


def ladder(beam: Beam, lens: Lens, diameter: float, ends: tuple[float, float], step: float, waves: float) -> FloatArray:
    """Return rising distances from the nearest to the furthest of ``ends``, or to that of a distant laser.

    Between two of them the distance grows by the factor 1 + ``step`` at most, and the defocus changes by ``waves`` or,
    from `FOLLOWED_WAVES`, by the share ``step`` of itself at most.
    """
    nearest, furthest = ends
    follows = lens.focus == "laser"
    focused = follows or (lens.focus == "infinity" and not lens.defocus)
    last = min(furthest, far_distance(beam, diameter, FAR_WAVES if focused else UNFOCUSED_WAVES))

    def defocus(distance: float) -> float:
        found = defocus_at(beam, distance, diameter, focus_of(lens), lens.defocus * _DEFOCUS)
        return 0.0 if follows else float(found)

    rungs = [last]
    while rungs[-1] > nearest:
        here, factor = rungs[-1], 1 + step
        allowed = waves if abs(defocus(here)) < FOLLOWED_WAVES else max(waves, step * abs(defocus(here)))
        while abs(defocus(here / factor) - defocus(here)) > allowed and factor > 1.002:
            factor = math.sqrt(factor)
        rungs.append(max(here / factor, nearest))
    return np.array(rungs[::-1])


def miss_between(rungs: FloatArray, misses: Sequence[float], place: FloatArray) -> FloatArray:
    """Return by how much an interpolation may miss at places: nothing at a rung, the whole miss in the middle of a gap.

    ``misses`` has one number for each gap between two rungs; without any nothing is missed.
    """
    if not len(misses):
        return np.zeros_like(place)
    gap = np.clip(np.searchsorted(rungs, place, side="right") - 1, 0, len(rungs) - 2)
    part = np.clip((place - rungs[gap]) / (rungs[gap + 1] - rungs[gap]), 0, 1)
    missed: FloatArray = np.asarray(misses, np.float64)[gap] * 4 * part * (1 - part)
    return missed


def interpolated(rungs: FloatArray, values: FloatArray, place: FloatArray) -> FloatArray:
    """Return values (rung, ...) at places (any, ...), without overshoot between rungs; one rung holds everywhere."""
    from scipy.interpolate import PchipInterpolator

    if len(rungs) == 1:
        return np.broadcast_to(values[0], (*np.shape(place), *values.shape[1:]))
    between: FloatArray = PchipInterpolator(rungs, values)(place)
    return between


def as_wide(beam: Beam, radius: FloatArray) -> FloatArray:
    """Return the distance in m at which a beam has a 1/e2 radius; 1 mm where it is wider everywhere."""
    square = np.maximum(radius**2 - beam.waist**2, (5e-4 * beam.divergence) ** 2)
    distance: FloatArray = 2 * np.sqrt(square) / beam.divergence
    return distance


def fill_at(beam: Beam, diameter: float, distance: float) -> float:
    """Return (D / (2 w))^2 at a distance."""
    return diameter**2 / (4 * beam_radius(beam, distance) ** 2)
