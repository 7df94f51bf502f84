"""The page of a comparison of two runs: numbers, pictures, recipe, code and environment, in this order."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from neusee.workflows.comparison.differences import NumberDifference, ValueDifference, largest
from neusee.workflows.comparison.picture_differences import FileDifference
from neusee.workflows.report.study_folder import StudyReport
from neusee.workflows.report.study_page import Section

if TYPE_CHECKING:
    from neusee.workflows.comparison.compare_runs import RunComparison

_COLUMNS = ("name", "index", "left", "right", "right - left", "relative")
_NONE = "–"


def report(found: RunComparison) -> StudyReport:
    """Return the page of a comparison with its pictures and its table of numbers."""
    rows = [[n.name, n.index, n.left, n.right, n.difference, n.relative] for n in found.numbers]
    drawings = [each for each in (*found.figures, *found.data) if each.drawing]
    sections = [_results(found), _numbers(found), *map(_drawing, drawings), _files(found), *_causes(found)]
    return StudyReport(
        f"{found.left.name} and {found.right.name}",
        "\n\n".join([" ".join(summary(found)), _runs(found)]),
        sections,
        {_stem(each): each.drawing for each in drawings},
        {"numbers.csv": (_COLUMNS, rows)},
        shown=("command", "date", "versions"),
    )


def summary(found: RunComparison) -> list[str]:
    """Return sentences that count what differs between two runs."""
    drawn, data = ([each for each in files if each.state != "same"] for files in (found.figures, found.data))
    code = "The left or the right folder records no digests of code." if found.code is None else (
        f"{_counted(len(found.code), 'difference')} in the code." if found.code else "The code is the same."
    )  # fmt: skip
    return [
        *_compared(found.numbers),
        f"{len(drawn)} of {_counted(len(found.figures), 'picture')} differ.",
        f"{len(data)} of {_counted(len(found.data), 'data file')} and tensors differ.",
        f"{_counted(len(found.recipe), 'value')} of the recipe differ{'s' * (len(found.recipe) == 1)}."
        if found.recipe
        else "The recipe is the same.",
        code,
    ]


def _compared(numbers: Sequence[NumberDifference]) -> list[str]:
    """Return how many numbers of both runs differ, and how many numbers only one run has."""
    both = [each for each in numbers if each.left is not None and each.right is not None]
    differ = [each for each in both if each.relative > 0]
    counted = _counted(len(both), "number")
    said = f"{len(differ)} of {counted} differ{_by(differ)}." if differ else f"All {counted} are the same."
    alone = {"left": sum(each.right is None for each in numbers), "right": sum(each.left is None for each in numbers)}
    return [
        *([said] if both or not numbers else ["The runs have no number in common."]),
        *(f"Only the {side} run has {_counted(count, 'further number')}." for side, count in alone.items() if count),
    ]


def difference_text(each: NumberDifference) -> list[str]:
    """Return name, index, both sides, difference and relative difference of a number as cells of a table."""
    sides = [_NONE if side is None else f"{side:.6g}" for side in (each.left, each.right)]
    change = _NONE if each.difference is None else f"{each.difference:+.3g}"
    return [each.name, str(each.index), *sides, change, _relative(each.relative)]


def _relative(value: float) -> str:
    return f"{value:.2g}" if value < float("inf") else _NONE


def _by(differ: list[NumberDifference]) -> str:
    most = max(each.relative for each in differ)
    return f", by at most {most:.2g} relative to the larger of both" if most < float("inf") else ""


def _counted(count: int, word: str) -> str:
    return f"{count} {word}{'s' * (count != 1)}"


def _runs(found: RunComparison) -> str:
    sides = (("Left", found.left), ("right", found.right))
    return "; ".join(f"{word}: `{run.document.command}`, {run.document.started}" for word, run in sides) + "."


def _results(found: RunComparison) -> Section:
    header, rows = found.table
    text = "The result table of both runs." if rows else "Neither run has a result table."
    return Section("Results", text, header, rows)


def _numbers(found: RunComparison) -> Section:
    differ = largest(found.numbers)
    text = """Each result with a number that differs; of several numbers, such as one for each band, the one with the
        largest relative difference. Relative means: divided by the larger of both. `numbers.csv` has all numbers."""
    if not differ:
        text = "Every number of both runs is the same. `numbers.csv` has all numbers."
    return Section("Numbers", text, _COLUMNS if differ else (), [difference_text(each) for each in differ])


def _drawing(each: FileDifference) -> Section:
    said = f"Root mean square difference {each.rms:.3g}." if each.rms is not None else f"{each.state}.".capitalize()
    scale = f" Largest value of both {each.scale:.4g}." if each.scale not in (None, 255.0) else ""
    return Section(each.name, said + scale, picture=each.drawing)


def _files(found: RunComparison) -> Section:
    files = [*found.figures, *found.data]
    rows = [[each.name, each.state, each.largest, each.rms, each.scale] for each in files]
    text = """Differences of figures are in levels of 0 to 255, those of data files in the unit of the file. Figures of
        times and of the graph are not compared."""
    lines = _sentences(found.missing)
    columns = ("file", "state", "largest difference", "root mean square", "largest value")
    return Section("Files", f"{text}\n\n{lines}" if lines else text, columns if rows else (), rows)


def _causes(found: RunComparison) -> list[Section]:
    return [
        _table("Recipe", "The final values of both recipes", found.recipe, sources=True),
        Section(
            "Code",
            "The folder of a run of an earlier version records no digests of code, so that the code is not compared."
            if found.code is None
            else "What differs in the code of the nodes, by module and definition."
            if found.code
            else "The code of every common node is the same.",
            ("difference",) if found.code else (),
            [[line] for line in found.code or ()],
        ),
        Section("Steps", _sentences(found.steps) or "Both runs have the same steps with the same cache keys."),
        _table("Environment", "Command, device, machine and versions", found.environment),
    ]


def _table(heading: str, what: str, rows: Iterable[ValueDifference], sources: bool = False) -> Section:
    cells: list[list[Any]] = [
        [each.name, each.left or _NONE, each.right or _NONE,
         *([each.left_source or _NONE, each.right_source or _NONE] if sources else [])] for each in rows
    ]  # fmt: skip
    columns = ("name", "left", "right", *(("left written in", "right written in") if sources else ()))
    return Section(heading, f"{what} {'that differ' if cells else 'are the same'}.", columns if cells else (), cells)


def _sentences(lines: list[str]) -> str:
    return "\n\n".join(f"{line[0].upper()}{line[1:]}." for line in lines)


def _stem(each: FileDifference) -> str:
    return each.name.rpartition(".")[0].replace(" ", "_")
