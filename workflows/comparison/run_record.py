"""The results folder of a run, read for a comparison. A folder that cannot be compared gives one
error that names the file.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.graph.final_values import flow
from neusee.workflows.keys.sealed_files import NotRegular, text_of
from neusee.workflows.recipe.text.yaml_values import read
from neusee.workflows.report.run_folder import CODE, find_run

M = TypeVar("M", bound=BaseModel)

_OTHER_RESULTS = {
    "sweep.yaml": (
        "a sweep: compare reads folders of `neusee run`; the results of each point are in sweep.csv"
    ),
    "training.json": (
        "a training: compare reads folders of `neusee run`, such as two runs with the trained"
        " weights"
    ),
}
_DAMAGED = "the file is damaged, or of another version of neusee: run the recipe again"


class NotComparable(ValueError):
    """Error for a folder that is not the complete folder of a run; the text names the place and
    the way out.
    """


class StepRow(BaseModel):
    """Entry of one step in the document of a run."""

    step: str
    node: str
    state: str
    key: str


class ResultTable(BaseModel):
    """The result table of a run, as the page shows it."""

    columns: list[str]
    rows: list[dict[str, Any]]


class RunDocument(BaseModel):
    """The parts of ``provenance.json`` that a comparison needs."""

    model_config = ConfigDict(extra="ignore")

    recipe: str
    version: str
    command: str
    started: str
    device: str
    metrics: list[tuple[str, str, int | str, float | None]]
    steps: list[StepRow]
    table: ResultTable
    facts: list[tuple[str, str]]


class CodeDigests(BaseModel):
    """The content of ``code.json``: digests of the code of each node, and of what the code uses."""

    nodes: dict[str, str]
    parts: dict[str, dict[str, str]]


@dataclass(frozen=True)
class FinalValue:
    """A final value of a recipe as text, and the place where it was written."""

    text: str
    source: str


@dataclass(frozen=True)
class RunRecord:
    """The folder of a run: its document, the final values of its recipe and its digests of code."""

    folder: Path
    document: RunDocument
    values: Mapping[str, FinalValue]
    code: CodeDigests | None  #: None for a folder of a version that recorded no digests

    @property
    def name(self) -> str:
        return self.folder.name


def read_record(where: str, root: Path) -> RunRecord:
    """Return the record of a run; ``where`` is ``latest``, the name of a folder in ``root`` or a
    path.

    Raises `NotComparable`, with the file and the place in the file, for a folder that is missing,
    damaged or of something else than a run.
    """
    for path in (root / where, Path(where)):
        for file, text in _OTHER_RESULTS.items():
            if (path / file).is_file():
                raise NotComparable(f"{path} is the folder of {text}")
    try:
        folder = find_run(where, root).resolve()
    except FileNotFoundError as error:
        raise NotComparable(str(error)) from None
    provenance = _json(folder / "provenance.json")
    other_kind = (
        provenance.get("study") or provenance.get("stage") if isinstance(provenance, dict) else None
    )
    if other_kind:
        text = f"{folder} is the folder of `{other_kind}`: compare reads folders of `neusee run`"
        raise NotComparable(
            f"{text}; the numbers of this folder are in its tables and its page report.html"
        )
    document = _checked(folder / "provenance.json", RunDocument, provenance)
    code = folder / CODE
    digests = _checked(code, CodeDigests, _json(code)) if code.is_file() else None
    return RunRecord(folder, document, _values(folder / "recipe.yaml"), digests)


def _json(path: Path) -> Any:
    """Return the content of a JSON file; raise `NotComparable` with the place of a
    mistake in it.
    """
    try:
        return json.loads(text_of(path))
    except json.JSONDecodeError as error:
        raise NotComparable(
            f"{path}:{error.lineno}:{error.colno}: {error.msg}: {_DAMAGED}"
        ) from None
    except NotRegular as error:
        raise NotComparable(str(error)) from None
    except UnicodeDecodeError as error:
        raise NotComparable(f"{path}: byte {error.start} is not UTF-8: {_DAMAGED}") from None
    except OSError as error:
        raise NotComparable(f"{path} cannot be read: {error.strerror}") from None


def _checked(path: Path, model: type[M], content: Any) -> M:
    """Return content as a model; raise `NotComparable` with the place of the first mistake."""
    try:
        return TypeAdapter(model).validate_python(content)
    except ValidationError as error:
        first_mistake = error.errors()[0]
        mistake_path = ".".join(map(str, first_mistake["loc"])) or "the top"
        raise NotComparable(
            f"{path}: {mistake_path}: {first_mistake['msg'].lower()}: {_DAMAGED}"
        ) from None


def _values(path: Path) -> dict[str, FinalValue]:
    """Return the final values in the ``recipe.yaml`` of a run, each with its source from the
    comment behind it.
    """
    try:
        document = read(path, str(path))
    except RecipeError as error:
        raise NotComparable(str(error)) from None
    lines = text_of(path, "utf-8-sig").splitlines()
    # text before and after the comment of each line
    sources = [line.rpartition(" # ")[::2] for line in lines]
    values = {}
    for leaf in document.root.leaves():
        line_before_comment, source = sources[leaf.key.line - 1]
        if line_before_comment:  # a block of which every value is a default has no source
            values[leaf.name] = FinalValue(flow(leaf.plain), source.strip())
    return values
