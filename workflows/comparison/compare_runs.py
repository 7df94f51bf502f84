"""Comparison of two runs: everything that differs, and the folder with its page, table and pictures."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from neusee.workflows.comparison import differences, picture_differences
from neusee.workflows.comparison.comparison_page import report
from neusee.workflows.comparison.differences import NumberDifference, ValueDifference
from neusee.workflows.comparison.picture_differences import FileDifference
from neusee.workflows.comparison.run_record import RunRecord
from neusee.workflows.engine.provenance import timestamp, versions
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.report.run_folder import new_run


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
        """Return the largest relative difference of a number of both runs; infinite if one run lacks a number."""
        return max((each.relative for each in self.numbers), default=0.0)


def compare(left: RunRecord, right: RunRecord) -> RunComparison:
    """Return everything that differs between two runs; raise `NotComparable` for a damaged picture or data file."""
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


def document(found: RunComparison) -> dict[str, Any]:
    """Return a comparison as a document of JSON values."""
    return {
        "left": str(found.left.folder),
        "right": str(found.right.folder),
        "largest": found.largest,
        "numbers": [
            {"name": n.name, "index": n.index, "left": n.left, "right": n.right, "difference": n.difference,
             "relative": n.relative} for n in found.numbers
        ],
        "recipe": [asdict(each) for each in found.recipe],
        "code": found.code,
        "environment": [asdict(each) for each in found.environment],
        "steps": found.steps,
        "figures": [_of_file(each) for each in found.figures],
        "data": [_of_file(each) for each in found.data],
        "missing": found.missing,
    }  # fmt: skip


def write_comparison(found: RunComparison, out: Path, command: Sequence[str]) -> Path:
    """Write the folder ``out/comparisons/<date>_<recipe>_<key>/`` of a comparison, and return its path."""
    content = document(found)
    names = list(dict.fromkeys(side.document.recipe for side in (found.left, found.right)))
    with new_run(out / "comparisons", "_and_".join(names), digest(content["left"], content["right"])) as folder:
        about = {
            "study": "compare",
            "recipe": names[0],
            "title": f"Comparison of {found.left.name} and {found.right.name}.",
            "command": shlex.join(command),
            "date": timestamp(),
            "versions": versions(),
        }
        folder.said = about | {"began": found.began}
        report(found).write(folder, about | content)
    return folder.path


def _of_file(each: FileDifference) -> dict[str, Any]:
    return {name: value for name, value in asdict(each).items() if name != "drawing"}
