"""The folder of results of a command as an answer keeps it, with marks for date and seconds, and written again."""

from __future__ import annotations

import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from neusee.workflows.answers.stored_answer import Answer
from neusee.workflows.keys.regular_file import bytes_of
from neusee.workflows.report.run_crate import CRATE
from neusee.workflows.report.run_folder import RunFolder, new_run

if TYPE_CHECKING:
    from neusee.workflows.report.study_folder import StudyReport

PAGE, DATE, SECONDS = "@neusee-page@", "@neusee-date@", "@neusee-seconds@"  #: marks
DOCUMENT = "provenance.json"
_MARKED = (DOCUMENT, "report.html")  #: the files with a date and seconds


class NotRepeatable(ValueError):
    """Error for a folder of results that the marks do not give again byte by byte."""


def kept_files(folder: Path, report: StudyReport) -> dict[str, bytes]:
    """Return the files of a complete folder of results by name, with marks; the crate is written anew each time.

    Raises `NotRepeatable` if the marks do not give the same bytes again.
    """
    files = {
        path.relative_to(folder).as_posix(): bytes_of(path, sys.maxsize)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != CRATE
    }
    document = json.loads(files[DOCUMENT])
    if document.get("warnings"):
        raise NotRepeatable("a command with a warning")
    with TemporaryDirectory(prefix="neusee-") as place:
        report.write(RunFolder(Path(place)), {**document, "date": DATE, "seconds": SECONDS})
        marked = {name: (Path(place) / name).read_bytes() for name in _MARKED}
    for name, content in marked.items():
        if filled(name, content, document["date"], document["seconds"]) != files[name]:
            raise NotRepeatable(name)
    return files | marked


def filled(name: str, content: bytes, date: str, seconds: float) -> bytes:
    """Return the content of a file with a date and seconds in place of the marks."""
    if name not in _MARKED:
        return content
    content = content.replace(f'"{SECONDS}"'.encode(), repr(seconds).encode())
    return content.replace(SECONDS.encode(), f"{seconds:.3g}".encode()).replace(DATE.encode(), date.encode())


def write_again(answer: Answer, seconds: float) -> Path:
    """Write the folder of results of an answer with the present date and the seconds of the command; return its path.

    Raises `OSError` if the folder cannot be written; no part of it is left then.
    """
    date = datetime.now(UTC).isoformat(timespec="seconds")
    files = {name: filled(name, content, date, seconds) for name, content in answer.files.items()}
    document: dict[str, Any] = json.loads(files[DOCUMENT])
    with new_run(Path(answer.out), answer.label, answer.key) as folder:
        folder.said = document
        for name, content in files.items():
            folder.write(name, content)
    return folder.path


def printed(answer: Answer, page: Path) -> str:
    """Return the text of an answer with the path of its page."""
    path = json.dumps(str(page))[1:-1] if answer.as_json else str(page)
    return answer.text.replace(PAGE, path)
