"""Stored answer of a command: its file in the folder answers/ of the cache, and the folder of
results that it writes again without torch.
"""

from __future__ import annotations

import json
import os
import re
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

from neusee.workflows.answers.witnesses import (
    NOTHING,
    StoredResults,
    Witnesses,
    checked,
    taken_from,
)
from neusee.workflows.engine.machine_resources import process_peak
from neusee.workflows.keys.sealed_files import NotRead, bytes_of, seal_file, unseal_file
from neusee.workflows.report.run_crate import CRATE
from neusee.workflows.report.run_folder import RunFolder, document_text, new_run, page, present_time
from neusee.workflows.report.terminal_text import json_line
from neusee.workflows.store.cache_settings import format_size
from neusee.workflows.store.shared_folder import Disk, below, read_file

if TYPE_CHECKING:
    from neusee.workflows.report.study_report import StudyReport
    from neusee.workflows.store.result_store import Store


# --- stored answer --------------------------------------------------------------------------------

# File of a stored answer in the folder ``answers/`` of the cache: sealed like every file there, and
# never incomplete.
#
# The first line is the seal, which contains the name of the answer; the second line is a JSON
# object; then follow the files of the folder of results. An answer counts as missing if it is
# damaged, has another format or lacks the required signature.


FOLDER, SUFFIX = "answers", ".answer"
#: kinds of answers: with all files of a folder, and with the document of a run
AS_KEPT, RUN = "as kept", "run"
MOST_BYTES = 32 << 20  #: size (bytes) of the largest answer that is stored
_LABEL = re.compile(r"\w[\w.-]*")
_FILE = re.compile(r"\w[\w.-]*(/\w[\w.-]*)*")


@dataclass(frozen=True)
class Answer:
    """The text and the files of a command, and everything that must be unchanged for the answer to
    be valid.
    """

    state: str  #: digest of the installed program
    witnesses: Witnesses
    text: str  #: printed text, with a mark in place of the path of the page
    as_json: bool  #: True if the text is JSON
    out: str  #: folder in which the command makes its folder of results
    label: str  #: recipe and kind in the name of this folder
    #: key of the result in the name of this folder; empty for a command that writes no folder
    key: str
    #: files of this folder by name, with marks in place of date and seconds
    files: Mapping[str, bytes]
    stored: StoredResults = NOTHING  #: results and files of the cache that the answer depends on
    kind: str = AS_KEPT  #: how the folder is written again
    memory: int = 0  #: memory (bytes) that must be free


def answer_path(disk: Disk, name: str) -> str:
    """Return the path of the answer ``name``."""
    return f"{disk.folder}/{FOLDER}/{name[:2]}/{name}{SUFFIX}"


def read_answer(disk: Disk, name: str) -> Answer | None:
    """Return the answer ``name``, or None if it is missing, damaged, of another format or without
    the required signature.
    """
    path = answer_path(disk, name)
    try:
        return unpacked(name, read_file(path, MOST_BYTES))
    except NotRead:
        return None
    except OSError:
        return None
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        disk.put_aside(path)
        return None


def write_answer(disk: Disk, name: str, answer: Answer) -> bool:
    """Write the answer ``name`` under a temporary name and rename the file; return False for an
    answer that is too large.

    Raises `OSError` if the folder cannot be written.
    """
    content, path = packed(name, answer), answer_path(disk, name)
    if len(content) > MOST_BYTES:
        return False
    with disk.temporary(f"{name[:8]}{SUFFIX}") as (temporary, file):
        file.write(content)
        file.flush()
        disk.make_folder(f"{disk.folder}/{FOLDER}")
        disk.share(temporary)
        disk.rename(temporary, path)
    return True


def used(disk: Disk, name: str) -> None:
    """Record that an answer was used, so that it is kept longer than others."""
    with suppress(OSError):
        os.utime(answer_path(disk, name), follow_symlinks=False)


def packed(name: str, answer: Answer) -> bytes:
    """Return the content of the file of an answer."""
    fields = {
        key: value
        for key, value in vars(answer).items()
        if key not in ("files", "witnesses", "stored")
    }
    sizes = [[file, len(content)] for file, content in answer.files.items()]
    foundations = {"witnesses": answer.witnesses._asdict(), "stored": answer.stored._asdict()}
    head_line = json.dumps({**fields, **foundations, "files": sizes}).encode()
    content = b"".join([head_line, b"\n", *answer.files.values()])
    return seal_file("answer", f"{FOLDER}/{name}", content) + b"\n" + content


def unpacked(name: str, raw: bytes) -> Answer:
    """Return the answer in the content of a file.

    Raises `NotRead` for another format version or a missing signature, and `ValueError`,
    `TypeError`, `KeyError` or `AttributeError` for any other content.
    """
    seal, _, content = raw.partition(b"\n")
    head_line, _, file_bytes = unseal_file("answer", f"{FOLDER}/{name}", seal, content).partition(
        b"\n"
    )
    fields: dict[str, Any] = json.loads(head_line)
    files, offset = {}, 0
    for file, size in fields.pop("files"):
        # abs, so that a damaged size cannot move the offset backwards
        files[_checked(_FILE, file)] = file_bytes[offset : offset + abs(size)]
        offset += abs(size)
    if offset != len(file_bytes):
        raise ValueError("the files of the answer are not as long as it says")
    witnesses = Witnesses(**fields.pop("witnesses"))
    stored = checked(fields.pop("stored"))
    for file in stored.taken:
        _checked(_FILE, file)
    answer = Answer(**fields, witnesses=witnesses, files=files, stored=stored)
    if answer.key or answer.label:
        _checked(_LABEL, answer.label)
        _checked(_LABEL, answer.key)
    _refuse_other_types(answer)
    return answer


def _refuse_other_types(answer: Answer) -> None:
    """Raise ValueError if a field of an answer has the wrong type."""
    files, absent_paths, recipes, listed_folders = answer.witnesses
    texts = [answer.state, answer.text, answer.out, answer.label, answer.key, answer.kind]
    for mapping in (files, recipes, listed_folders):
        texts += [*mapping, *mapping.values()]
    if type(answer.memory) is not int:
        raise ValueError("a field of the answer is not of its type")
    if not isinstance(absent_paths, list) or not all(
        isinstance(text, str) for text in [*texts, *absent_paths]
    ):
        raise ValueError("a field of the answer is not of its type")


def _checked(form: re.Pattern[str], text: str) -> str:
    """Return ``text`` if it matches the pattern ``form``; raise `ValueError` otherwise."""
    if not form.fullmatch(text):
        raise ValueError(f"{text!r} is no name of a file in a folder of results")
    return text


# --- answer upkeep --------------------------------------------------------------------------------

# Number and size of the stored answers, the check of all of them, and the removal of old ones.


COUNT, BYTES = 200, 64 << 20  #: greatest number and total size (bytes) of the answers that are kept
_WEEK = 7 * 86400.0  #: time (s) without use after which `neusee cache gc` removes an answer


class Kept(NamedTuple):
    """A stored answer: its name, its size (bytes) and the time of its last use (s)."""

    name: str
    path: str
    size: int
    used: float


def answers(disk: Disk) -> list[Kept]:
    """Return all stored answers, the most recently used first."""
    return sorted(_found(disk), key=lambda answer: (-answer.used, answer.name))


def _found(disk: Disk) -> Iterator[Kept]:
    """Yield the stored answers, in no order."""
    for entry in below(f"{disk.folder}/{FOLDER}"):
        with suppress(OSError):
            file_status = entry.stat(follow_symlinks=False)
            yield Kept(
                entry.name.removesuffix(SUFFIX),
                entry.path,
                file_status.st_size,
                file_status.st_mtime,
            )


def make_room(disk: Disk, budget: int | None = None) -> None:
    """Remove the least recently used answers until at most `COUNT` answers with at most `BYTES`
    bytes are left.

    If the store has a ``budget`` (bytes), the answers may use at most a twentieth of it.
    """
    total_bytes, limit = 0, BYTES if budget is None else min(BYTES, budget // 20)
    for number, answer in enumerate(answers(disk)):
        total_bytes += answer.size
        if number >= COUNT or total_bytes > limit:
            _remove(disk, answer)


def sweep(disk: Disk, dry: bool = False, everything: bool = False) -> list[Kept]:
    """Remove the answers that nobody used for a week, or ``everything``, or only list them if
    ``dry``; return them.
    """
    old_answers = [
        answer for answer in answers(disk) if everything or time.time() - answer.used > _WEEK
    ]
    return old_answers if dry else [answer for answer in old_answers if _remove(disk, answer)]


def check(disk: Disk) -> tuple[list[Kept], list[Kept]]:
    """Return the undamaged answers, and the damaged ones, which are moved to the folder
    ``bad/``.
    """
    undamaged, damaged = [], []
    for answer in answers(disk):
        is_readable = read_answer(disk, answer.name) is not None
        # an answer of another format or without a signature is not moved
        if is_readable or os.path.lexists(answer.path):
            undamaged.append(answer)
        else:
            damaged.append(answer)
    return undamaged, damaged


def _remove(disk: Disk, answer: Kept) -> bool:
    """Remove an answer; return False if it cannot be removed."""
    try:
        disk.unlink(answer.path)
    except OSError:
        return False
    return True


# --- results folder -------------------------------------------------------------------------------

# The folder of results of a command: stored in an answer, with marks for date and seconds, and
# written again.


PAGE, DATE, SECONDS = "@neusee-page@", "@neusee-date@", "@neusee-seconds@"  #: marks
DOCUMENT = "provenance.json"
_MARKED = (DOCUMENT, "report.html")  #: files that contain the date and the seconds


class NotRepeatable(ValueError):
    """Error for a folder of results that cannot be reproduced byte by byte from the stored files
    and marks.
    """


def kept_files(folder: Path, report: StudyReport) -> dict[str, bytes]:
    """Return the files of a complete folder of results by name, with marks; the crate is left out,
    since it is written anew each time.

    Raises `NotRepeatable` if filling the marks does not reproduce the same bytes.
    """
    files = {
        path.relative_to(folder).as_posix(): bytes_of(path, sys.maxsize)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != CRATE
    }
    document = json.loads(files[DOCUMENT])
    if document.get("warnings"):
        raise NotRepeatable("a command with a warning")
    # write the report once more, with marks in place of date and seconds
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
    """Return the content of a file with the date and the seconds in place of the marks."""
    if name not in _MARKED:
        return content
    # the seconds are a number in JSON, but the mark is a text in quotes
    content = content.replace(f'"{SECONDS}"'.encode(), repr(seconds).encode())
    return content.replace(SECONDS.encode(), f"{seconds:.3g}".encode()).replace(
        DATE.encode(), date.encode()
    )


def write_again(answer: Answer, seconds: float) -> Path:
    """Write the results folder of a stored answer again, with today's date and the run time of the
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
    # escaped as in JSON, but without the quotes
    page_text = json.dumps(str(page))[1:-1] if answer.as_json else str(page)
    return answer.text.replace(PAGE, page_text)


# --- repeated run ---------------------------------------------------------------------------------

# The folder of a run whose results all come from the cache: stored in an answer, and written again
# without torch.
#
# The answer contains the document of the run and its small files; pictures and data files are taken
# from the cache. The page is made from the document and the pictures, as `neusee report` makes it.


FOLDER_MARK, SECONDS_MARK = "@neusee-folder@", "@neusee-took@"  #: marks in the printed text
REPORT_PAGE = "report.html"
_FIGURES = "figures/"
_ANY = sys.maxsize  #: size limit (bytes) for files of a run, which this program wrote
_SERVED = {"cached", "not needed", "left out"}  #: states of steps that were not computed


class RunResults(NamedTuple):
    """The folder of a run, and the dependencies of the run."""

    folder: Path  #: complete
    out: Path  #: the folder that has it
    document: Mapping[str, Any]
    taken: Mapping[str, Path]  #: files of the store that were taken, by name in the folder
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
        # the answer is stored only if it reproduces the same page
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
    """Return the printed text for a run whose folder was written again."""
    if answer.as_json:
        return json_line({"report": str(folder / REPORT_PAGE), **document})
    return answer.text.replace(SECONDS_MARK, f"{document['seconds']:.2f}").replace(
        FOLDER_MARK, str(folder)
    )


def _of_now(document: dict[str, Any], seconds: float) -> dict[str, Any]:
    """Return the document of a run with the time and the memory of this process, and with a
    reference to the repeated run.
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
