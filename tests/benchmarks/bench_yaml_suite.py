"""The official YAML test suite, each case read as a recipe file and beside the suite's JSON.

    git clone -b data https://github.com/yaml/yaml-test-suite FOLDER
    python tests/benchmarks/bench_yaml_suite.py FOLDER

A case whose reference is a mapping must be read like it, or refused with a place in the file. What
is not a mapping is no recipe: it is read as the value of an argument is, and must be like the
reference too, or refused. Everything else is listed. The suite is fetched and not shipped.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any

from stored_results import store, stored

from neusee.workflows.graph.errors import Location, RecipeError
from neusee.workflows.recipe.text.yaml_values import parse, read

DOCUMENT = "yaml_suite"  #: in `results/`
ALIKE = "read like the reference"
REFUSED = "refused with a place"
INVALID_REFUSED = "refused with a place, and no YAML"
#: outcomes that are listed, case by case
NO_PLACE = "refused without a place"
OTHER = "READ OTHERWISE"
INVALID_READ = "READ, THOUGH NO YAML"
NO_REFERENCE = "read, and the suite has no JSON"
BROKEN = "BROKEN"
LISTED = (NO_PLACE, OTHER, INVALID_READ, NO_REFERENCE, BROKEN)
KINDS = ("a mapping", "another document", "several documents or none", "no JSON", "no YAML")


@dataclass(frozen=True)
class Case:
    """One case of the suite: a YAML text, and the JSON of each of its documents."""

    name: str
    title: str
    text: bytes
    documents: list[Any] | None  #: None without JSON
    is_invalid: bool  #: whether the text is no YAML

    @property
    def kind(self) -> str:
        if self.is_invalid:
            return "no YAML"
        if self.documents is None:
            return "no JSON"
        if len(self.documents) != 1:
            return "several documents or none"
        return "a mapping" if isinstance(self.documents[0], dict) else "another document"


@dataclass(frozen=True)
class Outcome:
    """What became of a case, with what was read or the message of the refusal."""

    case: Case
    state: str
    detail: str


def cases(folder: Path) -> Iterator[Case]:
    """Yield the cases in a checkout of the branch `data`, where each has a folder with a file
    `in.yaml`.
    """
    for path in sorted(folder.glob("[0-9A-Z]*/**/in.yaml")):
        place = path.parent
        titles = (place / "===").read_text(encoding="utf-8").strip()
        reference = place / "in.json"
        yield Case(
            name=place.relative_to(folder).as_posix(),
            title=titles,
            text=path.read_bytes(),
            documents=documents_in(reference.read_text("utf-8")) if reference.exists() else None,
            is_invalid=(place / "error").exists(),
        )


def documents_in(text: str) -> list[Any]:
    """Return the JSON values that follow one another in a text."""
    decoder, values, rest = json.JSONDecoder(), [], text.strip()
    while rest:
        value, end = decoder.raw_decode(rest)
        values.append(value)
        rest = rest[end:].strip()
    return values


def outcome(case: Case, folder: Path) -> Outcome:
    """Read a case as a recipe file, or as the value of an argument if it is no mapping."""
    path = folder / "case.yaml"
    path.write_bytes(case.text)
    try:
        if case.kind == "another document":
            value = parse(case.text.decode("utf-8-sig"), Location(path.name, 1, 1))
        else:
            value = read(path, path.name).root
    except RecipeError as error:
        return _refused(case, error)
    except Exception as error:  # any other error is what this script looks for
        return Outcome(case, BROKEN, f"{type(error).__name__}: {error}")
    shown = json.dumps(value.plain, default=str)
    if case.is_invalid:
        return Outcome(case, INVALID_READ, shown)
    if case.documents is None:
        return Outcome(case, NO_REFERENCE, shown)
    is_alike = len(case.documents) == 1 and alike(value.plain, case.documents[0])
    return Outcome(case, ALIKE if is_alike else OTHER, shown)


def _refused(case: Case, error: RecipeError) -> Outcome:
    messages = "; ".join(f"{p.mark}: {p.message}" for p in error.diagnostics)
    if any(problem.mark.line == 0 for problem in error.diagnostics):
        return Outcome(case, NO_PLACE, messages)
    return Outcome(case, INVALID_REFUSED if case.is_invalid else REFUSED, messages)


def alike(ours: Any, reference: Any) -> bool:
    """Return True for equal values of the same kind; the keys of JSON are texts."""
    if isinstance(reference, dict):
        return isinstance(ours, dict) and _mappings_alike(ours, reference)
    if isinstance(reference, list):
        is_list = isinstance(ours, list) and len(ours) == len(reference)
        return is_list and all(map(alike, ours, reference))
    if type(reference) in (int, float) and type(ours) in (int, float):
        return math.isclose(ours, reference, rel_tol=1e-12)
    return type(ours) is type(reference) and bool(ours == reference)


def _mappings_alike(ours: dict[Any, Any], reference: dict[str, Any]) -> bool:
    values = {str(key): value for key, value in ours.items()}
    if values.keys() != reference.keys():
        return False
    return all(alike(value, reference[key]) for key, value in values.items())


def listed(outcomes: list[Outcome]) -> Iterator[str]:
    """Yield a line for each case that is neither read like its reference nor refused in its place."""
    for state in LISTED:
        of_state = [result for result in outcomes if result.state == state]
        if of_state:
            yield f"\n{state}:\n"
        yield from map(_row, of_state)


def table(outcomes: list[Outcome]) -> dict[str, list[Any]]:
    """Return the columns and the rows of the table of outcomes by kind of reference."""
    counts = Counter((result.case.kind, result.state) for result in outcomes)
    occurring = {result.state for result in outcomes}
    states = [state for state in (ALIKE, REFUSED, INVALID_REFUSED, *LISTED) if state in occurring]
    rows = []
    for kind in KINDS:
        numbers = [counts[kind, state] for state in states]
        rows.append([kind, *map(str, (sum(numbers), *numbers))])
    return {"columns": ["the reference is", "cases", *states], "rows": rows}


def _row(result: Outcome) -> str:
    return f"- `{result.case.name}` {result.case.title}: {result.detail}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="checkout of the branch data of the suite")
    parser.add_argument("--refused", action="store_true", help="list the refused mappings too")
    options = parser.parse_args()
    warnings.simplefilter("ignore")  # of the parser, on an anchor that is given again
    with tempfile.TemporaryDirectory() as folder:
        outcomes = [outcome(case, Path(folder)) for case in cases(options.folder)]
    if not outcomes:
        raise SystemExit(f"{options.folder} has no cases: give a checkout of the branch data")
    document = stored(DOCUMENT)
    [old] = document["tables"]
    conditions = (
        f"{len(outcomes)} cases of the branch `data`, each read as a recipe file, or as the value of"
        f" an argument if it is no mapping; ruamel.yaml {version('ruamel.yaml')}."
    )
    today = date.today().isoformat()
    document["tables"] = [old | table(outcomes) | {"conditions": conditions, "date": today}]
    store(DOCUMENT, document)
    print("\n".join(listed(outcomes)))
    if options.refused:
        for result in outcomes:
            if result.state == REFUSED and result.case.kind == "a mapping":
                print(_row(result))


if __name__ == "__main__":
    main()
