"""The folder of a run whose results all come from the cache, as an answer keeps it, and written again without torch.

The answer keeps the document of the run and its small files; pictures and data files are those of the cache. The page
is made of the document and the pictures, as `neusee report` makes it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from neusee.workflows.answers.results_folder import DOCUMENT, NotRepeatable
from neusee.workflows.answers.stored_answer import RUN, Answer
from neusee.workflows.answers.stored_results import taken_from
from neusee.workflows.engine.memory_use import process_peak
from neusee.workflows.keys.regular_file import bytes_of
from neusee.workflows.report.json_output import json_line
from neusee.workflows.report.run_crate import CRATE
from neusee.workflows.report.run_folder import new_run
from neusee.workflows.report.run_html import document_text, page, present_time
from neusee.workflows.store.byte_sizes import format_size
from neusee.workflows.store.shared_folder import Disk

if TYPE_CHECKING:
    from neusee.workflows.store.result_store import Store

FOLDER, TOOK = "@neusee-folder@", "@neusee-took@"  #: marks in the text of the terminal
PAGE = "report.html"
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

        Raises `NotRepeatable` for a run that computed a step, missed a number or warned, or whose page is not made of
        its document and pictures alone.
        """
        document, folder = self.document, self.folder
        if {each["state"] for each in document["steps"]} - _SERVED or document["warnings"] or document["missed"]:
            raise NotRepeatable("a run that computed a step, warned or missed a number")
        files = {
            name: bytes_of(path, _ANY)
            for path in sorted(folder.rglob("*"))
            if path.is_file() and (name := path.relative_to(folder).as_posix()) not in (CRATE, PAGE, *self.taken)
        }
        said = json.loads(files[DOCUMENT])
        made = page(said, _pictures(folder, self.taken))
        if made.encode() != bytes_of(folder / PAGE, _ANY) or document_text(said).encode() != files[DOCUMENT]:
            raise NotRepeatable("the page or the document is not the same when it is written again")
        return {"kind": RUN, "files": files, "stored": taken_from(self.store, self.taken)}


def write_run_again(answer: Answer, disk: Disk, seconds: float) -> tuple[Path, dict[str, Any]]:
    """Write the folder of a run again with the present time and ``seconds``; return its path and its document.

    Raises `OSError` if the folder cannot be written; no part of it is left then.
    """
    began, document = datetime.now(UTC).isoformat(timespec="seconds"), json.loads(answer.files[DOCUMENT])
    document = _of_now(document, seconds)
    with new_run(Path(answer.out), answer.label, answer.key) as folder:
        folder.said = {"began": began} | document
        for name, path in answer.stored.taken.items():
            folder.take(name, disk.root / path)
        files = {**answer.files, DOCUMENT: document_text(document).encode()}
        for name, content in files.items():
            folder.write(name, content)
        folder.write(PAGE, page(document, _pictures(folder.path, answer.stored.taken)))
    return folder.path, document


def said_again(answer: Answer, folder: Path, document: Mapping[str, Any]) -> str:
    """Return the text of the terminal for a run that was written again."""
    if answer.as_json:
        return json_line({"report": str(folder / PAGE), **document})
    return answer.text.replace(TOOK, f"{document['seconds']:.2f}").replace(FOLDER, str(folder))


def _of_now(document: dict[str, Any], seconds: float) -> dict[str, Any]:
    """Return the document of a run with the time and the memory of this process, and with the run that it repeats."""
    memory = process_peak()
    now = {"engine": f"{seconds:.3f} s", "peak memory": format_size(memory)}
    facts = [[name, now.get(name, value)] for name, value in document["facts"]]
    facts.append(["answer", f"that of the run of {document['started']}, all of whose results are still in the cache"])
    timing = {**document["timing"], "peak": [document["timing"]["peak"][0], memory]}
    changed = {"started": present_time(), "seconds": seconds, "facts": facts, "timing": timing}
    return {**document, **changed}


def _pictures(folder: Path, taken: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the pictures of a run by name, in the order in which the run added them."""
    names = [name for name in taken if name.startswith(_FIGURES)]
    return {name[len(_FIGURES) :].removesuffix(".png"): bytes_of(folder / name, _ANY) for name in names}
