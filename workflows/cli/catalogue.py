"""The commands ``neusee recipes``, ``nodes`` and ``schema``, and the lines that they print."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from itertools import chain, groupby
from pathlib import Path
from types import MappingProxyType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Union, get_args, get_origin

import typer

import neusee.recipes
from neusee.workflows.cli import lazy_imports as lazy
from neusee.workflows.cli.command_frame import Debug, failing, refusing, say
from neusee.workflows.graph.errors import nearest
from neusee.workflows.report.paper_readings import READINGS, SETTLED
from neusee.workflows.report.terminal_text import columns

if TYPE_CHECKING:
    from neusee.nodes import Node
    from neusee.workflows.recipe.node_families import Own

#: how the help on a node describes a type of `neusee.nodes.units`
_TYPES_IN_WORDS = {
    "DarkCurrent": "charge from 0 of one exposure, such as 0.002 e-, or by time, such as 0.02 e-/s",
    "DataFile": "a file",
    "DataFiles": "files: a path, a folder, a pattern such as dark/*.png, or a list of these",
}
#: name of a quantity and an example, by its SI unit
_QUANTITIES = {
    "m": ("length", "2.9 um"),
    "s": ("time", "100 ms"),
    "rad": ("angle", "1 mrad"),
    "K": ("temperature", "6504 K"),
    "e-": ("charge", "390 e-"),
    "e-/s": ("dark current", "0.02 e-/s"),
    "W": ("power", "5 mW"),
    "J": ("energy", "1 uJ"),
    "Hz": ("frequency", "1 kHz"),
    "lx": ("illuminance", "1000 lx"),
    "cd/m2": ("luminance", "300 cd/m2"),
    "waves": ("optical path", "2 waves"),
    "DN/e-": ("gain", "2.7 DN/e- or 0.37 e-/DN"),
}


#: examples of types of `neusee.nodes.units` whose usual values are far from the example of their
#: unit
_EXAMPLES = {
    "Wavelength": "550 nm",
    "Linewidth": "10 nm",
    "Distance": "100 m",
    "Visibility": "10 km",
    "FocalLength": "50 mm",
    "Diameter": "25 mm",
    "BeamRadius": "1 mm",
    "Depth": "1.2 um",
    "Height": "50 nm",
    "Delay": "1 ms",
}


def recipes() -> None:
    """List the recipes and the groups of options."""
    say(recipe_lines())


def nodes(
    name: Annotated[
        str | None, typer.Argument(help="One node, such as optics.psf; `reading`, or `glossary`.")
    ] = None,
    recipe: Annotated[
        str | None, typer.Option("--recipe", help="Include the nodes that this recipe names.")
    ] = None,
    debug: Debug = False,
) -> None:
    """List the nodes, or explain one node.

    For one node: its physics, source, error, inputs and parameters, and the recipes that use it.
    `reading` lists how the paper is read where it contradicts itself. `glossary` lists the terms of
    the field, one a line.
    """
    own_families = _own(recipe)
    with failing(LookupError):
        lines = node_lines(name, own_families) if name else nodes_lines(own_families)
        say(lines)


def schema(
    recipe: Annotated[
        str | None, typer.Argument(help="Include the nodes that this recipe names.")
    ] = None,
) -> None:
    """Print the JSON schema of recipes for editors."""
    import json

    say([json.dumps(lazy.json_schema.schema(_own(recipe)), indent=1)])


def _own(recipe: str | None) -> Own:
    """Return the modules of the families of nodes that a recipe names, by family."""
    if recipe is None:
        return {}

    with refusing():
        return lazy.loading.families_of(recipe)


# --- what the commands print ----------------------------------------------------------------------


def recipe_lines() -> list[str]:
    """Return a line for each recipe with its title, then a line for each group with its options."""
    titles = columns([[recipe.name, recipe.title] for recipe in lazy.loading.recipes()])
    groups: list[str] = []
    for name, options in lazy.loading.groups().items():
        names = ", ".join(option.name for option in options)
        groups.append(f"  {name}: {names}")
    return [*titles, "", "groups, as in `neusee run laser=six`", *groups]


def nodes_lines(own: Own = MappingProxyType({})) -> list[str]:
    """Return a line for each node, sorted by family, with the first sentence of its docstring."""
    nodes = dict(lazy.node_families.all_nodes(own))
    width = max(map(len, nodes), default=0)
    lines: list[str] = []
    for family, paths in groupby(nodes, lambda path: path.partition(".")[0]):
        lines += ["", first_sentence(lazy.node_families.family_title(family, own))]
        lines += [f"{path:<{width}}  {first_sentence(nodes[path].__doc__)}" for path in paths]
    lines += _networks(own)
    broken_texts = lazy.node_families.broken_families().values()
    # without the empty line before the first family
    return [*lines[1:], *([""] if broken_texts else []), *broken_texts]


def _networks(own: Own) -> list[str]:
    """Return a line for each network class of the user's families."""
    lines = ["", "Network classes, for restore.network"]
    for family, module in own.items():
        lines += [
            f"{family}.{name}  {first_sentence(vars(network).get('__doc__'))}"
            for name, network in lazy.own_modules.network_classes(module).items()
        ]
    # more than the heading
    return lines if len(lines) > 2 else []


def node_lines(name: str, own: Own = MappingProxyType({})) -> list[str]:
    """Return the help on one node; for `reading` the interpretations of the paper, for
    `glossary` the field's terms.
    """
    if name == "glossary":
        return glossary_lines()
    if name == "reading":
        return _reading_lines()
    nodes = dict(lazy.node_families.all_nodes(own))
    if name not in nodes:
        raise LookupError(f"there is no node {name}: {nearest(name, nodes)}")
    files_and_steps = list(_uses(name))
    paths = dict.fromkeys(chain.from_iterable(_readings_of(step) for _, step in files_and_steps))
    lines = [name, "", *_signature_lines(nodes[name])]
    for path in paths:
        lines += ["", *_reading(path)]
    recipes = dict.fromkeys(file for file, _ in files_and_steps)
    return [*lines, "", f"written in  {', '.join(recipes) or 'no recipe'}"]


def _reading_lines() -> list[str]:
    """Return each contradiction in the paper that a recipe key resolves, and then those that need
    no key.
    """
    lines: list[str] = []
    for reading in READINGS:
        lines += [*_reading(reading.path), ""]
    for row in SETTLED:
        lines += [f"{row.number}: {row.matter}", f"  no key: {row.why}", ""]
    return lines


def _signature_lines(node: Node) -> list[str]:
    """Return the docstring of a node, its inputs and its parameters."""
    inputs = [
        f"  {input_name}{' (optional)' if input_name in node.optional else ''}"
        for input_name in node.inputs
    ]
    rows = [[f"  {name}", words] for name, words in parameter_rows(node)]
    return [
        *inspect.cleandoc(node.__doc__ or "").splitlines(),
        *("", "inputs", *(inputs or ["  none"])),
        *("", "parameters", *(columns(rows) or ["  none"])),
    ]


def glossary_lines() -> list[str]:
    """Return the terms of the packaged glossary, one on each line, without Markdown markup."""
    text = (_recipes() / "guide" / "glossary.md").read_text(encoding="utf-8")
    return [re.sub(r"[*`]", "", line[2:]) for line in text.splitlines() if line.startswith("- **")]


def _recipes() -> Path:
    return Path(neusee.recipes.__file__).parent


def parameter_rows(node: Node) -> list[list[str]]:
    """Return the name of each parameter of a node, and its type and default value in words."""
    rows = []
    for name, field in node.params.model_fields.items():
        value = "none" if field.default is None else str(field.default)
        default = "required" if field.is_required() else f"default {value}"
        rows.append([name, f"{_kind(node.hints[name])}; {default}"])
    return rows


def _kind(hint: Any) -> str:
    """Describe a parameter's type in words: its unit, its allowed texts, or the range of its
    numbers.
    """
    for name, words in _TYPES_IN_WORDS.items():
        if hint == getattr(lazy.units, name):
            return words
    metadata, arguments = getattr(hint, "__metadata__", ()), get_args(hint)
    if any(isinstance(extra, lazy.units.IsFile) for extra in metadata):
        return _TYPES_IN_WORDS["DataFile"]
    if metadata and (words := _quantity(hint)):
        return words
    if metadata:
        return f"{_kind(arguments[0])} {_limits(hint)}".strip()
    if arguments:
        return _composed(hint, arguments)
    names = {
        "int": "whole number",
        "float": "number",
        "bool": "true | false",
        "NoneType": "none",
        "str": "text",
        "Any": "any value",
        "Architecture": "a network class of yours, such as mynet.SmallUNet",
    }
    return names.get(getattr(hint, "__name__", ""), str(hint))


def _quantity(hint: Any) -> str:
    """Describe a quantity by its name, its range and an example, or return "" for a number
    without a unit.
    """
    number_range = next(lazy.units.number_ranges(hint), None)
    if (
        number_range is None
        or not number_range.si
        or number_range.least is None
        or number_range.greatest is None
    ):
        return ""
    name, usual_example = _QUANTITIES[number_range.si]
    example = next(
        (text for kind, text in _EXAMPLES.items() if hint == getattr(lazy.units, kind)),
        usual_example,
    )
    in_words = lazy.units.in_words
    greatest = in_words(number_range.greatest, number_range.si)
    if number_range.least == 0:
        return (
            f"{name} {'above' if 'gt=0' in repr(hint) else 'from'} 0 to {greatest}, such as"
            f" {example}"
        )
    return (
        f"{name} from {in_words(number_range.least, number_range.si)} to {greatest}, such as"
        f" {example}"
    )


def _limits(hint: Any) -> str:
    """Return the limits of a number in words, such as ``>= 0 and < 1``.

    They are read from the text of its annotation.
    """
    signs = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}
    limits = re.findall(r"\b(?:Ge|Gt|Le|Lt)\((ge|gt|le|lt)=([^)]+)\)", repr(hint))
    return " and ".join(f"{signs[sign]} {limit}" for sign, limit in limits)


def _composed(hint: Any, arguments: tuple[Any, ...]) -> str:
    """Return the words for a type that is made of others: choices, unions, mappings and lists."""
    if all(isinstance(argument, str) for argument in arguments):
        return " | ".join(arguments)
    part_kinds = [_kind(argument) for argument in arguments if argument is not Ellipsis]
    if get_origin(hint) in (Union, UnionType):
        return " or ".join(part_kinds)
    if get_origin(hint) is dict:
        return f"mapping of {part_kinds[0]}: {part_kinds[-1]}"
    return (
        f"list of {part_kinds[0]}"
        if Ellipsis in arguments or len(part_kinds) == 1
        else f"[{', '.join(part_kinds)}]"
    )


def _uses(name: str) -> Iterator[tuple[str, Any]]:
    """Yield each packaged recipe file with a step that runs the node ``name``, together with
    this step.
    """
    from ruamel.yaml import YAML

    for path in sorted(_recipes().rglob("*.yaml")):
        text = path.read_text(encoding="utf-8")
        if name not in text:
            continue
        steps = (YAML(typ="safe").load(text) or {}).get("steps") or {}
        for step in steps.values():
            if isinstance(step, dict) and step.get("node") == name:
                yield str(path.relative_to(_recipes())), step


def _readings_of(step: Any) -> Iterator[str]:
    """Yield each recipe key that chooses an interpretation of the paper and to which a parameter
    of ``step`` refers.
    """
    paths = {row.path for row in READINGS}
    for value in (step.get("with") or {}).values():
        match = re.fullmatch(r"\$\{(\w+\.\w+)\??\}", str(value))
        if match and (match[1].startswith("reading.") or match[1] in paths):
            yield match[1]


def _reading(path: str) -> list[str]:
    """Return lines about a contradiction in the paper: its text, both interpretations and their
    options.
    """
    row = next((reading for reading in READINGS if reading.path == path), None)
    if row is None:
        return [path]
    return [
        f"{row.path} ({row.number}): {row.matter}",
        f"  coherent (in force by default): {row.coherent}, because {row.reason}",
        f"  as printed ({row.argument}): {row.as_printed}",
        *([f"    {row.consequence}"] if row.consequence else []),
    ]


def first_sentence(text: str | None) -> str:
    """Return the first sentence of a text."""
    return (
        inspect.cleandoc(text or "")
        .partition("\n\n")[0]
        .replace("\n", " ")
        .partition(". ")[0]
        .rstrip(".")
    )
