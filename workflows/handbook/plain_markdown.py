"""Docstrings and tables as Markdown."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence

_CODE = re.compile(r"(``.+?``|`[^`]+`)", re.DOTALL)


def escaped(text: str) -> str:
    """Return a text in which signs that Markdown would read stand for themselves, outside of code."""
    parts = _CODE.split(text)
    return "".join(part if n % 2 else re.sub(r"([\\*_<>\[\]|])", r"\\\1", part) for n, part in enumerate(parts))


def cell(text: str) -> str:
    """Return a text that may stand in a cell of a table."""
    return " ".join(re.sub(r"(?<!\\)\|", r"\\|", text).split())


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(map(cell, line)) + " |" for line in lines]


def prose(text: str) -> list[str]:
    """Return a docstring as Markdown; indented lines stay a block of code."""
    lines: list[str] = []
    for paragraph in re.split(r"\n\s*\n", text.strip()):
        is_code = all(line.startswith("    ") for line in paragraph.splitlines())
        lines += [*(paragraph.splitlines() if is_code else _sentences(paragraph)), ""]
    return lines


def _sentences(paragraph: str) -> Iterator[str]:
    """Yield the lines of a paragraph; a line such as ``Source: …`` begins a paragraph of its own."""
    for line in paragraph.splitlines():
        if named := re.match(r"([A-Z]\w+): ", line):
            yield from ("", f"**{named[1]}:** {escaped(line[named.end() :])}")
        else:
            yield escaped(line.strip())
