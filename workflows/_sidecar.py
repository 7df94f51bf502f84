"""What stands beside a result: one line of JSON that says what it is, sealed with the checksum of itself."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import xxhash

from neusee.workflows._disk import Disk

About = dict[str, Any]
UNREADABLE = (OSError, ValueError, LookupError, TypeError, AttributeError, ImportError)
_SEAL = ',"seal":"'
_SEAL_SIZE = len(_SEAL) + 32 + 2
_encode = json.JSONEncoder(separators=(",", ":")).encode


def seal(about: About) -> bytes:
    """JSON whose last field is the checksum of all before it."""
    body = _encode(about)[:-1].encode()
    return body + f'{_SEAL}{xxhash.xxh3_128_hexdigest(body)}"}}'.encode()


def unseal(raw: bytes) -> About:
    """What `seal` wrote, or a `ValueError`."""
    body = raw[:-_SEAL_SIZE]
    if raw[-_SEAL_SIZE:] != f'{_SEAL}{xxhash.xxh3_128_hexdigest(body)}"}}'.encode():
        raise ValueError("its description is not the one that was written")
    about: About = json.loads(body + b"}")
    return about


def read(disk: Disk, key: str) -> About:
    """What stands beside ``key``; one of `UNREADABLE` where nothing can be trusted."""
    with open(disk.path(key, "json"), "rb") as file:
        about = unseal(file.read())
    if about["key"] != key:
        raise ValueError(f"it is the result of {about['key']}")
    return about


def is_kept(about: About) -> bool:
    """Whether there is a value, and not the receipt alone."""
    return bool(about.get("kept", True))


def receipt(about: About) -> About:
    """All that is known of a result, without its value."""
    return {k: v for k, v in about.items() if k not in ("layout", "payload", "tensors")} | {"kept": False}


def names(disk: Disk) -> Iterator[str]:
    """The key of every result, in order."""
    for path in sorted(disk.root.glob("[0-9a-f][0-9a-f]/*.json")):
        yield path.stem


def each(disk: Disk) -> Iterator[tuple[str, About]]:
    """Every key with what stands beside it; what cannot be read is passed over."""
    for key in names(disk):
        with suppress(*UNREADABLE):
            yield key, read(disk, key)
