"""The folder with the results of a study, a calibration or an evaluation: page, pictures, tables
and provenance.

run = StudyRun("stability", recipe, command)            # starts the clock
document = run.document({"failed": 3})                  # the content of provenance.json
report = StudyReport("Stability", lead, sections) # the page, its pictures and its tables
folder = run.write(runs, key, document, report)
"""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from neusee.workflows.engine.provenance import timestamp, versions
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.report.run_folder import RunFolder, new_run
from neusee.workflows.report.study_page import Section, page
from neusee.workflows.store.result_store import Store

Progress = Callable[[str], None]  #: receives a line after each part of a study
CsvTable = tuple[Sequence[str], Iterable[Sequence[Any]]]  #: the names of the columns, and the rows
#: of a file, or a function that writes the file at a path
Content = str | bytes | Callable[[Path], Any]
#: values of the document that the page of a study shows
SHOWN = ("command", "date", "seconds", "versions")


def silent(line: str) -> None:
    """Ignore a line of text about the progress of a study."""


@dataclass(frozen=True)
class StudyReport:
    """The report of a study: title, summary and sections of its page, and pictures, tables and
    other files by name.
    """

    title: str
    lead: str
    sections: Sequence[Section]
    #: by name, without folder and suffix
    pictures: Mapping[str, bytes | None] = field(default_factory=dict)
    tables: Mapping[str, CsvTable] = field(default_factory=dict)  #: by file name
    files: Mapping[str, Content] = field(default_factory=dict)  #: by file name
    #: the values of the document that the page shows; None for all but the recipe
    shown: Sequence[str] | None = SHOWN
    banner: str = ""  #: reason why the result must not be used

    def write(self, folder: RunFolder, document: Mapping[str, Any]) -> None:
        """Write the files of a study into a folder: page, pictures, tables, other files and
        ``provenance.json``.
        """
        for name, picture in self.pictures.items():
            if picture:
                folder.write(f"figures/{name}.png", picture)
        for name, (header, rows) in self.tables.items():
            folder.write_rows(name, header, rows)
        for name, content in self.files.items():
            content(folder.path / name) if callable(content) else folder.write(name, content)
        folder.write("provenance.json", as_json(document))
        shown_facts = self._shown_of(document)
        folder.write(
            "report.html", page(self.title, self.lead, self.sections, shown_facts, self.banner)
        )

    def _shown_of(self, document: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of a document that the page shows, and its warnings if it has any."""
        names = self.shown
        if names is None:
            names = [name for name in document if name != "config"]
        shown_facts = {name: document[name] for name in names}
        if document.get("warnings"):
            shown_facts["warnings"] = "; ".join(document["warnings"])
        return shown_facts


@dataclass(frozen=True)
class StudyOutcome:
    """What a study has found, before its folder is written."""

    key: str  #: of all that decides the results; the name of the folder ends with it
    content: Mapping[str, Any]  #: of ``provenance.json``, beside what each study states
    report: StudyReport


class StudyRun:
    """A study in progress, whose computing time is measured from the creation of this object."""

    def __init__(self, kind: str, recipe: Recipe, command: Sequence[str]) -> None:
        self.kind, self.recipe, self.command = kind, recipe, command
        self._began, self._failures = time.perf_counter(), len(Store.failures)

    def document(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """Return the provenance of a study as a document: command, date, run time, ``content``,
        versions and recipe.
        """
        return {
            "study": self.kind,
            "recipe": self.recipe.name,
            "command": shlex.join(self.command),
            "date": timestamp(),
            "seconds": time.perf_counter() - self._began,
            **content,
            "warnings": Store.failures[self._failures :],
            "versions": versions(),
            "config": self.recipe.config.to_yaml(),
        }

    def write(
        self, runs: Path, key: str, document: Mapping[str, Any], report: StudyReport, name: str = ""
    ) -> Path:
        """Write the results of a study into the folder ``runs/<date>_<recipe>_<name>_<key>``, and
        return its path.

        Without ``name``, the folder has the kind of the study in its name.
        """
        with new_run(
            runs, f"{self.recipe.name}_{name or self.kind.replace('-', '_')}", key
        ) as folder:
            folder.said = dict(document)
            folder.write("recipe.yaml", document["config"])
            report.write(folder, document)
        return folder.path


def as_json(document: Mapping[str, Any]) -> str:
    """Return the document of a study as indented JSON text."""
    return json.dumps(document, indent=1, ensure_ascii=False)
