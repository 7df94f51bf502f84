"""Sentences on what an estimate counts along the axis and what it does not: scatter, focus, air and the beam itself."""

from __future__ import annotations

import math
from collections.abc import Iterator

from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.safety.distance_ladder import FAR_FILL, FAR_WAVES
from neusee.workflows.safety.light_levels import ASSUMED, Veil
from neusee.workflows.safety.spots_along import Peaks, Ranked

_ARMS = {"plain": "plain lens", "mask": "mask"}
_MORE = "more optics.samples, and a step laser.wavefront, carry a nearer one"


def scatter_text(veil: Veil | None) -> str:
    """Return which share of the light the lens scatters, whether it is assumed, and what it does."""
    if veil is None:
        return (
            "The lens scatters no light (safety.lens.scatter: null). A real lens scatters, and is dazzled from farther "
            "away and from nearer by than is said here."
        )
    share = f"Lens scatter {100 * float(veil.share[0]):.2g} %"
    source = "as the recipe says"
    if veil.assumed:
        source = f"assumed, within a factor of {ASSUMED:g} (one standard deviation): give safety.lens.scatter of yours"
    return (
        f"{share}, {source}. It is a veil that falls beside the spot behind a mask as well as behind the plain lens, "
        "and is counted in dazzle. It does not raise the peak, and so not the damage."
    )


def focus_text(safety: Safety) -> str:
    """Return on which distance the lens is focused, and what another focus does."""
    focus = safety.settings.lens.focus
    if focus == "laser":
        return "The lens is focused on the laser at every distance, which gives the highest peak."
    name = "infinity" if focus == "infinity" else f"{focus:g} m"
    return (
        f"The lens is focused at {name} (safety.lens.focus), and a laser elsewhere is out of focus. A camera that "
        "focuses on the laser has a higher peak: safety.lens.focus: laser."
    )


def counted(safety: Safety) -> Iterator[str]:
    """Yield one sentence for each property of beam and air: counted with its value, or not counted."""
    beam, quality = safety.settings.beam, safety.laser.beam().m_squared
    if beam.hot_spots > 1 or "beam.hot_spots" in safety.values:
        yield f"Hot spots of the beam: counted, factor {beam.hot_spots:g} on the irradiance of an even Gaussian beam."
    else:
        yield "Hot spots of the beam: not counted (safety.beam.hot_spots is 1)."
    if beam.cn2 is None:
        yield "Turbulence of the air (scintillation): not counted (safety.beam.cn2 is not given)."
    else:
        yield (
            f"Turbulence of the air: counted, Cn2 {beam.cn2:g} m^(-2/3); the exposure is the one that is exceeded for "
            f"{100 * (1 - beam.worst):.2g} % of the time, by Rytov's variance of a plane wave, an upper bound."
        )
    if quality > 1 + 1e-6:
        yield (
            f"M2 of {quality:.3g}: counted in the width of the beam. Its light is focused as one Gaussian mode, "
            "an upper bound of the peak: a beam of many modes has a wider spot."
        )
    else:
        yield "M2 is 1: a beam of many modes has a wider spot and a lower peak; its hot spots are named above."


def ladder_text(ranked: tuple[Ranked, ...], peaks: Peaks | None) -> str:
    """Return at how many distances the spot is computed, and how exact it is between them."""
    text = (
        f"The spot of the clear lens is computed at every distance; from where the beam fills the lens to "
        f"(D / 2w)^2 = {FAR_FILL:g} with {FAR_WAVES:g} waves of curvature it is that of a distant laser."
    )
    spots = [(each.arm, len(each.distances), each.error) for each in ranked]
    if peaks and len(peaks.along) > 1:
        spots.append(("peak behind the mask", len(peaks.along), peaks.error))
    parts = [
        f"{arm}: {count} distances, within {max(100 * error, 0.1):.2g} % between them, counted upward"
        for arm, count, error in spots
        if math.isfinite(error)
    ]
    text += f" Point-spread functions, {'; '.join(parts)}." if parts else ""
    return text


def near_text(asked: float, ranked: tuple[Ranked, ...], peaks: Peaks | None) -> Iterator[str]:
    """Yield one sentence for each point-spread function that is not computed at the nearest distance asked (m).

    Another one says at which distances light outside the window of the spot behind the mask counts as its peak.
    """
    if peaks and peaks.along[0][0] > asked:
        yield (
            f"Nearer than {peaks.along[0][0]:.3g} m the beam in front of the mask is not computed ({_MORE}): its peak "
            "counts as that of the clear lens in focus there, which no mask exceeds."
        )
    if peaks and peaks.outside:
        lacking = max(share for _, share in peaks.outside)
        places = f"{len(peaks.outside)} of {len(peaks.along)} distances, the farthest {peaks.outside[-1][0]:.3g} m"
        yield (
            f"At {places}, the window of the spot behind the mask lacks light (up to {100 * lacking:.2g} %) that may "
            "be brighter outside: it counts as one spot, as sharp as that of the clear lens. Choose a larger window."
        )
    for each in ranked:
        if math.isfinite(each.error) and each.distances[0] > asked:
            yield (
                f"Nearer than {each.distances[0]:.3g} m the pixels behind the {_ARMS[each.arm]} are not computed "
                f"({_MORE}): all light counts in the pixels that may be lost, the most that there can be."
            )
