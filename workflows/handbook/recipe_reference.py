"""The page of the handbook on the recipe language, written from the JSON schema and from the files of the groups."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from neusee.workflows.handbook.json_schema import schema
from neusee.workflows.handbook.plain_markdown import escaped, table
from neusee.workflows.recipe.distributions.law_text import KINDS
from neusee.workflows.recipe.loading import groups, recipes

_TYPES = {"integer": "whole number", "array": "list", "object": "mapping", "string": "text", "null": "none"}
_STEP = {
    "node": "The function that computes the step: [nodes](nodes.md).",
    "from": "The inputs: names of steps.",
    "with": "The parameters.",
    "each": "A block: one copy of the step for each item.",
    "device": "Where to compute: `any`, `cpu`, `gpu` or `cuda:0`.",
    "cache": "`false` computes the step in each run, and stores neither its result nor what follows from it.",
}


def recipe_page() -> str:
    """Return the page on the keys of a recipe, the keys of a step, the groups and the packaged recipes."""
    whole = schema()
    keys = [[f"`{name}`", _kind(part), part["description"]] for name, part in whole["properties"].items()]
    step = whole["$defs"]["step"]["properties"]
    lines = [
        "# Recipe language",
        "",
        "Every key that the program reads. [Recipes and groups](../recipes.md) explains how they work together, and",
        "`neusee schema` prints the same as a JSON schema for your editor.",
        *("", "## Keys of a recipe", ""),
        *table(["key", "value", "meaning"], keys),
        *("", "Any other key is a block of values, such as `sensor`, to which steps refer as `${sensor.bits}`."),
        *("", "## Keys of a step", ""),
        *table(["key", "meaning"], [[f"`{name}`", _STEP[name]] for name in step]),
        *("", "## Values", ""),
        f"A number with its unit (`532 nm`), a reference (`${{a.b}}`), or one of {', '.join(map(_code, KINDS))}.",
        *("", "## Block `train`", ""),
        *_training(whole["$defs"]["train"], whole["$defs"]),
        *("", "## Groups", ""),
        *_groups(),
        *("", "## Recipes", ""),
        *table(["recipe", "what it shows"], [[f"`{each.name}`", escaped(each.title)] for each in recipes()]),
    ]
    return "\n".join(lines) + "\n"


def _code(text: str) -> str:
    return f"`{text}`"


def _kind(part: Mapping[str, Any]) -> str:
    """Return the types that a part of the schema allows, in words."""
    if "anyOf" in part:
        return " or ".join(dict.fromkeys(_kind(each) for each in part["anyOf"] if "pattern" not in each))
    if "$ref" in part:
        return "mapping"
    kinds = part.get("type", [])
    return " or ".join(_TYPES.get(kind, kind) for kind in ([kinds] if isinstance(kinds, str) else kinds))


def _training(block: Mapping[str, Any], blocks: Mapping[str, Any]) -> list[str]:
    """Return a table of the keys of the block ``train`` and of the blocks in it."""
    rows = [
        [f"`{name}`", _kind(part), _code(str(part["default"])) if part.get("default") is not None else ""]
        for name, part in _keys(block, blocks, "train")
    ]
    return table(["key", "value", "default"], rows)


def _keys(block: Mapping[str, Any], blocks: Mapping[str, Any], path: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    for name, part in block["properties"].items():
        if inner := part.get("$ref"):
            yield from _keys(blocks[inner.rpartition("/")[2]], blocks, f"{path}.{name}")
        else:
            yield f"{path}.{name}", part


def _groups() -> Iterator[str]:
    """Yield a table of the options of each group."""
    for group, options in groups().items():
        yield from (f"### `{group}`", "")
        yield from table(["option", "what it is"], [[f"`{group}={o.name}`", escaped(o.title)] for o in options])
        yield ""
