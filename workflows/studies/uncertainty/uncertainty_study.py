"""The study of uncertainty: what a recipe's outputs are worth, its values being known only so well."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neusee.workflows.engine.provenance import timestamp, versions
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.recipe.distributions.joint import Z_90
from neusee.workflows.recipe.distributions.nominal_values import told
from neusee.workflows.recipe.distributions.uncertain_inputs import SCRAMBLES, Inputs, Points
from neusee.workflows.report.run_folder import RunFolder, new_run
from neusee.workflows.report.study_page import page
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.uncertainty.output_draws import Draws, Numbers
from neusee.workflows.studies.uncertainty.scatter_estimate import Scatter, scatter, worst_known
from neusee.workflows.studies.uncertainty.sobol_indices import indices, require_salib
from neusee.workflows.studies.uncertainty.uncertainty_result import Found

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Places = NDArray[np.float64]

Tell = Callable[[str], None]
LEAST = 64  #: draws before any stop
_ROUND = 16  #: independent draws by round
PICTURED = 32  #: draws that pictures are made of: a deviation to 13 %
_COLUMNS = ("quantity", "element", "at the medians", "mean", "sd", "5 %", "95 %")


def study(
    recipe: Recipe,
    store: Store,
    runs: Path,
    command: Sequence[str],
    tell: Tell,
    error: float = 0.05,
    most: int = 1000,
    points: str = "draws",
    workers: int = 0,
    device: str = "cpu",
) -> Path:
    """Draw until every standard deviation is known to a relative ``error``, or ``most`` draws are made.

    ``workers`` draws are made at once, on the CPU one a core where it is 0; on another ``device`` one after another.
    """
    began = time.perf_counter()
    require_salib()
    inputs = Inputs.of(recipe)
    at = _points(inputs, recipe.seed, most, points)
    inputs.checked(np.concatenate([at.values, _ends(inputs)]))
    draws = Draws(inputs, store, device, workers)
    found = _found(inputs, draws, at, tell, error, SCRAMBLES if points == "sobol" else 0)
    doc = _document(found, draws, command, time.perf_counter() - began)
    with new_run(runs, f"{recipe.name}_uncertainty", digest(doc["quantities"])) as folder:
        _write(folder, found, doc)
    return folder.path


def _points(inputs: Inputs, seed: int, most: int, points: str) -> Points:
    if points == "sobol":
        return inputs.sobol(SCRAMBLES * 2 ** int(np.log2(max(most, LEAST) / SCRAMBLES)), seed)
    return inputs.independent(most if inputs.most is None else min(most, inputs.most), seed)


def _ends(inputs: Inputs) -> Places:
    """All inputs at their median, and each by itself at its 5 and its 95 %."""
    count = len(inputs.names)
    z = np.concatenate([np.zeros((1, count)), *(np.stack([-Z_90 * e, Z_90 * e]) for e in np.eye(count))])
    return inputs.at(z)


def _found(inputs: Inputs, draws: Draws, at: Points, tell: Tell, wanted: float, sequences: int) -> Found:
    names = ", ".join(inputs.names)
    tell(f"{len(inputs.names)} inputs: {names}; {len(draws.outputs)} outputs hang on them")
    seconds = draws.ready()
    tell(f"what they do not reach: {seconds:.1f} s")
    pictures = draws.pictures(at.values[: min(PICTURED, len(at.values))])
    ends = draws.numbers(_ends(inputs))
    if not ends[0]:
        raise ValueError("the outputs are pictures alone: ask for a number too, such as saturated or restored_quality")
    numbers: list[Numbers] = []
    used = 0
    while used < len(at.values):
        used = _next(used, len(at.values), sequences)
        numbers += draws.numbers(at.values[len(numbers) : used])
        values = {name: np.array([n[name] for n in numbers]) for name in ends[0]}
        scattered = {name: scatter(x, sequences) for name, x in values.items()}
        worst, error = worst_known(scattered)
        tell(f"{used} draws: every standard deviation to {error:.1%} ({worst})")
        if error <= wanted:
            break
    middle, swings = ends[0], _swings(inputs, ends, values, scattered)
    z = at.z[:used]
    shares = {n: indices(inputs.labels, z, values[n][:, 0], inputs.recipe.seed) for n in swings}
    rest = (pictures, draws.is_constant, wanted, sequences)
    return Found(inputs, Points(z, at.values[:used]), values, scattered, middle, swings, shares, *rest)


def _next(used: int, most: int, sequences: int) -> int:
    """Sobol's points are even after powers of two alone."""
    more = max(LEAST, 2 * used) if sequences else max(LEAST, used + _ROUND)
    return min(more, most)


def _swings(
    inputs: Inputs, ends: Sequence[Numbers], values: Mapping[str, Places], scattered: Mapping[str, Scatter]
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


def _one_is_the_other(x: Places, y: Places) -> bool:
    """Whether two numbers are proportional in every draw, such as pixels and their share of all."""
    at = int(np.abs(y).argmax())
    return y[at] != 0 and bool(np.allclose(x * y[at], y * x[at], rtol=1e-9, atol=0.0))


# --- the folder -------------------------------------------------------------------------------------------------------


def _document(found: Found, draws: Draws, command: Sequence[str], seconds: float) -> dict[str, Any]:
    recipe = found.inputs.recipe
    computed, spent = draws.computed, draws.seconds
    return {
        "study": "uncertainty",
        "recipe": recipe.name,
        "command": " ".join(command),
        "date": timestamp(),
        "seconds": seconds,
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
        "versions": versions(),
        "config": recipe.config.to_yaml(),
    }


def _inputs(found: Found) -> list[dict[str, Any]]:
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


def _plain(found: Found, name: str) -> dict[str, Any]:
    s = found.scatter[name]
    arrays = {"mean": s.mean, "sd": s.sd, "low": s.low, "high": s.high}
    return {"error": s.error, "middle": list(found.middle[name]), **{k: x.tolist() for k, x in arrays.items()}}


def _write(folder: RunFolder, found: Found, doc: Mapping[str, Any]) -> None:
    from neusee.workflows.studies.uncertainty.uncertainty_page import drawn, lead, sections

    shown = drawn(found)
    for name, content in shown.items():
        folder.write(f"figures/{name}.png", content)
    folder.write("provenance.json", json.dumps(doc, indent=1, ensure_ascii=False))
    folder.write_rows("table.csv", _COLUMNS, _rows(found))
    folder.write("draws.npz", _arrays(found))
    if found.pictures:
        folder.write("pictures.npz", _packed({f"{n} {part}": x.numpy() for n, both in found.pictures.items()
                                              for part, x in zip(("mean", "sd"), both, strict=True)}))  # fmt: skip
    said = {
        name: doc[name] for name in ("command", "date", "seconds", "draws", "computed", "seconds a draw", "versions")
    }
    title = f"{found.inputs.recipe.name}: what it is worth"
    folder.write("report.html", page(title, lead(found), sections(found, shown), said))


def _rows(found: Found) -> list[Sequence[Any]]:
    rows: list[Sequence[Any]] = []
    for name, s in found.scatter.items():
        columns = zip(found.middle[name], s.mean, s.sd, s.low, s.high, strict=True)
        rows += [(name, i if len(s.mean) > 1 else "", *row) for i, row in enumerate(columns)]
    return rows


def _arrays(found: Found) -> bytes:
    """Inputs and quantities by name, draw by draw."""
    columns = dict(zip(found.inputs.names, found.points.values.T, strict=True))
    return _packed({**columns, **found.values})


def _packed(arrays: Mapping[str, Any]) -> bytes:
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()
