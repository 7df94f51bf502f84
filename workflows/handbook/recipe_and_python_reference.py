"""The pages of the handbook on the recipe language and on Python, as Markdown."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import neusee
from neusee.workflows.handbook.json_schema import schema
from neusee.workflows.recipe.distributions.law_text import KINDS
from neusee.workflows.recipe.loading import groups, recipes

# --- plain markdown -------------------------------------------------------------------------------

# Docstrings and tables as Markdown.


_CODE = re.compile(r"(``.+?``|`[^`]+`)", re.DOTALL)


def escaped(text: str) -> str:
    """Return a text with the special characters of Markdown escaped, except in code."""
    pieces = _CODE.split(text)
    return "".join(
        # the pattern has one group, so that every second piece is code
        piece if number % 2 else re.sub(r"([\\*_<>\[\]|])", r"\\\1", piece)
        for number, piece in enumerate(pieces)
    )


def cell(text: str) -> str:
    """Return a text that may stand in a cell of a table."""
    return " ".join(re.sub(r"(?<!\\)\|", r"\\|", text).split())


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(map(cell, line)) + " |" for line in lines]


def prose(text: str) -> list[str]:
    """Return a docstring as Markdown; indented lines stay a block of code."""
    lines: list[str] = []
    for paragraph in re.split(r"\n\s*\n", text.strip()):
        is_code = all(line.startswith("    ") for line in paragraph.splitlines())
        lines += [*(paragraph.splitlines() if is_code else _sentences(paragraph)), ""]
    return lines


def _sentences(paragraph: str) -> Iterator[str]:
    """Yield the lines of a paragraph; a line such as ``Source: …`` begins a paragraph of its
    own.
    """
    for line in paragraph.splitlines():
        if label := re.match(r"([A-Z]\w+): ", line):
            yield from ("", f"**{label[1]}:** {escaped(line[label.end() :])}")
        else:
            yield escaped(line.strip())


# --- python reference -----------------------------------------------------------------------------

# The page of the handbook on Python, written from the signatures and docstrings of the public
# names.


def python_page() -> str:
    """Return the page on every public name of the package ``neusee``."""
    public_names = {
        name: getattr(neusee, name) for name in neusee.__all__ if not name.startswith("_")
    }
    functions: list[str] = []
    classes: list[str] = []
    errors: list[str] = []
    for name, value in public_names.items():
        if not inspect.isclass(value):
            functions += _section(name, value)
        elif not issubclass(value, Exception):
            classes += _class(name, value)
    for name in sorted(public_names):
        if _is_error(public_names[name]):
            errors += _section(name, public_names[name])
    opening = [
        "# Public names",
        "",
        (
            "These names are `neusee.load`, `neusee.run` and so on. The page [from"
            " Python](../python.md) has examples, and"
        ),
        (
            "[exceptions](../exceptions.md) says who raises what. The text below is that of the"
            " program itself."
        ),
        "",
        *prose(inspect.getdoc(neusee) or ""),
    ]
    lines: list[str] = []
    for section in (
        opening,
        ["## Functions"],
        functions,
        ["## Classes"],
        classes,
        ["## Errors"],
        errors,
    ):
        lines += [*section, ""]
    return "\n".join(lines) + "\n"


def _is_error(value: Any) -> bool:
    return inspect.isclass(value) and issubclass(value, Exception)


def _section(name: str, value: Any, level: str = "###") -> Iterator[str]:
    """Yield the heading, the signature and the docstring of a function or a class."""
    yield from (f"{level} {name}", "")
    if callable(value) and not _is_error(value):
        yield from ("```python", f"{name}{_signature(value)}", "```", "")
    yield from (*prose(inspect.getdoc(value) or ""), "")


def _class(name: str, value: type) -> Iterator[str]:
    """Yield the section of a class and of each public method."""
    yield from _section(name, value)
    for method, function in vars(value).items():
        function_itself = function.fget if isinstance(function, property) else function
        if not method.startswith("_") and (
            inspect.isfunction(function_itself) or isinstance(function, classmethod)
        ):
            yield from _section(
                f"{name}.{method}", getattr(function_itself, "__func__", function_itself), "####"
            )


def _signature(value: Any) -> str:
    """Return the arguments and the result of a function, without the argument ``self``."""
    try:
        signature = inspect.signature(value)
    except (TypeError, ValueError):
        return "()"
    text = str(
        signature.replace(
            parameters=[
                parameter for name, parameter in signature.parameters.items() if name != "self"
            ]
        )
    )
    # a default that is a function or a class is shown by its name, without an address
    return re.sub(r"<(?:function|class) '?([\w.]*\.)?(\w+)'?(?: at 0x[0-9a-f]+)?>", r"\2", text)


# --- recipe reference -----------------------------------------------------------------------------

# The page of the handbook on the recipe language, written from the JSON schema and from the files
# of the groups.


_TYPES = {
    "integer": "whole number",
    "array": "list",
    "object": "mapping",
    "string": "text",
    "null": "none",
}
_STEP = {
    "node": "The function that computes the step: [nodes](nodes.md).",
    "from": "The inputs: names of steps.",
    "with": "The parameters.",
    "each": "A block: one copy of the step for each item.",
    "device": "Where to compute: `any`, `cpu`, `gpu` or `cuda:0`.",
    "cache": (
        "`false` computes the step in each run, and stores neither its result nor what follows"
        " from it."
    ),
}


def recipe_page() -> str:
    """Return the page on the keys of a recipe, the keys of a step, the groups and the packaged
    recipes.
    """
    recipe_schema = schema()
    keys = [
        [f"`{name}`", _kind(entry), entry["description"]]
        for name, entry in recipe_schema["properties"].items()
    ]
    step = recipe_schema["$defs"]["step"]["properties"]
    titles = [[f"`{recipe.name}`", escaped(recipe.title)] for recipe in recipes()]
    lines = [
        "# Recipe language",
        "",
        (
            "Every key that the program reads. [Recipes and groups](../recipes.md) explains how"
            " they work together, and"
        ),
        "`neusee schema` prints the same as a JSON schema for your editor.",
        *("", "## Keys of a recipe", ""),
        *table(["key", "value", "meaning"], keys),
        *(
            "",
            (
                "Any other key is a block of values, such as `sensor`, to which steps refer as"
                " `${sensor.bits}`."
            ),
        ),
        *("", "## Keys of a step", ""),
        *table(["key", "meaning"], [[f"`{name}`", _STEP[name]] for name in step]),
        *("", "## Values", ""),
        (
            "A number with its unit (`532 nm`), a reference (`${a.b}`), or one of"
            f" {', '.join(map(_code, KINDS))}."
        ),
        *("", "## Block `train`", ""),
        *_training(recipe_schema["$defs"]["train"], recipe_schema["$defs"]),
        *("", "## Groups", ""),
        *_groups(),
        *("", "## Recipes", ""),
        *table(["recipe", "what it shows"], titles),
    ]
    return "\n".join(lines) + "\n"


def _code(text: str) -> str:
    return f"`{text}`"


def _kind(entry: Mapping[str, Any]) -> str:
    """Return the types that a part of the schema allows, in words."""
    if "anyOf" in entry:
        return " or ".join(
            dict.fromkeys(_kind(choice) for choice in entry["anyOf"] if "pattern" not in choice)
        )
    if "$ref" in entry:
        return "mapping"
    kinds = entry.get("type", [])
    return " or ".join(
        _TYPES.get(kind, kind) for kind in ([kinds] if isinstance(kinds, str) else kinds)
    )


def _training(block: Mapping[str, Any], blocks: Mapping[str, Any]) -> list[str]:
    """Return a table of the keys of the block ``train`` and of the blocks in it."""
    rows = [
        [
            f"`{name}`",
            _kind(entry),
            _code(str(entry["default"])) if entry.get("default") is not None else "",
        ]
        for name, entry in _keys(block, blocks, "train")
    ]
    return table(["key", "value", "default"], rows)


def _keys(
    block: Mapping[str, Any], blocks: Mapping[str, Any], path: str
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield each key of a block with its path and its part of the schema.

    Keys of blocks in the block are among them.
    """
    for name, entry in block["properties"].items():
        if reference := entry.get("$ref"):
            yield from _keys(blocks[reference.rpartition("/")[2]], blocks, f"{path}.{name}")
        else:
            yield f"{path}.{name}", entry


def _groups() -> Iterator[str]:
    """Yield a table of the options of each group."""
    for group, options in groups().items():
        yield from (f"### `{group}`", "")
        yield from table(
            ["option", "what it is"],
            [[f"`{group}={option.name}`", escaped(option.title)] for option in options],
        )
        yield ""
