"""Folder of results of a command, as an answer keeps it, and written again without torch."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

from neusee.workflows.answers.stored_answer import RUN, Answer
from neusee.workflows.answers.witnesses import taken_from
from neusee.workflows.engine.machine_resources import process_peak
from neusee.workflows.keys.sealed_files import bytes_of
from neusee.workflows.report.run_crate import CRATE
from neusee.workflows.report.run_folder import RunFolder, document_text, new_run, page, present_time
from neusee.workflows.report.terminal_text import json_line
from neusee.workflows.store.cache_settings import format_size
from neusee.workflows.store.shared_folder import Disk

if TYPE_CHECKING:
    from neusee.workflows.report.study_folder import StudyReport
    from neusee.workflows.store.result_store import Store


# --- results folder -------------------------------------------------------------------------------

# The folder of results of a command as an answer keeps it, with marks for date and seconds, and
# written again.


PAGE, DATE, SECONDS = "@neusee-page@", "@neusee-date@", "@neusee-seconds@"  #: marks
DOCUMENT = "provenance.json"
_MARKED = (DOCUMENT, "report.html")  #: the files with a date and seconds


class NotRepeatable(ValueError):
    """Error for a folder of results that the marks do not give again byte by byte."""


def kept_files(folder: Path, report: StudyReport) -> dict[str, bytes]:
    """Return the files of a complete folder of results by name, with marks; the crate is written
    anew each time.

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
    # written once more, with marks in place of date and seconds
    with TemporaryDirectory(prefix="neusee-") as temporary_folder:
        report.write(
            RunFolder(Path(temporary_folder)), {**document, "date": DATE, "seconds": SECONDS}
        )
        marked_files = {name: (Path(temporary_folder) / name).read_bytes() for name in _MARKED}
    for name, content in marked_files.items():
        if filled(name, content, document["date"], document["seconds"]) != files[name]:
            raise NotRepeatable(name)
    return files | marked_files


def filled(name: str, content: bytes, date: str, seconds: float) -> bytes:
    """Return the content of a file with a date and seconds in place of the marks."""
    if name not in _MARKED:
        return content
    # in JSON a number, in quotes as long as it is a mark
    content = content.replace(f'"{SECONDS}"'.encode(), repr(seconds).encode())
    return content.replace(SECONDS.encode(), f"{seconds:.3g}".encode()).replace(
        DATE.encode(), date.encode()
    )


def write_again(answer: Answer, seconds: float) -> Path:
    """Write the folder of results of an answer with the present date and the seconds of the
    command; return its path.

    Raises `OSError` if the folder cannot be written; no part of it is left then.
    """
    date = datetime.now(UTC).isoformat(timespec="seconds")
    files = {name: filled(name, content, date, seconds) for name, content in answer.files.items()}
    run_document: dict[str, Any] = json.loads(files[DOCUMENT])
    with new_run(Path(answer.out), answer.label, answer.key) as folder:
        folder.said = run_document
        for name, content in files.items():
            folder.write(name, content)
    return folder.path


def printed(answer: Answer, page: Path) -> str:
    """Return the text of an answer with the path of its page."""
    # with the escapes of JSON, without its quotes
    page_text = json.dumps(str(page))[1:-1] if answer.as_json else str(page)
    return answer.text.replace(PAGE, page_text)


# --- repeated run ---------------------------------------------------------------------------------

# The folder of a run whose results all come from the cache, as an answer keeps it, and written
# again without torch.
#
# The answer keeps the document of the run and its small files; pictures and data files are those of
# the cache. The page is made of the document and the pictures, as `neusee report` makes it.


FOLDER, TOOK = "@neusee-folder@", "@neusee-took@"  #: marks in the text of the terminal
REPORT_PAGE = "report.html"
_FIGURES = "figures/"
_ANY = sys.maxsize  #: bytes of a file of a run, which this program wrote
_SERVED = {"cached", "not needed", "left out"}  #: states of a step that was not computed


class RunResults(NamedTuple):
    """The folder of a run, and what it rests on."""

    folder: Path  #: complete
    out: Path  #: the folder that has it
    document: Mapping[str, Any]
    taken: Mapping[str, Path]  #: by name in the folder: the file of the store
    store: Store

    def fields(self) -> dict[str, Any]:
        """Return the fields of the answer of a run.

        Raises `NotRepeatable` for a run that computed a step, missed a number or warned, or whose
        page is not made of its document and pictures alone.
        """
        document, folder = self.document, self.folder
        if (
            {step["state"] for step in document["steps"]} - _SERVED
            or document["warnings"]
            or document["missed"]
        ):
            raise NotRepeatable("a run that computed a step, warned or missed a number")
        not_kept = {CRATE, REPORT_PAGE, *self.taken}
        files: dict[str, bytes] = {}
        for path in sorted(filter(Path.is_file, folder.rglob("*"))):
            name = path.relative_to(folder).as_posix()
            if name not in not_kept:
                files[name] = bytes_of(path, _ANY)
        document_again = json.loads(files[DOCUMENT])
        # the answer is only kept if the same page can be made of it
        page_again = page(document_again, _pictures(folder, self.taken))
        if (
            page_again.encode() != bytes_of(folder / REPORT_PAGE, _ANY)
            or document_text(document_again).encode() != files[DOCUMENT]
        ):
            raise NotRepeatable("the page or the document is not the same when it is written again")
        return {"kind": RUN, "files": files, "stored": taken_from(self.store, self.taken)}


def write_run_again(answer: Answer, disk: Disk, seconds: float) -> tuple[Path, dict[str, Any]]:
    """Write the folder of a run again with the present time and ``seconds``; return its path and
    its document.

    Raises `OSError` if the folder cannot be written; no part of it is left then.
    """
    began = datetime.now(UTC).isoformat(timespec="seconds")
    document = _of_now(json.loads(answer.files[DOCUMENT]), seconds)
    with new_run(Path(answer.out), answer.label, answer.key) as folder:
        folder.said = {"began": began} | document
        for name, path in answer.stored.taken.items():
            folder.take(name, disk.root / path)
        files = {**answer.files, DOCUMENT: document_text(document).encode()}
        for name, content in files.items():
            folder.write(name, content)
        folder.write(REPORT_PAGE, page(document, _pictures(folder.path, answer.stored.taken)))
    return folder.path, document


def said_again(answer: Answer, folder: Path, document: Mapping[str, Any]) -> str:
    """Return the text of the terminal for a run that was written again."""
    if answer.as_json:
        return json_line({"report": str(folder / REPORT_PAGE), **document})
    return answer.text.replace(TOOK, f"{document['seconds']:.2f}").replace(FOLDER, str(folder))


def _of_now(document: dict[str, Any], seconds: float) -> dict[str, Any]:
    """Return the document of a run with the time and the memory of this process, and with the
    run that it repeats.
    """
    memory = process_peak()
    present_facts = {"engine": f"{seconds:.3f} s", "peak memory": format_size(memory)}
    facts = [[name, present_facts.get(name, value)] for name, value in document["facts"]]
    facts.append(
        [
            "answer",
            (
                f"that of the run of {document['started']}, all of whose results are still in the"
                " cache"
            ),
        ]
    )
    timing = {**document["timing"], "peak": [document["timing"]["peak"][0], memory]}
    changed = {"started": present_time(), "seconds": seconds, "facts": facts, "timing": timing}
    return {**document, **changed}


def _pictures(folder: Path, taken: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the pictures of a run by name, in the order in which the run added them."""
    names = [name for name in taken if name.startswith(_FIGURES)]
    return {
        name[len(_FIGURES) :].removesuffix(".png"): bytes_of(folder / name, _ANY) for name in names
    }
