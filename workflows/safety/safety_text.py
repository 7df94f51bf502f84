"""An estimate of safety as lines of text for a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from neusee.workflows.report.text_table import columns, wrapped
from neusee.workflows.safety import counted_parts as parts_of
from neusee.workflows.safety import eye_words, helps_words
from neusee.workflows.safety import safety_words as words
from neusee.workflows.safety.damage_words import damage_sentence, limit_rows, zone_rows
from neusee.workflows.safety.safety_estimate import CERTIFICATE, Estimate, Finding

Paragraphs = Sequence[Sequence[str]]  #: lines that stay as they are, or a single text that is wrapped


def paragraphs(found: Estimate) -> list[list[str]]:
    """Return the verdict, the tables of limits and distances, the eye, and the sources, before lines are wrapped."""
    parts = [[f"{found.recipe.name}: {found.recipe.title}", CERTIFICATE, ""], [words.laser_text(found)]]
    steps = (_damage, _limits, _dazzled_area, _helps, _eye, _unsaid, _counted, _intervals, _sources, _eye_sources)
    for step in steps:
        parts += step(found)
    return parts


def _damage(found: Estimate) -> Iterator[list[str]]:
    """Yield the verdict of damage behind the plain lens."""
    if found.damage:
        yield from (["", "damage"], [damage_sentence(found.damage[0], found)])


def _limits(found: Estimate) -> Iterator[list[str]]:
    """Yield the tables of limits and of distances."""
    rows = limit_rows(found)
    if rows:
        yield _table("limits", words.LIMIT_COLUMNS, rows)
        yield _table("distances", words.ZONE_COLUMNS, zone_rows(found))


def _dazzled_area(found: Estimate) -> Iterator[list[str]]:
    """Yield the table of the dazzled area, and whether the mask enlarges it."""
    if not found.dazzled:
        return
    here = words.metres(found.safety.laser.distance)
    yield _table(f"dazzled area at {here}", words.DAZZLE_COLUMNS, [words.dazzled_cells(area) for area in found.dazzled])
    text = words.enlarged_text(found)
    if text:
        yield [text]


def _unsaid(found: Estimate) -> Iterator[list[str]]:
    """Yield what the estimate does not say."""
    if found.unsaid:
        yield ["", "not said"]
        yield from ([text] for text in found.unsaid)


def _counted(found: Estimate) -> Iterator[list[str]]:
    """Yield what is counted along the axis."""
    yield from (
        ["", "counted along the axis"],
        [parts_of.scatter_text(found.veil)],
        [parts_of.focus_text(found.safety)],
    )
    yield from ([text] for text in parts_of.counted(found.safety))


def _intervals(found: Estimate) -> Iterator[list[str]]:
    """Yield what the numbers in brackets mean."""
    yield from (["", "intervals"], [words.intervals_text(found)])


def _sources(found: Estimate) -> Iterator[list[str]]:
    """Yield the sources of the limits."""
    yield ["", "sources"]
    yield from ([text] for text in dict.fromkeys(map(_source, found.findings)))


def _helps(found: Estimate) -> Iterator[list[str]]:
    """Yield what helps, without the notes of the page."""
    if found.helps:
        cells = [row[:-1] for row in helps_words.table(found.helps)]
        yield _table("what helps, behind the plain lens", helps_words.COLUMNS[:-1], cells)
        yield from ([text] for text in helps_words.sentences(found.helps))


def _eye(found: Estimate) -> Iterator[list[str]]:
    """Yield the limit of the eye and the distances of its dazzle."""
    if found.eye:
        yield from (["", "eye"], [words.eye_text(found.eye)])
    if found.eye_dazzle.rows:
        header, *cells = eye_words.distance_table(found.eye_dazzle.rows)
        yield _table("dazzle of the eye (NODD)", tuple(header), cells)
    yield [eye_words.dazzle_text(found.eye_dazzle, found.safety.settings.eye.dazzle)]


def _eye_sources(found: Estimate) -> Iterator[list[str]]:
    """Yield the sources of what is said of the eye."""
    if found.eye:
        yield [f"eye: {found.eye.source}"]
    if found.eye_dazzle.rows:
        yield [f"dazzle of the eye: {found.eye_dazzle.source}"]


def lines(parts: Paragraphs) -> list[str]:
    """Return paragraphs as lines that are no wider than the terminal, but for tables."""
    return [line for part in parts for line in (wrapped(part[0]) if len(part) == 1 else part)]


def _source(finding: Finding) -> str:
    """Return the source of a limit, with what is interpolated, extrapolated or assumed in it."""
    note = f" ({finding.limit.note})" if finding.limit.note else ""
    return f"{finding.limit.name}: {finding.limit.source}{note}"


def _table(title: str, header: tuple[str, ...], rows: list[list[str]]) -> list[str]:
    return ["", title, *(f"  {line}" for line in columns([list(header), *rows]))]
