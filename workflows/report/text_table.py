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
