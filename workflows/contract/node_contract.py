"""The contract of a node: every rule, and what each found on one example of a call."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from neusee.nodes import Node
from neusee.workflows.contract.document_rules import check_docstring, check_hooks, check_signature
from neusee.workflows.contract.finding import Finding
from neusee.workflows.contract.value_rules import (
    Call,
    check_bands,
    check_gradient,
    check_reference,
    check_result,
    check_shape,
    check_skip_bound,
)
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.user_code import own_code_of
from neusee.workflows.observation.own_call import WORDS, call_observed


def check_reach(call: Call) -> Iterator[Finding]:
    """Find whether a call of own code reaches more than its cache key covers."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            own = own_code_of(call.node, call.params, [], Code(Path(folder) / "code.json"))
        except LookupError:
            return  # the rule on the key says so
    if own is None:
        return
    _, taints = call_observed(call.result, own)
    for taint in taints:
        yield Finding("reach", False, f"{WORDS[taint.kind]} {taint.what}, which the key does not cover: {taint.fix}")
    if not taints:
        yield Finding("reach", True, "this call reached no file, process, network or chance beyond its key")


_OF_VALUES: tuple[Callable[[Call], Iterator[Finding]], ...] = (
    check_result,
    check_reference,
    check_gradient,
    check_bands,
    check_skip_bound,
    check_shape,
    check_reach,
)


def check_node(node: Node, example: Mapping[str, Any] | None = None) -> list[Finding]:
    """Return what each rule of the contract found; a rule that does not concern the node finds nothing.

    ``example`` has the inputs and parameters of one call by name, parameters as a recipe writes them or in SI; by
    default it is what the node's hook ``example`` returns.
    """
    call = example_call(node, example)
    return [*check_words(node), *([call] if isinstance(call, Finding) else check_values(call))]


def check_words(node: Node) -> list[Finding]:
    """Return what each rule found on what a node says of itself, and on its key."""
    return [*check_docstring(node), *check_signature(node), *check_hooks(node), *_check_key(node)]


def check_values(call: Call) -> list[Finding]:
    """Return what each rule found on what a node computes in one call."""
    return [finding for rule in _OF_VALUES for finding in _guarded(rule, call)]


def _check_key(node: Node) -> Iterator[Finding]:
    """Find whether a cache key can follow the code of the node."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            Code(Path(folder) / "code.json").of(node)
        except LookupError as error:
            yield Finding("key", False, str(error.args[0]))
        else:
            yield Finding("key", True, "follows the code and all that it names")


def example_call(node: Node, example: Mapping[str, Any] | None = None) -> Call | Finding:
    """Return the call of the example, or the finding that there is none or that it is wrong."""
    if example is None and node.hooks.example is None:
        name = node.fn.__name__
        return Finding("example", False, f"none: attach a function with @{name}.example that returns its arguments")
    try:
        validated = node.params
    except Exception:
        return Finding("example", False, "not tried: the parameters cannot be validated, see the rule signature")
    try:
        given = dict(node.hooks.example() if example is None and node.hooks.example else example or {})
    except Exception as error:
        return Finding("example", False, f"the example raises {type(error).__name__}: {error}")
    inputs = [given.pop(name, None) for name in node.inputs]
    missing = [n for n, v in zip(node.inputs, inputs, strict=True) if v is None and n not in node.optional]
    if missing:
        return Finding("example", False, f"lacks the inputs {', '.join(missing)}")
    try:
        params = {name: value for name, value in validated(**given)}
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        text = first["msg"].removeprefix("Value error, ")
        return Finding("example", False, f"{'.'.join(map(str, first['loc']))}: {text}")
    return Call(node, inputs, params)


def _guarded(rule: Callable[[Call], Iterator[Finding]], call: Call) -> Iterator[Finding]:
    """Yield what a rule finds, and the error of the node or of a hook as a finding."""
    try:
        yield from rule(call)
    except Exception as error:
        name = rule.__name__.removeprefix("check_").replace("_", " ")
        yield Finding(name, False, f"raises {type(error).__name__}: {error}")
