"""Tables as lines of text, in which each column is as wide as its widest cell."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

Rows = Sequence[Sequence[str]]


def columns(rows: Rows, numbers: str = "<", gap: str = "  ") -> list[str]:
    """Return a line of text for each table row, with the first column aligned left.

    ``numbers`` aligns all other columns left (``<``) or right (``>``).
    """
    widths = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
    forms = [f"{'<' if i == 0 else numbers}{width}" for i, width in enumerate(widths)]
    return [gap.join(f"{cell:{form}}" for cell, form in zip(row, forms, strict=True)).rstrip() for row in rows]


def columns_within(rows: Rows, width: int | None, spare: Sequence[str]) -> list[str]:
    """Return the lines of a table that fits ``width`` characters, without as many columns of ``spare`` as needed.

    The first row has the names of the columns. The last line names the columns that are left out. None is no limit.
    """
    left_out: list[str] = []
    lines = columns(rows)
    for name in spare:
        if width is None or max(map(len, lines)) <= width:
            break
        at = rows[0].index(name)
        rows = [[*row[:at], *row[at + 1 :]] for row in rows]
        lines = columns(rows)
        left_out.append(name)
    return [*lines, *([f"left out on this narrow terminal: {', '.join(left_out)}"] if left_out else [])]


def indented(rows: Rows) -> list[str]:
    """Return an indented line of text for each table row, with numbers aligned right and a dash for an empty cell."""
    full = [[name, *(cell or "–" for cell in cells)] for name, *cells in rows]
    return [f"  {line}" for line in columns(full, ">", "   ")]


def by_family(names: Iterable[str]) -> dict[str, list[str]]:
    """Group names of steps by the part before the bracket: ``psf[plain]`` and ``psf[mask]`` belong to ``psf``."""
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(name.partition("[")[0], []).append(name)
    return groups


def lasts(seconds: float) -> str:
    """Return a duration in words, such as ``3 h 05 min``, ``2 min 10 s`` or ``4 s``."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02} min"
    return f"{whole // 60} min {whole % 60:02} s" if whole >= 60 else f"{whole} s"
