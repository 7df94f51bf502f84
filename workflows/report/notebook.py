"""HTML views of a recipe and of a run result in a Jupyter notebook, each as one page that loads
no other file.
"""

from __future__ import annotations

import base64
import io
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from neusee.workflows.graph.final_values import Setting, flow
from neusee.workflows.graph.recipe_graph import Recipe, in_order
from neusee.workflows.report import result_numbers
from neusee.workflows.report.contents import BANDS, FIGURES, LINES, TABLE, wanted
from neusee.workflows.report.result_numbers import metrics_of, table
from neusee.workflows.report.study_page import filled
from neusee.workflows.report.terminal_text import by_family

if TYPE_CHECKING:
    from torch import Tensor

    from neusee.workflows.engine.runner import Result

_LONGEST_WAIT = 2.0  #: s, limit for computing values that the store does not hold
_WEIGHT = 800_000  #: bytes of base64, limit for all pictures together
#: pixels of the longer side, by the number of pictures; 280 for other numbers
_EDGES = {1: 640, 2: 400}
_NAMES = {"plain": "plain lens", "mask": "with mask"}
_LONGEST = 100  #: characters of a value in a table, at most


def numbers_of(result: Result) -> dict[str, float | list[float]]:
    """Return the figures of merit of a run by name, as a number or as a list with one number for
    each band.
    """
    recipe = result.recipe.unsubstituted or result.recipe
    names = metrics_of(recipe, {*result.keys, *wanted(recipe)})
    values = _values_of(result, recipe, names)
    lists: dict[str, list[float]] = {}
    for name in names:
        for step, field, _, number in result_numbers.numbers_of(name, values[name]):
            lists.setdefault(f"{step}.{field}".rstrip("."), []).append(number)
    return {name: numbers[0] if len(numbers) == 1 else numbers for name, numbers in lists.items()}


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
    return (
        {name: arrays_of(item) for name, item in value.items()}
        if isinstance(value, dict)
        else value
    )


def result_line(result: Result) -> str:
    """Return a run result as a line such as ``<result of first_light: restored, raw; 12 run, 3
    cached in 0.31 s>``.
    """
    return (
        f"<result of {result.recipe.name}: {', '.join(by_family(result.values))};"
        f" {_counts(result)}>"
    )


def result_html(result: Result) -> str:
    """Return an HTML page with pictures, result table and steps of a run, without values that
    take over 2 s.
    """
    values = _at_hand(result, [*_of_table(result), *_of_overview().values()])
    return filled(
        "notebook.html.j2",
        title=result.recipe.name,
        lines=[
            line for line in (result.recipe.title, f"{_counts(result)}, on {result.device}") if line
        ],
        look=_failed_checks(result),
        pictures=_pictures({**result.values, **values}),
        tables=[*_results(result, values), _outputs(result), _steps(result)],
    )


def _failed_checks(result: Result) -> list[str]:
    texts = []
    for done in result.done.values():
        texts += [f"{done.step}: {check.text}" for check in done.checks if not check.ok]
    return texts


def _counts(result: Result) -> str:
    from neusee.workflows.report.run_page import state_counts

    return f"{state_counts(result.done.values())} in {result.seconds:.3g} s"


def _of_table(result: Result) -> list[str]:
    cells = itertools.chain.from_iterable(row.values() for row in TABLE.values())
    return [BANDS, *[n for n in result.keys if n.startswith(LINES.removesuffix("*]"))], *cells]


def _of_overview() -> dict[str, str]:
    return {
        name: need.removeprefix("?") for name, need in FIGURES[0].needs.items() if "*" not in need
    }


def _at_hand(result: Result, steps: Iterable[str]) -> dict[str, Any]:
    """Return the results of those ``steps`` that are in the store or can be computed again
    within 2 s.
    """
    affordable = _affordable(result, dict.fromkeys(steps))
    values = _values_of(result, result.recipe, affordable)
    return {name: values[name] for name in affordable}


def _affordable(result: Result, steps: Iterable[str]) -> list[str]:
    """Return those ``steps`` of a run whose results need at most 2 s together."""
    held = _held(result)
    sources = {
        name: () if name in held else result.recipe.steps[name].sources for name in result.keys
    }
    affordable: list[str] = []
    for name in steps:
        if name not in sources:
            continue
        missing = [n for n in in_order(sources, [*affordable, name]) if n not in held]
        if sum(_took(result, n) for n in missing) <= _LONGEST_WAIT:
            affordable.append(name)
    return affordable


def _held(result: Result) -> set[str]:
    """Return the steps whose results the run or its store has."""
    return {
        name for name, key in result.keys.items() if name in result.values or result.store.has(key)
    }


def _values_of(result: Result, recipe: Recipe, steps: Iterable[str]) -> Mapping[str, Any]:
    """Return the values of a run, and those of other ``steps``, which ``recipe`` computes."""
    absent = [name for name in steps if name not in result.values]
    again = recipe.run(result.store, absent, device=result.device).values if absent else {}
    return {**again, **result.values}


def _took(result: Result, step: str) -> float:
    done = result.done[step]
    if done.state == "run":
        return done.seconds
    about = result.store.about(result.keys[step]) or {}
    return float(about.get("seconds", math.inf))


def _results(result: Result, values: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the result table of a run without empty rows and columns, or an empty list if all
    cells are empty.
    """
    results = table(result.recipe, {name: result.keys[name] for name in values}, values.__getitem__)
    rows = [[row["name"], *row["cells"]] for row in results["rows"] if any(row["cells"])]
    columns = ["", *results["columns"]]
    if not rows:
        return []
    title = ". ".join(["Results", *results["legend"]])
    shown, cells = _without_empty_columns(columns, rows)
    return [_table(title, shown, cells, numbers=columns[1:])]


def _without_empty_columns(
    columns: Sequence[str], rows: Sequence[Sequence[str]]
) -> tuple[list[str], list[list[str]]]:
    """Return the columns with a text in any row, and the rows with – for each empty cell; the first
    column stays.
    """
    shown = [0, *(i for i in range(1, len(columns)) if any(row[i] for row in rows))]
    cells = [[row[i] or "–" for i in shown] for row in rows]
    return [columns[i] for i in shown], cells


def _outputs(result: Result) -> dict[str, Any]:
    rows = [
        [name, result.recipe.steps[name].node.path, *_looks(value)]
        for name, value in result.values.items()
    ]
    return _table("Values", ["output", "node", "shape", "type", "from … to"], rows, ["from … to"])


def _looks(value: Any) -> tuple[str, str, str]:
    """Return shape, type and range of a result as text; for a named tuple, its numbers replace
    the range.
    """
    from neusee.nodes import TensorStats

    facts = TensorStats.of(value)
    if facts is None:
        return "", type(value).__name__, ""
    if hasattr(value, "_asdict"):
        fields = {name: TensorStats.of(item) for name, item in value._asdict().items()}
        numbers = ", ".join(
            f"{name} {f.max:.5g}" for name, f in fields.items() if f and not f.shape
        )
        return ", ".join(fields) if not numbers else "", type(value).__name__, numbers
    span = dict.fromkeys(f"{end:.5g}" for end in (facts.min, facts.max))
    return " × ".join(map(str, facts.shape)) or "number", facts.dtype, " … ".join(span)


def _steps(result: Result) -> dict[str, Any]:
    rows = []
    for done in result.done.values():
        state = "cached" if done.state == "not needed" else done.state
        rows.append(
            [done.step, state, f"{done.seconds:.3f}" if done.state == "run" else "", done.why]
        )
    return _table(
        f"{len(rows)} steps",
        ["step", "state", "seconds", "why"],
        rows,
        ["seconds"],
        shown=len(rows) <= 12,
    )


def _pictures(values: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Encode the truth, raw and restored pictures of a run as PNG, or up to four other images if
    one is missing.
    """
    shown = _shown_pictures(values)
    edge = _EDGES.get(len(shown), 280)
    while True:
        pictures = [_picture(_NAMES.get(name, name), image, edge) for name, image in shown.items()]
        if sum(len(p["png"]) for p in pictures) <= _WEIGHT:
            return pictures
        edge = edge * 3 // 4


def _shown_pictures(values: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return linear pictures of which the brightest has the value 1: of the overview, or four
    others.
    """
    from neusee.workflows.report.figures.camera_pictures import centre, high

    if all(need in values for need in FIGURES[0].needs.values() if not need.startswith("?")):
        needs = _of_overview()
        truth = values[needs["truth"]]
        white = high(truth)
        return {
            name: centre(values[need], truth) / white
            for name, need in needs.items()
            if need in values
        }
    pictures = [(name, value) for name, value in values.items() if _is_picture(value)]
    return {name: picture.float() / high(picture.float()) for name, picture in pictures[:4]}


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
    """Return an HTML page with the outputs, the steps, and the changed and all other parameters
    of a recipe.
    """
    written = {
        name: s
        for name, s in recipe.config.settings.items()
        if not s.default and not name.startswith("steps.")
    }
    changed = {name: s for name, s in recipe.config.settings.items() if "argument " in s.source}
    lines = [recipe.title, f"gives {', '.join(by_family(recipe.outputs))}"]
    return filled(
        "notebook.html.j2",
        title=recipe.name,
        lines=[
            *filter(None, lines),
            f"seed {recipe.seed}, tolerance {recipe.tolerance:g}",
            *recipe.notes,
        ],
        look=[],
        pictures=[],
        tables=[
            *([_settings("Changes", changed, True)] if changed else []),
            _graph(recipe),
            _settings(f"{len(written)} values", written, False),
        ],
    )


def _graph(recipe: Recipe) -> dict[str, Any]:
    """Return a table of the steps of a recipe; ``psf[plain]`` and ``psf[mask]``, copies of one
    step, share a row.
    """
    rows = [_copies(recipe, family, names) for family, names in by_family(recipe.steps).items()]
    columns = ["step", "node", "reads", "where"]
    if not any(row[3] for row in rows):
        columns.remove("where")
    nodes = {step.node.path for step in recipe.steps.values()}
    title = f"{len(recipe.steps)} steps of {len(nodes)} nodes"
    return _table(title, columns, [row[: len(columns)] for row in rows], shown=len(rows) <= 12)


def _copies(recipe: Recipe, family: str, names: Sequence[str]) -> list[str]:
    """Return the row of all copies of a step: name, node, what they read, and where they run."""
    steps = [recipe.steps[name] for name in names]
    reads = by_family(itertools.chain.from_iterable(step.sources for step in steps))
    title = f"{family} ×{len(names)}" if len(names) > 1 else names[0]
    devices = dict.fromkeys(step.device for step in steps if step.device)
    return [title, steps[0].node.path, ", ".join(reads), ", ".join(devices)]


def _settings(title: str, settings: Mapping[str, Setting], shown: bool) -> dict[str, Any]:
    rows = []
    for name, setting in settings.items():
        text = flow(setting.value)
        rows.append(
            [name, text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…", setting.source]
        )
    return _table(title, ["parameter", "value", "from"], rows, shown=shown)


def _table(
    title: str,
    columns: Sequence[str],
    rows: Sequence[Sequence[str]],
    numbers: Sequence[str] = (),
    shown: bool = True,
) -> dict[str, Any]:
    return {"title": title, "columns": columns, "rows": rows, "numbers": numbers, "open": shown}
