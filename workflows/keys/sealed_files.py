"""Safe reading of files that other users may have written: only regular files are read, and records
have a seal.
"""

from __future__ import annotations

import functools
import hashlib
import hmac
import json
import os
import stat
import threading
from collections.abc import Mapping
from contextlib import suppress
from io import BufferedReader
from pathlib import Path
from typing import Any, Literal

import xxhash

# --- regular file ---------------------------------------------------------------------------------

# Reading of the program's own kinds of files: texts, documents and records. Anything but a regular
# file is refused.
#
# So a pipe, a device or a socket in the place of a file never blocks the program, and a file that
# is too long for its kind is not read. This module imports little, because the fast commands read
# files with it.


MOST = 64 << 20  #: greatest size of a document or a record (bytes)
_KINDS = ((stat.S_ISFIFO, "a pipe"), (stat.S_ISSOCK, "a socket"), (stat.S_ISDIR, "a folder"))


class NotRegular(OSError, ValueError):
    """Error for a path that is not a regular file, or for a file that is too long for its kind."""


def refuse_other_than_file(path: Path | str) -> None:
    """Raise `NotRegular` for a pipe, a device, a socket or a folder; do nothing for a missing
    file.
    """
    try:
        mode = os.stat(path).st_mode
    except OSError:
        return
    _refuse(path, mode)


def _refuse(path: Path | str, mode: int) -> None:
    """Raise `NotRegular` if a file mode is not that of a regular file."""
    if not stat.S_ISREG(mode):
        kind = next((kind for fits, kind in _KINDS if fits(mode)), "a device")
        raise NotRegular(f"{path} is not a regular file but {kind}: give the path of a file")


def opened(path: Path | str) -> BufferedReader:
    """Open a regular file to read its bytes, without waiting; raise `NotRegular` for anything
    else.
    """
    refuse_other_than_file(path)  # checked first, since opening some devices has an effect
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        # the file may have been replaced since the first check
        _refuse(path, os.fstat(descriptor).st_mode)
    except NotRegular:
        os.close(descriptor)
        raise
    return os.fdopen(descriptor, "rb")


def bytes_of(path: Path | str, max_bytes: int = MOST) -> bytes:
    """Return the bytes of a regular file; raise `NotRegular` for anything else, and for more
    than ``max_bytes`` bytes.
    """
    with opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > max_bytes:
            raise NotRegular(
                f"{path} has {size} bytes, more than the limit of {max_bytes}: give a shorter file"
            )
        return file.read(size)


def head_of(path: Path | str, count: int) -> bytes:
    """Return the first bytes of a regular file."""
    with opened(path) as file:
        return file.read(count)


def text_of(
    path: Path | str, encoding: str = "utf-8", errors: str = "strict", max_bytes: int = MOST
) -> str:
    """Return the text of a regular file, with ``\\n`` at the end of each line. Raises the same
    errors as `bytes_of`.
    """
    return (
        bytes_of(path, max_bytes).decode(encoding, errors).replace("\r\n", "\n").replace("\r", "\n")
    )


# --- inherited modes ------------------------------------------------------------------------------

# Permissions below the root of a store: folders and files have the group and the permissions of the
# root.
#
# A umask of 022 would remove the group's permission to write, which the owner of the root granted.


def make_folders(folder: str, root: str) -> None:
    """Make a folder and the missing ones above it; those below ``root`` inherit its permissions.

    The root itself has the permissions that the umask leaves.
    """
    if os.path.isdir(folder):
        return
    if folder == root or not folder.startswith(f"{root}/"):
        os.makedirs(folder, exist_ok=True)
        return
    make_folders(os.path.dirname(folder), root)
    with suppress(FileExistsError):
        os.mkdir(folder)
        # all permission bits, with set-group-ID and sticky bit
        inherit(folder, root, 0o7777)
        if os.stat(folder).st_gid != os.getegid():
            # set-group-ID: new entries get the group of the folder
            os.chmod(folder, os.stat(folder).st_mode | stat.S_ISGID)


def inherit(path: str, root: str, mask: int) -> None:
    """Give a file or folder the group of ``root``, and those permissions of ``root`` that are in
    ``mask``.
    """
    root_status, own_status = os.stat(root), os.stat(path)
    with suppress(OSError):  # fails if the user is not a member of the group
        if own_status.st_gid != root_status.st_gid:
            os.chown(path, -1, root_status.st_gid)
    wanted_mode = root_status.st_mode & mask
    if wanted_mode & ~own_status.st_mode:
        with suppress(OSError):
            os.chmod(path, (own_status.st_mode | wanted_mode) & 0o7777)


def write_shared(path: Path, content: bytes, folder: Path) -> None:
    """Write a file by atomic rename; do nothing if the folder cannot be written.

    ``folder`` is the folder of temporary files, directly below the root of the store.
    """
    root = str(folder.parent)
    # one temporary file for each process and thread
    partial = folder / f"{path.name}.{os.getpid()}.{threading.get_ident()}"
    with suppress(OSError):
        make_folders(str(folder), root)
        make_folders(str(path.parent), root)
        partial.write_bytes(content)
        inherit(str(partial), root, 0o444)
        os.replace(partial, path)


# --- seal -----------------------------------------------------------------------------------------

# The seal of a record of the cache consists of the format version, a checksum and, if a secret is
# set, a signature.
#
# A record is a dict that is written as one line of JSON. `seal_record` adds the fields ``format``,
# ``seal`` (xxh3 of all bytes before it) and ``sign`` (HMAC-SHA256 of format, kind of file, key and
# SHA-256 of these bytes). The checksum detects damage. Only the signature detects a forgery, or a
# signed record that was moved to another place, because it covers the kind of file and the key.
# ``NEUSEE_CACHE_SECRET`` holds the secret, or several separated by commas: the first one signs, and
# each one is accepted. A file whose content is no record begins with such a record, which holds the
# SHA-256 of the rest.


#: version of the format of all files of the cache; files of version 0.1 have no version and count
#: as 1
FORMAT = 2
#: purpose of a signature: a line or a file of a cache, or the secret of a worker
Kind = Literal[
    "result",
    "small result",
    "result at a URL",
    "receipt at a URL",
    "journal",
    "speeds",
    "sources",
    "definitions",
    "answer",
    "checks",
    "draws",
    "worker",
]
_encode = json.JSONEncoder(separators=(",", ":")).encode
_SEAL, _SIGN = b',"seal":"', b'","sign":"'
_SEALED, _SIGNED = len(_SEAL) + 32, len(_SIGN) + 64  #: length (bytes) of each field with its digits
_END = b'"}'


class NotRead(ValueError):
    """Error for an intact record that this program cannot read; the record counts as missing and is
    left unchanged.
    """


class OtherFormat(NotRead):
    """Error for a record that another version of the program wrote."""


class Unsigned(NotRead):
    """Error for a record without a signature by one of the secrets in ``NEUSEE_CACHE_SECRET``."""


def secrets() -> tuple[bytes, ...]:
    """Return the secrets in ``NEUSEE_CACHE_SECRET``: the first one signs, and each one is
    accepted.
    """
    return _split(os.environ.get("NEUSEE_CACHE_SECRET", ""))


@functools.lru_cache(8)
def _split(text: str) -> tuple[bytes, ...]:
    """Return the secrets in a text, which are separated by commas."""
    return tuple(secret.strip().encode() for secret in text.split(",") if secret.strip())


def signature(kind: Kind, key: str, sha256: bytes) -> str:
    """Return the signature of content with the digest ``sha256`` under a key, as 64 hexadecimal
    digits; an empty text if no secret is set.
    """
    secret_values = secrets()
    return _signed_by(secret_values[0], kind, key, sha256) if secret_values else ""


def check_signature(sign: str, kind: Kind, key: str, sha256: bytes) -> None:
    """Raise `Unsigned` if a secret is set and no secret gives the signature ``sign`` for this
    digest, kind and key.
    """
    secret_values = secrets()
    if secret_values and not any(
        hmac.compare_digest(sign.encode(), _signed_by(s, kind, key, sha256).encode())
        for s in secret_values
    ):
        raise Unsigned("there is no signature by a secret in NEUSEE_CACHE_SECRET")


def _signed_by(secret: bytes, kind: Kind, key: str, sha256: bytes) -> str:
    """Return the signature of content by one secret: HMAC-SHA256 of format, kind, key and
    digest.
    """
    signed_text = b"neusee cache %d\n%s\n%s\n%s" % (
        FORMAT,
        kind.encode(),
        key.encode(errors="replace"),
        sha256,
    )
    return hmac.digest(secret, signed_text, "sha256").hex()


def seal_record(kind: Kind, record: Mapping[str, Any]) -> bytes:
    """Return a record as one line of JSON with its format version, checksum and signature.

    The record may have a field ``key``. The signature covers it and the kind of the file that the
    record is written to.
    """
    # without the last brace: seal and signature come before it
    body = _encode({**record, "format": FORMAT})[:-1].encode()
    sealed = body + _SEAL + xxhash.xxh3_128_hexdigest(body).encode()
    if secrets():
        sealed += (
            _SIGN
            + signature(kind, str(record.get("key", "")), hashlib.sha256(body).digest()).encode()
        )
    return sealed + _END


def unseal_record(kind: Kind, raw: bytes) -> dict[str, Any]:
    """Return the record that `seal_record` wrote.

    Raises `OtherFormat` for another format version, `Unsigned` for a missing signature or that of
    another kind of file, and `ValueError` for damage.
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
    """Return the record that seals the content of a file; `unseal_file` checks it. The signature
    covers kind, name and content.
    """
    return seal_record(kind, {"key": name, "sha256": hashlib.sha256(content).hexdigest()})


def unseal_file(kind: Kind, name: str, seal: bytes, content: bytes) -> bytes:
    """Return the content of a file after a check of its seal.

    Raises `NotRead` for another format version or a missing signature, and `ValueError` for any
    other content or name.
    """
    if unseal_record(kind, seal) != {"key": name, "sha256": hashlib.sha256(content).hexdigest()}:
        raise ValueError(f"the content of {name} is not what was sealed")
    return content


def may_change(file: int) -> bool:
    """Return True if a secret is set and an opened file belongs to another user, who could change
    it after the check.
    """
    return bool(secrets()) and os.fstat(file).st_uid != os.geteuid()


def checked_body(raw: bytes) -> tuple[bytes, str]:
    """Return the JSON text before the seal, without its last brace, and the signature. Only the
    checksum is checked.

    Raises `ValueError` for a checksum that does not match.
    """
    unsigned, sign = raw[: -len(_END)], b""
    # the signature, if any, is the last field
    if unsigned[-_SIGNED:].startswith(_SIGN):
        unsigned, sign = unsigned[:-_SIGNED], unsigned[-_SIGNED + len(_SIGN) :]
    body = unsigned[:-_SEALED]
    is_complete = raw.endswith(_END) and len(unsigned) > _SEALED
    if not is_complete or unsigned[-_SEALED:] != _SEAL + xxhash.xxh3_128_hexdigest(body).encode():
        raise ValueError("checksum mismatch: the metadata have changed since they were written")
    return body, sign.decode(errors="replace")


def _parsed(text: bytes) -> dict[str, Any]:
    """Return the dict in a JSON text; raise `ValueError` for anything else."""
    try:
        record = json.loads(text)
    except RecursionError:
        raise ValueError("the record is nested too deeply") from None
    if not isinstance(record, dict):
        raise ValueError("the record is not a mapping")
    return record
