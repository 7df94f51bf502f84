"""The build of the handbook: pages, pictures and reference become a site that a browser opens as
files.
"""

from __future__ import annotations

import importlib.util
import itertools
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ruamel.yaml import YAML

from neusee.workflows.handbook.guide_pages import (
    GUIDE,
    Picture,
    draw_pictures,
    pictures_of,
    read_pages,
    title_of,
    with_pictures,
    write_files,
)
from neusee.workflows.report.run_folder import writable_folder

#: the file by which a folder is known as a handbook, which a new build may replace
_MARK = ".neusee_handbook"
_REST = "More"  #: the section of the pages that the list `nav` of the settings does not name
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
    if out.is_dir() and any(out.iterdir()) and not (out / _MARK).is_file():
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
        (site / _MARK).touch()
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
    return _sections(nav, pages) + ([{_REST: unnamed_pages}] if unnamed_pages else [])


def _sections(nav: Tree, pages: Mapping[str, str]) -> Tree:
    """Return each entry with its title, without entries of no page."""
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
