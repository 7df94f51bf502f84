"""Conversion between numbers of bytes and texts such as ``20 GB``."""

from __future__ import annotations

import re

UNITS = {"B": 1, "kB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12, "MiB": 2**20, "GiB": 2**30, "TiB": 2**40}
_ANY_CASE = {"b": 1, "kib": 2**10, **{unit.lower(): scale for unit, scale in UNITS.items()}}
_SIZE = re.compile(r"\s*(\d+(?:\.\d+)?)\s*((?:[kmgt]i?)?b?)\s*", re.IGNORECASE)


def parse_size(text: str) -> int:
    """Return the number of bytes in a text such as ``20 GB`` or ``1.5 TiB``; raise `ValueError` for an invalid text."""
    match = _SIZE.fullmatch(text)
    if not match:
        raise ValueError(f"{text!r} is not a size: write a number of bytes, such as 20 GB")
    unit = match[2].lower().removesuffix("b") + "b"
    return int(float(match[1]) * _ANY_CASE[unit])


def format_size(count: float) -> str:
    """Return a number of bytes as text with three significant digits and a suitable unit, such as ``20 GB``."""
    unit = next((unit for unit in ("B", "kB", "MB", "GB") if count < 1000 * UNITS[unit]), "TB")
    return f"{count / UNITS[unit]:.3g} {unit}"
