"""Signatures of nodes as JSON, from which a recipe is checked without an import of the nodes.

A signature says what `loading` reads of a node: inputs, types, units, ranges and defaults. A type
that JSON cannot say, such as that of a glass with its own coefficients, leaves a parameter whose
values are looked up: those that an earlier process has read.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import NoneType, SimpleNamespace, UnionType
from typing import Annotated, Any, Literal, NoReturn, Union, get_args, get_origin

from pydantic import AfterValidator, BeforeValidator, Field, PlainValidator, create_model
from pydantic.fields import FieldInfo

from neusee.nodes import Node, units
from neusee.nodes.parameters import ParameterModel, is_file, texts_of

Signature = Mapping[str, Any]  #: a JSON object
#: returns the value of a parameter that another process read: node, parameter, value in the recipe
Look = Callable[[str, str, Any], Any]


class NotRemembered(Exception):
    """Raised where a check asks for something that no earlier process has written down."""


class _NoJson(Exception):
    """Raised for a type or a default that a signature cannot say."""


# --- types ----------------------------------------------------------------------------------------

_NAMED: dict[str, Any] = {
    "float": float,
    "int": int,
    "str": str,
    "bool": bool,
    "None": NoneType,
    "...": Ellipsis,
    "Path": Path,
    "Any": Any,
    "object": object,
    "ElectronsPerSecond": units.ElectronsPerSecond,
}
_CONTAINERS: dict[str, Any] = {"tuple": tuple, "list": list, "dict": dict}
#: limits of a number or a length, as `pydantic.Field` names them
_LIMITS = ("gt", "ge", "lt", "le", "min_length", "max_length")
#: readers and checks of values that a signature may name, all without torch
_READERS = {
    name: reader
    for name, reader in vars(units).items()
    if inspect.isfunction(reader) and reader.__module__ == units.__name__
}


def _said(hint: Any) -> Any:
    """Return a type annotation as JSON; raise `_NoJson` for one that JSON cannot say."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return ["annotated", _said(arguments[0]), *map(_said_constraint, hint.__metadata__)]
    if origin is Literal:
        return ["literal", *arguments]
    if origin in (Union, UnionType):
        return ["union", *map(_said, arguments)]
    if origin in _CONTAINERS.values():
        return [origin.__name__, *map(_said, arguments)]
    return _name_of(hint)


def _name_of(type_: Any) -> str:
    """Return the name of a single type."""
    for name, named_type in _NAMED.items():
        if type_ is named_type:
            return name
    raise _NoJson


def _said_constraint(constraint: Any) -> Any:
    """Return a constraint of an annotated type as JSON."""
    if isinstance(constraint, units.IsFile):
        return ["file"]
    if isinstance(constraint, FieldInfo):
        return _said_limits(constraint)
    if not isinstance(constraint, BeforeValidator | AfterValidator):
        raise _NoJson
    reader = constraint.func
    if isinstance(reader, units.QuantityReader):
        return ["quantity", reader.si]
    name = getattr(reader, "__name__", "")
    if _READERS.get(name) is not reader:
        raise _NoJson
    return ["before" if isinstance(constraint, BeforeValidator) else "after", name]


def _said_limits(field: FieldInfo) -> list[Any]:
    """Return the limits of a number or a length as JSON; a field that says more has no JSON."""
    limits: dict[str, Any] = {}
    for limit in field.metadata:
        limits |= {name: getattr(limit, name) for name in _LIMITS if hasattr(limit, name)}
    if repr(Field(**limits)) != repr(field):
        raise _NoJson
    return ["limits", limits]


def _type_of(said: Any) -> Any:
    """Return the type annotation that `_said` has written."""
    if isinstance(said, str):
        return _NAMED[said]
    kind, *parts = said
    if kind == "literal":
        return Literal[tuple(parts)]
    if kind == "class":
        return _class_of(*parts)
    if kind == "annotated":
        return Annotated[(_type_of(parts[0]), *map(_constraint_of, parts[1:]))]
    types = tuple(map(_type_of, parts))
    return Union[types] if kind == "union" else _CONTAINERS[kind][types]  # noqa: UP007


def _constraint_of(said: Sequence[Any]) -> Any:
    """Return the constraint that `_said_constraint` has written."""
    kind, *parts = said
    if kind == "file":
        return units.IsFile()
    if kind == "limits":
        return Field(**{name: limit for name, limit in parts[0].items() if name in _LIMITS})
    if kind == "quantity":
        return BeforeValidator(units.QuantityReader(parts[0]))
    validator = BeforeValidator if kind == "before" else AfterValidator
    return validator(_READERS[parts[0]])


# --- classes of inputs and results ----------------------------------------------------------------

# An input and a result are classes, such as ``Tensor`` and ``Psf``, of which a check compares name
# and kinship alone.


_classes: dict[str, type] = {}  #: stand-ins for the classes of other modules, by module and name


def _said_wire(hint: Any) -> Any:
    """Return the type annotation of an input or a result as JSON."""
    if get_origin(hint) is Annotated:
        return _said_wire(get_args(hint)[0])
    if get_origin(hint) in (Union, UnionType):
        return ["union", *map(_said_wire, get_args(hint))]
    if get_origin(hint) is list:
        return ["list", *map(_said_wire, get_args(hint))]
    if isinstance(hint, type) and hint not in _NAMED.values():
        return _said_class(hint)
    return _said(hint)


def _said_class(class_: type) -> list[Any]:
    """Return a class as JSON: module, name, and the classes from which it is derived."""
    if class_.__module__ == "builtins" or not class_.__name__.isidentifier():
        raise _NoJson
    parents = [parent for parent in class_.__bases__ if parent.__module__ != "builtins"]
    return ["class", class_.__module__, class_.__name__, *map(_said_class, parents)]


def _class_of(module: str, name: str, *parents: Any) -> type:
    """Return the stand-in for a class, one for each module and name."""
    key = f"{module}:{name}"
    if key not in _classes:
        bases = tuple(_type_of(parent) for parent in parents)
        _classes[key] = type(name, bases, {"__module__": module})
    return _classes[key]


# --- signature ------------------------------------------------------------------------------------


def signature_of(node: Node) -> dict[str, Any] | None:
    """Return what a check reads of a node as JSON, or None for a node that JSON cannot describe."""
    parameters = _parameters_of(node)
    wires = [name for name in (*node.inputs, "return") if name in node.hints]
    hooks = node.hooks
    try:
        return {
            "module": node.fn.__module__,
            "inputs": node.inputs,
            "optional": sorted(node.optional),
            "random": node.random,
            "device": node.device,
            "before_run": node.before_run,
            "is_cheaper": node.channel_sum_form is not None or node.low_rank_form is not None,
            "accepts_channel_sums": node.accepts_channel_sums,
            "accepts_low_rank": node.accepts_low_rank,
            "checks": None if hooks.preflight is None else node.preflight_inputs,
            "has_shape": hooks.shape is not None,
            "wires": {name: _said_wire(node.hints[name]) for name in wires},
            "parameters": {p.name: _said_parameter(p, node.hints[p.name]) for p in parameters},
        }
    except _NoJson:
        return None


def _parameters_of(node: Node) -> list[inspect.Parameter]:
    """Return the arguments of a node that a recipe gives as parameters."""
    arguments = inspect.signature(node.fn).parameters.values()
    return [p for p in arguments if p.kind is p.KEYWORD_ONLY and p.name != "rng"]


def _said_parameter(parameter: inspect.Parameter, hint: Any) -> dict[str, Any]:
    """Return type and default of a parameter as JSON."""
    try:
        entry = {"type": _said(hint)}
    except _NoJson:
        entry = {"is_file": is_file(hint), "texts": texts_of(hint)}
    if parameter.default is not parameter.empty:
        entry["default"] = _said_default(parameter.default)
    return entry


def _said_default(value: Any) -> Any:
    """Return a default value as JSON, in which a tuple stands as an object."""
    if isinstance(value, bool | int | float | str | None):
        return value
    if type(value) is tuple:
        return {"tuple": [*map(_said_default, value)]}
    if value == {}:
        return {}
    raise _NoJson


def _default_of(said: Any) -> Any:
    """Return the default value that `_said_default` has written."""
    if not isinstance(said, dict):
        return said
    return tuple(map(_default_of, said["tuple"])) if "tuple" in said else {}


def looked_up_parameters(node: Node) -> list[str]:
    """Return the names of the parameters of a node whose type JSON cannot say."""
    return [name for name in node.params.model_fields if _is_looked_up(node.hints[name])]


def _is_looked_up(hint: Any) -> bool:
    try:
        _said(hint)
    except _NoJson:
        return True
    return False


class RememberedNode(Node):
    """A node as far as its signature describes it; a call raises `NotRemembered`."""

    def __init__(self, path: str, signature: Signature, look: Look) -> None:
        # the fields of a node, without its function
        self.path = path
        self.fn = _function_of(signature["module"])
        self.inputs, self.optional = tuple(signature["inputs"]), frozenset(signature["optional"])
        self.random, self.device = signature["random"], signature["device"]
        self.before_run = signature["before_run"]
        self.accepts_channel_sums = tuple(signature["accepts_channel_sums"])
        self.accepts_low_rank = tuple(signature["accepts_low_rank"])
        self.channel_sum_form = self if signature["is_cheaper"] else None
        self.low_rank_form = None
        self.bands, self.depends, self.environment = None, (), {}
        self.needs_band_invariant, self.additive_inputs, self.rtol = (), (), 0.0
        self._checks = signature["checks"]
        self.hooks = _hooks_of(signature)
        parameters = signature["parameters"]
        self.hints = {name: _type_of(said) for name, said in signature["wires"].items()}
        self.hints |= {name: _hint_of(path, name, said, look) for name, said in parameters.items()}
        fields: dict[str, Any] = {
            name: (self.hints[name], _default_of(said["default"]) if "default" in said else ...)
            for name, said in parameters.items()
        }
        self.params = create_model(path.rpartition(".")[2], __base__=ParameterModel, **fields)

    @property
    def preflight_inputs(self) -> tuple[str, ...]:
        return tuple(self._checks or ())


def _hint_of(node: str, name: str, said: Mapping[str, Any], look: Look) -> Any:
    """Return the type annotation of a parameter; one that JSON cannot say looks its values up."""
    if "type" in said:
        return _type_of(said["type"])

    def read(value: Any) -> Any:
        return look(node, name, value)

    texts = said["texts"]
    any_value = Union[Literal[tuple(texts)], Any] if texts else Any  # noqa: UP007
    of_file = [units.IsFile()] if said["is_file"] else []
    return Annotated[(any_value, *of_file, PlainValidator(read))]


def _hooks_of(signature: Signature) -> Any:
    """Return the hooks whose presence a check reads; a call of one raises `NotRemembered`."""
    return SimpleNamespace(
        preflight=None if signature["checks"] is None else _not_remembered,
        shape=_not_remembered if signature["has_shape"] else None,
    )


def _not_remembered(*inputs: Any, **params: Any) -> NoReturn:
    raise NotRemembered("a node is called")


def _function_of(module: str) -> Callable[..., NoReturn]:
    """Return a function in place of that of a node, with the module of the node."""

    def function(*inputs: Any, **params: Any) -> NoReturn:
        _not_remembered()

    function.__module__ = module
    return function
