"""The report of a study, a calibration or an evaluation: one page that loads no other file, and the
folder with the page, the pictures, the tables and the provenance.

    run = StudyRun("stability", recipe, command)            # starts the clock
    document = run.document({"failed": 3})                  # the content of provenance.json
    report = StudyReport("Stability", lead, sections) # the page, its pictures and its tables
    folder = run.write(runs, key, document, report)
"""

from __future__ import annotations

import base64
import json
import math
import numbers
import re
import shlex
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from neusee.workflows.engine.provenance import timestamp, versions
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.report.run_folder import SHORT, RunFolder, filled, new_run
from neusee.workflows.store.result_store import Store

# --- the page -------------------------------------------------------------------------------------
# The page has a light mode, a dark mode and a print mode. A sign in each coloured cell repeats the
# meaning of the colour.

_LARGE, _LARGEST = 999.5, 1e6  #: real numbers between these are shown without an exponent

Mark = Literal["pass", "warn", "fail"]


@dataclass(frozen=True, slots=True)
class Marked:
    """A value of a table cell that passes, warns or fails; without a mark, the plain value."""

    value: Any
    mark: Mark | None = None


@dataclass(frozen=True)
class Section:
    """A section of the HTML page of a study: heading, text, picture and table.

    A blank line in the text begins a new paragraph.
    """

    heading: str
    text: str
    columns: Sequence[str] = ()
    #: a real number is shown with three digits, None as a dash, a `Marked` value with its colour
    rows: Sequence[Sequence[Any]] = ()
    picture: bytes | None = None  #: PNG


def page(
    title: str,
    lead: str,
    sections: Sequence[Section],
    provenance: Mapping[str, Any],
    banner: str = "",
) -> str:
    """Return the HTML page of a study; a red ``banner`` gives the reason why the result must not
    be used.
    """
    texts = {name: _plain(value) for name, value in provenance.items()}
    return filled(
        "study_page.html.j2",
        title=title,
        banner=banner,
        lead=_paragraphs(lead),
        sections=[_section(f"s{number}", section) for number, section in enumerate(sections)],
        provenance=[(name, text) for name, text in texts.items() if text],
    )


def marked_column(
    rows: Iterable[Sequence[Any]], column: int, marks: Iterable[Mark | None]
) -> list[Sequence[Any]]:
    """Return the rows of a table with a mark, or None, for the cell of each row in a column."""
    return [
        (*row[:column], Marked(row[column], mark), *row[column + 1 :])
        for row, mark in zip(rows, marks, strict=True)
    ]


def cell_text(value: Any) -> str:
    """Return the value of a table cell as text, with three digits of a real number and a dash
    for None.
    """
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, numbers.Real) and not isinstance(value, numbers.Integral):
        text = f"{float(value):.3g}"
        # 3720 in place of 3.72e+03
        return f"{float(text):.0f}" if _LARGE <= abs(float(value)) < _LARGEST else text
    return str(value)


def with_uncertainty(mean: float, sd: float) -> str:
    """Return mean ± standard deviation as text, rounded to two significant digits of the
    standard deviation.
    """
    if not 0 < sd < math.inf:
        return f"{mean:.6g} ± {sd:g}"
    # decimals with which two digits of the deviation are written; below 0 left of the point
    digits = 1 - math.floor(math.log10(sd))
    if not -5 <= digits <= 12:
        return f"{mean:.5g} ± {sd:.2g}"
    return " ± ".join(f"{round(value, digits):.{max(digits, 0)}f}" for value in (mean, sd))


def _section(anchor: str, section: Section) -> dict[str, Any]:
    """Return a section as values of the template; a column of numbers is aligned right."""
    marked_rows = [[_with_mark(value) for value in row] for row in section.rows]
    numeric = {
        column
        for column in range(len(section.columns))
        if _holds_numbers([row[column].value for row in marked_rows])
    }
    return {
        "anchor": anchor,
        "heading": section.heading,
        "text": _paragraphs(section.text),
        "alt": _alternative(section),
        "picture": base64.b64encode(section.picture).decode() if section.picture else "",
        "columns": section.columns,
        "numeric": numeric,
        "rows": [
            [_cell(value, column in numeric) for column, value in enumerate(row)]
            for row in marked_rows
        ],
    }


def _alternative(section: Section) -> str:
    """Return the alternative text of the picture of a section: the heading, and the first
    sentence of the text.
    """
    sentences = [
        re.split(r"(?<=[.!?]) ", paragraph)[0] for paragraph in _paragraphs(section.text)[:1]
    ]
    return " ".join([f"Figure: {section.heading}.", *sentences])


def _with_mark(value: Any) -> Marked:
    """Return a value of a cell as a `Marked` value, without a mark unless it has one."""
    return value if isinstance(value, Marked) else Marked(value)


def _cell(cell: Marked, numeric: bool) -> dict[str, str]:
    """Return text and classes of a cell: ``n`` aligns right, ``one`` keeps a word in one line."""
    text = cell_text(cell.value)
    alignment = ""
    if numeric or _is_number(cell.value):
        alignment = "n"
    elif _is_short_word(text):
        alignment = "one"
    return {"text": text, "kind": " ".join(filter(None, (alignment, cell.mark)))}


def _is_short_word(text: str) -> bool:
    """Return True for a short text without a space, such as 2.6e-05, which must not break at its
    hyphen.
    """
    return len(text) <= SHORT and "-" in text and not any(map(str.isspace, text))


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def _holds_numbers(cells: Sequence[Any]) -> bool:
    """Return True if a table column contains at least one number and otherwise only numbers and
    empty cells.
    """
    filled_cells = [cell for cell in cells if cell is not None]
    return bool(filled_cells) and all(map(_is_number, filled_cells))


def _paragraphs(text: str) -> list[str]:
    """Return the paragraphs of a text, which are separated by blank lines, each in one line."""
    return [" ".join(paragraph.split()) for paragraph in text.split("\n\n") if paragraph.strip()]


def _plain(value: Any) -> str:
    """Return a value as text: a list with commas, and a mapping as names and values; inner ones
    stand in brackets.
    """
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_inner(item)}" for name, item in value.items())
    return ", ".join(map(_inner, value)) if isinstance(value, list | tuple) else cell_text(value)


def _inner(value: Any) -> str:
    """Return an inner value as text, in brackets if it has parts."""
    text = _plain(value)
    return f"({text})" if isinstance(value, Mapping | list | tuple) else text or "–"


# --- the folder -----------------------------------------------------------------------------------

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
    """Result of a study before its folder is written: key, provenance and report."""

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
