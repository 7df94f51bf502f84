"""The command ``neusee check``: does a node keep what nodes promise?"""

from __future__ import annotations

import json
from dataclasses import asdict
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from neusee.workflows.cli.command_frame import failing, say
from neusee.workflows.cli.command_list import DONE, MISSED
from neusee.workflows.cli.command_options import AsJson, Debug

if TYPE_CHECKING:
    from types import ModuleType

    from torch import nn

    from neusee.nodes import Node

_MARKS = {True: "ok", False: "FAIL", None: "-"}


def check(
    place: Annotated[str, typer.Argument(help="A file, a folder or a module with nodes, or a node: optics.psf.")],
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Check whether nodes keep what the nodes of neusee keep.

    Docstring, annotations, hooks, what a cache key covers; on the example of each node: the reference, gradients
    against finite differences, bands, bounds and shapes, and the same call in a process with other surroundings. A
    network class of yours is called on small pictures. The exit code is 3 if a rule fails. Runs the code.
    """
    from neusee.workflows.contract.elsewhere_client import elsewhere

    with failing(LookupError), elsewhere(early=not _is_of_neusee(place)) as process:
        nodes, networks = _found(place)
        from neusee.workflows.contract.whole_contract import check_all

        found = check_all(nodes, networks, process)
    if as_json:
        say([json.dumps({name: [asdict(f) for f in findings] for name, findings in found.items()}, indent=1)])
    for name, findings in found.items() if not as_json else ():
        say([name, *(f"  {_MARKS[f.ok]:<4}  {f.rule:<11}  {f.text}" for f in findings), ""])
    failed = sum(f.ok is False for findings in found.values() for f in findings)
    if not as_json:
        end = f"{failed} rule{'s fail' if failed > 1 else ' fails'}" if failed else "every rule holds"
        say([f"{_count(len(nodes), len(networks))}: {end}"])
    raise typer.Exit(MISSED if failed else DONE)


def _is_of_neusee(place: str) -> bool:
    """Return True for a node or a family of neusee, without an import of them."""
    return (files("neusee") / "nodes" / place.partition(".")[0]).is_dir() and not place.endswith(".py")


def _installed(family: str) -> ModuleType | None:
    """Return the module of a family of an installed package; None for a family of neusee."""
    from neusee.workflows.recipe.node_families import module_of

    try:
        return module_of(family)
    except LookupError:
        return None


def _is_module(place: str) -> bool:
    """Return True if a name with dots is that of a module, such as ``mylab.nodes``, and not of a node."""
    try:
        return find_spec(place) is not None
    except ImportError:
        return False


def _count(nodes: int, networks: int) -> str:
    """Return the numbers of nodes and networks as text, such as ``2 nodes and 1 network``."""
    counts = [(nodes, "node")] * (nodes > 0 or not networks) + [(networks, "network")] * (networks > 0)
    return " and ".join(f"{count} {what}{'s' * (count != 1)}" for count, what in counts)


def _found(place: str) -> tuple[dict[str, Node], dict[str, type[nn.Module]]]:
    """Return the nodes and the network classes at a place by name; raise `LookupError` if there are none."""
    from neusee.workflows.contract.network_contract import whole_networks
    from neusee.workflows.recipe.node_families import find_node, import_own, installed_as, is_known, nodes_of, own_nodes

    family = place.partition(".")[0]
    if not place.endswith(".py") and "/" not in place and is_known(family):
        if place == family:
            module = _installed(family)
            networks = whole_networks(module) if module else {}
            nodes = {f"{family}.{name}": node for name, node in nodes_of(family).items()}
            return nodes, {f"{family}.{key}": value for key, value in networks.items()}
        if not _is_module(place):
            return {place: find_node(place)}, {}
    module = import_own(place, Path.cwd())
    name = installed_as(module.__name__) or module.__name__.rpartition(".")[2]
    nodes = {f"{name}.{key}": node for key, node in own_nodes(name, module).items()}
    return nodes, {f"{name}.{key}": value for key, value in whole_networks(module).items()}
