"""An estimate of safety as lines of text for a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from neusee.workflows.report.text_table import columns, wrapped
from neusee.workflows.safety import safety_words as words
from neusee.workflows.safety.safety_estimate import CERTIFICATE, Estimate

Paragraphs = Sequence[Sequence[str]]  #: lines that stay as they are, or a single text that is wrapped


def paragraphs(found: Estimate) -> list[list[str]]:
    """Return the verdict, the tables of limits and distances, the eye, and the sources, before lines are wrapped."""
    rows = [words.limit_cells(each) for each in found.findings]
    zones = [words.zone_cells(each) for each in found.findings]
    sources = dict.fromkeys(f"{each.limit.name}: {each.limit.source}" for each in found.findings)
    parts = [[f"{found.recipe.name}: {found.recipe.title}", CERTIFICATE, ""], [words.laser_text(found)]]
    if rows:
        parts += [_table("limits", words.LIMIT_COLUMNS, rows), _table("distances", words.ZONE_COLUMNS, zones)]
    if found.dazzled:
        here = words.metres(found.safety.laser.distance)
        cells = [words.dazzled_cells(each) for each in found.dazzled]
        parts += [_table(f"dazzled area at {here}", words.DAZZLE_COLUMNS, cells)]
        parts += [[text] for text in [words.enlarged_text(found)] if text]
    if found.eye:
        parts += [["", "eye"], [words.eye_text(found.eye)]]
    parts += [["", "not said"], *([text] for text in found.unsaid)] if found.unsaid else []
    parts += [["", "intervals"], [words.intervals_text(found)], ["", "sources"], *([text] for text in sources)]
    return [*parts, [f"eye: {found.eye.source}"]] if found.eye else parts


def lines(parts: Paragraphs) -> list[str]:
    """Return paragraphs as lines that are no wider than the terminal, but for tables."""
    return [line for part in parts for line in (wrapped(part[0]) if len(part) == 1 else part)]


def _table(title: str, header: tuple[str, ...], rows: list[list[str]]) -> list[str]:
    return ["", title, *(f"  {line}" for line in columns([list(header), *rows]))]
