"""The pages of the guide as text: their titles, the files that they define, and the pictures that they ask for."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import neusee.recipes

GUIDE = Path(neusee.recipes.__file__).parent / "guide"

#: a file of the reader: a fenced block whose first line is a comment with the path of the file below ``my/``
_FILE = re.compile(r"^```\w+\n(?P<text># (?P<path>my/[\w/]+\.\w+)\b.*?)^```", re.MULTILINE | re.DOTALL)
_COMMAND = re.compile(r"^    neusee (?P<words>.+)$", re.MULTILINE)
_MARK = re.compile(r"^<!-- picture (?P<file>[\w./*-]+): (?P<caption>[^>]+?) -->$", re.MULTILINE)


class Picture(NamedTuple):
    """A picture of a page: a file in the folder of results of the command that stands before the picture."""

    words: tuple[str, ...]
    file: str
    caption: str


def read_pages() -> dict[str, str]:
    """Return the text of each page of the guide by its path below the folder of the guide."""
    return {str(path.relative_to(GUIDE)): path.read_text(encoding="utf-8") for path in sorted(GUIDE.rglob("*.md"))}


def title_of(text: str) -> str:
    """Return the first heading of a page."""
    found = re.search(r"^# (.+)$", text, re.MULTILINE)
    return found[1] if found else "Page without a title"


def write_files(pages: Mapping[str, str], folder: Path) -> None:
    """Write every file below ``my/`` that a block of a page defines."""
    for text in pages.values():
        for block in _FILE.finditer(text):
            path = folder / block["path"]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block["text"], encoding="utf-8")


def pictures_of(text: str) -> Iterator[Picture]:
    """Yield each picture of a page; raise ValueError for a picture that stands before the first command."""
    for mark in _MARK.finditer(text):
        commands = _COMMAND.findall(text, 0, mark.start())
        if not commands:
            raise ValueError(f"the picture {mark['file']} stands before the first command of its page")
        words = tuple(shlex.split(commands[-1], comments=True))
        yield Picture(words, mark["file"], " ".join(mark["caption"].split()))


def with_pictures(text: str, paths: Mapping[Picture, str]) -> str:
    """Return the text of a page in which pictures take the place of their marks; other marks stay invisible."""
    wanted = pictures_of(text)

    def figure(mark: re.Match[str]) -> str:
        picture = next(wanted)
        if picture not in paths:
            return mark[0]
        shown = (
            f"[![{picture.caption}]({paths[picture]})]({paths[picture]})"  # a click shows the picture at its full size
        )
        return f'<figure markdown="span">\n{shown}\n<figcaption>{picture.caption}</figcaption>\n</figure>'

    return _MARK.sub(figure, text)
