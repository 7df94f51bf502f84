"""The contract of nodes and networks: every rule, and its findings."""

from __future__ import annotations

import ast
import inspect
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from pydantic import ValidationError
from torch import nn

from neusee.nodes import Node, ParameterError, restore
from neusee.nodes.own_modules import Architecture, network_classes
from neusee.nodes.restore import OwnNetwork, own_network, try_network
from neusee.workflows.contract.elsewhere_rule import check_elsewhere, network_call, node_call
from neusee.workflows.contract.node_rules import (
    Call,
    Finding,
    check_bands,
    check_docstring,
    check_gradient,
    check_hooks,
    check_reference,
    check_result,
    check_shape,
    check_signature,
    check_skip_bound,
)
from neusee.workflows.contract.surroundings import Elsewhere
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.user_code import own_code_of
from neusee.workflows.observation.observed_call import WORDS, call_observed

# --- node contract --------------------------------------------------------------------------------

# The contract of a node: every rule, and its findings on one example of a call.


def check_reach(call: Call) -> Iterator[Finding]:
    """Find whether a call of the user's code uses more than its cache key covers."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            own_code = own_code_of(call.node, call.params, [], Code(Path(folder) / "code.json"))
        except LookupError:
            return  # the rule on the key says so
    if own_code is None:
        return
    _, taints = call_observed(call.result, own_code)
    for taint in taints:
        yield Finding(
            "reach",
            False,
            f"{WORDS[taint.kind]} {taint.what}, which the key does not cover: {taint.fix}",
        )
    if not taints:
        yield Finding(
            "reach", True, "this call reached no file, process, network or chance beyond its key"
        )


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
    """Return the findings of each rule of the contract; a rule that does not concern the node has
    none.

    ``example`` has the inputs and parameters of one call by name, parameters as a recipe writes
    them or in SI; by default it is what the node's hook ``example`` returns.
    """
    call = example_call(node, example)
    return [*check_words(node), *([call] if isinstance(call, Finding) else check_values(call))]


def check_words(node: Node) -> list[Finding]:
    """Return the findings on the docstring, the signature, the hooks and the key of a node."""
    return [*check_docstring(node), *check_signature(node), *check_hooks(node), *_check_key(node)]


def check_values(call: Call) -> list[Finding]:
    """Return the findings of each rule on the values that a node computes in one call."""
    findings: list[Finding] = []
    for rule in _OF_VALUES:
        findings += _guarded(rule, call)
    return findings


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
    """Return the call of the example, or a finding if there is no example or it is wrong."""
    if example is None and node.hooks.example is None:
        return _no_example(node)
    try:
        parameter_model = node.params
    except Exception:
        return Finding(
            "example",
            False,
            "not tried: the parameters cannot be validated, see the rule signature",
        )
    try:
        arguments = _arguments(node, example)
    except Exception as error:
        return Finding("example", False, f"the example raises {type(error).__name__}: {error}")
    # what is left of the arguments are parameters
    inputs = {name: arguments.pop(name, None) for name in node.inputs}
    missing = _missing(node, inputs)
    if missing:
        return Finding("example", False, f"lacks the inputs {', '.join(missing)}")
    try:
        params = dict(parameter_model(**arguments))
    except ValidationError as error:
        return Finding("example", False, _first_mistake(error))
    return Call(node, list(inputs.values()), params)


def _missing(node: Node, inputs: Mapping[str, Any]) -> list[str]:
    """Return the names of inputs that a node needs and an example does not give."""
    required = [name for name in node.inputs if name not in node.optional]
    return [name for name in required if inputs[name] is None]


def _first_mistake(error: ValidationError) -> str:
    """Return the first mistake in the parameters of an example."""
    first_error = error.errors(include_url=False)[0]
    text = first_error["msg"].removeprefix("Value error, ")
    return f"{'.'.join(map(str, first_error['loc']))}: {text}"


def _no_example(node: Node) -> Finding:
    """Return the finding on a node without an example."""
    name = node.fn.__name__
    return Finding(
        "example",
        False,
        f"none: attach a function with @{name}.example that returns its arguments",
    )


def _arguments(node: Node, example: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the arguments of ``example``, or else those of the node's own example."""
    if example is None and node.hooks.example:
        return dict(node.hooks.example())
    return dict(example or {})


def _guarded(rule: Callable[[Call], Iterator[Finding]], call: Call) -> Iterator[Finding]:
    """Yield the findings of a rule; an error of the node or of a hook becomes a finding."""
    try:
        yield from rule(call)
    except Exception as error:
        name = rule.__name__.removeprefix("check_").replace("_", " ")
        yield Finding(name, False, f"raises {type(error).__name__}: {error}")


# --- network contract -----------------------------------------------------------------------------

# The contract of a network class of a user, and the findings of each rule on small pictures.


Make = Callable[[int], OwnNetwork]  #: returns a network with initial weights from a seed
_SIDE = 32  #: pixels of a picture, at least


def whole_networks(module: ModuleType) -> dict[str, type[nn.Module]]:
    """Return the network classes of a module by name, without those that other definitions of
    their file use.
    """
    classes = network_classes(module)
    names_used: set[str] = set()
    for name in {network.__module__ for network in classes.values()}:
        for item in ast.parse(inspect.getsource(sys.modules[name])).body:
            own_name = getattr(item, "name", "")
            names_used |= {
                leaf.id
                for leaf in ast.walk(item)
                if isinstance(leaf, ast.Name) and leaf.id != own_name
            }
    return {name: network for name, network in classes.items() if name not in names_used}


def check_network(name: str, network: type[nn.Module]) -> list[Finding]:
    """Return the findings of each rule on a network class, built with the defaults of its
    arguments.
    """
    findings = [*_check_docstring(network), *_check_network_key(network)]
    make: Make = partial(own_network, Architecture(name, network), None, None)
    try:
        make(0)
    except ParameterError as error:
        return [
            *findings,
            Finding("arguments", False, f"{error}: give each argument a default, for this check"),
        ]
    findings.append(Finding("arguments", True, "the class builds with its defaults"))
    for rule in (_check_picture, _check_double, _check_weights, _check_gradient):
        findings += _guarded_network(rule, make)
    return findings


def _guarded_network(rule: Callable[[Make], Iterator[Finding]], make: Make) -> Iterator[Finding]:
    """Yield the findings of a rule on a network; an error of the network becomes a finding."""
    try:
        yield from rule(make)
    except (ParameterError, RuntimeError, TypeError, ValueError) as error:
        yield Finding(rule.__name__.removeprefix("_check_"), False, str(error))


def _check_docstring(network: type[nn.Module]) -> Iterator[Finding]:
    """Find whether the class has a docstring of its own that begins with a sentence."""
    first_line = (vars(network).get("__doc__") or "").strip().partition("\n")[0]
    is_sentence = first_line[:1].isupper() and first_line.endswith(".")
    advice = "begin the class with one sentence that ends with a stop"
    yield Finding.of("docstring", is_sentence, "one sentence", advice)


def _check_network_key(network: type[nn.Module]) -> Iterator[Finding]:
    """Find whether a cache key can follow the code of the class."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            Code(Path(folder) / "code.json").of(
                restore.network, ((network.__module__, network.__qualname__),)
            )
        except LookupError as error:
            yield Finding("key", False, str(error.args[0]))
        else:
            yield Finding("key", True, "follows the code and all that it names")


def _check_picture(make: Make) -> Iterator[Finding]:
    """Find whether the network returns a finite picture of the same size, the same twice, and
    leaves its input unchanged.
    """
    net = make(0)
    trial = try_network(net)
    cost = f"{trial.operations:.3g} operations and {trial.memory:.3g} bytes a pixel"
    yield Finding(
        "picture",
        True,
        f"same sizes, finite, same twice, input as before; sides by {net.multiple}; {cost}",
    )


def _check_double(make: Make) -> Iterator[Finding]:
    """Find whether the network computes in float64."""
    try_network(make(0), torch.float64)
    yield Finding("double", True, "float64 in, float64 out")


def _check_weights(make: Make) -> Iterator[Finding]:
    """Find whether a second network, built with other random numbers, equals the first after it has
    loaded the weights of the first.
    """
    network, other_network = make(1).eval(), make(2).eval()
    other_network.inner.load_state_dict(network.inner.state_dict())
    picture = _picture()
    with torch.no_grad():
        is_same = torch.equal(network(picture), other_network(picture))
    kept_text = "a file of weights holds all that the network has drawn"
    broken_text = (
        "two networks with the same weights differ: register each drawn tensor as a parameter or a"
        " buffer"
    )
    yield Finding.of("weights", is_same, kept_text, broken_text)


def _check_gradient(make: Make) -> Iterator[Finding]:
    """Find whether each trainable parameter receives a finite gradient in training."""
    net = make(0).train()
    with torch.random.fork_rng([]):
        torch.manual_seed(0)
        # any target will do, such as the mirrored picture
        (net(_picture()) - _picture().flip(-1)).square().mean().backward()
    trainable = {name: p for name, p in net.inner.named_parameters() if p.requires_grad}
    if not trainable:
        yield Finding("gradient", False, "the class has no parameters: there is nothing to train")
        return
    without_gradient = [name for name, parameter in trainable.items() if parameter.grad is None]
    not_finite = [
        name for name, parameter in trainable.items() if not _has_finite_gradient(parameter)
    ]
    if not_finite:
        yield Finding("gradient", False, f"the gradient of {not_finite[0]} is not finite")
    elif without_gradient:
        yield Finding(
            "gradient",
            False,
            f"{without_gradient[0]} has no gradient: the result does not depend on it",
        )
    else:
        yield Finding("gradient", True, f"finite for each of {len(trainable)} parameters")


def _has_finite_gradient(parameter: nn.Parameter) -> bool:
    """Return True if a gradient is finite, or there is none."""
    return parameter.grad is None or bool(parameter.grad.isfinite().all())


def _picture() -> torch.Tensor:
    """Return a small pseudo-random picture with odd sides."""
    random = torch.Generator().manual_seed(3)
    return torch.rand(1, 3, _SIDE + 1, _SIDE + 3, generator=random)


# --- whole contract -------------------------------------------------------------------------------

# The contract of all nodes and networks of a place, with the calls in other processes.


def check_all(
    nodes: Mapping[str, Node],
    networks: Mapping[str, type[nn.Module]],
    process: Callable[[], Elsewhere],
) -> dict[str, list[Finding]]:
    """Return the findings of each rule on each node and network, by name.

    ``process`` returns a process in which all surroundings are changed. A call that ends this
    process would end the check, so each is made there first.
    """
    findings = {name: check_words(node) for name, node in nodes.items()}
    calls = {name: example_call(node) for name, node in nodes.items()}
    tried = [node_call(name, call) for name, call in calls.items() if isinstance(call, Call)]
    tried += [network_call(name, network) for name, network in networks.items()]
    findings_away, names_ending = check_elsewhere(tried, process)
    for name, call in calls.items():
        findings[name] += _on_values(call, name in names_ending)
    for name, network in networks.items():
        findings[name] = [] if name in names_ending else check_network(name, network)
    for name, finding in findings_away.items():
        findings[name].append(finding)
    return findings


def _on_values(call: Call | Finding, ends: bool) -> list[Finding]:
    """Return the findings on the values of a call, the finding on a missing example, or none for a
    call that ends its process.
    """
    if isinstance(call, Finding):
        return [call]
    return [] if ends else check_values(call)
