"""The folder of a run: its final name, ``latest``, ``code.json``, and the HTML page."""

from __future__ import annotations

import base64
import csv
import functools
import json
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import date, datetime
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neusee.workflows.keys.sealed_files import bytes_of, head_of, text_of
from neusee.workflows.report.run_crate import remove_crate, restore_crate, write_crate

if TYPE_CHECKING:
    from neusee.workflows.engine.runner import Result


# --- run folder -----------------------------------------------------------------------------------

# The folder of a run, which gets its final name when all files are written, and the link ``latest``
# to this folder.


_NAME = 4096  #: bytes of the name of a folder, at most
_OTHER_FOLDER = "name another folder with --out"
_ABANDONED = 3600.0  #: s without a change, after which an unfinished folder is removed


class NotWritten(OSError):
    """Error for a folder of results that could not be written; no part of the folder is left."""


@dataclass
class RunFolder:
    """The folder of a run, which has a temporary path until all files are written, and then its
    final path.
    """

    path: Path
    #: for the crate: command, recipe, inputs, versions, seconds
    said: dict[str, Any] = field(default_factory=dict)
    #: by name: the stored file that was added to the folder
    taken: dict[str, Path] = field(default_factory=dict)

    def place(self, name: str) -> Path:
        """Return the path of a file that is to be written into the folder of a run, and make the
        folder above it.
        """
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def write(self, name: str, content: str | bytes) -> Path:
        """Write a file into the folder of a run, and return the path of the file."""
        path = self.place(name)
        data = content.encode() if isinstance(content, str) else content
        path.write_bytes(data)
        return path

    def write_rows(self, name: str, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
        """Write a CSV file with a header line into the folder of a run."""
        with (self.path / name).open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(header)
            writer.writerows([_plain(cell) for cell in row] for row in rows)

    def take(self, name: str, source: Path) -> None:
        """Add a stored file to the folder of a run as a hard link, or as a copy if the file
        system refuses the link.
        """
        path = self.place(name)
        self.taken[name] = source
        try:
            os.link(source, path)
        except OSError:
            shutil.copyfile(source, path)


def writable_folder(out: str | os.PathLike[str]) -> Path:
    """Return the folder in which a command makes its folder of results; raise ValueError if nothing
    can be written.

    A folder that does not exist yet is not made: the nearest existing folder above it must be
    writable.
    """
    root = existing = Path(out)
    try:
        existing = next(
            path for path in (root, *root.absolute().parents) if path.exists() or path.is_symlink()
        )
        # a stranger's folder may have put it there
        if root.is_symlink() and os.environ.get("NEUSEE_NO_CODE"):
            raise ValueError(f"{root} is a link, which --no-code does not follow: {_OTHER_FOLDER}")
        if existing.is_dir():
            # the only sure test: a folder that is made and removed
            os.rmdir(tempfile.mkdtemp(prefix=".neusee.", dir=existing))
            return root
        problem = f"{existing} is not a folder, so that no results can be written to {root}"
    except OSError as error:
        problem = (
            f"the folder {existing} cannot be written ({error.strerror}), so that {root} cannot"
            " hold results"
        )
    raise ValueError(f"{problem}: {_OTHER_FOLDER}")


@contextmanager
def new_run(root: Path, recipe: str, key: str) -> Iterator[RunFolder]:
    """Create a run folder with a temporary name; rename it after the ``with`` block, or remove it
    after an error.

    Raises `NotWritten` for an error of a file.
    """
    try:
        with _folder(root, recipe, key) as run:
            yield run
    except OSError as error:
        text = (
            f"the folder of results in {root} cannot be written ({error}), and no part of it is"
            " left"
        )
        raise NotWritten(text) from error


@contextmanager
def _folder(root: Path, recipe: str, key: str) -> Iterator[RunFolder]:
    """Make a folder with a hidden name, yield it, write its crate, and give it its final name.

    An error removes it. ``latest`` points to it at the end.
    """
    root.mkdir(parents=True, exist_ok=True)
    # unfinished folders of killed runs
    _sweep(root)
    name = f"{date.today().isoformat()}_{recipe}_{key[:8]}"
    run_folder = RunFolder(root / f".{name}.{os.getpid()}.part")
    shutil.rmtree(run_folder.path, ignore_errors=True)
    run_folder.path.mkdir()
    try:
        yield run_folder
        write_crate(run_folder.path, name, run_folder.said)
        run_folder.path = _rename(run_folder.path, root / name)
    except BaseException:
        shutil.rmtree(run_folder.path, ignore_errors=True)
        raise
    _point(root, run_folder.path.name)


def _sweep(root: Path) -> None:
    """Remove the unfinished folders of killed runs, in which no file has changed for an hour."""
    for unfinished in root.glob(".*.part"):
        try:
            if _is_being_written(unfinished):
                continue
            if (
                time.time()
                - max(changed.stat().st_mtime for changed in (unfinished, *unfinished.rglob("*")))
                > _ABANDONED
            ):
                shutil.rmtree(unfinished, ignore_errors=True)
        except OSError:  # another process has already removed the folder
            continue


def _is_being_written(unfinished: Path) -> bool:
    """Return True if the process that made an unfinished folder runs on this machine, whatever
    the clock says.
    """
    # .<name>.<process>.part
    process_number = (
        unfinished.suffixes[-2].removeprefix(".") if len(unfinished.suffixes) > 1 else ""
    )
    try:
        # signal 0 tests whether the process exists
        os.kill(int(process_number), 0)
    except (ValueError, OverflowError, ProcessLookupError):
        return False
    except OSError:  # of another user
        return True
    return True


def _rename(unfinished: Path, target: Path) -> Path:
    """Rename the complete folder of a run to the first free name: ``name``, ``name_2``,
    ``name_3`` …
    """
    number = 1
    while True:
        path = target if number == 1 else target.with_name(f"{target.name}_{number}")
        if not path.exists():
            try:
                return unfinished.rename(path)
            except OSError:
                # no other run took the name: the file system refused the rename
                if not path.exists():
                    raise
        number += 1


def _point(root: Path, name: str) -> None:
    """Make ``latest`` a symbolic link to the folder of a run, or a file with its name if links
    are not possible.
    """
    link = root / f".latest.{os.getpid()}"
    try:
        link.symlink_to(name, target_is_directory=True)
    except OSError:
        link.write_text(name + "\n", encoding="utf-8")
    # atomic: a reader never finds half of it
    try:
        link.replace(root / "latest")
    except OSError:
        link.unlink(missing_ok=True)
        raise


def find_run(where: str, root: Path) -> Path:
    """Return the folder of a run; ``where`` is ``latest``, the name of a folder in ``root`` or a
    path.
    """
    for path in (root / where, Path(where)):
        # `latest` where links are not possible: a file with the name of a folder
        if path.is_file():
            path = path.with_name(head_of(path, _NAME).decode("utf-8", "replace").strip())
        if (path / "provenance.json").is_file():
            return path
    raise FileNotFoundError(
        f"no run at {where}: give the name of a folder in {root}, a path, or `latest`"
    )


def _plain(cell: Any) -> Any:
    """Return a NumPy number as a number of Python, because NumPy's print options change its text;
    return any other cell as it is.
    """
    return cell.item() if hasattr(cell, "dtype") and not cell.ndim else cell


# --- run code -------------------------------------------------------------------------------------

# The file ``code.json`` in the folder of a run: digests of the code of each node, and of all that
# the code uses.


CODE = "code.json"


def code_text(result: Result) -> str:
    """Return the digests of code of a run as JSON text with one line for each node and each module.

    ``nodes`` has the digest of each node with all that it uses; ``parts`` has, for each module, the
    digest of every function, class and constant, and for each package its version.
    """
    origins = [result.origins[key] for key in result.keys.values() if key in result.origins]
    nodes = {origin["node"]: origin["code"] for origin in origins}
    parts: dict[str, Any] = {}
    for code_digest in dict.fromkeys(nodes.values()):
        parts |= result.code.get(code_digest, {})
    return f'{{"nodes": {_lines(nodes)},\n"parts": {_lines(parts)}}}\n'


def _lines(values: object) -> str:
    """Return a dictionary as JSON with one line for each entry, sorted by name."""
    assert isinstance(values, dict)
    return (
        "{\n"
        + ",\n".join(
            f"{json.dumps(name)}: {json.dumps(value)}" for name, value in sorted(values.items())
        )
        + "\n}"
    )


# --- templates of all pages -----------------------------------------------------------------------

SHORT = 16  #: characters of the longest text that a table does not break at a hyphen
_BREAK = re.compile(r"(?<=[_,/.])(?=[a-z])|(?=\[)")  #: where a long word may go on in a new line


def filled(template: str, **values: Any) -> str:
    """Return the HTML page that a template of the folder ``templates`` makes with ``values``."""
    return str(compiled(template).render(**values))


@functools.cache
def compiled(template: str) -> Any:
    """Return an HTML template of the folder ``templates``, read and compiled once."""
    from jinja2 import Environment, StrictUndefined

    text = (Path(__file__).parent / "templates" / template).read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    environment.filters["code"] = _with_code
    environment.filters["breaks"] = _with_breaks
    return environment.from_string(text)


def _with_code(text: str) -> str:
    """Return text as HTML, with each part between backticks as code."""
    return re.sub("`([^`]+)`", r"<code>\1</code>", escape(text))


def _with_breaks(text: str) -> str:
    """Return text as HTML in which a long word such as ``developed_quality[mask]`` may go on in
    a new line.
    """
    return " ".join(
        _BREAK.sub("<wbr>", escape(word)) if len(word) > SHORT else escape(word)
        for word in text.split(" ")
    )


# --- run html -------------------------------------------------------------------------------------

# The HTML page of a run, from its document and its pictures alone, and the page of an earlier run
# written again.
#
# Neither torch nor a recipe is needed.


_TEMPLATE = "run_page.html.j2"


def prepare() -> None:
    """Read and compile the template of the page, which takes longer than to fill it."""
    compiled(_TEMPLATE)


def document_text(doc: Mapping[str, Any]) -> str:
    """Return the document of a run as the text of its file ``provenance.json``."""
    return json.dumps(doc, indent=1, ensure_ascii=False, allow_nan=True)


def present_time() -> str:
    """Return the present time as the page of a run shows it."""
    return datetime.now().astimezone().strftime("%Y-%m-%d %H:%M:%S %Z")


def page(doc: Mapping[str, Any], pictures: Mapping[str, bytes]) -> str:
    """Return the report of a run, from its document and pictures, as one HTML page that loads no
    other file.
    """
    picture_texts = {name: base64.b64encode(content).decode() for name, content in pictures.items()}
    shown_document = {
        **doc,
        "figures": [figure for figure in doc["figures"] if figure["name"] in picture_texts],
    }
    return filled(_TEMPLATE, doc=shown_document, pictures=picture_texts)


def rebuild(folder: Path) -> Path:
    """Write ``report.html`` of a run again, from the document and the pictures in ``folder``,
    and return its path.
    """
    doc = json.loads(text_of(folder / "provenance.json"))
    pictures = {
        picture_file.stem: bytes_of(picture_file, sys.maxsize)
        for picture_file in sorted((folder / "figures").glob("*.png"))
    }
    target = folder / "report.html"
    unfinished = folder / ".report.html.part"
    unfinished.write_text(page(doc, pictures), encoding="utf-8")
    # the crate states the size of the page, which is about to change
    crate = remove_crate(folder)
    unfinished.replace(target)
    if crate is not None:
        restore_crate(folder, crate)
    return target
