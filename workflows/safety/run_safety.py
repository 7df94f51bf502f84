"""The folder of an estimate of safety: page, pictures, table and document."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.report.study_folder import StudyRun
from neusee.workflows.safety.safety_estimate import CERTIFICATE, Estimate, Finding, estimate
from neusee.workflows.safety.safety_page import report
from neusee.workflows.store.result_store import Store


def assess(
    recipe: Recipe, store: Store | None, out: Path, command: Sequence[str]
) -> tuple[Estimate, Path, dict[str, Any]]:
    """Estimate damage, dazzle and eye exposure, write the folder, and return estimate, folder and document.

    Raises `RecipeError` for a recipe that cannot be estimated, and `RunError` if a step of its mask fails.
    """
    run = StudyRun("safety", recipe, command)
    found = estimate(recipe, store)
    content = document(found)
    folder = run.write(out, digest(recipe.config.to_yaml()), run.document(content), report(found), "safety")
    return found, folder, content


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
        "eye": asdict(found.eye) if found.eye else None,
        "not_said": list(found.unsaid),
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
