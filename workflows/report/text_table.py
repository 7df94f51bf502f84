"""Tables as lines of text, in which each column is as wide as its widest cell."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from shutil import get_terminal_size

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
    return [f"  {line}" for line in columns(full, ">", "  ")]


def wrapped(text: str) -> list[str]:
    """Return a text as indented lines that are no wider than the terminal."""
    return textwrap.wrap(text, get_terminal_size().columns, initial_indent="  ", subsequent_indent="  ")


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
