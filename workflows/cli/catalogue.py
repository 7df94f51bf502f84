"""What there is to use: recipes, nodes with their parameters, readings, and the JSON schema of it all."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any, get_args

import neusee.recipes
from neusee.nodes import Node, units
from neusee.workflows.graph.diagnostics import nearest
from neusee.workflows.recipe.loading import groups, recipes
from neusee.workflows.recipe.paper_readings import READINGS
from neusee.workflows.recipe.step_declarations import all_nodes

_FOLDER = Path(neusee.recipes.__file__).parent
_KINDS = (
    "PositiveLength",
    "Length",
    "Wavelength",
    "Time",
    "Angle",
    "Temperature",
    "Electrons",
    "Gain",
    "Waves",
    "DataFile",
    "DataFiles",
)
_SAID = {
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


def recipe_lines() -> list[str]:
    """Each recipe with its first line, then the groups that it may choose from."""
    found = recipes()
    wide = max((len(r.name) for r in found), default=0)
    lines = [f"{r.name:<{wide}}  {r.title}" for r in found]
    lines += ["", "groups, as in `neusee run laser=six`"]
    return [*lines, *(f"  {name}: {', '.join(o.name for o in options)}" for name, options in groups().items())]


def nodes_lines() -> list[str]:
    """Every node by family, with the first sentence of what it does."""
    nodes = dict(all_nodes())
    wide = max(map(len, nodes), default=0)
    lines: list[str] = []
    for path, node in nodes.items():
        family = path.partition(".")[0]
        if not any(line.startswith(f"{family}.") for line in lines):
            lines += ["", _first(importlib.import_module(f"neusee.nodes.{family}").__doc__)]
        lines.append(f"{path:<{wide}}  {_first(node.__doc__)}")
    return lines[1:]


def node_lines(name: str) -> list[str]:
    """Return the lines on one node: its physics, its inputs and parameters, where it is used; or readings, or terms."""
    if name == "glossary":
        return glossary_lines()
    if name == "reading":
        return [line for row in READINGS for line in (*_reading(row.path), "")]
    nodes = dict(all_nodes())
    if name not in nodes:
        raise LookupError(f"no node {name}: {nearest(name, nodes)}")
    node, uses = nodes[name], list(_uses(name))
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
        rows.append((name, _kind(node.hints[name]), default))
    wide = max((len(name) for name, _, _ in rows), default=0)
    return [f"  {name:<{wide}}  {kind}; {default}" for name, kind, default in rows]


def _default(value: Any) -> str:
    return "none" if value is None else str(value)


def _kind(hint: Any) -> str:
    """A type as a user writes it: the unit, the words that are allowed, or a number and its range."""
    for name in _KINDS:
        if hint == getattr(units, name):
            return _SAID[name]
    if any(isinstance(extra, units.IsFile) for extra in getattr(hint, "__metadata__", ())):
        return _SAID["DataFile"]  # and what it names
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
    """Recipe files with a step of this node, and that step."""
    from ruamel.yaml import YAML

    for path in sorted(_FOLDER.rglob("*.yaml")):
        text = path.read_text(encoding="utf-8")
        if name not in text:
            continue
        steps = (YAML(typ="safe").load(text) or {}).get("steps") or {}
        for step in steps.values():
            if isinstance(step, dict) and step.get("node") == name:
                yield str(path.relative_to(_FOLDER)), step


def _readings_of(step: Any) -> Iterator[tuple[str, str]]:
    for name, value in (step.get("with") or {}).items():
        match = re.fullmatch(r"\$\{(\w+\.\w+)\}", str(value))
        if match and (match[1].startswith("reading.") or any(row.path == match[1] for row in READINGS)):
            yield match[1], name


def _reading(path: str) -> list[str]:
    """One contradiction of the paper: what it says, the two readings, and which packaged group chooses which."""
    row = next((r for r in READINGS if r.path == path), None)
    if row is None:
        return [path]
    return [
        f"{row.path} ({row.number}): {row.matter}",
        f"  coherent (in force by default): {row.coherent}, because {row.reason}",
        f"  as printed (reading=as_printed): {row.as_printed}",
    ]


def _first(text: str | None) -> str:
    """The first sentence."""
    return inspect.cleandoc(text or "").partition("\n\n")[0].replace("\n", " ").partition(". ")[0].rstrip(".")
