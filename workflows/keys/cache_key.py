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

# Settings of a new process, from which `loaded_state.settings` tells the differences; torch is
# not needed.


#: settings that only code of a user reads
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

# Whose module is it: one of neusee, whose nodes its own tests prove, or one of the user?


PROVEN = ("neusee.",)  #: packages whose nodes are not observed


def is_own(module: str) -> bool:
    """Return True for a module outside of neusee, whose nodes are proven by its own tests."""
    return not f"{module}.".startswith(PROVEN)


# --- written params -------------------------------------------------------------------------------

# What the parameters of an own node say beside their values: names of files, and the order of
# mappings.
#
# The nodes of neusee read the content of a file and the entries of a mapping, so equal ones share
# results. A node of a user may also read an exposure in ``dark_20ms.npy``, or take the first entry
# of a mapping.


#: parameters of nodes of neusee whose entries count in their order: light meets the first surface
#: of a lens first
_ORDERED = frozenset({("flare.stray_light", "surfaces"), ("flare.stray_shares", "surfaces")})


def written(step: Step) -> dict[str, Any]:
    """Return the names of files and the order of mappings in the parameters of an own node, as JSON
    by parameter.

    Of a node of neusee only the order of a mapping counts, where the node says so.
    """
    notes: dict[str, Any] = {}
    is_of_user = is_own(step.node.fn.__module__)
    for name, value in step.params.items():
        if not is_of_user and (step.node.path, name) not in _ORDERED:
            continue
        # where the recipe writes the parameter, and where the step
        places_in_recipe = [
            location for location in (step.param_marks.get(name), step.mark) if location is not None
        ]
        note = _said(value, [os.path.abspath(location.folder) for location in places_in_recipe])
        if note is not None:
            notes[name] = note
    return notes


def _said(value: Any, folders: list[str]) -> Any:
    """Return what a value says beside its content, or None if it says nothing."""
    if isinstance(value, Path):
        return _name(value, folders)
    if isinstance(value, Mapping):
        return _said_in_order(value, folders)
    if isinstance(value, tuple | list):
        notes = [_said(item, folders) for item in value]
        return notes if any(item is not None for item in notes) else None
    return None


def _said_in_order(mapping: Mapping[Any, Any], folders: list[str]) -> Any:
    """Return the keys of a mapping in their order with what their values say, or None for a single
    key whose value says nothing.
    """
    keys_and_notes = [[str(key), _said(item, folders)] for key, item in mapping.items()]
    return (
        keys_and_notes
        if len(keys_and_notes) > 1 or any(item is not None for _, item in keys_and_notes)
        else None
    )


def _name(path: Path, folders: list[str]) -> list[str]:
    """Return the path of a file as a recipe in one of some folders writes it, and the name that
    links lead to.
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

# Digest of the content of an input file, which is part of the cache key of each step that reads the
# file.


#: ns after a change of a file in which a second change may not change the time stamp
_SETTLED = 2_000_000_000
_TICK = 20_000_000  #: ns, longer than a tick of the clock of a file system
_TRIES = 3  #: readings of a file that changes while it is read
_files: dict[tuple[int, ...], str] = {}

#: device, inode, size, and the times (ns) of the last change of content and of the entry
Stamp = tuple[int, ...]


def file_digest(path: Path) -> str:
    """Return the xxh3 digest of a file; an unchanged file is read only once in a process.

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
    """Return a stamp of each file in a parameter or a collection of parameters.

    Equal stamps before and after a reading say that the file was not replaced in between, not even
    by a file that was taken away again. A file that changed in this moment is waited for, because
    its next change could have its stamp.
    """
    stamps = [file_stamp(path) for path in files_in(value)]
    if stamps and time.time_ns() - max(max(stamp[-2:]) for stamp in stamps) < _TICK:
        time.sleep(_TICK / 1e9)
    return stamps


def files_in(value: Any) -> Iterable[Path]:
    """Return the files in a parameter or a collection of parameters."""
    if isinstance(value, Path):
        return [value]
    if isinstance(value, Mapping):
        return list(chain.from_iterable(map(files_in, value.values())))
    if isinstance(value, tuple | list):
        return list(chain.from_iterable(map(files_in, value)))
    return []


def file_stamp(path: Path | str) -> Stamp:
    """Return what changes whenever a file is changed; raise `OSError` if it is missing."""
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
#: first letters of the key of a result that holds for one process alone and is not stored
PRIVATE = "private-"


def digest(*parts: Any) -> str:
    """Return the digest of the JSON values ``parts`` as 32 hexadecimal digits; every bit of a
    float affects it.
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
        "params": {name: plain(value) for name, value in step.params.items()},
        "inputs": [_keys_of(step.wires.get(name), keys) for name in node.inputs],
    }
    if notes := written(step):
        key_parts["written"] = notes
    if node.random:
        key_parts["stream"] = [seed, step.name, device_kind(device)]
    is_private_key = not step.cached or any(
        map(is_private, [key_parts["code"], *(keys[name] for name in step.sources)])
    )
    # shorter by the first letters, so that all keys have 32
    return (PRIVATE + digest(key_parts)[:24] if is_private_key else digest(key_parts)), key_parts


def code_of(step: Step, code: Code) -> str:
    """Return the digest of the code of a step: of its node, and of the network classes that its
    parameters name.
    """
    networks = [(network.__module__, network.__qualname__) for network in networks_of(step)]
    return code.of(step.node, tuple(dict.fromkeys(networks)))


def networks_of(step: Step) -> list[type[Any]]:
    """Return the network classes that the parameters of a step name."""
    networks = map(_network_of, step.params.values())
    return [network for network in networks if network]


def _network_of(value: Any) -> type[Any] | None:
    """Return the network class that a parameter names, or None for another value, without an
    import of torch.
    """
    module = sys.modules.get("neusee.nodes.own_modules")  # imported where there is such a value
    return value.network if module and isinstance(value, module.Architecture) else None


def is_private(key: Key) -> bool:
    """Return True for the key of a result that holds for one process alone, whose code may not
    be that of its file.
    """
    return key.startswith(PRIVATE)


def stream_seed(seed: int, step: str) -> int:
    """Return the seed of the random numbers of a step, which depends only on the recipe's seed
    and the step's name.
    """
    # 60 bits, which fit into the seed of torch
    return int(digest(seed, step)[:15], 16)


def device_kind(device: str) -> str:
    """Return the kind of a device, such as ``cuda`` for ``cuda:1``."""
    return device.partition(":")[0]


def _keys_of(wire: Wire, keys: Mapping[str, Key]) -> Any:
    """Return the key behind a wire, or those of a list of wires; None for no wire."""
    if wire is None or isinstance(wire, str):
        return wire and keys[wire]
    return [keys[name] for name in wire]


def plain(value: Any) -> Any:
    """Return a step's parameter as JSON that is the same in every process; a file becomes the
    digest of its content.
    """
    # as JSON has them
    if isinstance(value, bool | int | str | None):
        return value
    if isinstance(value, float):
        # of a class that is derived from float
        return float(value)
    if isinstance(value, Path):
        return {"file": file_digest(value), "suffix": value.suffix.lower()}
    if isinstance(value, Mapping):
        return {
            # in an order that does not depend on that of the mapping
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
