"""The contract of a network class of a user, and what each rule found on small pictures."""

from __future__ import annotations

import ast
import inspect
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import ModuleType

import torch
from torch import nn

from neusee.nodes import ParameterError, restore
from neusee.nodes.network_classes import Architecture, network_classes
from neusee.nodes.restore import OwnNetwork, own_network, try_network
from neusee.workflows.contract.finding import Finding
from neusee.workflows.keys.code_digest import Code

Make = Callable[[int], OwnNetwork]  #: returns a network with initial weights of a seed
_SIDE = 32  #: pixels of a picture, at least


def whole_networks(module: ModuleType) -> dict[str, type[nn.Module]]:
    """Return the network classes of a module by name, without those that other definitions of their file use."""
    classes = network_classes(module)
    used: set[str] = set()
    for name in {value.__module__ for value in classes.values()}:
        for item in ast.parse(inspect.getsource(sys.modules[name])).body:
            own = getattr(item, "name", "")
            used |= {part.id for part in ast.walk(item) if isinstance(part, ast.Name) and part.id != own}
    return {name: value for name, value in classes.items() if name not in used}


def check_network(name: str, network: type[nn.Module]) -> list[Finding]:
    """Return what each rule found on a network class, built with the defaults of its arguments."""
    found = [*_check_docstring(network), *_check_key(network)]
    make: Make = partial(own_network, Architecture(name, network), None, None)
    try:
        make(0)
    except ParameterError as error:
        return [*found, Finding("arguments", False, f"{error}: give each argument a default, for this check")]
    found.append(Finding("arguments", True, "the class builds with its defaults"))
    for rule in (_check_picture, _check_double, _check_weights, _check_gradient):
        found += _guarded(rule, make)
    return found


def _guarded(rule: Callable[[Make], Iterator[Finding]], make: Make) -> Iterator[Finding]:
    try:
        yield from rule(make)
    except (ParameterError, RuntimeError, TypeError, ValueError) as error:
        yield Finding(rule.__name__.removeprefix("_check_"), False, str(error))


def _check_docstring(network: type[nn.Module]) -> Iterator[Finding]:
    """Find whether the class has a docstring of its own that begins with a sentence."""
    first = (vars(network).get("__doc__") or "").strip().partition("\n")[0]
    ok = first[:1].isupper() and first.endswith(".")
    yield Finding("docstring", ok, "one sentence" if ok else "begin the class with one sentence that ends with a stop")


def _check_key(network: type[nn.Module]) -> Iterator[Finding]:
    """Find whether a cache key can follow the code of the class."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            Code(Path(folder) / "code.json").of(restore.network, ((network.__module__, network.__qualname__),))
        except LookupError as error:
            yield Finding("key", False, str(error.args[0]))
        else:
            yield Finding("key", True, "follows the code and all that it names")


def _check_picture(make: Make) -> Iterator[Finding]:
    """Find whether a picture gives one of the same sizes, finite, the same twice, and the input is left alone."""
    net = make(0)
    trial = try_network(net)
    cost = f"{trial.operations:.3g} operations and {trial.memory:.3g} bytes a pixel"
    yield Finding("picture", True, f"same sizes, finite, same twice, input as before; sides by {net.multiple}; {cost}")


def _check_double(make: Make) -> Iterator[Finding]:
    """Find whether the network computes in float64."""
    try_network(make(0), torch.float64)
    yield Finding("double", True, "float64 in, float64 out")


def _check_weights(make: Make) -> Iterator[Finding]:
    """Find whether the weights of one network make another one, built with other random numbers, equal to it."""
    one, other = make(1).eval(), make(2).eval()
    other.inner.load_state_dict(one.inner.state_dict())
    picture = _picture()
    with torch.no_grad():
        same = torch.equal(one(picture), other(picture))
    text = "a file of weights holds all that the network has drawn"
    wrong = "two networks with the same weights differ: register each drawn tensor as a parameter or a buffer"
    yield Finding("weights", same, text if same else wrong)


def _check_gradient(make: Make) -> Iterator[Finding]:
    """Find whether each trainable parameter receives a finite gradient in training."""
    net = make(0).train()
    with torch.random.fork_rng([]):
        torch.manual_seed(0)
        (net(_picture()) - _picture().flip(-1)).square().mean().backward()
    trained = {name: one.grad for name, one in net.inner.named_parameters() if one.requires_grad}
    if not trained:
        yield Finding("gradient", False, "the class has no parameters: there is nothing to train")
        return
    unused = [name for name, grad in trained.items() if grad is None]
    wrong = [name for name, grad in trained.items() if grad is not None and not grad.isfinite().all()]
    if wrong:
        yield Finding("gradient", False, f"the gradient of {wrong[0]} is not finite")
    elif unused:
        yield Finding("gradient", False, f"{unused[0]} has no gradient: the result does not depend on it")
    else:
        yield Finding("gradient", True, f"finite for each of {len(trained)} parameters")


def _picture() -> torch.Tensor:
    random = torch.Generator().manual_seed(3)
    return torch.rand(1, 3, _SIDE + 1, _SIDE + 3, generator=random)
