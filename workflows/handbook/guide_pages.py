"""The pages of the guide as text, and the pictures that the commands of the pages draw."""

from __future__ import annotations

import hashlib
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import neusee
import neusee.recipes

# --- guide pages ----------------------------------------------------------------------------------

# The pages of the guide as text: their titles, the files that they define, and the pictures that
# they ask for.


GUIDE = Path(neusee.recipes.__file__).parent / "guide"

#: a file of the reader: a fenced block whose first line is a comment with the path of the file
#: below ``my/``
_FILE = re.compile(
    r"^```\w+\n(?P<text># (?P<path>my/[\w/]+\.\w+)\b.*?)^```", re.MULTILINE | re.DOTALL
)
_COMMAND = re.compile(r"^    neusee (?P<words>.+)$", re.MULTILINE)
_MARK = re.compile(r"^<!-- picture (?P<file>[\w./*-]+): (?P<caption>[^>]+?) -->$", re.MULTILINE)


class Picture(NamedTuple):
    """A picture of a page: a file in the folder of results of the command that stands before the
    picture.
    """

    words: tuple[str, ...]
    file: str
    caption: str


def read_pages() -> dict[str, str]:
    """Return the text of each page of the guide by its path below the folder of the guide."""
    return {
        str(path.relative_to(GUIDE)): path.read_text(encoding="utf-8")
        for path in sorted(GUIDE.rglob("*.md"))
    }


def title_of(text: str) -> str:
    """Return the first heading of a page."""
    heading = re.search(r"^# (.+)$", text, re.MULTILINE)
    return heading[1] if heading else "Page without a title"


def write_files(pages: Mapping[str, str], folder: Path) -> None:
    """Write every file below ``my/`` that a block of a page defines."""
    for text in pages.values():
        for block in _FILE.finditer(text):
            path = folder / block["path"]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block["text"], encoding="utf-8")


def pictures_of(text: str) -> Iterator[Picture]:
    """Yield each picture of a page; raise ValueError for a picture that stands before the first
    command.
    """
    for mark in _MARK.finditer(text):
        # the last command above the mark of the picture
        commands = _COMMAND.findall(text, 0, mark.start())
        if not commands:
            raise ValueError(
                f"the picture {mark['file']} stands before the first command of its page"
            )
        words = tuple(shlex.split(commands[-1], comments=True))
        yield Picture(words, mark["file"], " ".join(mark["caption"].split()))


def with_pictures(text: str, paths: Mapping[Picture, str]) -> str:
    """Return the text of a page in which pictures take the place of their marks; other marks
    stay invisible.
    """
    pictures = pictures_of(text)

    def figure(mark: re.Match[str]) -> str:
        picture = next(pictures)
        if picture not in paths:
            return mark[0]
        linked = (
            # a click shows the picture at its full size
            f"[![{picture.caption}]({paths[picture]})]({paths[picture]})"
        )
        return (
            "<figure"
            f' markdown="span">\n{linked}\n<figcaption>{picture.caption}</figcaption>\n</figure>'
        )

    return _MARK.sub(figure, text)


# --- command pictures -----------------------------------------------------------------------------

# The pictures of the handbook, which the commands of its pages draw.


_FINE = (0, 3)  #: exit codes after which the folder of results is whole


class NoPicture(RuntimeError):
    """Error for a command of a page that failed, or that did not write the picture that the page
    shows.
    """


def draw_pictures(
    pictures: Iterable[Picture],
    work: Path,
    target: Path,
    progress: Callable[[str], None],
    strict: bool = True,
) -> dict[Picture, str]:
    """Run each command once in the folder ``work``, copy the pictures to ``target`` and return
    their file names.

    Commands run in their order, and `runs/latest` is what the one before wrote.
    If a command fails, a ``strict`` build raises `NoPicture`; any other build says so and goes on
    without the picture.
    """
    by_words: dict[tuple[str, ...], list[Picture]] = {}
    for picture in pictures:
        by_words.setdefault(picture.words, []).append(picture)
    target.mkdir(parents=True, exist_ok=True)
    progress(
        f"commands that draw pictures: {len(by_words)}; what the cache holds is not computed again"
    )
    names: dict[Picture, str] = {}
    for number, (words, pictures_of_words) in enumerate(by_words.items(), 1):
        try:
            results = _run(words, work, work / f"results_{number}")
            _name_latest(results, work)
            names |= {picture: _take(picture, results, target) for picture in pictures_of_words}
        except NoPicture as error:
            if strict:
                raise
            progress(f"no picture: {error}")
        progress(f"command {number} of {len(by_words)}: neusee {' '.join(words)}")
    return names


def _run(words: tuple[str, ...], work: Path, results: Path) -> Path:
    """Run a command of neusee and return the folder that it wrote."""
    package = str(Path(neusee.__file__).parents[1])
    # the same package in the process of the command, also if it is not installed
    paths = os.pathsep.join([package, *filter(None, [os.environ.get("PYTHONPATH")])])
    process = subprocess.run(
        [sys.executable, "-m", "neusee", *words, "--out", str(results)],
        cwd=work,
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
    )
    folders = [path for path in results.glob("*") if path.is_dir() and not path.is_symlink()]
    if process.returncode not in _FINE or len(folders) != 1:
        raise NoPicture(
            f"neusee {' '.join(words)} ended with exit code {process.returncode}:"
            f" {process.stderr.strip()[-500:]}"
        )
    return folders[0]


def _name_latest(results: Path, work: Path) -> None:
    """Make a folder of results the `runs/latest` of the commands that follow, as it is for a
    reader who types them.
    """
    latest = work / "runs" / "latest"
    latest.parent.mkdir(exist_ok=True)
    latest.unlink(missing_ok=True)
    latest.symlink_to(results.resolve(), target_is_directory=True)


def _take(picture: Picture, results: Path, target: Path) -> str:
    """Copy a picture out of a folder of results and return its new name."""
    matching_files = sorted(results.glob(picture.file))
    if not matching_files:
        written_text = (
            ", ".join(sorted(str(path.relative_to(results)) for path in results.rglob("*.png")))
            or "no picture"
        )
        raise NoPicture(
            f"neusee {' '.join(picture.words)} wrote no {picture.file}; it wrote {written_text}"
        )
    # one name for each command and file, whatever the order of the pages
    digest = hashlib.sha256(" ".join([*picture.words, picture.file]).encode()).hexdigest()[:12]
    name = f"{digest}{matching_files[0].suffix}"
    shutil.copyfile(matching_files[0], target / name)
    return name
