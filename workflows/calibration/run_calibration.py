"""``neusee calibrate``: from a recipe's levels to a folder with the posterior, its checks and its pictures."""

from __future__ import annotations

import io
import json
import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from neusee.nodes.values import Levels
from neusee.workflows.calibration.calibration_page import Finding, banner, lead, sections
from neusee.workflows.calibration.identifiability import known
from neusee.workflows.calibration.initial_guess import begin
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.model_spread import spread
from neusee.workflows.calibration.posterior_checks import arviz, checks, failed, weighed
from neusee.workflows.calibration.posterior_mode import peak
from neusee.workflows.engine.provenance import timestamp, versions
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.report.run_folder import RunFolder, new_run
from neusee.workflows.report.study_page import page
from neusee.workflows.store.result_store import Store

Tell = Callable[[str], None]
_KEPT = 4000  #: draws that go into the folder


class Refused(ValueError):
    """The levels tell too little for any posterior to be worth drawing from."""


def calibrate(
    recipe: Recipe,
    store: Store,
    runs: Path,
    command: Sequence[str] = (),
    tell: Tell = lambda line: None,
    *,
    walkers: int = 64,
    move: str = "de",
    draws: int = 1000,
) -> Path:
    """Find the posterior of ``recipe``'s sensor and write it; the folder.

    Goes on where an earlier call was interrupted, and draws nothing where it was not. Raises `Refused` before anything
    is drawn where the levels tell too little, ValueError for a recipe that does not calibrate.
    """
    began = time.perf_counter()
    finding = found(recipe, store, tell, walkers=walkers, move=move, draws=draws)
    doc = _document(finding, command, time.perf_counter() - began)
    with new_run(runs, f"{recipe.name}_posterior", digest(doc["parameters"])) as folder:
        _write(folder, finding, doc)
    return folder.path


def found(recipe: Recipe, store: Store, tell: Tell, *, walkers: int, move: str, draws: int) -> Finding:
    """The posterior with all that is known of it."""
    from neusee.workflows.calibration import emcee_sampler

    emcee_sampler.move(move)  # refused before anything is computed
    arviz()
    problem = SensorPosterior.of(recipe, store)
    top = peak(problem, begin(problem))
    told = known(problem, top)
    if told.refused:
        raise Refused(told.refused)
    for line in told.directions:
        tell(f"not told: {line}")
    key = digest("posterior", engine("calibration.emcee_sampler"), problem.key, walkers, move, recipe.seed)
    file = store.root / "posterior" / f"{key}.h5"
    chains = emcee_sampler.sample(
        problem, top, file, seed=recipe.seed, walkers=walkers, how=move, wanted=draws, tell=tell
    )
    law = weighed(problem, top, recipe.seed)
    models = spread(recipe, store, recipe.seed) if isinstance(problem.levels, Levels) else []
    return Finding(problem, top, told, chains, checks(problem, top, told, chains, law), models)


def _document(finding: Finding, command: Sequence[str], seconds: float) -> dict[str, Any]:
    problem, flat = finding.problem, finding.chains.flat
    return {
        "study": "calibrate",
        "recipe": problem.recipe.name,
        "command": " ".join(command),
        "date": timestamp(),
        "seconds": seconds,
        "failed": failed(finding.checks),
        "parameters": {row.name: _plain(asdict(row)) for row in finding.rows()},
        "gaussian": {
            "coordinates": list(problem.coordinates.labels),
            "mean": flat.mean(0).tolist(),
            "covariance": np.cov(flat.T).reshape(len(problem.names), -1).tolist(),
        },
        "stated": {model.name: asdict(model.stated) for model in finding.models},
        "not told": list(finding.known.directions),
        "checks": [asdict(check) for check in finding.checks],
        "versions": versions(),
        "config": problem.recipe.config.to_yaml(),
    }


def _plain(row: Mapping[str, Any]) -> dict[str, Any]:
    """With no mean and deviation where there is no estimate: nobody shall take them for one."""
    kept = {name: value for name, value in row.items() if row["kind"] == "estimate" or name not in ("mean", "sd")}
    return {name: None if isinstance(x, float) and not math.isfinite(x) else x for name, x in kept.items()}


def _write(folder: RunFolder, finding: Finding, doc: Mapping[str, Any]) -> None:
    told = {name: doc[name] for name in ("command", "date", "seconds", "versions")}
    parts = sections(finding)
    for name, section in zip(("transfer", "corner", "chains"), parts[-3:], strict=True):
        if section.picture:
            folder.write(f"figures/{name}.png", section.picture)
    folder.write("posterior.json", json.dumps(doc, indent=1, ensure_ascii=False))
    folder.write("provenance.json", json.dumps(doc, indent=1, ensure_ascii=False))
    folder.write("draws.npz", _draws(finding))
    _inference_data(finding).to_netcdf(str(folder.path / "posterior.nc"))
    folder.write(
        "report.html", page(f"{finding.problem.recipe.name}: posterior", lead(finding), parts, told, banner(finding))
    )


def _draws(finding: Finding) -> bytes:
    """Parameters by name, evenly from all chains."""
    every = max(1, finding.chains.flat.shape[0] // _KEPT)
    out = io.BytesIO()
    draws: dict[str, Any] = {name: x.reshape(-1)[::every] for name, x in finding.draws.items()}
    np.savez(out, **draws)
    return out.getvalue()


def _inference_data(finding: Finding) -> Any:
    """ArviZ's, each walker a chain."""
    chains = finding.chains

    def by_walker(draws: Any) -> Any:
        return draws.transpose(0, 2, 1).reshape(-1, draws.shape[1])

    posterior = {name: by_walker(x) for name, x in finding.draws.items()}
    attributes = {"recipe": finding.problem.recipe.name, "inference_library": "emcee"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of more walkers than steps
        return arviz().from_dict(posterior, sample_stats={"lp": by_walker(chains.log)}, attrs=attributes)
