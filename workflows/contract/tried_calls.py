"""Calls of nodes and networks as another process makes them: pickled, with full paths, and with what keys cover."""

from __future__ import annotations

import inspect
import os
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import nn

from neusee.nodes.network_classes import Architecture
from neusee.nodes.restore import own_network
from neusee.workflows.contract.elsewhere_rule import Tried
from neusee.workflows.contract.value_rules import Call
from neusee.workflows.keys.code_digest import Code

_SIDE = 32  #: pixels of a picture
_VARIABLE = "env:"  #: begins the declaration of a variable of the environment


def node_call(name: str, call: Call) -> Tried:
    """Return the call of a node's example; files of its parameters are named by their full paths."""
    full = Call(call.node, call.inputs, {key: _with_full_paths(value) for key, value in call.params.items()})
    return _tried(name, call.node.fn, call.node.rtol, full.result, call.node.depends)


def network_call(name: str, network: type[nn.Module]) -> Tried:
    """Return the call of a network, built with its defaults, on a small picture."""
    rtol = 1e-5  # as a node by default
    return _tried(name, network, rtol, partial(_on_a_picture, Architecture(name, network)), ())


def _tried(name: str, code: Any, rtol: float, function: Callable[[], Any], depends: tuple[str, ...]) -> Tried:
    module = code.__module__
    variables = [*depends, *_declarations(module)]
    names = {entry.removeprefix(_VARIABLE) for entry in variables if entry.startswith(_VARIABLE)}
    declared = {each: os.environ[each] for each in sorted(names) if each in os.environ}
    return Tried(name, module, _place(code), rtol, function, declared)


def _declarations(module: str) -> Iterator[str]:
    """Yield what a module, and those that it imports, declare that they read."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            looks = Code(Path(folder) / "code.json").looks(module)
        except LookupError:
            return  # the rule on the key says so
    for look in looks.values():
        yield from look.summary.depends if look.summary else ()


def _with_full_paths(value: Any) -> Any:
    if isinstance(value, Path):
        return value.absolute()
    return type(value)(map(_with_full_paths, value)) if type(value) in (tuple, list) else value


def _on_a_picture(architecture: Architecture) -> torch.Tensor:
    net = own_network(architecture, None, None).eval()
    picture = torch.rand(1, 3, _SIDE + 1, _SIDE + 3, generator=torch.Generator().manual_seed(3))
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        result: torch.Tensor = net(picture)
    return result


def _place(code: Any) -> str:
    try:
        lines = inspect.getsourcelines(inspect.unwrap(code))[1]
        return f"{Path(inspect.getfile(inspect.unwrap(code))).name}:{lines}"
    except (OSError, TypeError):
        return str(code.__module__)
