"""The folder of an estimate of safety: page, pictures, table and document."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from neusee.nodes.laser import BrightPixels
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.report.study_folder import StudyReport, StudyRun
from neusee.workflows.report.study_page import Section
from neusee.workflows.safety.damage_verdict import DamageRow, DamageVerdict
from neusee.workflows.safety.damage_words import damage_sentence, is_bracket
from neusee.workflows.safety.dazzle_curves import Dazzled
from neusee.workflows.safety.dead_pixels import DeadPixels
from neusee.workflows.safety.distance_zones import Spread
from neusee.workflows.safety.light_levels import Veil
from neusee.workflows.safety.safety_estimate import CERTIFICATE, Estimate, Finding, Prepared, complete, prepare
from neusee.workflows.safety.safety_page import report
from neusee.workflows.safety.safety_text import paragraphs
from neusee.workflows.safety.worksheet import worksheet_page
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
    worksheet: str  #: of worksheet.html, to print

    @property
    def report(self) -> StudyReport:
        """Return the page of the estimate with its files."""
        sections = [
            Section(**{**each, "marks": {(row, column): mark for row, column, mark in each["marks"]}})
            for each in self.sections
        ]
        return StudyReport(
            self.title,
            self.lead,
            sections,
            self.pictures,
            {"limits.csv": (self.rows[0], self.rows[1:])},
            {"worksheet.html": self.worksheet},
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


def _as_text(groups: BrightPixels) -> list[str]:
    """Return the numbers of groups of pixels as text of their bytes."""
    return [part.numpy().tobytes().hex() for part in groups]


def key_of(recipe: Recipe, prepared: Prepared, store: Store) -> str:
    """Return the key of an estimate: values, draws, laws, what the steps say of lens and mask, and the code."""
    code = Code(store.code_memo)
    modules = [code.digest(f"neusee.nodes.{family}") for family in ("flare", "laser", "sensor", "spectra")]
    draws = {name: values.tobytes().hex() for name, values in prepared.draws.values.items()}
    spots = [(each.option, each.pitch, each.light.tobytes().hex()) for each in prepared.spots]
    ranked = [(each.arm, each.distances, each.misses, list(map(_as_text, each.groups))) for each in prepared.ranked]
    options = [*map(asdict, prepared.options), prepared.peaks.outside if prepared.peaks else ()]
    laws = [tuple(law) for law in prepared.safety.laws]
    channels = prepared.safety.channels.key if prepared.safety.channels else ""
    values = (recipe.name, recipe.title, recipe.config.to_yaml(), recipe.seed, prepared.safety.settings.draws)
    key = digest("safety", values, draws, spots, ranked, options, laws, channels, modules, engine("safety.run_safety"))
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
    return Assessment(
        document=document(found),
        paragraphs=paragraphs(found),
        title=page.title,
        lead=page.lead,
        sections=sections,
        pictures=pictures,
        rows=plain,
        worksheet=worksheet_page(found),
    )


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
        "damage": [_verdict(each, found) for each in found.damage],
        "limits": [_finding(each) for each in found.findings],
        "dazzled": [_dazzled(each) for each in found.dazzled],
        **_veil(found.veil),
        "focus": found.safety.settings.lens.focus,
        "spots_at": {each.arm: list(each.distances) for each in found.ranked},
        "dead_pixels": [_dead_pixels(dead) for dead in found.dead],
        "what_helps": [asdict(each) for each in found.helps],
        "eye": asdict(found.eye) if found.eye else None,
        "eye_dazzle": asdict(found.eye_dazzle),
        "not_said": list(found.unsaid),
    }


def _veil(veil: Veil | None) -> dict[str, Any]:
    """Return the share of the light that the lens scatters."""
    if veil is None:
        return {"scattered_share": None, "scattered_share_is_assumed": False}
    share = Spread.of(float(veil.share[0]), veil.share[1:])
    return {"scattered_share": asdict(share), "scattered_share_is_assumed": veil.assumed}


def _dead_pixels(dead: DeadPixels) -> dict[str, Any]:
    """Return an example of damage without its picture."""
    return {name: value for name, value in vars(dead).items() if name != "frame"}


def _verdict(each: DamageVerdict, found: Estimate) -> dict[str, Any]:
    return {
        "protection": each.option,
        "verdict": each.state,
        "sentence": damage_sentence(each, found),
        "rows": [_row(row) for row in each.rows],
    }


def _row(row: DamageRow) -> dict[str, Any]:
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


def _dazzled(each: Dazzled) -> dict[str, Any]:
    return {
        "protection": each.option,
        "pixels": asdict(each.pixels),
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
        "probability_of_nowhere": None if is_bracket(each) else each.zones.none,
        "probability_here": None if is_bracket(each) else each.zones.inside,
        "source": each.limit.source,
        "spot": each.limit.note,
    }
