"""Cache keys: a digest of what decides a result, and of nothing else.

A key covers the node and its code, the parameters, the content of input files, the keys
of the inputs and the random stream. No tensor is read to make one. Thread count, versions
of libraries and, but for random nodes, the device are not physics and stay out of it.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import xxhash

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Step
    from neusee.workflows.keys.code_digest import Code

Key = str
_SETTLED = 2_000_000_000  #: ns after which a file's stamp tells one content from the next
_files: dict[tuple[int, ...], str] = {}


def digest(*parts: Any) -> str:
    """32 hexadecimal digits of ``parts``, which must be plain JSON; floats count to the last bit."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def key_of(
    step: Step, keys: Mapping[str, Key], seed: int, code: Code, device: str = "cpu"
) -> tuple[Key, dict[str, Any]]:
    """The key of ``step``, given the keys of its sources, and everything that went into it."""
    node = step.node
    recipe: dict[str, Any] = {
        "node": node.path,
        "code": code.digest(node.fn.__module__),
        "params": {name: plain(value) for name, value in step.params.items()},
        "inputs": [_input(step.wires.get(name), keys) for name in node.inputs],
    }
    if node.random:
        recipe["stream"] = [seed, step.name, device_kind(device)]
    return digest(recipe), recipe


def stream_seed(seed: int, step: str) -> int:
    """Seed of a step's random stream: the recipe's seed and the step's name, and nothing else."""
    return int(digest(seed, step)[:15], 16)


def device_kind(device: str) -> str:
    """Return the kind of a device: ``cuda`` of ``cuda:1``."""
    return device.partition(":")[0]


def _input(wire: str | tuple[str, ...] | None, keys: Mapping[str, Key]) -> Any:
    if wire is None or isinstance(wire, str):
        return wire and keys[wire]
    return [keys[name] for name in wire]


def plain(value: Any) -> Any:
    """A parameter as JSON, the same in every process; a file is its content and its kind."""
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
    if isinstance(value, complex):
        return {"complex": [value.real, value.imag]}
    raise TypeError(f"a parameter must be a number, a text, a file or a collection of these, not {value!r}")


def file_digest(path: Path) -> str:
    """xxh3 of a file's bytes; read again only when its stamp has changed or is too young to tell."""
    stat = os.stat(path)
    stamp = (stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns)
    if stamp in _files:
        return _files[stamp]
    found = xxhash.xxh3_128()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            found.update(block)
    if time.time_ns() - max(stat.st_mtime_ns, stat.st_ctime_ns) > _SETTLED:
        _files[stamp] = found.hexdigest()
    return found.hexdigest()
