"""Seal of a record of the cache: format version, checksum and, where a secret is set, a signature.

A record is a dict that is written as one line of JSON. `seal_record` adds the fields ``format``, ``seal`` (xxh3 of all
bytes before it) and ``sign`` (HMAC-SHA256 of format, kind of file, key and SHA-256 of these bytes). The checksum finds
damage; only the signature finds a forgery, and what was signed in the place of another thing, because it is that of one
kind of file and one key. ``NEUSEE_CACHE_SECRET`` holds the secret, or several separated by commas: the first one signs,
and each one is accepted. A file of another kind begins with such a record, which holds the SHA-256 of the rest.
"""

from __future__ import annotations

import functools
import hashlib
import hmac
import json
import os
from collections.abc import Mapping
from typing import Any, Literal

import xxhash

FORMAT = 2  #: version of the format of all files of the cache; files of version 0.1 have no version and count as 1
#: what a signature is for: a line or a file of a cache, or the secret of a worker
Kind = Literal[
    "result", "small result", "result at a URL", "receipt at a URL", "journal", "speeds", "band", "sources",
    "definitions", "answer", "draws", "worker",
]  # fmt: skip
_encode = json.JSONEncoder(separators=(",", ":")).encode
_SEAL, _SIGN = b',"seal":"', b'","sign":"'
_SEALED, _SIGNED = len(_SEAL) + 32, len(_SIGN) + 64  #: bytes of each field with its digits
_END = b'"}'


class NotRead(ValueError):
    """Error for an undamaged record that this program does not read; it counts as missing and stays as it is."""


class OtherFormat(NotRead):
    """Error for a record that another version of the program wrote."""


class Unsigned(NotRead):
    """Error for a record without a signature by one of the secrets in ``NEUSEE_CACHE_SECRET``."""


def secrets() -> tuple[bytes, ...]:
    """Return the secrets in ``NEUSEE_CACHE_SECRET``: the first one signs, and each one is accepted."""
    return _split(os.environ.get("NEUSEE_CACHE_SECRET", ""))


@functools.lru_cache(8)
def _split(text: str) -> tuple[bytes, ...]:
    return tuple(part.strip().encode() for part in text.split(",") if part.strip())


def signature(kind: Kind, key: str, sha256: bytes) -> str:
    """Return the signature of a content under a key as 64 hexadecimal digits, or an empty text without a secret."""
    known = secrets()
    return _signed_by(known[0], kind, key, sha256) if known else ""


def check_signature(sign: str, kind: Kind, key: str, sha256: bytes) -> None:
    """Raise `Unsigned` if a secret is set and ``sign`` is the signature of this content, kind and key by none."""
    known = secrets()
    if known and not any(hmac.compare_digest(sign.encode(), _signed_by(s, kind, key, sha256).encode()) for s in known):
        raise Unsigned("there is no signature by a secret in NEUSEE_CACHE_SECRET")


def _signed_by(secret: bytes, kind: Kind, key: str, sha256: bytes) -> str:
    text = b"neusee cache %d\n%s\n%s\n%s" % (FORMAT, kind.encode(), key.encode(errors="replace"), sha256)
    return hmac.digest(secret, text, "sha256").hex()


def seal_record(kind: Kind, record: Mapping[str, Any]) -> bytes:
    """Return a record as one line of JSON with its format version, checksum and signature.

    The record may have a field ``key``. The signature covers it and the kind of the file that the record is written to.
    """
    body = _encode({**record, "format": FORMAT})[:-1].encode()
    raw = body + _SEAL + xxhash.xxh3_128_hexdigest(body).encode()
    if secrets():
        raw += _SIGN + signature(kind, str(record.get("key", "")), hashlib.sha256(body).digest()).encode()
    return raw + _END


def unseal_record(kind: Kind, raw: bytes) -> dict[str, Any]:
    """Return the record that `seal_record` wrote.

    Raises `OtherFormat` for another format version, `Unsigned` for a missing signature or that of another kind of file,
    and `ValueError` for damage.
    """
    body, sign = checked_body(raw)
    record = _parsed(body + b"}")
    version = record.pop("format", 1)
    if version != FORMAT or isinstance(version, bool):
        raise OtherFormat(f"its format is version {version!r}, not version {FORMAT}")
    if secrets():
        check_signature(sign, kind, str(record.get("key", "")), hashlib.sha256(body).digest())
    return record


def seal_file(kind: Kind, name: str, content: bytes) -> bytes:
    """Return the record that `unseal_file` compares with a content; the signature covers kind, name and content."""
    return seal_record(kind, {"key": name, "sha256": hashlib.sha256(content).hexdigest()})


def unseal_file(kind: Kind, name: str, seal: bytes, content: bytes) -> bytes:
    """Return the content of a file whose seal is right.

    Raises `NotRead` for another format version or a missing signature, and `ValueError` for any other content or name.
    """
    if unseal_record(kind, seal) != {"key": name, "sha256": hashlib.sha256(content).hexdigest()}:
        raise ValueError(f"the content of {name} is not what was sealed")
    return content


def may_change(file: int) -> bool:
    """Return True if a secret is set, and another user owns an opened file and could change it after its check."""
    return bool(secrets()) and os.fstat(file).st_uid != os.geteuid()


def checked_body(raw: bytes) -> tuple[bytes, str]:
    """Return the JSON text before the seal, without its last brace, and the signature; compare only the checksum.

    Raises `ValueError` for a checksum that does not match.
    """
    rest, sign = raw[: -len(_END)], b""
    if rest[-_SIGNED:].startswith(_SIGN):
        rest, sign = rest[:-_SIGNED], rest[-_SIGNED + len(_SIGN) :]
    body = rest[:-_SEALED]
    whole = raw.endswith(_END) and len(rest) > _SEALED
    if not whole or rest[-_SEALED:] != _SEAL + xxhash.xxh3_128_hexdigest(body).encode():
        raise ValueError("checksum mismatch: the metadata have changed since they were written")
    return body, sign.decode(errors="replace")


def _parsed(text: bytes) -> dict[str, Any]:
    try:
        record = json.loads(text)
    except RecursionError:
        raise ValueError("the record is nested too deeply") from None
    if not isinstance(record, dict):
        raise ValueError("the record is not a mapping")
    return record
