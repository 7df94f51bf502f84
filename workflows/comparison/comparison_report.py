"""The comparison of two runs as a page, as lines for a terminal, and as a folder."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from neusee.workflows.comparison import differences
from neusee.workflows.comparison.differences import (
    FileDifference,
    NumberDifference,
    ValueDifference,
    largest,
)
from neusee.workflows.comparison.run_record import RunRecord
from neusee.workflows.engine.provenance import timestamp, versions
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.report.run_folder import new_run
from neusee.workflows.report.study_report import Section, StudyReport
from neusee.workflows.report.terminal_text import columns

# --- comparison page ------------------------------------------------------------------------------

# The page of a comparison of two runs: numbers, pictures, recipe, code and environment, in this
# order.


_COLUMNS = ("name", "index", "left", "right", "right - left", "relative")
_NO_NUMBER = "–"


def report(comparison: RunComparison) -> StudyReport:
    """Return the page of a comparison with its pictures and its table of numbers."""
    rows = [
        [number.name, number.index, number.left, number.right, number.difference, number.relative]
        for number in comparison.numbers
    ]
    drawings = [file for file in (*comparison.figures, *comparison.data) if file.drawing]
    sections = [
        _results(comparison),
        _numbers(comparison),
        *map(_drawing, drawings),
        _files(comparison),
        *_causes(comparison),
    ]
    return StudyReport(
        f"{comparison.left.name} and {comparison.right.name}",
        "\n\n".join([" ".join(summary(comparison)), _runs(comparison)]),
        sections,
        {_stem(file): file.drawing for file in drawings},
        {"numbers.csv": (_COLUMNS, rows)},
        shown=("command", "date", "versions"),
    )


def summary(comparison: RunComparison) -> list[str]:
    """Return sentences that count what differs between two runs."""
    differing_figures, data = (
        [file for file in files if file.state != "same"]
        for files in (comparison.figures, comparison.data)
    )
    code_sentence = "The code is the same."
    if comparison.code is None:
        code_sentence = "The left or the right folder records no digests of code."
    elif comparison.code:
        code_sentence = f"{_counted(len(comparison.code), 'difference')} in the code."
    return [
        *_compared(comparison.numbers),
        f"{len(differing_figures)} of {_counted(len(comparison.figures), 'picture')} differ.",
        f"{len(data)} of {_counted(len(comparison.data), 'data file')} and tensors differ.",
        (
            f"{_counted(len(comparison.recipe), 'value')} of the recipe"
            f" differ{'s' * (len(comparison.recipe) == 1)}."
            if comparison.recipe
            else "The recipe is the same."
        ),
        code_sentence,
    ]


def _compared(numbers: Sequence[NumberDifference]) -> list[str]:
    """Return how many numbers of both runs differ, and how many numbers only one run has."""
    in_both = [number for number in numbers if number.left is not None and number.right is not None]
    sentences = ["The runs have no number in common."]
    if in_both or not numbers:
        sentences = [_differ(in_both)]
    only_in = {
        "left": sum(number.right is None for number in numbers),
        "right": sum(number.left is None for number in numbers),
    }
    for side, count in only_in.items():
        if count:
            sentences.append(f"Only the {side} run has {_counted(count, 'further number')}.")
    return sentences


def _differ(both: Sequence[NumberDifference]) -> str:
    """Return how many of the numbers that both runs have differ, and by how much."""
    differing = [number for number in both if number.relative > 0]
    count_text = _counted(len(both), "number")
    if not differing:
        return f"All {count_text} are the same."
    return f"{len(differing)} of {count_text} differ{_by_how_much(differing)}."


def difference_text(number: NumberDifference) -> list[str]:
    """Return name, index, both sides, difference and relative difference of a number as cells of
    a table.
    """
    sides = [_NO_NUMBER if side is None else f"{side:.6g}" for side in (number.left, number.right)]
    difference_cell = _NO_NUMBER if number.difference is None else f"{number.difference:+.3g}"
    return [number.name, str(number.index), *sides, difference_cell, _relative(number.relative)]


def _relative(value: float) -> str:
    """Return a relative difference as text, or a dash where none is defined."""
    return f"{value:.2g}" if value < float("inf") else _NO_NUMBER


def _by_how_much(differ: Sequence[NumberDifference]) -> str:
    """Return by how much numbers differ at most, or nothing where one difference is infinite."""
    largest_relative = max(number.relative for number in differ)
    return (
        f", by at most {largest_relative:.2g} relative to the larger of both"
        if largest_relative < float("inf")
        else ""
    )


def _counted(count: int, word: str) -> str:
    """Return a number with a word, in the plural unless it is 1."""
    return f"{count} {word}{'s' * (count != 1)}"


def _runs(comparison: RunComparison) -> str:
    """Return command and start of both runs in one sentence."""
    sides = (("Left", comparison.left), ("right", comparison.right))
    return (
        "; ".join(
            f"{side_name}: `{run.document.command}`, {run.document.started}"
            for side_name, run in sides
        )
        + "."
    )


def _results(comparison: RunComparison) -> Section:
    """Return the section with the result tables of both runs."""
    header, rows = comparison.table
    text = "The result table of both runs." if rows else "Neither run has a result table."
    return Section("Results", text, header, rows)


def _numbers(comparison: RunComparison) -> Section:
    """Return the section with the numbers that differ most, one for each result."""
    differing = largest(comparison.numbers)
    text = """Each result with a number that differs; of several numbers, such as one for each band,
        the one with the largest relative difference. Relative means: divided by the larger of both.
        `numbers.csv` has all numbers."""
    if not differing:
        text = "Every number of both runs is the same. `numbers.csv` has all numbers."
    return Section(
        "Numbers",
        text,
        _COLUMNS if differing else (),
        [difference_text(number) for number in differing],
    )


def _drawing(file: FileDifference) -> Section:
    """Return the section of a file with a drawing of both sides."""
    difference_text_of_file = (
        f"Root mean square difference {file.rms:.3g}."
        if file.rms is not None
        else f"{file.state}.".capitalize()
    )
    # 255 is the scale of every figure
    scale_text = (
        f" Largest value of both {file.scale:.4g}." if file.scale not in (None, 255.0) else ""
    )
    return Section(file.name, difference_text_of_file + scale_text, picture=file.drawing)


def _files(comparison: RunComparison) -> Section:
    """Return the section with the difference of each figure and data file."""
    files = [*comparison.figures, *comparison.data]
    rows = [[file.name, file.state, file.largest, file.rms, file.scale] for file in files]
    text = """Differences of figures are in levels of 0 to 255, those of data files in the unit of
        the file. Figures of times and of the graph are not compared."""
    lines = _sentences(comparison.missing)
    columns = ("file", "state", "largest difference", "root mean square", "largest value")
    return Section("Files", f"{text}\n\n{lines}" if lines else text, columns if rows else (), rows)


def _text_of_code(comparison: RunComparison) -> str:
    """Return the result of the comparison of the code, in a sentence."""
    if comparison.code is None:
        return (
            "The folder of a run of an earlier version records no digests of code, so that the"
            " code is not compared."
        )
    if comparison.code:
        return "What differs in the code of the nodes, by module and definition."
    return "The code of every common node is the same."


def _causes(comparison: RunComparison) -> list[Section]:
    """Return the sections on what may have caused the differences: recipe, code, steps,
    environment.
    """
    return [
        _table("Recipe", "The final values of both recipes", comparison.recipe, sources=True),
        Section(
            "Code",
            _text_of_code(comparison),
            ("difference",) if comparison.code else (),
            [[line] for line in comparison.code or ()],
        ),
        Section(
            "Steps",
            _sentences(comparison.steps)
            or "Both runs have the same steps with the same cache keys.",
        ),
        _table("Environment", "Command, device, machine and versions", comparison.environment),
    ]


def _table(
    heading: str, subject: str, rows: Iterable[ValueDifference], sources: bool = False
) -> Section:
    """Return the section with entries that differ, and with ``sources`` where each was written."""
    cells: list[list[Any]] = [
        [
            row.name,
            row.left or _NO_NUMBER,
            row.right or _NO_NUMBER,
            *([row.left_source or _NO_NUMBER, row.right_source or _NO_NUMBER] if sources else []),
        ]
        for row in rows
    ]
    columns = (
        "name",
        "left",
        "right",
        *(("left written in", "right written in") if sources else ()),
    )
    return Section(
        heading,
        f"{subject} {'that differ' if cells else 'are the same'}.",
        columns if cells else (),
        cells,
    )


def _sentences(lines: list[str]) -> str:
    """Return lines as paragraphs, each as a sentence."""
    return "\n\n".join(f"{line[0].upper()}{line[1:]}." for line in lines)


def _stem(file: FileDifference) -> str:
    """Return the name of the picture of a file, without its suffix and without spaces."""
    return file.name.rpartition(".")[0].replace(" ", "_")


# --- compare runs ---------------------------------------------------------------------------------

# Comparison of two runs: everything that differs, and the folder with its page, table and pictures.


@dataclass(frozen=True)
class RunComparison:
    """Everything that differs between a left and a right run."""

    left: RunRecord
    right: RunRecord
    numbers: list[NumberDifference]
    table: tuple[list[str], list[list[str]]]
    recipe: list[ValueDifference]
    code: list[str] | None
    environment: list[ValueDifference]
    steps: list[str]
    figures: list[FileDifference]
    data: list[FileDifference]
    missing: list[str]  #: files that only one run has
    began: str  #: time at which the comparison began

    @property
    def largest(self) -> float:
        """Return the largest relative difference of a number of both runs; infinite if one run
        lacks a number.
        """
        return max((number.relative for number in self.numbers), default=0.0)


def compare(left: RunRecord, right: RunRecord) -> RunComparison:
    """Return everything that differs between two runs; raise `NotComparable` for a damaged
    picture or data file.
    """
    began = timestamp()
    return RunComparison(
        left,
        right,
        differences.numbers(left, right),
        differences.table(left, right),
        differences.recipe(left, right),
        differences.code(left, right),
        differences.environment(left, right),
        differences.steps(left, right),
        differences.figures(left.folder, right.folder),
        differences.data_files(left.folder, right.folder),
        differences.only_one_has(left.folder, right.folder),
        began,
    )


def document(comparison: RunComparison) -> dict[str, Any]:
    """Return a comparison as a document of JSON values."""
    return {
        "left": str(comparison.left.folder),
        "right": str(comparison.right.folder),
        "largest": comparison.largest,
        "numbers": [
            {
                "name": number.name,
                "index": number.index,
                "left": number.left,
                "right": number.right,
                "difference": number.difference,
                "relative": number.relative,
            }
            for number in comparison.numbers
        ],
        "recipe": [asdict(value) for value in comparison.recipe],
        "code": comparison.code,
        "environment": [asdict(value) for value in comparison.environment],
        "steps": comparison.steps,
        "figures": [_of_file(file) for file in comparison.figures],
        "data": [_of_file(file) for file in comparison.data],
        "missing": comparison.missing,
    }


def write_comparison(comparison: RunComparison, out: Path, command: Sequence[str]) -> Path:
    """Write the folder ``out/comparisons/<date>_<recipe>_<key>/`` of a comparison, and return
    its path.
    """
    content = document(comparison)
    names = list(
        dict.fromkeys(side.document.recipe for side in (comparison.left, comparison.right))
    )
    with new_run(
        out / "comparisons", "_and_".join(names), digest(content["left"], content["right"])
    ) as folder:
        description = {
            "study": "compare",
            "recipe": names[0],
            "title": f"Comparison of {comparison.left.name} and {comparison.right.name}.",
            "command": shlex.join(command),
            "date": timestamp(),
            "versions": versions(),
        }
        folder.said = description | {"began": comparison.began}
        report(comparison).write(folder, description | content)
    return folder.path


def _of_file(file: FileDifference) -> dict[str, Any]:
    """Return the difference of a file as JSON values, without its drawing."""
    return {name: value for name, value in asdict(file).items() if name != "drawing"}


# --- comparison text ------------------------------------------------------------------------------

# A comparison of two runs as lines of text for a terminal.


_MOST_ROWS = 12  #: rows of each table


def lines(comparison: RunComparison) -> list[str]:
    """Return lines with the tables of a comparison; the page has the complete tables."""
    printed = [f"left   {comparison.left.folder}", f"right  {comparison.right.folder}"]
    printed += summary(comparison)
    files = [file for file in (*comparison.figures, *comparison.data) if file.state != "same"]
    blocks = {
        "numbers": _number_table(comparison),
        "pictures and data": _indented(map(_file, files)),
        "recipe": _indented(map(_value, comparison.recipe)),
        "code": _indented(comparison.code or ()),
        "environment": _indented(map(_value, comparison.environment)),
        "steps": _indented((*comparison.steps, *comparison.missing)),
    }
    for title, rows in blocks.items():
        if rows:
            printed += ["", title, *_first_rows(rows)]
    return printed


def _number_table(comparison: RunComparison) -> list[str]:
    """Return the lines of the numbers that differ; none without any."""
    differing = largest(comparison.numbers)
    header = ["number", "index", "left", "right", "right - left", "relative"]
    return _text_table([header, *map(difference_text, differing)]) if differing else []


def _indented(texts: Iterable[str]) -> list[str]:
    return [f"  {text}" for text in texts]


def _text_table(rows: list[list[str]]) -> list[str]:
    return [f"  {line}" for line in columns(rows, ">")]


def _first_rows(rows: list[str]) -> list[str]:
    hidden = len(rows) - _MOST_ROWS
    return [*rows[:_MOST_ROWS], f"  and {hidden} more on the page"] if hidden > 0 else rows


def _value(value: ValueDifference) -> str:
    """Return an entry that differs as a line: its text and source in both runs."""
    sides = [
        (text or "none") + (f" ({source})" if source else "")
        for text, source in ((value.left, value.left_source), (value.right, value.right_source))
    ]
    return f"{value.name}: {sides[0]} -> {sides[1]}"


def _file(file: FileDifference) -> str:
    """Return the difference of a file as a line."""
    if file.largest is None:
        return f"{file.name}: {file.state}"
    return (
        f"{file.name}: differs by at most {file.largest:.4g}, where the largest value is"
        f" {file.scale:.4g}"
    )
