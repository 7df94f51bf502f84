"""The commands that list what there is, and their lines: recipes, nodes with their parameters, the JSON schema."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from neusee.workflows.cli.command_frame import Debug, fail, say
from neusee.workflows.report.text_table import columns

if TYPE_CHECKING:
    from neusee.nodes import Node

_UNITS_IN_WORDS = {
    "PositiveLength": "length > 0, such as 2.9 um",
    "Length": "length, such as 50 nm",
    "Wavelength": "wavelength from 100 nm to 20 um, such as 550 nm",
    "Time": "time > 0, such as 100 ms",
    "Angle": "angle, such as 1 mrad",
    "Temperature": "temperature > 0, such as 6504 K",
    "Electrons": "charge >= 0, such as 390 e-",
    "Gain": "gain > 0, such as 2.7 DN/e- or 0.37 e-/DN",
    "Waves": "wavelengths of path, such as 2 waves",
    "DataFile": "a file",
    "DataFiles": "files: a path, a folder, a pattern such as dark/*.png, or a list of these",
}


def recipes() -> None:
    """List the recipes and the groups that they choose from."""
    say(recipe_lines())


def nodes(
    name: Annotated[str | None, typer.Argument(help="One node, such as optics.psf; `reading`, or `glossary`.")] = None,
    debug: Debug = False,
) -> None:
    """List the nodes, or explain one of them.

    For one node: its physics, source, error, inputs and parameters, and the recipes that use it. `reading` lists how
    the paper is read where it contradicts itself. `glossary` lists the terms of the field, one a line.
    """
    try:
        say(node_lines(name) if name else nodes_lines())
    except LookupError as error:
        fail(str(error.args[0]))


def schema() -> None:
    """Print the JSON schema of recipes for editors."""
    import json

    from neusee.workflows.recipe import json_schema

    say([json.dumps(json_schema.schema(), indent=1)])


# --- what the commands print ------------------------------------------------------------------------------------------


def recipe_lines() -> list[str]:
    """Return a line for each recipe with its title, then the groups of options."""
    from neusee.workflows.recipe import loading

    found = loading.recipes()
    lines = [*columns([[r.name, r.title] for r in found]), "", "groups, as in `neusee run laser=six`"]
    return [*lines, *(f"  {name}: {', '.join(o.name for o in options)}" for name, options in loading.groups().items())]


def nodes_lines() -> list[str]:
    """Return a line for each node by family, with the first sentence of its docstring."""
    from neusee.workflows.recipe.step_declarations import all_nodes

    found = dict(all_nodes())
    wide = max(map(len, found), default=0)
    lines: list[str] = []
    for path, node in found.items():
        family = path.partition(".")[0]
        if not any(line.startswith(f"{family}.") for line in lines):
            lines += ["", _first(importlib.import_module(f"neusee.nodes.{family}").__doc__)]
        lines.append(f"{path:<{wide}}  {_first(node.__doc__)}")
    return lines[1:]


def node_lines(name: str) -> list[str]:
    """Return the lines on one node: its physics, its inputs and parameters, where it is used; or readings, or terms."""
    from neusee.workflows.graph.diagnostics import nearest
    from neusee.workflows.recipe.paper_readings import READINGS
    from neusee.workflows.recipe.step_declarations import all_nodes

    if name == "glossary":
        return glossary_lines()
    if name == "reading":
        return [line for row in READINGS for line in (*_reading(row.path), "")]
    found = dict(all_nodes())
    if name not in found:
        raise LookupError(f"no node {name}: {nearest(name, found)}")
    node, uses = found[name], list(_uses(name))
    lines = [name, "", *inspect.cleandoc(node.__doc__ or "").splitlines(), "", "inputs"]
    lines += [f"  {i}{' (optional)' if i in node.optional else ''}" for i in node.inputs] or ["  none"]
    lines += ["", "parameters", *(_parameters(node) or ["  none"])]
    readings = {r: value for _, step in uses for r, value in _readings_of(step)}
    for reading in readings:
        lines += ["", *_reading(reading)]
    return [*lines, "", f"written in  {', '.join(dict.fromkeys(where for where, _ in uses)) or 'no recipe'}"]


def glossary_lines() -> list[str]:
    """Return the terms of the packaged glossary, one a line, without the marks of Markdown."""
    text = (files("neusee.recipes") / "guide" / "glossary.md").read_text(encoding="utf-8")
    return [re.sub(r"[*`]", "", line[2:]) for line in text.splitlines() if line.startswith("- **")]


def _parameters(node: Node) -> list[str]:
    rows = []
    for name, field in node.params.model_fields.items():
        default = "required" if field.is_required() else f"default {_default(field.default)}"
        rows.append([f"  {name}", f"{_kind(node.hints[name])}; {default}"])
    return columns(rows)


def _default(value: Any) -> str:
    return "none" if value is None else str(value)


def _kind(hint: Any) -> str:
    """Return a type as a user writes it: the unit, the words that are allowed, or a number and its range."""
    from neusee.nodes import units

    for name in _UNITS_IN_WORDS:
        if hint == getattr(units, name):
            return _UNITS_IN_WORDS[name]
    if any(isinstance(extra, units.IsFile) for extra in getattr(hint, "__metadata__", ())):
        return _UNITS_IN_WORDS["DataFile"]  # and what it names
    arguments = get_args(hint)
    if arguments and all(isinstance(a, str) for a in arguments):
        return " | ".join(arguments)
    if getattr(hint, "__metadata__", None):
        ranges = re.findall(r"\b(?:Ge|Gt|Le|Lt)\((ge|gt|le|lt)=([^)]+)\)", repr(hint))
        signs = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}
        said = " and ".join(f"{signs[sign]} {limit}" for sign, limit in ranges)
        return f"{_kind(arguments[0])} {said}".strip()
    if arguments:
        return (
            " or ".join(_kind(a) for a in arguments if a is not Ellipsis)
            if _is_union(hint)
            else _composed(hint, arguments)
        )
    return {"int": "whole number", "float": "number", "bool": "true | false", "NoneType": "none", "str": "text"}.get(
        getattr(hint, "__name__", ""), str(hint)
    )


def _is_union(hint: Any) -> bool:
    return "|" in str(type(hint)) or type(hint).__name__ in ("UnionType", "_UnionGenericAlias", "Union")


def _composed(hint: Any, arguments: tuple[Any, ...]) -> str:
    inside = [_kind(a) for a in arguments if a is not Ellipsis]
    if getattr(hint, "__origin__", None) is dict:
        return f"mapping of {inside[0]}: {inside[-1]}"
    return f"list of {inside[0]}" if Ellipsis in arguments or len(inside) == 1 else f"[{', '.join(inside)}]"


def _uses(name: str) -> Iterator[tuple[str, Any]]:
    """Return the recipe files that have a step of this node, each with the step."""
    from ruamel.yaml import YAML

    import neusee.recipes

    folder = Path(neusee.recipes.__file__).parent
    for path in sorted(folder.rglob("*.yaml")):
        text = path.read_text(encoding="utf-8")
        if name not in text:
            continue
        steps = (YAML(typ="safe").load(text) or {}).get("steps") or {}
        for step in steps.values():
            if isinstance(step, dict) and step.get("node") == name:
                yield str(path.relative_to(folder)), step


def _readings_of(step: Any) -> Iterator[tuple[str, str]]:
    from neusee.workflows.recipe.paper_readings import READINGS

    for name, value in (step.get("with") or {}).items():
        match = re.fullmatch(r"\$\{(\w+\.\w+)\}", str(value))
        if match and (match[1].startswith("reading.") or any(row.path == match[1] for row in READINGS)):
            yield match[1], name


def _reading(path: str) -> list[str]:
    """Return the lines of a contradiction of the paper: its text, the two readings, and the groups that choose them."""
    from neusee.workflows.recipe.paper_readings import READINGS

    row = next((r for r in READINGS if r.path == path), None)
    if row is None:
        return [path]
    return [
        f"{row.path} ({row.number}): {row.matter}",
        f"  coherent (in force by default): {row.coherent}, because {row.reason}",
        f"  as printed (reading=as_printed): {row.as_printed}",
    ]


def _first(text: str | None) -> str:
    """Return the first sentence of a text."""
    return inspect.cleandoc(text or "").partition("\n\n")[0].replace("\n", " ").partition(". ")[0].rstrip(".")
