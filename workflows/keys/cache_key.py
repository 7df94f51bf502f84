"""Cache key of a result: the digest of everything that determines the result."""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Iterable, Mapping
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import xxhash

from neusee.workflows.keys.sealed_files import opened

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Step, Wire
    from neusee.workflows.keys.code_digest import Code


# --- usual settings -------------------------------------------------------------------------------

# Settings of a new process. `loaded_state.settings` reports how the present process differs from
# them. They are written as text, so that this module does not import torch.


#: settings that neusee itself ignores, but that code of a user may read
OWN_USUAL = {
    "floating-point errors": "told",
    "printed numbers": "as NumPy prints",
    "encoding of texts": "utf-8",
    "time zone": "UTC",
    "code at the start of Python": "none",
}
#: settings of a new process
USUAL = {
    "default dtype": "torch.float32",
    "default device": "cpu",
    "matmul precision": "highest",
    "TF32": "True",
    "autocast": "off",
    "numbers below 1e-308": "kept",
    "assert statements": "run",
    **OWN_USUAL,
}


# --- module owner ---------------------------------------------------------------------------------

# Does a module belong to neusee or to the user? The tests of neusee check its own nodes; nodes of a
# user are observed while they run.


PROVEN = ("neusee.",)  #: packages whose nodes are not observed


def is_own(module: str) -> bool:
    """Return True for a module outside of neusee, that is, a module of the user; the nodes of
    neusee are checked by its own tests.
    """
    return not f"{module}.".startswith(PROVEN)


# --- written params -------------------------------------------------------------------------------

# What a node of the user can learn from its parameters beside their values: the names of files, and
# the order of the entries of mappings.
#
# The nodes of neusee read only the content of a file and the entries of a mapping, so equal content
# shares a result. A node of a user may also read an exposure time from the name ``dark_20ms.npy``,
# or take the first entry of a mapping.


#: parameters of nodes of neusee in which the order of the entries matters: light meets the first
#: surface of a lens first
_ORDERED = frozenset({("flare.stray_light", "surfaces"), ("flare.stray_shares", "surfaces")})


def written(step: Step) -> dict[str, Any]:
    """Return, for each parameter of a node of the user, the names of its files and the order of its
    mappings, as JSON values.

    For a node of neusee, only the order of the mappings in `_ORDERED` is returned.
    """
    notes: dict[str, Any] = {}
    is_of_user = is_own(step.node.fn.__module__)
    for name, value in step.params.items():
        if not is_of_user and (step.node.path, name) not in _ORDERED:
            continue
        # the place of the parameter in the recipe, and the place of its step
        places_in_recipe = [
            location for location in (step.param_marks.get(name), step.mark) if location is not None
        ]
        note = _said(value, [os.path.abspath(location.folder) for location in places_in_recipe])
        if note is not None:
            notes[name] = note
    return notes


def _said(value: Any, folders: list[str]) -> Any:
    """Return the file names and the order of keys that a value contains, or None if it contains
    neither.
    """
    if isinstance(value, Path):
        return _name(value, folders)
    if isinstance(value, Mapping):
        return _said_in_order(value, folders)
    if isinstance(value, tuple | list):
        notes = [_said(item, folders) for item in value]
        return notes if any(item is not None for item in notes) else None
    return None


def _said_in_order(mapping: Mapping[Any, Any], folders: list[str]) -> Any:
    """Return the keys of a mapping in their order, each with the result of `_said` for its value;
    None for at most one key whose value contains no file name and no mapping.
    """
    keys_and_notes = [[str(key), _said(item, folders)] for key, item in mapping.items()]
    return (
        keys_and_notes
        if len(keys_and_notes) > 1 or any(item is not None for _, item in keys_and_notes)
        else None
    )


def _name(path: Path, folders: list[str]) -> list[str]:
    """Return the path of a file relative to the folder of its recipe, and the path of the file
    behind symbolic links if that differs. A file outside of all ``folders`` has its absolute path,
    and the bare name of the file behind the links.
    """
    absolute_path = os.path.abspath(path)
    real_path = os.path.realpath(absolute_path)
    written_path = absolute_path
    target_path, path_without_links = os.path.basename(real_path), os.path.basename(absolute_path)
    folder = next((candidate for candidate in folders if _is_in(absolute_path, candidate)), None)
    if folder is not None:
        written_path, real_folder = os.path.relpath(absolute_path, folder), os.path.realpath(folder)
        if _is_in(real_path, real_folder):
            target_path, path_without_links = os.path.relpath(real_path, real_folder), written_path
    return [written_path] if target_path == path_without_links else [written_path, target_path]


def _is_in(path: str, folder: str) -> bool:
    """Return True if a path is below a folder."""
    return path.startswith(folder.rstrip(os.sep) + os.sep)


# --- input file digest ----------------------------------------------------------------------------

# The digest of the content of an input file is part of the cache key of each step that reads the
# file.


#: time (ns) after a change of a file during which a second change may leave the time stamp as it is
_SETTLED = 2_000_000_000
_TICK = 20_000_000  #: ns, longer than the resolution of the clock of a file system
_TRIES = 3  #: number of attempts to read a file that changes while it is read
_files: dict[tuple[int, ...], str] = {}

#: device, inode, size, and the times (ns) of the last change of content and of the entry
Stamp = tuple[int, ...]


def file_digest(path: Path) -> str:
    """Return the xxh3 digest of the content of a file; a process reads an unchanged file only once.

    A file that changed in the last two seconds is read each time, because its time stamp may not
    show a second change. Raises `OSError` if the file changes each time while it is read.
    """
    for _ in range(_TRIES):
        stamp = file_stamp(path)
        if stamp in _files:
            return _files[stamp]
        with opened(path) as file:
            hex_digest = hashlib.file_digest(file, xxhash.xxh3_128).hexdigest()
        if file_stamp(path) == stamp:
            # the last two numbers of a stamp are its times
            if time.time_ns() - max(stamp[-2:]) > _SETTLED:
                _files[stamp] = hex_digest
            return hex_digest
    raise OSError(f"{path} changes while it is read: wait until it is written, and run again")


def file_stamps(value: Any) -> list[Stamp]:
    """Return the stamp of each file in a parameter or in a collection of parameters.

    Equal stamps before and after a reading prove that nobody replaced the file in between, not even
    for a moment. If a file has just changed, the function waits for one tick of the clock, because
    the next change could otherwise leave the same stamp.
    """
    stamps = [file_stamp(path) for path in files_in(value)]
    if stamps and time.time_ns() - max(max(stamp[-2:]) for stamp in stamps) < _TICK:
        time.sleep(_TICK / 1e9)
    return stamps


def files_in(value: Any) -> Iterable[Path]:
    """Return the paths of the files in a parameter or in a collection of parameters."""
    if isinstance(value, Path):
        return [value]
    if isinstance(value, Mapping):
        return list(chain.from_iterable(map(files_in, value.values())))
    if isinstance(value, tuple | list):
        return list(chain.from_iterable(map(files_in, value)))
    return []


def file_stamp(path: Path | str) -> Stamp:
    """Return numbers that change whenever a file changes; raise `OSError` if the file is
    missing.
    """
    stat = os.stat(path)
    return stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns


# --- cache key ------------------------------------------------------------------------------------

# Cache keys: the key of a result is a digest of everything that determines the result, and of
# nothing else.
#
# A key depends on the node with its code, the versions of the packages that the code imports, the
# parameters, the content of input files, the keys of the inputs and the random stream. A key does
# not depend on tensors, the number of threads or, except for random nodes, the device.


Key = str
#: first letters of the key of a result that is valid in one process only and is not stored
PRIVATE = "private-"


def digest(*parts: Any) -> str:
    """Return the digest of the JSON values ``parts`` as 32 hexadecimal digits. Every bit of a float
    affects it.
    """
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def key_of(
    step: Step, keys: Mapping[str, Key], seed: int, code: Code, device: str = "cpu"
) -> tuple[Key, dict[str, Any]]:
    """Return the cache key of ``step`` and the data from which the key is computed, such as
    parameters.

    ``keys`` are the cache keys of the steps whose results are inputs of ``step``.
    """
    node = step.node
    key_parts: dict[str, Any] = {
        "node": node.path,
        "code": code_of(step, code),
        "params": counted_params(step),
        "inputs": [_keys_of(step.wires.get(name), keys) for name in node.inputs],
    }
    if notes := written(step):
        key_parts["written"] = notes
    if node.random and "rng" not in node.unused_parameters(step.params):
        key_parts["stream"] = [seed, step.name, device_kind(device)]
    is_private_key = not step.cached or any(
        map(is_private, [key_parts["code"], *(keys[name] for name in step.sources)])
    )
    # 24 digits after the prefix, so that every key has 32 characters
    return (PRIVATE + digest(key_parts)[:24] if is_private_key else digest(key_parts)), key_parts


def counted_params(step: Step) -> dict[str, Any]:
    """Return the parameters on which the result of a step depends, as JSON values."""
    unused = step.node.unused_parameters(step.params)
    return {name: plain(value) for name, value in step.params.items() if name not in unused}


def code_of(step: Step, code: Code) -> str:
    """Return the digest of the code of a step: the code of its node, and of the network classes
    that its parameters name.
    """
    networks = [(network.__module__, network.__qualname__) for network in networks_of(step)]
    return code.of(step.node, tuple(dict.fromkeys(networks)))


def networks_of(step: Step) -> list[type[Any]]:
    """Return the network classes that the parameters of a step name."""
    networks = map(_network_of, step.params.values())
    return [network for network in networks if network]


def _network_of(value: Any) -> type[Any] | None:
    """Return the network class that a parameter names, or None for any other value. It does not
    import torch.
    """
    module = sys.modules.get("neusee.nodes.own_modules")  # imported where there is such a value
    return value.network if module and isinstance(value, module.Architecture) else None


def is_private(key: Key) -> bool:
    """Return True for the key of a result that is valid in one process only, because the loaded
    code may differ from its source file.
    """
    return key.startswith(PRIVATE)


def stream_seed(seed: int, step: str) -> int:
    """Return the seed of the random numbers of a step. It depends only on the recipe's seed and the
    step's name.
    """
    # 60 bits, which fit into the seed of torch
    return int(digest(seed, step)[:15], 16)


def device_kind(device: str) -> str:
    """Return the kind of a device, such as ``cuda`` for ``cuda:1``."""
    return device.partition(":")[0]


def _keys_of(wire: Wire, keys: Mapping[str, Key]) -> Any:
    """Return the cache key of the step that an input is connected to, a list of keys for a list of
    steps, or None for an input without a connection.
    """
    if wire is None or isinstance(wire, str):
        return wire and keys[wire]
    return [keys[name] for name in wire]


def plain(value: Any) -> Any:
    """Return a step's parameter as a JSON value that is the same in every process; a file is
    represented by the digest of its content and its suffix.
    """
    # types that JSON has
    if isinstance(value, bool | int | str | None):
        return value
    if isinstance(value, float):
        # it may be of a subclass of float
        return float(value)
    if isinstance(value, Path):
        return {"file": file_digest(value), "suffix": value.suffix.lower()}
    if isinstance(value, Mapping):
        return {
            # sorted, so that the order of the mapping does not count
            "items": sorted(([plain(key), plain(item)] for key, item in value.items()), key=repr)
        }
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    if network := _network_of(value):
        return {"class": f"{network.__module__}.{network.__qualname__}"}
    if isinstance(value, complex):
        return {"complex": [value.real, value.imag]}
    raise TypeError(
        f"a parameter must be a number, a string, a file or a collection of these, not {value!r}"
    )
