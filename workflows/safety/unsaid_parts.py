"""Sentences on what an estimate does not say, each with its reason."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from neusee.workflows.recipe.blocks.safety_block import SATURATION, Safety
from neusee.workflows.safety.dazzled_area import Area, Ranked
from neusee.workflows.safety.sensor_limits import veil_level

if TYPE_CHECKING:
    from neusee.workflows.safety.safety_estimate import Finding


def unsaid_of_damage(safety: Safety, findings: Sequence[Finding]) -> Iterator[str]:
    """Yield a sentence where no threshold of damage is known."""
    laser, damage = safety.laser, safety.settings.damage
    if not any(each.limit.effect == "damage" for each in findings):
        yield (
            f"Nothing is said of damage: no threshold is known for {damage.device} at {laser.wavelength * 1e9:.4g} nm "
            "and this exposure. Give a table of your own: safety.damage.file."
        )


def unsaid_of_dazzle(safety: Safety, known: Mapping[str, Area | str], findings: Sequence[Finding]) -> Iterator[str]:
    """Yield sentences on what is not said of dazzle; ``known`` has the area behind each protection, or a reason."""
    dazzle, sensor = safety.settings.dazzle, safety.settings.sensor
    if dazzle is None:
        lacking = [name.replace("_", " ") for name in SATURATION if getattr(sensor, name) is None]
        reason = "the recipe does not ask for it (safety.dazzle)"
        if lacking:
            reason = f"the recipe gives no {', '.join(lacking)} of the sensor at this wavelength"
        yield f"Nothing is said of dazzle: {reason}."
        return
    yield from _unsaid_areas(known, findings)
    level = veil_level(dazzle)
    if level <= 0:
        yield "The feature of safety.dazzle is lost without any laser, so that no veil is stated."
    elif level >= (sensor.full_well or 0.0):
        yield (
            f"The feature of safety.dazzle is seen through {level:.3g} e- of veiling light a pixel, more than the full "
            "well: a pixel is lost when it saturates, and no veil is stated."
        )


def _unsaid_areas(known: Mapping[str, Area | str], findings: Sequence[Finding]) -> Iterator[str]:
    """Yield one sentence for each reason why the dazzled area behind some protections is not known."""
    said = {each.option for each in findings if each.limit.effect == "dazzle"}
    reasons: dict[str, list[str]] = {}
    for name, area in known.items():
        if isinstance(area, str):
            reasons.setdefault(area, []).append(name)
        elif name not in said:
            text = "the dazzled area reaches beyond the window of the point-spread function: choose a larger window"
            reasons.setdefault(text, []).append(name)
    for reason, names in reasons.items():
        yield f"Nothing is said of dazzle behind {' and '.join(f'the {name}' for name in names)}: {reason}."


def stray_text(ranked: Sequence[Ranked]) -> str:
    """Return whether the light that the lens scatters is counted."""
    if any(each.stray for each in ranked):
        return (
            "The light that the lens scatters is counted in dazzle: it falls beside the spot, behind a mask as well as "
            "behind the plain lens. It does not change the peak, and so not the damage."
        )
    return (
        "The lens scatters no light: stray light is not in these numbers. A real lens scatters, and is dazzled from "
        "farther away than is said here; `flare: stray_light` in a recipe of a camera counts it."
    )
