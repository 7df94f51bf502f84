"""The uncertainty study: the scatter of a recipe's outputs because of uncertain values in the recipe."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.recipe.distributions.joint import Z_90
from neusee.workflows.recipe.distributions.nominal_values import told
from neusee.workflows.recipe.distributions.uncertain_inputs import SCRAMBLES, InputDraws, Inputs
from neusee.workflows.report.study_folder import Content, Progress, StudyReport, StudyRun
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.uncertainty.output_draws import Numbers, OutputDraws
from neusee.workflows.studies.uncertainty.scatter_estimate import FloatArray, Scatter, scatter, worst_known
from neusee.workflows.studies.uncertainty.sobol_indices import indices, require_salib
from neusee.workflows.studies.uncertainty.uncertainty_page import UncertaintyResult, draw_pictures, lead, sections

LEAST = 64  #: draws before the first decision to stop
_ROUND = 16  #: independent draws in each further round
PICTURED = 32  #: draws for the mean and standard deviation of pictures; the deviation is known to 13 %
_KEPT = ("mean", "sd")  #: of each picture
_COLUMNS = ("quantity", "element", "at the medians", "mean", "sd", "5 %", "95 %")


def study(
    recipe: Recipe,
    store: Store,
    runs: Path,
    command: Sequence[str],
    progress: Progress,
    error: float = 0.05,
    most: int = 1000,
    points: str = "draws",
    workers: int = 0,
    device: str = "cpu",
    until: Sequence[str] = (),
) -> Path:
    """Sample inputs, up to ``most`` times, until all output standard deviations are known to the relative ``error``.

    With ``until``, names of outputs or of single quantities, only their deviations decide. On the CPU, ``workers``
    processes compute draws; 0 means one for each free processor. Returns the folder with the results.
    """
    study_run = StudyRun("uncertainty", recipe, command)
    require_salib()
    inputs = Inputs.of(recipe)
    _chosen([name.partition(".")[0] for name in until], inputs.recipe.outputs)
    at = _points(inputs, recipe.seed, most, points)
    inputs.checked(np.concatenate([at.values, _ends(inputs)]))
    draws = OutputDraws(inputs, store, device, workers)
    result = _measure(inputs, draws, at, progress, (error, SCRAMBLES if points == "sobol" else 0, until))
    document = study_run.document(_document(result, draws))
    return study_run.write(runs, digest(document["quantities"]), document, _report(result))


def _points(inputs: Inputs, seed: int, most: int, points: str) -> InputDraws:
    if points == "sobol":
        return inputs.sobol(SCRAMBLES * 2 ** int(np.log2(max(most, LEAST) / SCRAMBLES)), seed)
    return inputs.independent(most if inputs.most is None else min(most, inputs.most), seed)


def _ends(inputs: Inputs) -> FloatArray:
    """Return the input values of each run: all at their medians, then one input at its 5 % and at its 95 % quantile."""
    count = len(inputs.names)
    return inputs.at(np.concatenate([np.zeros((1, count)), *(np.stack([-Z_90 * e, Z_90 * e]) for e in np.eye(count))]))


def _chosen(until: Sequence[str], there: Sequence[str]) -> tuple[str, ...]:
    """Return the names ``there`` that ``until`` means, or all; raise ValueError for a name that means none of them."""
    found = {name: [x for x in there if x == name or x.startswith((f"{name}.", f"{name}["))] for name in until}
    for name in (name for name, those in found.items() if not those):
        raise ValueError(f"--until {name}: no output with numbers has this name; there are {', '.join(there)}")
    return tuple(name for name in there if not until or any(name in those for those in found.values()))


def _measure(
    inputs: Inputs, draws: OutputDraws, at: InputDraws, progress: Progress, how: tuple[float, int, Sequence[str]]
) -> UncertaintyResult:
    wanted, sequences, until = how
    progress(f"{len(inputs.names)} inputs: {', '.join(inputs.names)}; {len(draws.outputs)} outputs depend on them")
    progress(f"steps that depend on no input: {draws.ready():.1f} s")
    pictures = draws.pictures(at.values[:PICTURED])
    ends = draws.numbers(_ends(inputs))
    if not ends[0]:
        raise ValueError("the outputs are pictures only: add an output with numbers, such as restored_quality")
    deciding = _chosen(until, list(ends[0]))
    what = f"standard deviations of {', '.join(until)}" if until else "every standard deviation"
    numbers: list[Numbers] = []
    used = 0
    while used < len(at.values):
        # Sobol points are evenly spread only for a power of two
        used = min(len(at.values), max(LEAST, 2 * used if sequences else used + _ROUND))
        numbers += draws.numbers(at.values[len(numbers) : used])
        values = {name: np.array([n[name] for n in numbers]) for name in ends[0]}
        scattered = {name: scatter(x, sequences) for name, x in values.items()}
        worst = worst_known({name: scattered[name] for name in deciding})
        error = scattered[worst].error
        needed = used if error <= wanted else min(len(at.values), int(used * (error / wanted) ** 2))
        progress(f"{used} draws of about {needed}: {what} to {error:.1%} ({worst})")
        if error <= wanted:
            break
    middle, swings = ends[0], _swings(inputs, ends, values, scattered)
    z = at.z[:used]
    shares = {n: indices(inputs.labels, z, values[n][:, 0], inputs.recipe.seed) for n in swings}
    rest = (pictures, draws.is_constant, wanted, sequences, deciding)
    return UncertaintyResult(inputs, InputDraws(z, at.values[:used]), values, scattered, middle, swings, shares, *rest)


def _swings(
    inputs: Inputs, ends: Sequence[Numbers], values: Mapping[str, FloatArray], scattered: Mapping[str, Scatter]
) -> dict[str, list[tuple[str, float, float]]]:
    """Return each output number with one input at its 5 % and 95 % quantile; skip numbers proportional to others."""
    found: dict[str, list[tuple[str, float, float]]] = {}
    for name, x in values.items():
        known = np.isfinite(x).all() and np.isfinite([end[name] for end in ends]).all()
        varies = known and x.shape[1] == 1 and not scattered[name].is_constant
        if varies and not any(_proportional(x[:, 0], values[other][:, 0]) for other in found):
            each = zip(inputs.labels, ends[1::2], ends[2::2], strict=True)
            found[name] = [(label, low[name][0], high[name][0]) for label, low, high in each]
    return found


def _proportional(x: FloatArray, y: FloatArray) -> bool:
    at = int(np.abs(y).argmax())
    return y[at] != 0 and bool(np.allclose(x * y[at], y * x[at], rtol=1e-9, atol=0.0))


def _document(result: UncertaintyResult, draws: OutputDraws) -> dict[str, Any]:
    return {
        "draws": len(result.points.z),
        "points": "sobol" if result.sequences else "draws",
        "computed": draws.computed,
        "seconds a draw": draws.seconds / draws.computed if draws.computed else None,
        "failed": result.failed,
        "error": result.error,
        "wanted": result.wanted,
        "decided by": list(result.deciding),
        "inputs": result.input_rows,
        "posterior": told(result.inputs.uncertain.standings),
        "idle": list(result.inputs.idle),
        "still": list(result.is_constant),
        "quantities": {name: _plain(result, name) for name in result.values},
        "sensitivity": {name: asdict(shares) for name, shares in result.shares.items()},
    }


def _plain(result: UncertaintyResult, name: str) -> dict[str, Any]:
    s = result.scatter[name]
    arrays = {what: getattr(s, what).tolist() for what in ("mean", "sd", "low", "high")}
    return {"error": s.error, "middle": list(result.middle[name]), **arrays}


def _report(result: UncertaintyResult) -> StudyReport:
    pictures = draw_pictures(result)
    draws = zip(result.inputs.names, result.points.values.T, strict=True)
    files: dict[str, Content] = {"draws.npz": _npz({**dict(draws), **result.values})}
    if result.pictures:
        named = (
            (f"{name} {what}", x) for name, both in result.pictures.items() for what, x in zip(_KEPT, both, strict=True)
        )
        files["pictures.npz"] = _npz({name: x.numpy() for name, x in named})
    return StudyReport(
        f"{result.inputs.recipe.name}: uncertainty",
        lead(result),
        sections(result, pictures),
        pictures,
        tables={"table.csv": (_COLUMNS, _rows(result))},
        files=files,
        shown=("command", "date", "seconds", "draws", "computed", "seconds a draw", "versions"),
    )


def _rows(result: UncertaintyResult) -> list[Sequence[Any]]:
    rows: list[Sequence[Any]] = []
    for name, s in result.scatter.items():
        columns = zip(result.middle[name], s.mean, s.sd, s.low, s.high, strict=True)
        rows += [(name, i if len(s.mean) > 1 else "", *row) for i, row in enumerate(columns)]
    return rows


def _npz(arrays: Mapping[str, Any]) -> bytes:
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()
