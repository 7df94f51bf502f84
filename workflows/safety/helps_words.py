"""Cells and sentences on what helps, which the page and the terminal share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from neusee.workflows.safety.safety_words import scaled
from neusee.workflows.safety.what_helps import MET, PictureCost, Remedy

COLUMNS = ("limit", "means", "at the limit", "in 95 % of the draws", "light of the scene", "SNR of the feature", "note")
_DENSITY = "OD "
EXPLAINED = """Damage, saturation and contrast are three problems, and each is solved apart, for the plain lens at the
    distance of the recipe. A density, a stop or an exposure is the one that brings the laser to the limit; in brackets
    is the middle 90 % of the draws, and beside it the value that holds in 95 % of them. The light of the scene is what
    is left of it in a pixel with that value."""


def table(remedies: Sequence[Remedy]) -> list[list[str]]:
    """Return a row for each means against each limit, and a single row for a limit that is met without any."""
    rows = []
    for limit in dict.fromkeys(each.limit for each in remedies):
        known = [each for each in remedies if each.limit == limit]
        if all(each.reason == MET for each in known):
            rows.append([limit, "none", MET, "–", "–", "–", ""])
        else:
            rows += [cells(each) for each in known]
    return rows


def cells(remedy: Remedy) -> list[str]:
    """Return the row of one means against one limit."""
    cost = remedy.cost
    left = "–" if cost is None else f"{100 * cost.scene:.3g} %"
    return [
        remedy.limit,
        remedy.means,
        _value(remedy),
        "–" if remedy.safe is None or remedy.value is None else _number(remedy.means, remedy.safe),
        left,
        "–" if cost is None else _snr(cost),
        _note(remedy),
    ]


def _value(remedy: Remedy) -> str:
    """Return the value at the limit with its interval, or that there is none."""
    if remedy.reason == MET:
        return MET
    if remedy.value is None:
        return "not judged" if remedy.reason.startswith("not judged") else "none helps"
    middle, low, high = (_number(remedy.means, x) for x in (remedy.value.value, remedy.value.low, remedy.value.high))
    low, high = low.removeprefix(_DENSITY), high.removeprefix(_DENSITY)
    return middle if low == high == middle.removeprefix(_DENSITY) else f"{middle} ({low} to {high})"


def _number(means: str, value: float) -> str:
    """Return a density, a diameter or an exposure with its unit."""
    if means in ("grey filter", "notch filter"):
        return f"{_DENSITY}{value:.2f}"
    return scaled(value, "m" if means == "stop" else "s")


def _snr(cost: PictureCost) -> str:
    """Return the signal-to-noise ratio of the stated feature before and after."""
    if cost.snr_before is None or cost.snr_after is None:
        return "–"
    return f"{cost.snr_before:.3g} to {cost.snr_after:.3g}"


def _note(remedy: Remedy) -> str:
    """Return what has to be known with a value, or why there is none."""
    if remedy.reason == MET:
        return ""
    if remedy.value is None:
        return remedy.reason
    notes = [remedy.reason, _notch_note(remedy), *_picture_notes(remedy)]
    return "; ".join(note for note in notes if note)


def _notch_note(remedy: Remedy) -> str:
    """Return the band that a notch filter has to block."""
    if remedy.band is None:
        return ""
    low, high = (f"{x * 1e9:.4g}" for x in remedy.band)
    return f"blocks {low} to {high} nm; the colour of the laser has to be known"


def _picture_notes(remedy: Remedy) -> Iterator[str]:
    """Yield what a stop, a grey filter or an exposure does to white and to fine detail."""
    cost = remedy.cost
    if cost is None:
        return
    if cost.white is not None and remedy.means != "notch filter":
        yield f"white falls to {scaled(cost.white, 'e-')}" if cost.scene < 1 else "white saturates"
    if cost.cutoff_after < min(0.5, 0.999 * cost.cutoff_before):
        yield f"diffraction leaves {cost.cutoff_after:.2g} cycles a pixel"


def sentences(remedies: Sequence[Remedy]) -> Iterator[str]:
    """Yield that an exposure never changes damage, and each limit against which no grey filter and no stop helps."""
    if any(each.problem == "damage" for each in remedies):
        yield "An exposure never changes damage."
    for limit in dict.fromkeys(each.limit for each in remedies):
        helpless = {each.means for each in remedies if each.limit == limit and each.value is None}
        if {"grey filter", "stop"} <= helpless:
            yield f"{limit}: no grey filter and no stop helps."
