"""Tables as lines of text: each column as wide as its widest cell."""

from __future__ import annotations

from collections.abc import Sequence

Rows = Sequence[Sequence[str]]


def columns(rows: Rows, numbers: str = "<", gap: str = "  ") -> list[str]:
    """Return one line for each row, the first cell aligned left and the others as ``numbers`` says: ``<`` or ``>``."""
    widths = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
    forms = [f"{'<' if i == 0 else numbers}{width}" for i, width in enumerate(widths)]
    return [gap.join(f"{cell:{form}}" for cell, form in zip(row, forms, strict=True)).rstrip() for row in rows]


def indented(rows: Rows) -> list[str]:
    """Return indented lines for a table of text in the first column and numbers in the others; a lacking one is –."""
    full = [[name, *(cell or "–" for cell in cells)] for name, *cells in rows]
    return [f"  {line}" for line in columns(full, ">", "   ")]
