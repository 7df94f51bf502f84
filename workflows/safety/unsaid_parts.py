"""Sentences on what an estimate does not say, each with its reason."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from neusee.workflows.recipe.blocks.safety_block import SATURATION, Safety
from neusee.workflows.safety.dazzled_area import Area
from neusee.workflows.safety.first_channel import sees
from neusee.workflows.safety.sensor_limits import veil_level

_BEYOND = 0.2  #: share of the lost pixels beyond a window from which a sentence says so

if TYPE_CHECKING:
    from neusee.workflows.safety.damage_verdict import DamageVerdict


def unsaid_of_damage(safety: Safety, verdicts: Sequence[DamageVerdict]) -> Iterator[str]:
    """Yield a sentence for each reason why a part of the light is not judged; or that damage is not asked for."""
    if safety.settings.damage is None:
        yield "Nothing is said of damage: the recipe does not ask for it (safety.damage)."
        return
    reasons: dict[str, dict[str, None]] = {}
    for verdict in verdicts:
        for row in verdict.unjudged:
            reasons.setdefault(row.reason, {})[row.part] = None
    for reason, parts in reasons.items():
        yield (
            f"Not judged for damage: the {' and the '.join(parts)}: {reason}. Give a table of your own: "
            "safety.damage.file."
        )


def unsaid_of_dazzle(safety: Safety, known: Mapping[str, Area | str]) -> Iterator[str]:
    """Yield sentences on what is not said of dazzle; ``known`` has the area behind each protection, or a reason."""
    dazzle, sensor = safety.settings.dazzle, safety.settings.sensor
    if dazzle is None:
        lacking = [name.replace("_", " ") for name in SATURATION if getattr(sensor, name) is None]
        reason = "the recipe does not ask for it (safety.dazzle)"
        if lacking:
            reason = f"the recipe gives no {', '.join(lacking)} of the sensor at this wavelength"
        yield f"Nothing is said of dazzle: {reason}."
        return
    if not sees(safety.channels):
        yield (
            f"Nothing is said of dazzle: no channel of the camera sees {safety.laser.wavelength * 1e9:.4g} nm, by the "
            "table of its responses. A sensor without its filters may see it."
        )
        return
    yield from _unsaid_areas(known)
    level = veil_level(dazzle)
    if level <= 0:
        yield "The feature of safety.dazzle is lost without any laser, so that no veil is stated."
    elif level >= sensor.fills:
        yield (
            f"The feature of safety.dazzle is seen through {level:.3g} e- of veiling light a pixel, more than the full "
            "well: a pixel is lost when it saturates, and no veil is stated."
        )


def _unsaid_areas(known: Mapping[str, Area | str]) -> Iterator[str]:
    """Yield one sentence for each reason why the dazzled area behind some protections is not known."""
    reasons: dict[str, list[str]] = {}
    for name, area in known.items():
        if isinstance(area, str):
            reasons.setdefault(area, []).append(name)
    for reason, names in reasons.items():
        yield f"Nothing is said of dazzle behind {' and '.join(f'the {name}' for name in names)}: {reason}."


def beyond_window(shares: Mapping[str, float]) -> Iterator[str]:
    """Yield one sentence if many of the lost pixels lie beyond the window of a PSF; ``shares`` are by protection."""
    wide = {name: share for name, share in shares.items() if share > _BEYOND}
    if wide:
        parts = ", ".join(f"{100 * share:.2g} % behind the {name}" for name, share in wide.items())
        yield (
            "The window of the point-spread function does not hold the dazzled area at every distance: of its pixels "
            f"up to {parts} have the light of a radial law (the third power of the distance), and light that this law "
            "does not explain counts where it dazzles most. Choose a larger window."
        )
