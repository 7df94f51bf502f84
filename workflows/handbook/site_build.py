"""The build of the handbook: the pages of the guide, the pictures that their commands draw and the
reference become a site that a browser opens as files.
"""

from __future__ import annotations

import hashlib
import importlib.util
import itertools
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from ruamel.yaml import YAML

import neusee
import neusee.recipes
from neusee.workflows.report.run_folder import writable_folder

# --- the pages of the guide as text ---------------------------------------------------------------

GUIDE = Path(neusee.recipes.__file__).parent / "guide"

#: a file of the reader: a fenced block whose first line is a comment with the path of the file
#: below ``my/``
_FILE = re.compile(
    r"^```\w+\n(?P<text># (?P<path>my/[\w/]+\.\w+)\b.*?)^```", re.MULTILINE | re.DOTALL
)
_COMMAND = re.compile(r"^    neusee (?P<words>.+)$", re.MULTILINE)
_PICTURE_MARK = re.compile(
    r"^<!-- picture (?P<file>[\w./*-]+): (?P<caption>[^>]+?) -->$", re.MULTILINE
)


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
    for mark in _PICTURE_MARK.finditer(text):
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

    return _PICTURE_MARK.sub(figure, text)


# --- command pictures -----------------------------------------------------------------------------

# The pictures of the handbook, which the commands of its pages draw.


# --- the pictures that the commands of the pages draw ---------------------------------------------

_FINE = (0, 3)  #: exit codes after which the folder of results is complete


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

    Commands run in order, and `runs/latest` is the folder that the previous command wrote.
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
    """Link `runs/latest` to a folder of results, so that later commands find it as they do for a
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


# --- the site -------------------------------------------------------------------------------------

#: the file by which a folder is known as a handbook, which a new build may replace
_MARK_FILE = ".neusee_handbook"
_OTHER_PAGES = "More"  #: the section of the pages that the list `nav` of the settings does not name
_NEEDED = ("mkdocs", "material")

Tree = list[dict[str, Any]]


class HandbookError(RuntimeError):
    """Error for a handbook that cannot be built: a module is missing, the folder is in use, or
    MkDocs failed.
    """


def check_modules() -> None:
    """Raise `HandbookError` if MkDocs or its theme is not installed."""
    if any(importlib.util.find_spec(name) is None for name in _NEEDED):
        raise HandbookError('mkdocs-material is not installed: pip install "neusee[docs]"')


def check_folder(out: Path) -> None:
    """Raise `HandbookError` if ``out`` cannot be written, or holds other files than a handbook."""
    try:
        writable_folder(out)
    except ValueError as error:
        raise HandbookError(f"--out: {error}") from None
    if out.is_dir() and any(out.iterdir()) and not (out / _MARK_FILE).is_file():
        raise HandbookError(
            f"{out} holds files that are no handbook, and a build replaces a folder: name a new"
            " folder"
        )


def build_handbook(
    out: Path,
    reference: Mapping[str, str],
    pictures: bool,
    progress: Callable[[str], None],
    strict: bool = False,
) -> Path:
    """Build the handbook in the folder ``out`` and return the path of its first page.

    ``reference`` has the pages that the program writes about itself, by path. Without ``pictures``
    no command of a page runs. A ``strict`` build fails at a link that leads nowhere, and at a
    command of a page that fails.
    """
    check_modules()
    check_folder(out)
    pages = {**read_pages(), **reference}
    with TemporaryDirectory(prefix="neusee_handbook_") as folder:
        docs, site = Path(folder, "docs"), Path(folder, "site")
        drawn_pictures = (
            _draw(pages, Path(folder), docs / "pictures", progress, strict) if pictures else {}
        )
        _write_docs(pages, drawn_pictures, docs)
        settings = Path(folder, "mkdocs.yml")
        settings.write_text(settings_text(pages, docs, site), encoding="utf-8")
        _run_mkdocs(settings, strict)
        (site / _MARK_FILE).touch()
        _replace(out, site)
    return out / "index.html"


def settings_text(pages: Mapping[str, str], docs: Path, site: Path) -> str:
    """Return the settings of MkDocs: those of the guide, with the folders, and every page in the
    list `nav`.
    """
    yaml = YAML()
    settings = yaml.load(GUIDE / "mkdocs.yml")
    settings |= {
        "docs_dir": str(docs),
        "site_dir": str(site),
        "nav": complete_nav(settings["nav"], pages),
    }
    text = StringIO()
    yaml.dump(settings, text)
    return text.getvalue()


def complete_nav(nav: Tree, pages: Mapping[str, str]) -> Tree:
    """Return the list `nav` without pages that do not exist, and with a section of the pages that
    it does not name.

    An entry that ends in ``/`` stands for all pages in a folder.
    """
    named_pages = set(_named(nav, pages))
    unnamed_pages = [
        {title_of(text): path} for path, text in pages.items() if path not in named_pages
    ]
    return _sections(nav, pages) + ([{_OTHER_PAGES: unnamed_pages}] if unnamed_pages else [])


def _sections(nav: Tree, pages: Mapping[str, str]) -> Tree:
    """Return each entry with its title, without entries that have no page."""
    sections = []
    for entries in nav:
        for title, entry in entries.items():
            if pages_of_entry := _filled(entry, pages):
                sections.append({title: pages_of_entry})
    return sections


def _filled(entry: Any, pages: Mapping[str, str]) -> Any:
    """Return an entry of the navigation with the pages that exist.

    An entry of no page gives None or an empty list.
    """
    if isinstance(entry, list):
        return _sections(entry, pages)
    if entry.endswith("/"):
        return [{title_of(text): path} for path, text in pages.items() if path.startswith(entry)]
    return entry if entry in pages else None


def _named(entry: Any, pages: Mapping[str, str]) -> set[str]:
    """Return the paths of all pages that an entry of the navigation names, at any depth."""
    if isinstance(entry, str):
        return {
            path
            for path in pages
            if path == entry or (entry.endswith("/") and path.startswith(entry))
        }
    named_pages = set()
    for entries in entry:
        for entry_below in entries.values():
            named_pages |= _named(entry_below, pages)
    return named_pages


def _draw(
    pages: Mapping[str, str],
    work: Path,
    target: Path,
    progress: Callable[[str], None],
    strict: bool,
) -> dict[Picture, str]:
    """Draw the pictures of all pages, and return the name of each file.

    The commands of the pages run in the folder `work`.
    """
    write_files(pages, work)
    pictures = list(itertools.chain.from_iterable(map(pictures_of, pages.values())))
    return draw_pictures(pictures, work, target, progress, strict)


def _write_docs(pages: Mapping[str, str], drawn: Mapping[Picture, str], docs: Path) -> None:
    """Write the pages with their pictures, and the files of the guide that are no pages."""
    shutil.copytree(
        GUIDE, docs, dirs_exist_ok=True, ignore=shutil.ignore_patterns("*.md", "mkdocs.yml")
    )
    for path, text in pages.items():
        path_to_root = "../" * path.count("/")
        target = docs / path
        target.parent.mkdir(parents=True, exist_ok=True)
        names = {picture: f"{path_to_root}pictures/{name}" for picture, name in drawn.items()}
        target.write_text(with_pictures(text, names), encoding="utf-8")


def _run_mkdocs(settings: Path, strict: bool) -> None:
    """Build the pages with MkDocs.

    Raise `HandbookError` with the end of its messages if it fails.
    """
    arguments = [
        "build",
        "--quiet",
        *(["--strict"] if strict else []),
        "--config-file",
        str(settings),
    ]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    process = subprocess.run(
        [sys.executable, "-m", "mkdocs", *arguments],
        env=environment,
        capture_output=True,
        text=True,
    )
    if process.returncode:
        raise HandbookError(
            "mkdocs could not build the pages:"
            f" {(process.stderr or process.stdout).strip()[-2000:]}"
        )


def _replace(out: Path, site: Path) -> None:
    """Put the files of the new handbook in the place of the files of an old one."""
    out.mkdir(parents=True, exist_ok=True)
    for old_file in out.iterdir():
        if old_file.is_dir() and not old_file.is_symlink():
            shutil.rmtree(old_file)
        else:
            old_file.unlink()
    for new_file in site.iterdir():
        shutil.move(new_file, out / new_file.name)
