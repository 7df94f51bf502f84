"""The comparison of two runs as a page, as lines for a terminal, and as a folder."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from neusee.workflows.comparison import differences
from neusee.workflows.comparison import differences as picture_differences
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
from neusee.workflows.report.study_folder import StudyReport
from neusee.workflows.report.study_page import Section
from neusee.workflows.report.terminal_text import columns

# --- comparison page ------------------------------------------------------------------------------

# The page of a comparison of two runs: numbers, pictures, recipe, code and environment, in this
# order.


_COLUMNS = ("name", "index", "left", "right", "right - left", "relative")
_NONE = "–"


def report(comparison: RunComparison) -> StudyReport:
    """Return the page of a comparison with its pictures and its table of numbers."""
    rows = [
        [n.name, n.index, n.left, n.right, n.difference, n.relative] for n in comparison.numbers
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
    drawn, data = (
        [file for file in files if file.state != "same"]
        for files in (comparison.figures, comparison.data)
    )
    code = "The code is the same."
    if comparison.code is None:
        code = "The left or the right folder records no digests of code."
    elif comparison.code:
        code = f"{_counted(len(comparison.code), 'difference')} in the code."
    return [
        *_compared(comparison.numbers),
        f"{len(drawn)} of {_counted(len(comparison.figures), 'picture')} differ.",
        f"{len(data)} of {_counted(len(comparison.data), 'data file')} and tensors differ.",
        (
            f"{_counted(len(comparison.recipe), 'value')} of the recipe"
            f" differ{'s' * (len(comparison.recipe) == 1)}."
            if comparison.recipe
            else "The recipe is the same."
        ),
        code,
    ]


def _compared(numbers: Sequence[NumberDifference]) -> list[str]:
    """Return how many numbers of both runs differ, and how many numbers only one run has."""
    both = [number for number in numbers if number.left is not None and number.right is not None]
    sentences = ["The runs have no number in common."]
    if both or not numbers:
        sentences = [_differ(both)]
    alone = {
        "left": sum(number.right is None for number in numbers),
        "right": sum(number.left is None for number in numbers),
    }
    for side, count in alone.items():
        if count:
            sentences.append(f"Only the {side} run has {_counted(count, 'further number')}.")
    return sentences


def _differ(both: Sequence[NumberDifference]) -> str:
    """Return how many of the numbers that both runs have differ, and by how much."""
    differ = [number for number in both if number.relative > 0]
    counted = _counted(len(both), "number")
    if not differ:
        return f"All {counted} are the same."
    return f"{len(differ)} of {counted} differ{_by(differ)}."


def difference_text(number: NumberDifference) -> list[str]:
    """Return name, index, both sides, difference and relative difference of a number as cells of
    a table.
    """
    sides = [_NONE if side is None else f"{side:.6g}" for side in (number.left, number.right)]
    change = _NONE if number.difference is None else f"{number.difference:+.3g}"
    return [number.name, str(number.index), *sides, change, _relative(number.relative)]


def _relative(value: float) -> str:
    return f"{value:.2g}" if value < float("inf") else _NONE


def _by(differ: Sequence[NumberDifference]) -> str:
    worst = max(number.relative for number in differ)
    return (
        f", by at most {worst:.2g} relative to the larger of both" if worst < float("inf") else ""
    )


def _counted(count: int, word: str) -> str:
    return f"{count} {word}{'s' * (count != 1)}"


def _runs(comparison: RunComparison) -> str:
    sides = (("Left", comparison.left), ("right", comparison.right))
    return (
        "; ".join(
            f"{word}: `{run.document.command}`, {run.document.started}" for word, run in sides
        )
        + "."
    )


def _results(comparison: RunComparison) -> Section:
    header, rows = comparison.table
    text = "The result table of both runs." if rows else "Neither run has a result table."
    return Section("Results", text, header, rows)


def _numbers(comparison: RunComparison) -> Section:
    differ = largest(comparison.numbers)
    text = """Each result with a number that differs; of several numbers, such as one for each band,
        the one with the largest relative difference. Relative means: divided by the larger of both.
        `numbers.csv` has all numbers."""
    if not differ:
        text = "Every number of both runs is the same. `numbers.csv` has all numbers."
    return Section(
        "Numbers", text, _COLUMNS if differ else (), [difference_text(number) for number in differ]
    )


def _drawing(file: FileDifference) -> Section:
    said = (
        f"Root mean square difference {file.rms:.3g}."
        if file.rms is not None
        else f"{file.state}.".capitalize()
    )
    scale = f" Largest value of both {file.scale:.4g}." if file.scale not in (None, 255.0) else ""
    return Section(file.name, said + scale, picture=file.drawing)


def _files(comparison: RunComparison) -> Section:
    files = [*comparison.figures, *comparison.data]
    rows = [[file.name, file.state, file.largest, file.rms, file.scale] for file in files]
    text = """Differences of figures are in levels of 0 to 255, those of data files in the unit of
        the file. Figures of times and of the graph are not compared."""
    lines = _sentences(comparison.missing)
    columns = ("file", "state", "largest difference", "root mean square", "largest value")
    return Section("Files", f"{text}\n\n{lines}" if lines else text, columns if rows else (), rows)


def _text_of_code(comparison: RunComparison) -> str:
    if comparison.code is None:
        return (
            "The folder of a run of an earlier version records no digests of code, so that the"
            " code is not compared."
        )
    if comparison.code:
        return "What differs in the code of the nodes, by module and definition."
    return "The code of every common node is the same."


def _causes(comparison: RunComparison) -> list[Section]:
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
    cells: list[list[Any]] = [
        [
            row.name,
            row.left or _NONE,
            row.right or _NONE,
            *([row.left_source or _NONE, row.right_source or _NONE] if sources else []),
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
    return "\n\n".join(f"{line[0].upper()}{line[1:]}." for line in lines)


def _stem(file: FileDifference) -> str:
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
        picture_differences.figures(left.folder, right.folder),
        picture_differences.data_files(left.folder, right.folder),
        picture_differences.only_one_has(left.folder, right.folder),
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
                "name": n.name,
                "index": n.index,
                "left": n.left,
                "right": n.right,
                "difference": n.difference,
                "relative": n.relative,
            }
            for n in comparison.numbers
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
        about = {
            "study": "compare",
            "recipe": names[0],
            "title": f"Comparison of {comparison.left.name} and {comparison.right.name}.",
            "command": shlex.join(command),
            "date": timestamp(),
            "versions": versions(),
        }
        folder.said = about | {"began": comparison.began}
        report(comparison).write(folder, about | content)
    return folder.path


def _of_file(file: FileDifference) -> dict[str, Any]:
    return {name: value for name, value in asdict(file).items() if name != "drawing"}


# --- comparison text ------------------------------------------------------------------------------

# A comparison of two runs as lines of text for a terminal.


_MOST = 12  #: rows of each table


def lines(comparison: RunComparison) -> list[str]:
    """Return lines with the tables of a comparison; the page has what is cut here."""
    head = [f"left   {comparison.left.folder}", f"right  {comparison.right.folder}"]
    head += summary(comparison)
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
            head += ["", title, *_cut(rows)]
    return head


def _number_table(comparison: RunComparison) -> list[str]:
    """Return the lines of the numbers that differ; none without any."""
    differ = largest(comparison.numbers)
    header = ["number", "index", "left", "right", "right - left", "relative"]
    return _text_table([header, *map(difference_text, differ)]) if differ else []


def _indented(texts: Iterable[str]) -> list[str]:
    return [f"  {text}" for text in texts]


def _text_table(rows: list[list[str]]) -> list[str]:
    return [f"  {line}" for line in columns(rows, ">")]


def _cut(rows: list[str]) -> list[str]:
    hidden = len(rows) - _MOST
    return [*rows[:_MOST], f"  and {hidden} more on the page"] if hidden > 0 else rows


def _value(value: ValueDifference) -> str:
    sides = [
        (text or "none") + (f" ({source})" if source else "")
        for text, source in ((value.left, value.left_source), (value.right, value.right_source))
    ]
    return f"{value.name}: {sides[0]} -> {sides[1]}"


def _file(file: FileDifference) -> str:
    if file.largest is None:
        return f"{file.name}: {file.state}"
    return (
        f"{file.name}: differs by at most {file.largest:.4g}, where the largest value is"
        f" {file.scale:.4g}"
    )
