"""The HTML page of a study, with paragraphs, pictures and tables, as one file that loads no other
file.

The page has a light mode, a dark mode and a print mode. A sign in each coloured cell repeats the
meaning of the colour.
"""

from __future__ import annotations

import base64
import functools
import math
import numbers
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Literal

_LARGE, _LARGEST = 999.5, 1e6  #: real numbers between these are shown without an exponent
_SHORT = 16  #: characters of the longest text that a table does not break at a hyphen
_BREAK = re.compile(r"(?<=[_,/.])(?=[a-z])|(?=\[)")  #: where a long word may go on in a new line

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


def filled(template: str, **values: Any) -> str:
    """Return the HTML that an HTML template of the folder ``templates`` gives for the given
    ``values``.
    """
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
        _BREAK.sub("<wbr>", escape(word)) if len(word) > _SHORT else escape(word)
        for word in text.split(" ")
    )


def marked_column(
    rows: Iterable[Sequence[Any]], column: int, marks: Iterable[Mark | None]
) -> list[Sequence[Any]]:
    """Return the rows of a table with a mark, or None, for the cell of each row in a column."""
    return [
        (*row[:column], Marked(row[column], mark), *row[column + 1 :])
        for row, mark in zip(rows, marks, strict=True)
    ]


def said(value: Any) -> str:
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
    text = said(cell.value)
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
    return len(text) <= _SHORT and "-" in text and not any(map(str.isspace, text))


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def _holds_numbers(cells: Sequence[Any]) -> bool:
    """Return True if a table column contains at least one number and otherwise only numbers and
    empty cells.
    """
    filled_cells = [cell for cell in cells if cell is not None]
    return bool(filled_cells) and all(map(_is_number, filled_cells))


def _paragraphs(text: str) -> list[str]:
    """Return the paragraphs of a text, which blank lines part, each in one line."""
    return [" ".join(paragraph.split()) for paragraph in text.split("\n\n") if paragraph.strip()]


def _plain(value: Any) -> str:
    """Return a value as text: a list with commas, and a mapping as names and values; inner ones
    stand in brackets.
    """
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_inner(item)}" for name, item in value.items())
    return ", ".join(map(_inner, value)) if isinstance(value, list | tuple) else said(value)


def _inner(value: Any) -> str:
    """Return an inner value as text, in brackets if it has parts."""
    text = _plain(value)
    return f"({text})" if isinstance(value, Mapping | list | tuple) else text or "–"
