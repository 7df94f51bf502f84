"""A cache with a file of every kind, and all that it says."""

from __future__ import annotations

import json
import warnings
from contextlib import suppress

import torch

from neusee.workflows.answers.stored_answer import Answer, read_answer, write_answer
from neusee.workflows.answers.witnesses import Witnesses
from neusee.workflows.keys.module_digest import read_memo, read_parts, write_memo, write_parts
from neusee.workflows.recipe.remembered_checks import Answers
from neusee.workflows.store.derived_files import DerivedFiles
from neusee.workflows.store.result_store import Speeds, Store

KINDS = ("payload", "inline", "small", "receipt", "picture")
ABOUT = {
    "step": "s",
    "recipe": "r",
    "seconds": 2.0,
    "bytes": 32000,
    "date": "2026-01-01",
    "device": "cpu",
}


def key_of(kind, number):
    return f"{KINDS.index(kind):02x}{number}" + "0" * 29


def values_of(number, version):
    """The values of one set of keys; another version has other numbers of the same size."""
    numbers = torch.arange(2048, dtype=torch.float64) + 10 * number + 1000 * version
    return {
        "payload": numbers,
        "inline": numbers[:4].clone(),
    }


def fill(root, numbers=(1, 2), version=0):
    """Write a cache with files of every kind for some keys."""
    store = Store(root)
    for number in numbers:
        about = ABOUT | {"recipe": f"r{number}.{version}"}
        for kind, value in values_of(number, version).items():
            store.put(key_of(kind, number), value, about)
        store.put_small(key_of("small", number), torch.full((3,), 10.0 * number + version), about)
        store.put_receipt(key_of("receipt", number), about)
        picture = f"picture {number}.{version}".encode()
        DerivedFiles(store).keep(
            key_of("picture", number),
            ".png",
            "a",
            lambda path, text=picture: path.write_bytes(text),
        )
        write_parts(root, f"{number:032x}", {"m": {"f()": f"{number}.{version}"}})
        answer = Answer(
            "s", Witnesses({}, [], {}, {}), f"{number}.{version}", False, "", "", "", {}
        )
        with suppress(OSError):  # as its caller does
            write_answer(store.disk, f"{number:032x}", answer)
    write_memo(root / "code.json", {})
    checks = {f"question {number}": f"{number}.{version}" for number in numbers}
    Answers("edition", {}, checks).write(root / "checks.json")
    Speeds(store.disk).learn("read", 1 << 30, 1e-2 * (1 + version))
    return root


def bytes_in(value):
    return None if value is None else value.numpy().tobytes()


def got(store, key):
    try:
        return store.get(key, torch.Tensor)
    except KeyError:
        return None


def content(path):
    return path and path.read_bytes()


def believed(root, numbers=(1, 2)):
    """All that this cache says, by name; what is missing says None."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        store, said = Store(root, verify="never"), {}
        for number in numbers:
            for kind in KINDS:
                key = key_of(kind, number)
                said[f"about {kind} {number}"] = json.dumps(store.about(key))
                said[f"value {kind} {number}"] = bytes_in(got(store, key))
            for suffix in (".png", ".svg"):
                found = DerivedFiles(store).find(key_of("picture", number), suffix)
                said[f"picture {number} {suffix}"] = content(found)
            said[f"definitions {number}"] = json.dumps(read_parts(root, f"{number:032x}") or None)
            said[f"answer {number}"] = getattr(
                read_answer(store.disk, f"{number:032x}"), "text", None
            )
        checks = Answers.read(root / "checks.json", "edition").by_question
        said |= {f"check {number}": checks.get(f"question {number}") for number in numbers}
        said["sources"] = None if read_memo(root / "code.json") == {} else "another memo"
        said["speeds"] = json.dumps(Speeds(store.disk)._stored() or None)
        rows = frozenset(json.dumps(row) for row in store.journal.rows())
    return said, rows
