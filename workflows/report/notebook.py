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

from neusee.nodes import TensorStats
from neusee.workflows.engine.runner import Result, values_of
from neusee.workflows.engine.wanted_steps import BANDS, LINES, TABLE
from neusee.workflows.graph.errors import shortened
from neusee.workflows.graph.final_values import Setting, flow
from neusee.workflows.graph.recipe_graph import Recipe, by_family, in_order
from neusee.workflows.report.contents import FIGURES
from neusee.workflows.report.figures.camera_pictures import centre, high
from neusee.workflows.report.figures.style import encoded
from neusee.workflows.report.run_folder import filled
from neusee.workflows.report.run_summary import table

if TYPE_CHECKING:
    from torch import Tensor

_LONGEST_WAIT = 2.0  #: s, limit for computing values that the store does not hold
_WEIGHT = 800_000  #: bytes of base64, limit for all pictures together
#: pixels of the longer side, by the number of pictures; 280 for other numbers
_EDGES = {1: 640, 2: 400}
_NAMES = {"plain": "plain lens", "mask": "with mask"}
_MOST_CHARACTERS = 100  #: characters of a value in a table, at most


def result_html(result: Result) -> str:
    """Return an HTML page with pictures, result table and steps of a run; values that take more
    than 2 s to compute are left out.
    """
    values = _at_hand(result, [*_of_table(result), *_of_overview().values()])
    return filled(
        "notebook.html.j2",
        title=result.recipe.name,
        lines=[
            line for line in (result.recipe.title, f"{result.counts()}, on {result.device}") if line
        ],
        look=_failed_checks(result),
        pictures=_pictures({**result.values, **values}),
        tables=[*_results(result, values), _outputs(result), _steps(result)],
    )


def _failed_checks(result: Result) -> list[str]:
    """Return step and text of each check that failed."""
    texts = []
    for done in result.done.values():
        texts += [f"{done.step}: {check.text}" for check in done.checks if not check.ok]
    return texts


def _of_table(result: Result) -> list[str]:
    """Return the steps that the result table reads."""
    cells = itertools.chain.from_iterable(row.values() for row in TABLE.values())
    return [
        BANDS,
        *[name for name in result.keys if name.startswith(LINES.removesuffix("*]"))],
        *cells,
    ]


def _of_overview() -> dict[str, str]:
    """Return the steps of the pictures of the overview, by picture."""
    return {
        name: need.removeprefix("?") for name, need in FIGURES[0].needs.items() if "*" not in need
    }


def _at_hand(result: Result, steps: Iterable[str]) -> dict[str, Any]:
    """Return the results of those ``steps`` that are in the store or can be computed again
    within 2 s.
    """
    affordable = _affordable(result, dict.fromkeys(steps))
    values = values_of(result, result.recipe, affordable)
    return {name: values[name] for name in affordable}


def _affordable(result: Result, steps: Iterable[str]) -> list[str]:
    """Return those ``steps`` of a run whose results need at most 2 s together."""
    held_steps = _held(result)
    sources = {
        name: () if name in held_steps else result.recipe.steps[name].sources
        for name in result.keys
    }
    affordable: list[str] = []
    for name in steps:
        if name not in sources:
            continue
        missing_steps = [
            needed_step
            for needed_step in in_order(sources, [*affordable, name])
            if needed_step not in held_steps
        ]
        if sum(_took(result, needed_step) for needed_step in missing_steps) <= _LONGEST_WAIT:
            affordable.append(name)
    return affordable


def _held(result: Result) -> set[str]:
    """Return the steps whose results the run or its store has."""
    return {
        name for name, key in result.keys.items() if name in result.values or result.store.has(key)
    }


def _took(result: Result, step: str) -> float:
    """Return the seconds in which a result was computed, now or earlier; infinite if unknown."""
    done = result.done[step]
    if done.state == "run":
        return done.seconds
    metadata = result.store.about(result.keys[step]) or {}
    return float(metadata.get("seconds", math.inf))


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
    shown_columns, cells = _without_empty_columns(columns, rows)
    return [_table(title, shown_columns, cells, numbers=columns[1:])]


def _without_empty_columns(
    columns: Sequence[str], rows: Sequence[Sequence[str]]
) -> tuple[list[str], list[list[str]]]:
    """Return the columns with a text in any row, and the rows with – for each empty cell; the first
    column stays.
    """
    # column 0 has the names of the rows
    shown_columns = [
        0,
        *(column for column in range(1, len(columns)) if any(row[column] for row in rows)),
    ]
    cells = [[row[column] or "–" for column in shown_columns] for row in rows]
    return [columns[column] for column in shown_columns], cells


def _outputs(result: Result) -> dict[str, Any]:
    """Return the table of the outputs: shape, type and range."""
    rows = [
        [name, result.recipe.steps[name].node.path, *_looks(value)]
        for name, value in result.values.items()
    ]
    return _table("Values", ["output", "node", "shape", "type", "from … to"], rows, ["from … to"])


def _looks(value: Any) -> tuple[str, str, str]:
    """Return shape, type and range of a result as text; for a named tuple, its numbers replace
    the range.
    """
    facts = TensorStats.of(value)
    if facts is None:
        return "", type(value).__name__, ""
    if hasattr(value, "_asdict"):
        fields = {name: TensorStats.of(item) for name, item in value._asdict().items()}
        numbers = ", ".join(
            f"{name} {facts_of_field.max:.5g}"
            for name, facts_of_field in fields.items()
            if facts_of_field and not facts_of_field.shape
        )
        return ", ".join(fields) if not numbers else "", type(value).__name__, numbers
    # one text where both ends are equal
    ends = dict.fromkeys(f"{end:.5g}" for end in (facts.min, facts.max))
    return " × ".join(map(str, facts.shape)) or "number", facts.dtype, " … ".join(ends)


def _steps(result: Result) -> dict[str, Any]:
    """Return the table of the steps, closed if there are many."""
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
    linear_pictures = _shown_pictures(values)
    edge = _EDGES.get(len(linear_pictures), 280)
    while True:
        pictures = [
            _picture(_NAMES.get(name, name), image, edge) for name, image in linear_pictures.items()
        ]
        if sum(len(encoded_picture["png"]) for encoded_picture in pictures) <= _WEIGHT:
            return pictures
        # smaller until all fit into a page
        edge = edge * 3 // 4


def _shown_pictures(values: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return linear pictures, each over its white level: those of the overview, or up to four other
    images.
    """
    if all(need in values for need in FIGURES[0].needs.values() if not need.startswith("?")):
        step_of_picture = _of_overview()
        truth = values[step_of_picture["truth"]]
        white = high(truth)
        return {
            name: centre(values[need], truth) / white
            for name, need in step_of_picture.items()
            if need in values
        }
    pictures = [(name, value) for name, value in values.items() if _is_picture(value)]
    return {name: picture.float() / high(picture.float()) for name, picture in pictures[:4]}


def _is_picture(value: Any) -> bool:
    """Return True for a tensor that can be shown as a grey or an RGB picture."""
    from torch import Tensor

    if not isinstance(value, Tensor) or value.is_complex() or value.ndim not in (2, 3):
        return False
    return min(value.shape[-2:]) >= 8 and (value.ndim == 2 or value.shape[0] in (1, 3))


def _picture(name: str, linear: Tensor, edge: int) -> dict[str, Any]:
    """Encode a linear image as an sRGB PNG file, reduced to at most ``edge`` pixels on a side."""
    from kornia.geometry.transform import resize
    from PIL import Image

    image = linear.detach().cpu().float()
    image = image.expand(3, *image.shape[-2:])
    small_shape = [max(1, round(side * edge / max(image.shape[-2:]))) for side in image.shape[-2:]]
    if max(image.shape[-2:]) > edge:
        image = resize(image[None], (small_shape[0], small_shape[1]), antialias=True)[0]
    buffer = io.BytesIO()
    Image.fromarray((encoded(image) * 255).round().astype("uint8")).save(buffer, "PNG")
    # the longer side is 250 pixels wide on the page
    width = 250 * image.shape[-1] // max(image.shape[-2:])
    return {"name": name, "png": base64.b64encode(buffer.getvalue()).decode(), "width": width}


def recipe_html(recipe: Recipe) -> str:
    """Return an HTML page with the outputs, the steps, and the changed and all other parameters
    of a recipe.
    """
    written_settings = {
        name: setting
        for name, setting in recipe.config.settings.items()
        if not setting.default and not name.startswith("steps.")
    }
    # set by an argument of the command
    changed = {
        name: setting
        for name, setting in recipe.config.settings.items()
        if "argument " in setting.source
    }
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
            _settings(f"{len(written_settings)} values", written_settings, False),
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
    families_read = by_family(itertools.chain.from_iterable(step.sources for step in steps))
    title = f"{family} ×{len(names)}" if len(names) > 1 else names[0]
    devices = dict.fromkeys(step.device for step in steps if step.device)
    return [title, steps[0].node.path, ", ".join(families_read), ", ".join(devices)]


def _settings(title: str, settings: Mapping[str, Setting], shown: bool) -> dict[str, Any]:
    """Return the table of settings: path, value and where it was written."""
    rows = []
    for name, setting in settings.items():
        rows.append([name, shortened(flow(setting.value), _MOST_CHARACTERS), setting.source])
    return _table(title, ["parameter", "value", "from"], rows, shown=shown)


def _table(
    title: str,
    columns: Sequence[str],
    rows: Sequence[Sequence[str]],
    numbers: Sequence[str] = (),
    shown: bool = True,
) -> dict[str, Any]:
    """Return a table as values of the template; ``shown`` is False for one that is folded."""
    return {"title": title, "columns": columns, "rows": rows, "numbers": numbers, "open": shown}
