"""The command ``neusee sheet``: the EMVA 1288 sheet of frames, and the folder with the results."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from neusee.nodes.calibrate import Budget, EmvaSheet, emva_sheet, sheet_budgets
from neusee.workflows.calibration import emva_figures
from neusee.workflows.calibration.emva_sheet import (
    OPERATING_POINT,
    EmvaFrames,
    Release,
    banner,
    frames_of_recipe,
    group_of,
    lead,
    operating_point,
    pattern_tables,
    requirements,
    sections,
    temporal_variance,
)
from neusee.workflows.calibration.frame_validity import as_rows
from neusee.workflows.calibration.uncertainty_budget import (
    BUDGETED,
    COLUMNS,
    budget_document,
    budget_picture,
    budget_rows,
    budget_sections,
    is_relative,
    laboratory_of,
    stated,
)
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.report.study_report import StudyReport, StudyRun, as_json
from neusee.workflows.store.result_store import Store

_PLUS = (
    "U is the expanded uncertainty; + says that a source of it is not stated, which budget.json"
    " names."
)
_FURTHER_BUDGETS = (
    " The files `budget.json` and `budget.csv` have the budgets of all quantities with a value."
)
_COLUMNS = ("section", "key", "symbol", "quantity", "bound", "value", "unit", "reason")
_TRANSFER = ("photons", "exposure", "mean", "variance", "mean_dark", "variance_dark")


@dataclass(frozen=True)
class SheetStatements:
    """Options and statements for a sheet that the recipe does not contain."""

    #: release that defines the temporal variance; None: the release of the descriptor, else release
    #: 4
    release: Release | None = None
    #: True if the photon numbers of the recipe are known only up to a factor
    relative: bool = False
    state: Sequence[str] = ()  #: statements on the operating point, such as ``temperature=25 °C``


def write_sheet(
    recipe: Recipe,
    store: Store,
    runs: Path,
    command: Sequence[str] = (),
    statements: SheetStatements | None = None,
) -> Path:
    """Write the EMVA 1288 sheet of the frames of a recipe (page, PDF, JSON, CSV and pictures), and
    return its folder.

    Nothing in photons is stated where they are known up to a factor only.
    Raises: ValueError for a recipe without frames, without dark frames or without two lit levels,
    and for a wrong statement.
    """
    study_run, statements = StudyRun("sheet", recipe, command), statements or SheetStatements()
    operating_facts = operating_point(statements.state, stated(recipe))
    laboratory = laboratory_of(recipe)
    photons_told = not (statements.relative or is_relative(recipe))
    frames = frames_of_recipe(recipe, store, statements.release)
    sheet = emva_sheet(frames.levels, frames.spatial, photons_told=photons_told)
    budgets = sheet_budgets(frames.levels, sheet, laboratory, photons_told)
    document = study_run.document(
        _document(sheet, frames, operating_facts, statements.release is not None)
    )
    report = _report(recipe, sheet, frames, operating_facts, document, budgets)
    return study_run.write(runs, digest(document["quantities"]), document, report, "emva1288")


def _document(
    sheet: EmvaSheet, frames: EmvaFrames, statements: Mapping[str, Any], by_user: bool
) -> dict[str, Any]:
    """Return the content of ``emva1288.json``; ``by_user`` is True if the user chose the
    release.
    """
    return {
        "standard": "EMVA 1288, release 4.0 Linear",
        "temporal variance": temporal_variance(frames, by_user),
        "fails": banner(sheet, frames.tests),
        "quantities": {
            q.key: {"section": group_of(q, sheet), **asdict(q)} for q in sheet.quantities
        },
        "operating point": dict(statements),
        "frames": as_rows(frames.tests),
        "demands": [demand._asdict() for demand in requirements(sheet, frames, statements)],
        "deviation": None if sheet.linearity is None else sheet.linearity.deviation.tolist(),
    }


def _report(
    recipe: Recipe,
    sheet: EmvaSheet,
    frames: EmvaFrames,
    statements: Mapping[str, Any],
    document: Mapping[str, Any],
    budgets: Sequence[Budget],
) -> StudyReport:
    """Return page, pictures, tables and files of an EMVA 1288 sheet."""
    title, pictures = f"{recipe.name}: EMVA 1288", emva_figures.pictures(sheet)
    main_budgets = [
        budget_pictures for budget_pictures in budgets if budget_pictures.key in BUDGETED
    ]
    budget_pictures = {"budget": budget_picture(main_budgets)} if main_budgets else {}
    uncertainty_sections = budget_sections(
        main_budgets, stated(recipe), budget_pictures.get("budget"), _FURTHER_BUDGETS
    )
    pdf_lines = [
        f"{name}: {'not stated' if statements[key] is None else statements[key]}"
        for key, name in OPERATING_POINT.items()
    ]
    pdf_lines += [document["temporal variance"], _PLUS, document["fails"]]
    return StudyReport(
        title,
        lead(sheet, document["temporal variance"]),
        sections(sheet, frames, statements, pictures, uncertainty_sections),
        pictures | budget_pictures,
        tables={
            "emva1288.csv": (_COLUMNS, _rows(sheet)),
            "transfer.csv": (_TRANSFER, _levels(sheet)),
            "budget.csv": (COLUMNS, budget_rows(budgets)),
            **pattern_tables(sheet),
        },
        files={
            "emva1288.json": as_json(document),
            "budget.json": as_json(budget_document(budgets, stated(recipe))),
            "emva1288.pdf": emva_figures.pdf(sheet, title, pdf_lines, budgets),
        },
        banner=document["fails"],
    )


def _rows(sheet: EmvaSheet) -> Iterator[tuple[Any, ...]]:
    """Yield a row of ``emva1288.csv`` for each quantity."""
    for q in sheet.quantities:
        value = "" if q.value is None else repr(q.value)
        yield group_of(q, sheet), q.key, q.symbol, q.name, q.bound, value, q.unit, q.reason


def _levels(sheet: EmvaSheet) -> Iterator[tuple[float, ...]]:
    """Yield a row of ``transfer.csv`` for each lit level."""
    yield from zip(*(getattr(sheet.transfer, name).tolist() for name in _TRANSFER), strict=True)
