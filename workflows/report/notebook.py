"""HTML views of a recipe and of a run result in a Jupyter notebook, each as one page that loads no other file."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from neusee.workflows.graph.final_values import Setting, flow
from neusee.workflows.graph.recipe_graph import Recipe, in_order
from neusee.workflows.report import result_numbers
from neusee.workflows.report.contents import BANDS, FIGURES, LINES, TABLE, wanted
from neusee.workflows.report.result_numbers import metrics_of, table
from neusee.workflows.report.study_page import filled
from neusee.workflows.report.text_table import by_family

if TYPE_CHECKING:
    from torch import Tensor

    from neusee.workflows.engine.runner import Result

_LONGEST_WAIT = 2.0  #: s, limit for computing values that the store does not hold
_WEIGHT = 800_000  #: bytes of base64, limit for all pictures together
_EDGES = {1: 640, 2: 400}  #: pixels of the longer side, by the number of pictures; 280 for other numbers
_NAMES = {"plain": "plain lens", "mask": "with mask"}
_LONGEST = 100  #: characters of a value in a table, at most


def numbers_of(result: Result) -> dict[str, float | list[float]]:
    """Return the figures of merit of a run by name, as a number or as a list with one number for each band."""
    recipe = result.recipe.unsubstituted or result.recipe
    names = metrics_of(recipe, {*result.keys, *wanted(recipe)})
    absent = [name for name in names if name not in result.values]
    again = recipe.run(result.store, absent, device=result.device).values if absent else {}
    values = {**again, **result.values}
    found: dict[str, list[float]] = {}
    for step, field, _, number in (row for name in names for row in result_numbers.numbers_of(name, values[name])):
        found.setdefault(f"{step}.{field}".rstrip("."), []).append(number)
    return {name: values[0] if len(values) == 1 else values for name, values in found.items()}


def arrays_of(value: Any) -> Any:
    """Replace every tensor in a nested value by a NumPy array; bfloat16 becomes float32."""
    import torch
    from torch import Tensor

    if isinstance(value, Tensor):
        here = value.detach().cpu()
        return (here.float() if here.dtype == torch.bfloat16 else here).numpy()
    if isinstance(value, tuple):
        items = [arrays_of(item) for item in value]
        return value._make(items) if hasattr(value, "_make") else tuple(items)
    if isinstance(value, list):
        return [arrays_of(item) for item in value]
    return {name: arrays_of(item) for name, item in value.items()} if isinstance(value, dict) else value


def result_line(result: Result) -> str:
    """Return a run result as a line such as ``<result of first_light: restored, raw; 12 run, 3 cached in 0.31 s>``."""
    return f"<result of {result.recipe.name}: {', '.join(by_family(result.values))}; {_counts(result)}>"


def result_html(result: Result) -> str:
    """Return an HTML page with pictures, result table and steps of a run, without values that take over 2 s."""
    values = _at_hand(result, [*_of_table(result), *_of_overview().values()])
    return filled(
        "notebook.html.j2",
        title=result.recipe.name,
        lines=[line for line in (result.recipe.title, f"{_counts(result)}, on {result.device}") if line],
        look=[f"{d.step}: {c.text}" for d in result.done.values() for c in d.checks if not c.ok],
        pictures=_pictures({**result.values, **values}),
        tables=[*_results(result, values), _outputs(result), _steps(result)],
    )


def _counts(result: Result) -> str:
    from neusee.workflows.report.run_page import state_counts

    return f"{state_counts(result.done.values())} in {result.seconds:.3g} s"


def _of_table(result: Result) -> list[str]:
    cells = [step for row in TABLE.values() for step in row.values()]
    return [BANDS, *[n for n in result.keys if n.startswith(LINES.removesuffix("*]"))], *cells]


def _of_overview() -> dict[str, str]:
    return {name: need.removeprefix("?") for name, need in FIGURES[0].needs.items() if "*" not in need}


def _at_hand(result: Result, steps: Iterable[str]) -> dict[str, Any]:
    """Return the results of those ``steps`` that are in the store or can be computed again within 2 s."""
    held = {name for name, key in result.keys.items() if name in result.values or result.store.has(key)}
    sources = {name: () if name in held else result.recipe.steps[name].sources for name in result.keys}
    kept: list[str] = []
    for name in dict.fromkeys(steps):
        missing = [n for n in in_order(sources, [*kept, name]) if n not in held] if name in sources else []
        if name in sources and sum(_took(result, n) for n in missing) <= _LONGEST_WAIT:
            kept.append(name)
    absent = [name for name in kept if name not in result.values]
    again = result.recipe.run(result.store, absent, device=result.device).values if absent else {}
    values = {**again, **result.values}
    return {name: values[name] for name in kept}


def _took(result: Result, step: str) -> float:
    done = result.done[step]
    if done.state == "run":
        return done.seconds
    about = result.store.about(result.keys[step]) or {}
    return float(about.get("seconds", math.inf))


def _results(result: Result, values: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the result table of a run without empty rows and columns, or an empty list if all cells are empty."""
    found = table(result.recipe, {name: result.keys[name] for name in values}, values.__getitem__)
    rows = [[row["name"], *row["cells"]] for row in found["rows"] if any(row["cells"])]
    columns = ["", *found["columns"]]
    used = [i for i in range(len(columns)) if i == 0 or any(row[i] for row in rows)]
    if not rows:
        return []
    cells = [[row[i] or "–" for i in used] for row in rows]
    title = ". ".join(["Results", *found["legend"]])
    return [_table(title, [columns[i] for i in used], cells, numbers=columns[1:])]


def _outputs(result: Result) -> dict[str, Any]:
    rows = [[name, result.recipe.steps[name].node.path, *_looks(value)] for name, value in result.values.items()]
    return _table("Values", ["output", "node", "shape", "type", "from … to"], rows, ["from … to"])


def _looks(value: Any) -> tuple[str, str, str]:
    """Return shape, type and range of a result as text; for a named tuple, its numbers replace the range."""
    from neusee.nodes import TensorStats

    facts = TensorStats.of(value)
    if facts is None:
        return "", type(value).__name__, ""
    if hasattr(value, "_asdict"):
        fields = {name: TensorStats.of(item) for name, item in value._asdict().items()}
        numbers = ", ".join(f"{name} {f.max:.5g}" for name, f in fields.items() if f and not f.shape)
        return ", ".join(fields) if not numbers else "", type(value).__name__, numbers
    span = dict.fromkeys(f"{end:.5g}" for end in (facts.min, facts.max))
    return " × ".join(map(str, facts.shape)) or "number", facts.dtype, " … ".join(span)


def _steps(result: Result) -> dict[str, Any]:
    rows = []
    for done in result.done.values():
        state = "cached" if done.state == "not needed" else done.state
        rows.append([done.step, state, f"{done.seconds:.3f}" if done.state == "run" else "", done.why])
    return _table(f"{len(rows)} steps", ["step", "state", "seconds", "why"], rows, ["seconds"], shown=len(rows) <= 12)


def _pictures(values: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Encode the truth, raw and restored pictures of a run as PNG, or up to four other images if one is missing."""
    from neusee.workflows.report.figures.camera_overview import centre, high

    needs = _of_overview()
    if all(need in values for need in FIGURES[0].needs.values() if not need.startswith("?")):
        truth = values[needs["truth"]]
        white = high(truth)
        shown = {name: centre(values[need], truth) / white for name, need in needs.items() if need in values}
    else:
        found = {name: value for name, value in values.items() if _is_picture(value)}
        shown = {name: image.float() / high(image.float()) for name, image in list(found.items())[:4]}
    edge = _EDGES.get(len(shown), 280)
    while True:
        pictures = [_picture(_NAMES.get(name, name), image, edge) for name, image in shown.items()]
        if sum(len(p["png"]) for p in pictures) <= _WEIGHT:
            return pictures
        edge = edge * 3 // 4


def _is_picture(value: Any) -> bool:
    from torch import Tensor

    if not isinstance(value, Tensor) or value.is_complex() or value.ndim not in (2, 3):
        return False
    return min(value.shape[-2:]) >= 8 and (value.ndim == 2 or value.shape[0] in (1, 3))


def _picture(name: str, linear: Tensor, edge: int) -> dict[str, Any]:
    """Encode a linear image as an sRGB PNG file, reduced to at most ``edge`` pixels on a side."""
    from kornia.geometry.transform import resize
    from PIL import Image

    from neusee.workflows.report.figures.style import encoded

    image = linear.detach().cpu().float()
    image = image.expand(3, *image.shape[-2:])
    small = [max(1, round(n * edge / max(image.shape[-2:]))) for n in image.shape[-2:]]
    if max(image.shape[-2:]) > edge:
        image = resize(image[None], (small[0], small[1]), antialias=True)[0]
    out = io.BytesIO()
    Image.fromarray((encoded(image) * 255).round().astype("uint8")).save(out, "PNG")
    width = 250 * image.shape[-1] // max(image.shape[-2:])
    return {"name": name, "png": base64.b64encode(out.getvalue()).decode(), "width": width}


def recipe_html(recipe: Recipe) -> str:
    """Return an HTML page with the outputs, the steps, and the changed and all other parameters of a recipe."""
    written = {name: s for name, s in recipe.config.settings.items() if not s.default and not name.startswith("steps.")}
    changed = {name: s for name, s in recipe.config.settings.items() if "argument " in s.source}
    lines = [recipe.title, f"gives {', '.join(by_family(recipe.outputs))}"]
    return filled(
        "notebook.html.j2",
        title=recipe.name,
        lines=[*filter(None, lines), f"seed {recipe.seed}, tolerance {recipe.tolerance:g}", *recipe.notes],
        look=[],
        pictures=[],
        tables=[
            *([_settings("Changes", changed, True)] if changed else []),
            _graph(recipe),
            _settings(f"{len(written)} values", written, False),
        ],
    )


def _graph(recipe: Recipe) -> dict[str, Any]:
    """Return a table of the steps of a recipe; ``psf[plain]`` and ``psf[mask]``, copies of one step, share a row."""
    rows = []
    for family, names in by_family(recipe.steps).items():
        step = recipe.steps[names[0]]
        reads = by_family(source for n in names for source in recipe.steps[n].sources)
        title = f"{family} ×{len(names)}" if len(names) > 1 else names[0]
        devices = dict.fromkeys(recipe.steps[n].device for n in names if recipe.steps[n].device)
        rows.append([title, step.node.path, ", ".join(reads), ", ".join(devices)])
    columns = ["step", "node", "reads", "where"] if any(row[3] for row in rows) else ["step", "node", "reads"]
    title = f"{len(recipe.steps)} steps of {len({s.node.path for s in recipe.steps.values()})} nodes"
    return _table(title, columns, [row[: len(columns)] for row in rows], shown=len(rows) <= 12)


def _settings(title: str, settings: Mapping[str, Setting], shown: bool) -> dict[str, Any]:
    rows = []
    for name, setting in settings.items():
        text = flow(setting.value)
        rows.append([name, text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…", setting.source])
    return _table(title, ["parameter", "value", "from"], rows, shown=shown)


def _table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[str] = (), shown: bool = True
) -> dict[str, Any]:
    return {"title": title, "columns": columns, "rows": rows, "numbers": numbers, "open": shown}
