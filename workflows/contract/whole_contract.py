"""The contract of all nodes and networks of a place, with the calls in other processes."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from torch import nn

from neusee.nodes import Node
from neusee.workflows.contract.elsewhere_client import Elsewhere
from neusee.workflows.contract.elsewhere_rule import check_elsewhere
from neusee.workflows.contract.finding import Finding
from neusee.workflows.contract.network_contract import check_network
from neusee.workflows.contract.node_contract import check_values, check_words, example_call
from neusee.workflows.contract.tried_calls import network_call, node_call
from neusee.workflows.contract.value_rules import Call


def check_all(
    nodes: Mapping[str, Node], networks: Mapping[str, type[nn.Module]], process: Callable[[], Elsewhere]
) -> dict[str, list[Finding]]:
    """Return what each rule found on each node and network, by name.

    ``process`` returns a process in which all surroundings are changed. A call that ends this process would end the
    check, so each is made there first.
    """
    found = {name: check_words(node) for name, node in nodes.items()}
    calls = {name: example_call(node) for name, node in nodes.items()}
    tried = [node_call(name, call) for name, call in calls.items() if isinstance(call, Call)]
    tried += [network_call(name, network) for name, network in networks.items()]
    away, ending = check_elsewhere(tried, process)
    for name, call in calls.items():
        found[name] += [call] if isinstance(call, Finding) else [] if name in ending else check_values(call)
    for name, network in networks.items():
        found[name] = [] if name in ending else check_network(name, network)
    for name, finding in away.items():
        found[name].append(finding)
    return found
