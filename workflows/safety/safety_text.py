"""An estimate of safety as lines of text for a terminal."""

from __future__ import annotations

from neusee.workflows.report.text_table import columns, wrapped
from neusee.workflows.safety import safety_words as words
from neusee.workflows.safety.safety_estimate import CERTIFICATE, Estimate


def lines(found: Estimate) -> list[str]:
    """Return lines with the verdict, the tables of limits and distances, the eye, and the sources."""
    rows = [words.limit_cells(each) for each in found.findings]
    zones = [words.zone_cells(each) for each in found.findings]
    sources = dict.fromkeys(f"{each.limit.name}: {each.limit.source}" for each in found.findings)
    parts = [*wrapped(words.laser_text(found)), ""]
    if rows:
        parts += [*_table("limits", words.LIMIT_COLUMNS, rows), *_table("distances", words.ZONE_COLUMNS, zones)]
    if found.eye:
        parts += ["eye", *wrapped(words.eye_text(found.eye)), ""]
    for line in found.unsaid:
        parts += wrapped(line)
    parts += ["", *wrapped(words.intervals_text(found)), "", "sources"]
    for source in [*sources, *([f"eye: {found.eye.source}"] if found.eye else [])]:
        parts += wrapped(source)
    return [f"{found.recipe.name}: {found.recipe.title}", CERTIFICATE, "", *parts]


def _table(title: str, header: tuple[str, ...], rows: list[list[str]]) -> list[str]:
    return [title, *(f"  {line}" for line in columns([list(header), *rows])), ""]
