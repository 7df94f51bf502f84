"""The command ``neusee calibrate``: the posterior of a recipe's sensor, and the folder with the
results.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from neusee.nodes.calibrate import FrameTest, Laboratory, Rings
from neusee.nodes.values import Levels
from neusee.workflows.calibration.calibration_page import (
    NOT_TOLD,
    CalibrationResult,
    agreement,
    banner,
    compared,
    estimated_models,
    lead,
    sections,
)
from neusee.workflows.calibration.frame_validity import (
    ModelSpread,
    as_rows,
    compare_models,
    data_check,
    frame_checks,
    frame_section,
    hidden_checks,
    inspect_recipe,
    lines,
    widened,
    widened_models,
)
from neusee.workflows.calibration.identifiability import identify, identify_from_draws
from neusee.workflows.calibration.log_posterior import LaplaceFit, SensorPosterior, search_mode
from neusee.workflows.calibration.posterior_checks import (
    Check,
    arviz,
    checks,
    count_failures,
    importance_samples,
    is_camera,
)
from neusee.workflows.calibration.uncertainty_budget import (
    COLUMNS,
    budget_document,
    budget_rows,
    budgets,
    is_relative,
    laboratory_of,
    stated,
    with_laboratory,
    with_laboratory_models,
    without_efficiency,
)
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.code_digest import engine
from neusee.workflows.report.study_report import (
    Content,
    CsvTable,
    Progress,
    StudyReport,
    StudyRun,
    as_json,
    silent,
)
from neusee.workflows.store.result_store import Store

_STORED_DRAWS = 4000  #: draws in the file ``draws.npz``


class CalibrationRefused(ValueError):
    """Error raised if the levels constrain the sensor too weakly for a useful posterior."""


class FramesRefused(CalibrationRefused):
    """Error raised if no likelihood describes the frames; ``tests`` has the tests of the frames."""

    def __init__(self, tests: Sequence[FrameTest]) -> None:
        self.tests = tests
        super().__init__(
            "; ".join(f"{t.name}: {t.sentence}" for t in tests if t.verdict == "refused")
        )


@dataclass(frozen=True)
class CalibrationOptions:
    """Number of draws of a calibration, and settings of its walkers."""

    walkers: int = 64  #: in each of the four ensembles
    move: str = "de"  #: ``"de"`` or ``"stretch"``
    draws: int = 1000  #: least effective number of independent draws


def calibrate(
    recipe: Recipe,
    store: Store,
    runs: Path,
    command: Sequence[str] = (),
    progress: Progress = silent,
    options: CalibrationOptions | None = None,
) -> Path:
    """Draw from the posterior of the sensor of ``recipe``, and return the folder with the results.

    A second call continues an interrupted calibration and does not repeat draws. Where the frames
    are refused, nothing is drawn, and the page and the document have the tests of the frames and no
    parameter. Raises: `CalibrationRefused` before any sampling if the levels constrain the sensor
    too little, `ValueError` for a recipe without a likelihood.
    """
    study_run = StudyRun("calibrate", recipe, command)
    try:
        result = find_posterior(recipe, store, progress, options or CalibrationOptions())
    except FramesRefused as refused:
        document = study_run.document(_refused_document(refused))
        return study_run.write(
            runs,
            digest(document["frames"]),
            document,
            _refused_report(recipe, document, refused),
            "posterior",
        )
    document = study_run.document(_document(result))
    return study_run.write(
        runs, digest(document["parameters"]), document, _report(result, document), "posterior"
    )


def find_posterior(
    recipe: Recipe, store: Store, progress: Progress, options: CalibrationOptions
) -> CalibrationResult:
    """Compute the posterior of a recipe's sensor, with identifiability, checks and models of the
    response.
    """
    from neusee.workflows.calibration import emcee_sampler

    emcee_sampler.move(options.move)  # raises for a wrong name before anything is computed
    # raises before anything is computed where ArviZ is missing
    arviz()
    laboratory = laboratory_of(recipe)
    tests = _accepted_frames(recipe, store, progress)
    problem = SensorPosterior.of(recipe, store)
    mode = search_mode(problem)
    identifiability = identify(problem, mode)
    if identifiability.refused:
        raise CalibrationRefused(identifiability.refused)
    samples = importance_samples(problem, mode, recipe.seed)
    # the normal approximation at the mode does not describe a long, curved posterior
    if problem.coordinates.bent:
        identifiability = identify_from_draws(
            problem, mode, identifiability, samples.samples, samples.weights
        )
    for line in identifiability.directions:
        progress(f"not identifiable: {line}")
    chains = emcee_sampler.sample(
        problem,
        mode,
        _draws_file(store, problem, options),
        emcee_sampler.Sampling(recipe.seed, options.walkers, options.move, options.draws),
        progress,
        samples.guide,
    )
    models = _models_of_response(recipe, store, problem)
    all_checks = [
        *frame_checks(tests, not isinstance(problem.levels, Rings)),
        *_data_checks(problem, mode, tests),
        *checks(problem, mode, identifiability, chains, samples),
    ]
    result = CalibrationResult(problem, mode, identifiability, chains, all_checks, models, tests)
    result = _widened(result, laboratory)
    # only for a real camera must the standard's fit and the posterior agree
    if not is_camera(problem):
        return result
    return replace(result, checks=[*all_checks, *agreement(result.beside)])


def _models_of_response(
    recipe: Recipe, store: Store, problem: SensorPosterior
) -> list[ModelSpread]:
    """Return the posteriors for several models of the response; empty for rings around a source."""
    if not isinstance(problem.levels, Levels):
        return []
    return compare_models(recipe, store, recipe.seed)


def _draws_file(store: Store, problem: SensorPosterior, options: CalibrationOptions) -> Path:
    """Return the path in the store of the chains of a posterior."""
    seed = problem.recipe.seed
    code = engine("calibration.emcee_sampler")
    key = digest("posterior", code, problem.key, options.walkers, options.move, seed)
    return store.root / "posterior" / f"{key}.h5"


def _data_checks(
    problem: SensorPosterior, mode: LaplaceFit, tests: Sequence[FrameTest]
) -> list[Check]:
    """Return checks on faults that the frames may hide, and on the amount of data; empty without
    frames.
    """
    checks = hidden_checks(tests, problem.coordinates.prior.may_hide)
    if not checks or not isinstance(problem.levels, Levels):
        return checks
    levels = problem.levels
    is_fitted = problem.likelihood(mode.theta[None]).degrees_of_freedom > 0
    return [
        *checks,
        data_check(float(levels.degrees_of_freedom[is_fitted & (levels.photons > 0)].sum())),
    ]


def _widened(result: CalibrationResult, laboratory: Laboratory) -> CalibrationResult:
    """Return a calibration widened by the errors that frames and laboratory leave open, with its
    uncertainty budgets.
    """
    problem, tests = result.problem, result.frames
    identifiability = result.identifiability
    chains = widened(problem, result.chains, tests, problem.recipe.seed)
    models = widened_models(result.models, tests, problem.coordinates.prior.may_hide)
    if is_relative(problem.recipe):
        identifiability = without_efficiency(identifiability)
    result = replace(
        result,
        identifiability=identifiability,
        chains=with_laboratory(problem, chains, laboratory, problem.recipe.seed),
        models=with_laboratory_models(models, laboratory),
        walk=result.chains,
    )
    return replace(result, budgets=budgets(result, laboratory))


def _accepted_frames(recipe: Recipe, store: Store, progress: Progress) -> Sequence[FrameTest]:
    """Return the tests of the frames of a calibration; raise `FramesRefused` if no likelihood
    describes the frames.
    """
    tests = inspect_recipe(recipe, store)
    for line in lines(tests):
        progress(line)
    if any(test.verdict == "refused" for test in tests):
        raise FramesRefused(tests)
    return tests


def _refused_document(refused: FramesRefused) -> dict[str, Any]:
    """Return the JSON document of a calibration with refused frames, without parameter values."""
    checks = frame_checks(refused.tests)
    return {
        "failed": count_failures(checks),
        "parameters": {},
        "frames": as_rows(refused.tests),
        "checks": [asdict(check) for check in checks],
    }


def _refused_report(
    recipe: Recipe, document: Mapping[str, Any], refused: FramesRefused
) -> StudyReport:
    """Return the page of a calibration whose frames are refused: their tests, and no parameter."""
    lead_text = (
        "The frames are refused, and nothing was drawn: no likelihood describes them, so no"
        " parameter is stated."
    )
    files: dict[str, Content] = {"posterior.json": as_json(document)}
    banner_text = f"Not fit for use: {document['failed']} tests of the frames fail. {refused}."
    return StudyReport(
        f"{recipe.name}: frames refused",
        lead_text,
        [frame_section(refused.tests)],
        files=files,
        banner=banner_text,
    )


def _document(result: CalibrationResult) -> dict[str, Any]:
    """Return the results of a calibration for ``posterior.json``."""
    problem, all_draws = result.problem, result.chains.flat
    columns = [i for i, name in enumerate(problem.names) if name in result.identifiability.told]
    return {
        "failed": count_failures(result.checks),
        "parameters": {row.name: _plain(asdict(row)) for row in result.rows()},
        "gaussian": {
            "coordinates": [problem.coordinates.labels[i] for i in columns],
            "mean": all_draws[:, columns].mean(0).tolist(),
            "covariance": np.cov(all_draws[:, columns].T).reshape(len(columns), -1).tolist(),
        },
        "stated": {model.name: asdict(model.stated) for model in estimated_models(result)},
        "least_squares": compared(result.beside),
        "frames": as_rows(result.frames),
        "not told": list(result.identifiability.directions),
        "checks": [asdict(check) for check in result.checks],
    }


def _plain(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the results of a parameter without the fields that the frames do not determine."""
    not_told = NOT_TOLD[row["kind"]]
    stated_values = {name: value for name, value in row.items() if name not in not_told}
    return {
        name: None if isinstance(x, float) and not math.isfinite(x) else x
        for name, x in stated_values.items()
    }


def _report(result: CalibrationResult, document: Mapping[str, Any]) -> StudyReport:
    """Return page, pictures, tables and files of a calibration."""
    page_sections = sections(result)
    first_name = "rings" if isinstance(result.problem.levels, Rings) else "transfer"
    pictures: dict[str, bytes | None] = {
        name: section.picture
        # the last three sections are the curve, the pairs and the chains
        for name, section in zip((first_name, "corner", "chains"), page_sections[-3:], strict=True)
    }
    pictures["budget"] = result.budget_picture
    files: dict[str, Content] = {
        "posterior.json": as_json(document),
        "budget.json": as_json(budget_document(result.budgets, stated(result.problem.recipe))),
        "draws.npz": _draws(result),
        "posterior.nc": lambda path: _inference_data(result).to_netcdf(str(path)),
    }
    title = f"{result.problem.recipe.name}: posterior"
    tables: dict[str, CsvTable] = {"budget.csv": (COLUMNS, budget_rows(result.budgets))}
    return StudyReport(
        title, lead(result), page_sections, pictures, tables, files, banner=banner(result)
    )


def _draws(result: CalibrationResult) -> bytes:
    """Return the bytes of an npz file with evenly selected posterior draws of each parameter that
    the frames constrain.
    """
    stride = max(1, result.chains.flat.shape[0] // _STORED_DRAWS)
    npz_file = io.BytesIO()
    draws: dict[str, Any] = {
        name: result.draws[name].reshape(-1)[::stride] for name in result.identifiability.told
    }
    np.savez(npz_file, **draws)
    return npz_file.getvalue()


def _inference_data(result: CalibrationResult) -> Any:
    """Return the draws of the constrained parameters as ArviZ inference data; each walker is a
    chain.
    """
    chains = result.chains

    def by_walker(draws: Any) -> Any:
        return draws.transpose(0, 2, 1).reshape(-1, draws.shape[1])

    posterior = {name: by_walker(result.draws[name]) for name in result.identifiability.told}
    attributes = {"recipe": result.problem.recipe.name, "inference_library": "emcee"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ArviZ warns of more walkers than steps
        data = arviz().from_dict(
            posterior, sample_stats={"lp": by_walker(chains.log)}, attrs=attributes
        )
    for group in data.groups():
        # the date is that of the command, in provenance.json
        data[group].attrs.pop("created_at", None)
    return data
