"""Cache keys: the key of a result is a digest of everything that determines the result, and of nothing else.

A key depends on the node with its code, the versions of the packages that the code imports, the parameters, the content
of input files, the keys of the inputs and the random stream. A key does not depend on tensors, the number of threads
or, except for random nodes, the device.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neusee.workflows.keys.input_file_digest import file_digest
from neusee.workflows.keys.written_params import written

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Step, Wire
    from neusee.workflows.keys.code_digest import Code

Key = str
PRIVATE = "private-"  #: first letters of the key of a result that holds for one process alone and is not stored


def digest(*parts: Any) -> str:
    """Return the digest of the JSON values ``parts`` as 32 hexadecimal digits; every bit of a float affects it."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def key_of(
    step: Step, keys: Mapping[str, Key], seed: int, code: Code, device: str = "cpu"
) -> tuple[Key, dict[str, Any]]:
    """Return the cache key of ``step`` and the data from which the key is computed, such as parameters.

    ``keys`` are the cache keys of the steps whose results are inputs of ``step``.
    """
    node = step.node
    parts: dict[str, Any] = {
        "node": node.path,
        "code": code_of(step, code),
        "params": {name: plain(value) for name, value in step.params.items()},
        "inputs": [_keys_of(step.wires.get(name), keys) for name in node.inputs],
    }
    if said := written(step):
        parts["written"] = said
    if node.random:
        parts["stream"] = [seed, step.name, device_kind(device)]
    private = not step.cached or any(map(is_private, [parts["code"], *(keys[name] for name in step.sources)]))
    return (PRIVATE + digest(parts)[:24] if private else digest(parts)), parts


def code_of(step: Step, code: Code) -> str:
    """Return the digest of the code of a step: of its node, and of the network classes that its parameters name."""
    return code.of(step.node, tuple(dict.fromkeys((each.__module__, each.__qualname__) for each in networks_of(step))))


def networks_of(step: Step) -> list[type[Any]]:
    """Return the network classes that the parameters of a step name."""
    return [network for value in step.params.values() if (network := _network_of(value))]


def _network_of(value: Any) -> type[Any] | None:
    """Return the network class that a parameter names, or None for another value, without an import of torch."""
    module = sys.modules.get("neusee.nodes.network_classes")  # imported where there is such a value
    return value.network if module and isinstance(value, module.Architecture) else None


def is_private(key: Key) -> bool:
    """Return True for the key of a result that holds for one process alone, whose code may not be that of its file."""
    return key.startswith(PRIVATE)


def stream_seed(seed: int, step: str) -> int:
    """Return the seed of the random numbers of a step, which depends only on the recipe's seed and the step's name."""
    return int(digest(seed, step)[:15], 16)


def device_kind(device: str) -> str:
    """Return the kind of a device, such as ``cuda`` for ``cuda:1``."""
    return device.partition(":")[0]


def _keys_of(wire: Wire, keys: Mapping[str, Key]) -> Any:
    if wire is None or isinstance(wire, str):
        return wire and keys[wire]
    return [keys[name] for name in wire]


def plain(value: Any) -> Any:
    """Return a step's parameter as JSON that is the same in every process; a file becomes the digest of its content."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return float(value)
    if isinstance(value, Path):
        return {"file": file_digest(value), "suffix": value.suffix.lower()}
    if isinstance(value, Mapping):
        return {"items": sorted(([plain(k), plain(v)] for k, v in value.items()), key=repr)}
    if isinstance(value, tuple | list):
        return [plain(v) for v in value]
    if network := _network_of(value):
        return {"class": f"{network.__module__}.{network.__qualname__}"}
    if isinstance(value, complex):
        return {"complex": [value.real, value.imag]}
    raise TypeError(f"a parameter must be a number, a string, a file or a collection of these, not {value!r}")
