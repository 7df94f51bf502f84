"""The study of uncertainty: how far a recipe's outputs scatter when its uncertain values do."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.recipe.distributions.joint import Z_90
from neusee.workflows.recipe.distributions.nominal_values import told
from neusee.workflows.recipe.distributions.uncertain_inputs import SCRAMBLES, InputDraws, Inputs
from neusee.workflows.report.study_folder import Content, Progress, StudyReport, StudyRun
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.uncertainty.output_draws import Numbers, OutputDraws
from neusee.workflows.studies.uncertainty.scatter_estimate import Scatter, scatter, worst_known
from neusee.workflows.studies.uncertainty.sobol_indices import indices, require_salib
from neusee.workflows.studies.uncertainty.uncertainty_result import UncertaintyResult

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

LEAST = 64  #: draws before any stop
_ROUND = 16  #: independent draws by round
PICTURED = 32  #: draws that pictures are made of: a deviation to 13 %
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
) -> Path:
    """Draw until every standard deviation is known to a relative ``error``, or ``most`` draws are made.

    ``workers`` draws are made at once; 0 means one for each core of the CPU. Another ``device`` makes one after
    another.
    """
    study_run = StudyRun("uncertainty", recipe, command)
    require_salib()
    inputs = Inputs.of(recipe)
    at = _points(inputs, recipe.seed, most, points)
    inputs.checked(np.concatenate([at.values, _ends(inputs)]))
    draws = OutputDraws(inputs, store, device, workers)
    found = _measure(inputs, draws, at, progress, error, SCRAMBLES if points == "sobol" else 0)
    document = study_run.document(_document(found, draws))
    return study_run.write(runs, digest(document["quantities"]), document, _report(found))


def _points(inputs: Inputs, seed: int, most: int, points: str) -> InputDraws:
    if points == "sobol":
        return inputs.sobol(SCRAMBLES * 2 ** int(np.log2(max(most, LEAST) / SCRAMBLES)), seed)
    return inputs.independent(most if inputs.most is None else min(most, inputs.most), seed)


def _ends(inputs: Inputs) -> FloatArray:
    """Return all inputs at their median, and each one by itself at its 5 % and at its 95 %."""
    count = len(inputs.names)
    z = np.concatenate([np.zeros((1, count)), *(np.stack([-Z_90 * e, Z_90 * e]) for e in np.eye(count))])
    return inputs.at(z)


def _measure(
    inputs: Inputs, draws: OutputDraws, at: InputDraws, progress: Progress, wanted: float, sequences: int
) -> UncertaintyResult:
    names = ", ".join(inputs.names)
    progress(f"{len(inputs.names)} inputs: {names}; {len(draws.outputs)} outputs depend on them")
    seconds = draws.ready()
    progress(f"steps that no input reaches: {seconds:.1f} s")
    pictures = draws.pictures(at.values[: min(PICTURED, len(at.values))])
    ends = draws.numbers(_ends(inputs))
    if not ends[0]:
        raise ValueError("the outputs are pictures only: ask for a number too, such as saturated or restored_quality")
    numbers: list[Numbers] = []
    used = 0
    while used < len(at.values):
        used = _next(used, len(at.values), sequences)
        numbers += draws.numbers(at.values[len(numbers) : used])
        values = {name: np.array([n[name] for n in numbers]) for name in ends[0]}
        scattered = {name: scatter(x, sequences) for name, x in values.items()}
        worst, error = worst_known(scattered)
        progress(f"{used} draws: every standard deviation to {error:.1%} ({worst})")
        if error <= wanted:
            break
    middle, swings = ends[0], _swings(inputs, ends, values, scattered)
    z = at.z[:used]
    shares = {n: indices(inputs.labels, z, values[n][:, 0], inputs.recipe.seed) for n in swings}
    rest = (pictures, draws.is_constant, wanted, sequences)
    return UncertaintyResult(inputs, InputDraws(z, at.values[:used]), values, scattered, middle, swings, shares, *rest)


def _next(used: int, most: int, sequences: int) -> int:
    """Return the next number of draws; points of Sobol are even only after a power of two."""
    more = max(LEAST, 2 * used) if sequences else max(LEAST, used + _ROUND)
    return min(more, most)


def _swings(
    inputs: Inputs, ends: Sequence[Numbers], values: Mapping[str, FloatArray], scattered: Mapping[str, Scatter]
) -> dict[str, list[tuple[str, float, float]]]:
    found: dict[str, list[tuple[str, float, float]]] = {}
    for name, x in values.items():
        known = np.isfinite(x).all() and np.isfinite([end[name] for end in ends]).all()
        if x.shape[1] > 1 or scattered[name].is_constant or not known:
            continue
        if not any(_one_is_the_other(x[:, 0], values[other][:, 0]) for other in found):
            pairs = zip(ends[1::2], ends[2::2], strict=True)
            each = zip(inputs.labels, pairs, strict=True)
            found[name] = [(label, low[name][0], high[name][0]) for label, (low, high) in each]
    return found


def _one_is_the_other(x: FloatArray, y: FloatArray) -> bool:
    """Return True if two numbers are proportional in every draw, such as pixels and their share of all."""
    at = int(np.abs(y).argmax())
    return y[at] != 0 and bool(np.allclose(x * y[at], y * x[at], rtol=1e-9, atol=0.0))


# --- the folder -------------------------------------------------------------------------------------------------------


def _document(found: UncertaintyResult, draws: OutputDraws) -> dict[str, Any]:
    """Return what the folder says of the study, beside what every study says."""
    computed, spent = draws.computed, draws.seconds
    return {
        "draws": len(found.points.z),
        "points": "sobol" if found.sequences else "draws",
        "computed": computed,
        "seconds a draw": spent / computed if computed else None,
        "failed": found.failed,
        "error": found.error,
        "wanted": found.wanted,
        "inputs": _inputs(found),
        "posterior": told(found.inputs.uncertain.standings),
        "idle": list(found.inputs.idle),
        "still": list(found.is_constant),
        "quantities": {name: _plain(found, name) for name in found.values},
        "sensitivity": {name: asdict(shares) for name, shares in found.shares.items()},
    }


def _inputs(found: UncertaintyResult) -> list[dict[str, Any]]:
    inputs, values = found.inputs, found.points.values
    return [
        {
            "name": name,
            "label": label,
            "law": inputs.uncertain.said(name),
            "mean": float(x.mean()),
            "sd": float(x.std(ddof=1)),
        }
        for name, label, x in zip(inputs.names, inputs.labels, values.T, strict=True)
    ]


def _plain(found: UncertaintyResult, name: str) -> dict[str, Any]:
    s = found.scatter[name]
    arrays = {"mean": s.mean, "sd": s.sd, "low": s.low, "high": s.high}
    return {"error": s.error, "middle": list(found.middle[name]), **{k: x.tolist() for k, x in arrays.items()}}


def _report(found: UncertaintyResult) -> StudyReport:
    from neusee.workflows.studies.uncertainty.uncertainty_page import draw_pictures, lead, sections

    pictures = draw_pictures(found)
    files: dict[str, Content] = {"draws.npz": _arrays(found)}
    if found.pictures:
        files["pictures.npz"] = _packed({f"{n} {part}": x.numpy() for n, both in found.pictures.items()
                                         for part, x in zip(("mean", "sd"), both, strict=True)})  # fmt: skip
    return StudyReport(
        f"{found.inputs.recipe.name}: how certain it is",
        lead(found),
        sections(found, pictures),
        pictures,
        tables={"table.csv": (_COLUMNS, _rows(found))},
        files=files,
        shown=("command", "date", "seconds", "draws", "computed", "seconds a draw", "versions"),
    )


def _rows(found: UncertaintyResult) -> list[Sequence[Any]]:
    rows: list[Sequence[Any]] = []
    for name, s in found.scatter.items():
        columns = zip(found.middle[name], s.mean, s.sd, s.low, s.high, strict=True)
        rows += [(name, i if len(s.mean) > 1 else "", *row) for i, row in enumerate(columns)]
    return rows


def _arrays(found: UncertaintyResult) -> bytes:
    """Return inputs and quantities by name, draw by draw, as the bytes of an npz file."""
    columns = dict(zip(found.inputs.names, found.points.values.T, strict=True))
    return _packed({**columns, **found.values})


def _packed(arrays: Mapping[str, Any]) -> bytes:
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()
