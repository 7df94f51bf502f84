"""Cells and sentences on the dazzle of the eye, which the page and the terminal share."""

from __future__ import annotations

import math
from collections.abc import Sequence

from neusee.workflows.recipe.blocks.safety_block import EyeDazzle
from neusee.workflows.safety.eye_findings import EyeDazzleFinding, EyeDazzleRow
from neusee.workflows.safety.safety_words import end, metres, scaled

DAZZLE_COLUMNS = ("surroundings", "from the laser", "eye receives at most (MDE)", "dazzled up to (NODD)", "here")


def dazzle_cells(row: EyeDazzleRow) -> list[str]:
    """Return the row of one light of the surroundings and one angle."""
    start = [f"{row.background:g} cd/m²", f"{row.angle:.3g}°"]
    if row.distance is None:
        return [*start, "not seen without a laser", "–", "–"]
    return [*start, scaled(row.limit, "W/m²"), end(row.distance), "dazzled" if row.dazzled else "seen"]


def distance_table(rows: Sequence[EyeDazzleRow]) -> list[list[str]]:
    """Return the dazzle distance for each light of the surroundings (row) and each angle (column), the header first."""
    angles = list(dict.fromkeys(row.angle for row in rows))
    table = [["surroundings", *(f"{angle:.3g}° from the laser" for angle in angles)]]
    for background in dict.fromkeys(row.background for row in rows):
        reach = [row.distance for row in rows if row.background == background]
        table.append([f"{background:g} cd/m²", *("not seen" if x is None else metres(x.value) for x in reach)])
    return table


def dazzle_text(found: EyeDazzleFinding, asked: EyeDazzle) -> str:
    """Return what is asked of the eye, or why its dazzle is not judged."""
    if found.reason:
        return f"Dazzle of the eye is not judged: {found.reason}."
    size = math.degrees(asked.size) * 60
    return (
        f"A target of {size:.3g} arc minutes and the contrast {asked.contrast:g} is hidden from a viewer of "
        f"{asked.age:g} years by the light that the eye scatters, where the irradiance exceeds the maximum dazzle "
        "exposure (MDE), up to the nominal ocular dazzle distance (NODD) in clear air. Within the NOHD the eye may be "
        "injured as well."
    )
