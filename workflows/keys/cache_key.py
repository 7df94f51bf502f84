"""Cache keys: a digest of everything that determines a result, and of nothing else.

A key covers the node and its code, the parameters, the content of input files, the keys of the
inputs and the random stream. No tensor is read to compute a key. A key does not contain the
thread count, the versions of libraries or the device (except for random nodes), because these
are not physics.
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
_SETTLED = 2_000_000_000  #: age in ns from which a file's time stamp distinguishes its contents
_files: dict[tuple[int, ...], str] = {}


def digest(*parts: Any) -> str:
    """Return 32 hexadecimal digits of ``parts``, which must be plain JSON; floats count to the last bit."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def key_of(
    step: Step, keys: Mapping[str, Key], seed: int, code: Code, device: str = "cpu"
) -> tuple[Key, dict[str, Any]]:
    """Return the key of ``step``, given the keys of its sources, and all parts of that key."""
    node = step.node
    recipe: dict[str, Any] = {
        "node": node.path,
        "code": code.digest(node.fn.__module__),
        "params": {name: plain(value) for name, value in step.params.items()},
        "inputs": [_input(step.wires.get(name), keys) for name in node.inputs],
    }
    if node.random:
        recipe["stream"] = [seed, step.name, device.partition(":")[0]]
    return digest(recipe), recipe


def stream_seed(seed: int, step: str) -> int:
    """Return the seed of a step's random stream, which depends on the recipe's seed and the step's name only."""
    return int(digest(seed, step)[:15], 16)


def _input(wire: str | tuple[str, ...] | None, keys: Mapping[str, Key]) -> Any:
    if wire is None or isinstance(wire, str):
        return wire and keys[wire]
    return [keys[name] for name in wire]


def plain(value: Any) -> Any:
    """Return a parameter as JSON that is equal in every process; a file becomes its content digest and suffix."""
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
    raise TypeError(f"a parameter must be a number, a string, a file or a collection of these, not {value!r}")


def file_digest(path: Path) -> str:
    """Return the xxh3 of a file's bytes; read the file again only if its time stamp is new or too young."""
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
