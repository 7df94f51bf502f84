"""The result folder of a safety estimate: page, pictures, table and JSON document."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from neusee.nodes.laser import BrightPixels
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.code_digest import Code, engine
from neusee.workflows.report.study_report import Marked, Section, StudyReport, StudyRun
from neusee.workflows.safety.damage_pattern import DeadPixels
from neusee.workflows.safety.exposures import Spread
from neusee.workflows.safety.laser_spots import Veil
from neusee.workflows.safety.safety_estimate import (
    CERTIFICATE,
    DamageRow,
    DamageVerdict,
    Dazzled,
    Estimate,
    Finding,
    Prepared,
    complete,
    prepare,
)
from neusee.workflows.safety.safety_page import report
from neusee.workflows.safety.safety_text import damage_sentence, is_bracket, paragraphs
from neusee.workflows.safety.worksheet import worksheet_page
from neusee.workflows.store.result_store import Store, compute_once


@dataclass(frozen=True)
class Assessment:
    """A finished estimate in the form that the store keeps: JSON document, text for a terminal, and
    page with pictures.
    """

    document: dict[str, Any]
    paragraphs: list[list[str]]
    title: str
    lead: str
    #: fields of each `Section`; a `Marked` cell is a mapping of value and mark
    sections: list[dict[str, Any]]
    pictures: dict[str, bytes]
    rows: list[list[Any]]  #: of limits.csv, the header first
    worksheet: str  #: of worksheet.html, to print

    @property
    def report(self) -> StudyReport:
        """Return the page of the estimate with its files."""
        return StudyReport(
            self.title,
            self.lead,
            [_section(stored_section) for stored_section in self.sections],
            self.pictures,
            {"limits.csv": (self.rows[0], self.rows[1:])},
            {"worksheet.html": self.worksheet},
        )


def _section(plain: Mapping[str, Any]) -> Section:
    """Return a section from its stored form."""
    rows = [
        [Marked(**cell) if isinstance(cell, dict) else cell for cell in row]
        for row in plain["rows"]
    ]
    return Section(**{**plain, "rows": rows})


def _plain_section(section: Section) -> dict[str, Any]:
    """Return a section in its stored form."""
    rows = [
        [
            {"value": cell.value, "mark": cell.mark} if isinstance(cell, Marked) else cell
            for cell in row
        ]
        for row in section.rows
    ]
    return {**vars(section), "rows": rows}


def assess(
    recipe: Recipe, store: Store, out: Path, command: Sequence[str]
) -> tuple[Path, Assessment]:
    """Compute a safety estimate, or take it from the store, and write the result folder.

    Raises `RecipeError` for a recipe that cannot be estimated, and `RunError` if a step of its mask
    fails.
    """
    run = StudyRun("safety", recipe, command)
    prepared = prepare(recipe, store)
    key = key_of(recipe, prepared, store)
    assessment = compute_once(
        store, key, Assessment, lambda: _assessed(complete(recipe, prepared)), {"step": "safety"}
    )
    return run.write(
        out, key, run.document(assessment.document), assessment.report, "safety"
    ), assessment


def _as_text(groups: BrightPixels) -> list[str]:
    """Return the bytes of each array in groups of pixels as hexadecimal text."""
    return [tensor.numpy().tobytes().hex() for tensor in groups]


def key_of(recipe: Recipe, prepared: Prepared, store: Store) -> str:
    """Return the cache key of an estimate, from values, draws, laws, results of the recipe's steps
    for lens and mask, and the code.
    """
    code = Code(store.code_memo)
    modules = [
        code.digest(f"neusee.nodes.{family}") for family in ("flare", "laser", "sensor", "spectra")
    ]
    draws = {name: values.tobytes().hex() for name, values in prepared.draws.values.items()}
    spots = [(spot.option, spot.pitch, spot.light.tobytes().hex()) for spot in prepared.spots]
    ranked = [
        (pixels.arm, pixels.distances, pixels.misses, list(map(_as_text, pixels.groups)))
        for pixels in prepared.ranked
    ]
    options = [*map(asdict, prepared.options), prepared.peaks.outside if prepared.peaks else ()]
    laws = [tuple(law) for law in prepared.safety.laws]
    channels = prepared.safety.channels.key if prepared.safety.channels else ""
    values = (
        recipe.name,
        recipe.title,
        recipe.config.to_yaml(),
        recipe.seed,
        prepared.safety.settings.draws,
    )
    key = digest(
        "safety",
        values,
        draws,
        spots,
        ranked,
        options,
        laws,
        channels,
        modules,
        engine("safety.run_safety"),
    )
    code.save()
    return key


def _assessed(estimate: Estimate) -> Assessment:
    """Return an estimate in its stored form."""
    page = report(estimate)
    pictures = {name: picture for name, picture in page.pictures.items() if picture}
    header, rows = page.tables["limits.csv"]
    table_rows = [list(header), *(list(row) for row in rows)]
    return Assessment(
        document=document(estimate),
        paragraphs=paragraphs(estimate),
        title=page.title,
        lead=page.lead,
        sections=[_plain_section(section) for section in page.sections],
        pictures=pictures,
        rows=table_rows,
        worksheet=worksheet_page(estimate),
    )


def document(estimate: Estimate) -> dict[str, Any]:
    """Return an estimate as a document of JSON values."""
    beam, index = estimate.exposures.beams[0], estimate.at
    return {
        "certificate": CERTIFICATE,
        "laser": estimate.safety.name,
        "emission": estimate.emission,
        "beam": beam._asdict(),
        "distance": estimate.safety.laser.distance,
        "share_at_the_lens": float(estimate.exposures.lens[0, index]),
        "draws": estimate.draws.count,
        "laws": dict(estimate.draws.laws),
        "damage": [_verdict(verdict, estimate) for verdict in estimate.damage],
        "limits": [_finding(finding) for finding in estimate.findings],
        "dazzled": [_dazzled(area) for area in estimate.dazzled],
        **_veil(estimate.veil),
        "focus": estimate.safety.settings.lens.focus,
        "spots_at": {pixels.arm: list(pixels.distances) for pixels in estimate.ranked},
        "dead_pixels": [_dead_pixels(dead) for dead in estimate.dead],
        "what_helps": [asdict(remedy) for remedy in estimate.helps],
        "eye": asdict(estimate.eye) if estimate.eye else None,
        "eye_dazzle": asdict(estimate.eye_dazzle),
        "not_said": list(estimate.unsaid),
    }


def _veil(veil: Veil | None) -> dict[str, Any]:
    """Return the JSON entries for the share of the light that the lens scatters."""
    if veil is None:
        return {"scattered_share": None, "scattered_share_is_assumed": False}
    share = Spread.of(float(veil.share[0]), veil.share[1:])
    return {"scattered_share": asdict(share), "scattered_share_is_assumed": veil.assumed}


def _dead_pixels(dead: DeadPixels) -> dict[str, Any]:
    """Return an example of damage as JSON values, without its picture."""
    return {name: value for name, value in vars(dead).items() if name != "frame"}


def _verdict(verdict: DamageVerdict, estimate: Estimate) -> dict[str, Any]:
    """Return the verdict of damage behind one protection as JSON values."""
    return {
        "protection": verdict.option,
        "verdict": verdict.state,
        "sentence": damage_sentence(verdict, estimate),
        "rows": [_row(row) for row in verdict.rows],
    }


def _row(row: DamageRow) -> dict[str, Any]:
    """Return one part of the light with its limit as JSON values, None where it is not judged."""
    finding = row.finding
    return {
        "part": row.part,
        "damage": row.kind,
        "state": row.state,
        "reason": row.reason or None,
        "limit": finding.limit.name if finding else None,
        "quantity": finding.limit.quantity if finding else None,
        "threshold": asdict(finding.at_sensor) if finding else None,
        "exposure": asdict(finding.exposure) if finding else None,
        "ratio": asdict(finding.ratios) if finding and finding.ratios else None,
        "source": finding.limit.source if finding else None,
        "note": finding.limit.note if finding else None,
    }


def _dazzled(area: Dazzled) -> dict[str, Any]:
    return {
        "protection": area.option,
        "pixels": asdict(area.pixels),
        "share": area.share,
        "times_plain_lens": area.times,
    }


def _finding(finding: Finding) -> dict[str, Any]:
    """Return the comparison with one limit behind one protection as JSON values."""
    return {
        "protection": finding.option,
        "limit": finding.limit.name,
        "effect": finding.limit.effect,
        "quantity": finding.limit.quantity,
        "on_sensor": asdict(finding.at_sensor),
        "at_lens": asdict(finding.at_lens),
        "exposure": asdict(finding.exposure),
        "ratio": finding.ratio,
        "probability": asdict(finding.probability) if finding.probability else None,
        "zones": [asdict(zone) for zone in finding.zones.zones],
        "probability_of_nowhere": None if is_bracket(finding) else finding.zones.none,
        "probability_here": None if is_bracket(finding) else finding.zones.inside,
        "source": finding.limit.source,
        "spot": finding.limit.note,
    }
