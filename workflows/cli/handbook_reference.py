"""The pages of the handbook that the program writes about itself: nodes, commands, the recipe
language and Python.
"""

from __future__ import annotations

import inspect
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from typer.main import get_command

from neusee.workflows.cli.catalogue import first_sentence, parameter_rows
from neusee.workflows.cli.commands_and_exit_codes import EXIT_CODES
from neusee.workflows.cli.program_options import program
from neusee.workflows.handbook.recipe_and_python_reference import (
    escaped,
    prose,
    python_page,
    recipe_page,
    table,
)
from neusee.workflows.recipe.node_families import all_nodes, family_title

if TYPE_CHECKING:
    from neusee.nodes import Node


def reference_pages(recipes: Path) -> dict[str, str]:
    """Return every page of the reference by its path; ``recipes`` is the folder of the packaged
    recipes.
    """
    return {
        "reference/nodes.md": nodes_page(),
        **family_pages(uses_of_nodes(recipes)),
        "reference/recipe_language.md": recipe_page(),
        "reference/options.md": commands_page(),
        "reference/public_names.md": python_page(),
    }


# --- nodes ----------------------------------------------------------------------------------------


def uses_of_nodes(recipes: Path) -> dict[str, list[str]]:
    """Return the packaged files with a step of a node, by the name of the node."""
    uses: dict[str, list[str]] = defaultdict(list)
    for path in sorted(recipes.rglob("*.yaml")):
        for name in dict.fromkeys(
            re.findall(r"\bnode: ([\w.]+)", path.read_text(encoding="utf-8"))
        ):
            uses[name].append(str(path.relative_to(recipes)))
    return uses


def nodes_page() -> str:
    """Return the page that lists every node by family, with the first sentence of its docstring."""
    lines = [
        "# Nodes",
        "",
        (
            "A node is the function that computes one step. `neusee nodes optics.psf` explains one"
            " on the terminal."
        ),
    ]
    for family, names in groupby(dict(all_nodes()).items(), lambda item: item[0].partition(".")[0]):
        rows = [
            [
                f"[`{name}`](nodes/{family}.md#{_anchor(name)})",
                escaped(first_sentence(node.__doc__)),
            ]
            for name, node in names
        ]
        lines += [
            "",
            f"## {escaped(first_sentence(family_title(family)))}",
            "",
            *table(["node", "what it computes"], rows),
        ]
    return "\n".join(lines) + "\n"


def family_pages(uses: Mapping[str, list[str]]) -> dict[str, str]:
    """Return a page for each family of nodes: formulas, sources, errors, inputs and parameters
    of each node.
    """
    pages = {}
    for family, names in groupby(dict(all_nodes()).items(), lambda item: item[0].partition(".")[0]):
        lines = [f"# {family}", "", f"{escaped(first_sentence(family_title(family)))}.", ""]
        for name, node in names:
            lines += _node(name, node, uses.get(name, []))
        pages[f"reference/nodes/{family}.md"] = "\n".join(lines) + "\n"
    return pages


def _anchor(name: str) -> str:
    return name.replace(".", "-")


def _node(name: str, node: Node, files: list[str]) -> Iterator[str]:
    """Yield the lines on a node: docstring, inputs, parameters, and the files that use it."""
    yield from (
        f"## {name} {{ #{_anchor(name)} }}",
        "",
        *prose(inspect.cleandoc(node.__doc__ or "")),
        "",
    )
    inputs = [
        f"`{name_of_input}`{' (optional)' if name_of_input in node.optional else ''}"
        for name_of_input in node.inputs
    ]
    yield from (f"**Inputs:** {', '.join(inputs) or 'none'}.", "")
    rows = [
        [f"`{parameter}`", *map(escaped, words.rsplit("; ", 1))]
        for parameter, words in parameter_rows(node)
    ]
    yield from (
        *(table(["parameter", "value", ""], rows) if rows else ["**Parameters:** none."]),
        "",
    )
    yield from (
        f"**Written in:** {', '.join(f'`{file}`' for file in files) or 'no packaged recipe'}.",
        "",
    )


# --- commands -------------------------------------------------------------------------------------


def commands_page() -> str:
    """Return the page on every command: what it does, its arguments and its options."""
    command = get_command(program())
    context = typer.Context(command, info_name="neusee")
    lines = [
        "# Options of all commands",
        "",
        (
            "What `--help` prints, for every command. [Commands](../commands.md) has examples."
            f" {EXIT_CODES}"
        ),
        "",
        *_command(command, context, 1),
    ]
    return "\n".join(lines) + "\n"


def _command(command: Any, context: typer.Context, level: int) -> Iterator[str]:
    """Yield the section of a command, and of the commands below it."""
    if level > 1:
        usage = " ".join([context.command_path, *command.collect_usage_pieces(context)])
        text = inspect.cleandoc(command.help or "")
        yield from (f"{'#' * level} {context.command_path}", "", f"`{usage}`", "", *prose(text))
    rows = [
        [_spelled(parameter), escaped(getattr(parameter, "help", None) or ""), _default(parameter)]
        for parameter in command.params
    ]
    yield from (*(table(["", "meaning", "default"], rows) if rows else ()), "")
    # only a group has commands below it
    for name in command.list_commands(context) if hasattr(command, "list_commands") else ():
        inner_command = command.get_command(context, name)
        yield from _command(
            inner_command, typer.Context(inner_command, info_name=name, parent=context), level + 1
        )


def _spelled(parameter: Any) -> str:
    """Return how a parameter is written: all spellings of an option, the name of an argument."""
    if parameter.param_type_name == "option":
        return ", ".join(f"`{word}`" for word in (*parameter.opts, *parameter.secondary_opts))
    return f"`{parameter.metavar or parameter.name.upper()}`"


def _default(parameter: Any) -> str:
    """Return the default of a parameter; an empty text for a flag, and for none."""
    value = parameter.default
    is_shown = isinstance(value, int | float | str) and not isinstance(value, bool) and value != ""
    return f"`{value}`" if is_shown or isinstance(value, Path) else ""
