"""The folder of an estimate of safety: page, pictures, table and document."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.report.study_folder import StudyReport, StudyRun
from neusee.workflows.report.study_page import Section
from neusee.workflows.safety.dazzle_curves import Dazzled
from neusee.workflows.safety.safety_estimate import CERTIFICATE, Estimate, Finding, Prepared, complete, prepare
from neusee.workflows.safety.safety_page import report
from neusee.workflows.safety.safety_text import paragraphs
from neusee.workflows.store.memo import compute_once
from neusee.workflows.store.result_store import Store


@dataclass(frozen=True)
class Assessment:
    """A finished estimate as the store keeps it: its document, its text for a terminal, and its page with pictures."""

    document: dict[str, Any]
    paragraphs: list[list[str]]
    title: str
    lead: str
    sections: list[dict[str, Any]]  #: as `Section`, with the marks as a list of row, column and mark
    pictures: dict[str, bytes]
    rows: list[list[Any]]  #: of limits.csv, the header first

    @property
    def report(self) -> StudyReport:
        """Return the page of the estimate with its files."""
        sections = [
            Section(**{**each, "marks": {(row, column): mark for row, column, mark in each["marks"]}})
            for each in self.sections
        ]
        return StudyReport(
            self.title, self.lead, sections, self.pictures, {"limits.csv": (self.rows[0], self.rows[1:])}
        )


def assess(recipe: Recipe, store: Store, out: Path, command: Sequence[str]) -> tuple[Path, Assessment]:
    """Estimate damage, dazzle and eye exposure, or take the estimate from the store, and write the folder.

    Raises `RecipeError` for a recipe that cannot be estimated, and `RunError` if a step of its mask fails.
    """
    run = StudyRun("safety", recipe, command)
    prepared = prepare(recipe, store)
    key = key_of(recipe, prepared, store)
    found = compute_once(store, key, Assessment, lambda: _assessed(complete(recipe, prepared)), {"step": "safety"})
    return run.write(out, key, run.document(found.document), found.report, "safety"), found


def key_of(recipe: Recipe, prepared: Prepared, store: Store) -> str:
    """Return the key of an estimate: values, draws, laws, what the steps say of lens and mask, and the code."""
    code = Code(store.code_memo)
    modules = [code.digest(f"neusee.nodes.{family}") for family in ("laser", "sensor")]
    draws = {name: values.tobytes().hex() for name, values in prepared.draws.values.items()}
    spots = [(each.option, each.pitch, each.light.tobytes().hex()) for each in prepared.spots]
    ranked = [(each.arm, each.held, each.stray, *(x.tobytes().hex() for x in (each.count, each.level, each.smooth)))
              for each in prepared.ranked]  # fmt: skip
    options = [asdict(each) for each in prepared.options]
    laws = [tuple(law) for law in prepared.safety.laws]
    values = (recipe.name, recipe.title, recipe.config.to_yaml(), recipe.seed, prepared.safety.settings.draws)
    key = digest("safety", values, draws, spots, ranked, options, laws, modules, engine("safety.run_safety"))
    code.save()
    return key


def _assessed(found: Estimate) -> Assessment:
    """Return an estimate as the store keeps it."""
    page = report(found)
    pictures = {name: picture for name, picture in page.pictures.items() if picture}
    header, rows = page.tables["limits.csv"]
    sections = [
        {**vars(each), "marks": [[*place, mark] for place, mark in each.marks.items()]} for each in page.sections
    ]
    plain = [list(header), *(list(row) for row in rows)]
    return Assessment(document(found), paragraphs(found), page.title, page.lead, sections, pictures, plain)


def document(found: Estimate) -> dict[str, Any]:
    """Return an estimate as a document of JSON values."""
    beam, at = found.exposures.beams[0], found.at
    return {
        "certificate": CERTIFICATE,
        "laser": found.safety.name,
        "emission": found.emission,
        "beam": beam._asdict(),
        "distance": found.safety.laser.distance,
        "share_at_the_lens": float(found.exposures.lens[0, at]),
        "draws": found.draws.count,
        "laws": dict(found.draws.laws),
        "limits": [_finding(each) for each in found.findings],
        "dazzled": [_dazzled(each) for each in found.dazzled],
        "stray_light": any(each.stray for each in found.ranked),
        "dead_pixels": [{name: value for name, value in vars(each).items() if name != "frame"} for each in found.dead],
        "eye": asdict(found.eye) if found.eye else None,
        "not_said": list(found.unsaid),
    }


def _dazzled(each: Dazzled) -> dict[str, Any]:
    return {
        "protection": each.option,
        "pixels": asdict(each.pixels) if each.pixels else None,
        "share": each.share,
        "times_plain_lens": each.times,
    }


def _finding(each: Finding) -> dict[str, Any]:
    return {
        "protection": each.option,
        "limit": each.limit.name,
        "effect": each.limit.effect,
        "quantity": each.limit.quantity,
        "on_sensor": asdict(each.at_sensor),
        "at_lens": asdict(each.at_lens),
        "exposure": asdict(each.exposure),
        "ratio": each.ratio,
        "probability": asdict(each.probability) if each.probability else None,
        "zones": [asdict(zone) for zone in each.zones.zones],
        "probability_of_nowhere": each.zones.none,
        "probability_here": each.zones.inside,
        "source": each.limit.source,
        "spot": each.limit.note,
    }
