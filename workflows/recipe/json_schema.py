"""JSON schema of a recipe file, for editors: they complete names and mark mistakes during typing.

The schema of a step depends on its ``node``, so that a wrong name under ``with`` is one error and
not one error for every node. A file may be incomplete (groups are merged), so no key is required.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from typing import Any

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from neusee.nodes import Node, units
from neusee.workflows.recipe.blocks.train_block import Training
from neusee.workflows.recipe.distributions.scalar import KINDS as LAWS
from neusee.workflows.recipe.loading import groups
from neusee.workflows.recipe.step_declarations import all_nodes
from neusee.workflows.recipe.wiring import takes_many

Schema = dict[str, Any]

#: a reference ``${a.b}`` or a distribution, which may replace every value
REFERENCE: Schema = {"type": "string", "pattern": rf"\$\{{.+\}}|^({'|'.join(LAWS)})\(.+\)$"}
_WIRE: Schema = {"type": ["string", "null"], "pattern": r"^[^\[\]\s]+(\[[^\[\]]+\])?$|\$\{"}
_DEVICE: Schema = {"type": ["string", "null"], "pattern": r"^(any|cpu|gpu|mps|cuda(:\d+)?)$|\$\{"}
_ANY: Schema = {}
_REFERABLE = {"float", "int", "bool", "literal", "tuple", "list", "dict", "function-before"}  #: all but plain strings
_NUMBER = r"(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"


def schema() -> Schema:
    """Return the schema of recipes and of the options of groups."""
    nodes = dict(all_nodes())
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "neusee recipe",
        "type": "object",
        "properties": {
            "defaults": {"type": "array", "items": _defaults(), "description": "Groups that come first, in order."},
            "steps": {"type": "object", "additionalProperties": {"$ref": "#/$defs/step"}},
            "seed": {"anyOf": [{"type": "integer", "minimum": 0}, REFERENCE]},
            "tolerance": {"anyOf": [{"type": "number", "minimum": 0}, REFERENCE]},
            "outputs": {"type": ["array", "string"], "items": {"type": "string"}},
            "posterior": {"anyOf": [{"type": "string"}, {"type": "object"}, {"type": "null"}]},
            "train": {"anyOf": [{"$ref": "#/$defs/train"}, {"type": "null"}]},
            "train_lift": {"type": ["object", "null"]},
            "expect": {"type": "object", "additionalProperties": {"$ref": "#/$defs/expectation"}},
        },
        "additionalProperties": True,
        "$defs": {"step": _step(nodes), "expectation": _expectation(), **_parameters(nodes), **_training()},
    }


def _defaults() -> Schema:
    """Return the schema of one entry of ``defaults``: packaged options are offered, other names are allowed."""
    options = {
        group: {"anyOf": [{"enum": [option.name for option in found]}, {"type": ["string", "null"]}]}
        for group, found in groups().items()
    }
    return {"type": "object", "properties": options, "minProperties": 1, "maxProperties": 1}


def _step(nodes: Mapping[str, Node]) -> Schema:
    """Return the schema of a step: its general keys, and for each node the inputs and parameters."""
    each: Schema = {"type": ["string", "array", "null"], "items": {"type": "string"}, "maxItems": 2}
    names: Schema = {"anyOf": [{"enum": list(nodes)}, REFERENCE]}
    return {
        "type": ["object", "null"],
        "properties": {"node": names, "each": each, "from": _ANY, "with": _ANY, "device": _DEVICE},
        "additionalProperties": False,
        "allOf": [
            {
                "if": {"properties": {"node": {"const": name}}, "required": ["node"]},
                "then": {
                    "title": name,
                    "description": _first_sentence(node),
                    "properties": {"from": _inputs(node), "with": {"$ref": f"#/$defs/{name}"}},
                },
            }
            for name, node in nodes.items()
        ],
    }


def _inputs(node: Node) -> Schema:
    """Return the schema of ``from`` for a node."""
    if not node.inputs:
        return {"type": "null"}
    lists = [name for name in node.inputs if takes_many(node, name)]
    wires = {name: {**_WIRE, "description": "all items"} if name in lists else _WIRE for name in node.inputs}
    return {"type": ["string", "object", "null"], "properties": wires, "additionalProperties": False}


def _expectation() -> Schema:
    number: Schema = {"anyOf": [{"type": "number"}, REFERENCE]}
    at: Schema = {"type": ["array", "integer", "string"], "items": {"type": ["integer", "string"]}}
    properties = {"step": {"type": "string"}, "at": at, "value": number, "rtol": number}
    required = ["step", "value", "rtol"]
    return {"type": "object", "properties": properties, "additionalProperties": False, "required": required}


def _parameters(nodes: Mapping[str, Node]) -> Schema:
    """Return the schema of the parameters of every node, by the node's name."""
    found = {}
    for name, node in nodes.items():
        model = node.params.model_json_schema(schema_generator=_Generator)
        for field in model.get("properties", {}).values():
            field.pop("title", None)
        allowed = {"type": ["object", "null"], "properties": model.get("properties", {}), "additionalProperties": False}
        found[name] = allowed | ({"$defs": model["$defs"]} if "$defs" in model else {})
    return found


def _training() -> Schema:
    """Return the schema of the ``train`` block; every key is optional."""
    model = Training.model_json_schema(schema_generator=_Generator, ref_template="#/$defs/train.{model}")
    blocks = {f"train.{name}": block for name, block in model.pop("$defs").items()}
    for block in (model, *blocks.values()):
        block.pop("required", None)
    return {**blocks, "train": model}


class _Generator(GenerateJsonSchema):
    """Pydantic's schema extended by quantities with units, and by references."""

    def generate_inner(self, schema: Any) -> JsonSchemaValue:
        found = super().generate_inner(schema)
        return {"anyOf": [found, REFERENCE]} if schema["type"] in _REFERABLE else found

    def function_before_schema(self, schema: core_schema.BeforeValidatorFunctionSchema) -> JsonSchemaValue:
        """Return the schema of a quantity: a number and one of the units that its reader accepts."""
        read = schema["function"]["function"]
        found = [unit for unit in _all_units() if _takes(read, unit)]
        if not found:
            return super().function_before_schema(schema)
        sign = "[+]?" if {"gt", "ge"} & schema["schema"].keys() else "[-+]?"
        pattern = rf"^\s*{sign}{_NUMBER}\s*({'|'.join(map(re.escape, found))})\s*$"
        return {"type": "string", "pattern": pattern}


def _all_units() -> list[str]:
    return [unit for scale in units._SCALE.values() for unit in scale]


def _takes(read: Any, unit: str) -> bool:
    try:
        read(f"1 {unit}")
    except (ValueError, TypeError):
        return False
    return True


def _first_sentence(node: Node) -> str:
    return inspect.cleandoc(node.__doc__ or "").partition("\n")[0]
