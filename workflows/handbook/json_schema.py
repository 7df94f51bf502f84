"""JSON schema of recipe files, with which an editor completes names and marks mistakes.

The schema of a step depends on its ``node``, so that an editor reports a wrong name under ``with``
once, and not once for each node. The schema requires no key, because groups may complete a file.
"""

from __future__ import annotations

import inspect
import itertools
import math
import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from neusee.nodes import Node, units
from neusee.workflows.recipe.blocks.train_block import Training
from neusee.workflows.recipe.distributions.law_text import KINDS
from neusee.workflows.recipe.global_settings import ALL, HALF, NAMES, NONE
from neusee.workflows.recipe.loading import groups
from neusee.workflows.recipe.node_families import Own, all_nodes
from neusee.workflows.recipe.steps import takes_many

Schema = dict[str, Any]

#: schema of a reference such as ``${a.b}`` or a distribution, which may replace any value
REFERENCE: Schema = {"type": "string", "pattern": rf"\$\{{.+\}}|^({'|'.join(KINDS)})\(.+\)$"}
_WIRE: Schema = {"type": ["string", "null"], "pattern": r"^[^\[\]\s]+(\[[^\[\]]+\])?$|\$\{"}
_DEVICE: Schema = {"type": ["string", "null"], "pattern": r"^(any|cpu|gpu|mps|cuda(:\d+)?)$|\$\{"}
_CACHED: Schema = {"anyOf": [{"type": ["boolean", "null"]}, {"type": "string", "pattern": r"\$\{"}]}
_ANY: Schema = {}
_FAMILY: Schema = {"type": "object", "additionalProperties": {"type": "string"}, "maxProperties": 1}
_NODES: Schema = {"anyOf": [{"type": "string"}, _FAMILY]}
_MEANINGS = {
    "defaults": "Recipes that this one extends, and options of groups, in order.",
    "nodes": "Files and modules with your own nodes.",
    "steps": (
        "The graph: under each name a node, its inputs and its parameters; null removes a step."
    ),
    "seed": "Start of all random numbers.",
    "tolerance": "Largest error of an output, relative to its largest element; 0 is exact.",
    "estimates": (
        "False: only errors with a proved bound count towards the tolerance; true: estimated errors"
        " too."
    ),
    "outputs": "Steps whose results the run is for.",
    "exports": (
        "Data files that a run writes: all, none, or a list of names; NAME.exr@half has half"
        " floats."
    ),
    "posterior": "Joint distribution of several values.",
    "train": "Settings of `neusee train`.",
    "train_lift": "Settings of the training of a network from RGB to spectra.",
    "safety": "Settings of `neusee safety`.",
    "evaluate": "Settings of `neusee evaluate`.",
    "traceability": (
        "What the laboratory states of its light and temperature, for `neusee calibrate` and"
        " `sheet`."
    ),
    "expect": "Numbers from an independent source, which each run checks.",
}
#: types of values that a reference may replace
_REFERABLE = {"float", "int", "bool", "literal", "tuple", "list", "dict", "function-before"}
_NUMBER = r"(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"


def schema(own: Own = MappingProxyType({})) -> Schema:
    """Return the JSON schema of recipe files, which is also valid for the option files of groups.

    ``own`` has the modules of the user's families of nodes, by family.
    """
    nodes = dict(all_nodes(own))
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "neusee recipe",
        "type": "object",
        "properties": {
            name: {**value, "description": _MEANINGS[name]} for name, value in _keys().items()
        },
        # any other key is a block of values, such as `sensor`
        "additionalProperties": True,
        "$defs": {
            "step": _step(nodes),
            "expectation": _expectation(),
            **_parameters(nodes),
            **_training(),
        },
    }


def _keys() -> dict[str, Schema]:
    """Return the JSON schema of the value of each key of a recipe."""
    return {
        "defaults": {"type": "array", "items": _defaults()},
        "nodes": {"type": "array", "items": _NODES},
        "steps": {"type": "object", "additionalProperties": {"$ref": "#/$defs/step"}},
        "seed": {"anyOf": [{"type": "integer", "minimum": 0}, REFERENCE]},
        "tolerance": {"anyOf": [{"type": "number", "minimum": 0}, REFERENCE]},
        "estimates": {"anyOf": [{"type": "boolean"}, REFERENCE]},
        "outputs": {"type": ["array", "string"], "items": {"type": "string"}},
        "exports": {
            "anyOf": [
                {"enum": [ALL, NONE]},
                {"type": "array", "items": {"enum": _exported()}},
                REFERENCE,
            ]
        },
        "posterior": {"anyOf": [{"type": "string"}, {"type": "object"}, {"type": "null"}]},
        "train": {"anyOf": [{"$ref": "#/$defs/train"}, {"type": "null"}]},
        "train_lift": {"type": ["object", "null"]},
        "safety": {"type": ["object", "null"]},
        "evaluate": {"type": ["object", "null"]},
        "traceability": {"type": ["object", "null"]},
        "expect": {"type": "object", "additionalProperties": {"$ref": "#/$defs/expectation"}},
    }


def _exported() -> list[str]:
    """Return the words that name a data file of a run, with half floats or without."""
    return [*NAMES, *(name + HALF for name in NAMES if name.endswith(".exr"))]


def _defaults() -> Schema:
    """Return the JSON schema of an entry in ``defaults``, which suggests packaged options and
    allows other names.

    A name alone is that of a recipe, or, in the file of an option, that of another option of the
    same group.
    """
    packaged_options = {
        group: {"enum": [option.name for option in options]} for group, options in groups().items()
    }
    any_names: Schema = {"type": ["string", "null", "array"], "items": {"type": "string"}}
    options = {group: {"anyOf": [names, any_names]} for group, names in packaged_options.items()}
    group_choice: Schema = {
        "type": "object",
        "properties": options,
        "minProperties": 1,
        "maxProperties": 1,
    }
    return {"anyOf": [group_choice, {"type": "string"}]}


def _step(nodes: Mapping[str, Node]) -> Schema:
    """Return the JSON schema of a recipe step: the keys of all steps, and the inputs and
    parameters of each node.
    """
    item_lists: Schema = {
        "type": ["string", "array", "null"],
        "items": {"type": "string"},
        "maxItems": 2,
    }
    node_names: Schema = {"anyOf": [{"enum": list(nodes)}, REFERENCE]}
    return {
        "type": ["object", "null"],
        "properties": {
            "node": node_names,
            "each": item_lists,
            "from": _ANY,
            "with": _ANY,
            "device": _DEVICE,
            "cache": _CACHED,
        },
        "additionalProperties": False,
        "allOf": [
            {
                "if": {"properties": {"node": {"const": name}}, "required": ["node"]},
                "then": {
                    "title": name,
                    "description": inspect.cleandoc(node.__doc__ or "").partition("\n")[0],
                    "properties": {"from": _inputs(node), "with": {"$ref": f"#/$defs/{name}"}},
                },
            }
            for name, node in nodes.items()
        ],
    }


def _inputs(node: Node) -> Schema:
    """Return the JSON schema of a step's key ``from``, which names the inputs of the step's
    node.
    """
    if not node.inputs:
        return {"type": "null"}
    all_items = {**_WIRE, "description": "all items"}
    wires = {name: all_items if takes_many(node, name) else _WIRE for name in node.inputs}
    return {
        "type": ["string", "object", "null"],
        "properties": wires,
        "additionalProperties": False,
    }


def _expectation() -> Schema:
    """Return the JSON schema of an expected number in the key ``expect``."""
    number: Schema = {"anyOf": [{"type": "number"}, REFERENCE]}
    indices: Schema = {
        "type": ["array", "integer", "string"],
        "items": {"type": ["integer", "string"]},
    }
    properties = {"step": {"type": "string"}, "at": indices, "value": number, "rtol": number}
    required = ["step", "value", "rtol"]
    return {
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
        "required": required,
    }


def _parameters(nodes: Mapping[str, Node]) -> Schema:
    """Return the JSON schema of the parameters of each node, by the name of the node."""
    schemas = {}
    for name, node in nodes.items():
        model = node.params.model_json_schema(schema_generator=_Generator)
        for field in model.get("properties", {}).values():
            field.pop("title", None)
        parameter_schema = {
            "type": ["object", "null"],
            "properties": model.get("properties", {}),
            "additionalProperties": False,
        }
        schemas[name] = parameter_schema | ({"$defs": model["$defs"]} if "$defs" in model else {})
    return schemas


def _training() -> Schema:
    """Return the JSON schema of the block ``train`` of a recipe, in which every key is optional."""
    model = Training.model_json_schema(
        schema_generator=_Generator, ref_template="#/$defs/train.{model}"
    )
    blocks = {f"train.{name}": block for name, block in model.pop("$defs").items()}
    for block in (model, *blocks.values()):
        block.pop("required", None)
    return {**blocks, "train": model}


class _Generator(GenerateJsonSchema):
    """Generator of JSON schemas whose values may also be quantities with units, references and
    distributions.
    """

    def generate_inner(self, schema: Any) -> JsonSchemaValue:
        value_schema = super().generate_inner(schema)
        takes_reference = schema["type"] in _REFERABLE and REFERENCE not in value_schema.get(
            "anyOf", ()
        )
        return {"anyOf": [value_schema, REFERENCE]} if takes_reference else value_schema

    def function_before_schema(
        self, schema: core_schema.BeforeValidatorFunctionSchema
    ) -> JsonSchemaValue:
        """Return the JSON schema of a physical quantity: a number with one of the units that the
        parameter allows.
        """
        reader = schema["function"]["function"]
        every_unit = itertools.chain.from_iterable(units.SCALES.values())
        # the reader of a quantity refuses the units of other quantities
        allowed_units = [unit for unit in every_unit if _takes(reader, unit)]
        if not allowed_units:
            return super().function_before_schema(schema)
        lower_bound = max(schema["schema"].get(bound, -math.inf) for bound in ("gt", "ge"))
        sign = "[+]?" if lower_bound >= 0 else "[-+]?"
        pattern = rf"^\s*{sign}{_NUMBER}\s*({'|'.join(map(re.escape, allowed_units))})\s*$"
        return {"type": "string", "pattern": pattern}


def _takes(read: Any, unit: str) -> bool:
    """Return True if the reader of a quantity accepts a number with this unit."""
    try:
        read(f"1 {unit}")
    except (ValueError, TypeError):
        return False
    return True
