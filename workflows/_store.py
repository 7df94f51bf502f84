"""The store: a folder of results by key, ``<2>/<key>.safetensors`` beside ``<key>.json``.

The JSON says what a result is: the recipe of its key, its layout, facts, checks, seconds
and versions. Small results stand in it whole. Every byte is covered by a checksum that is
compared on each load; an entry that fails is put aside with one warning and counts as
missing. A result gets its name only when it is complete, so a killed process leaves no
half of one. Where the folder cannot be written, a run warns once and goes on.
"""

from __future__ import annotations

import fcntl
import json
import os
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import xxhash

if TYPE_CHECKING:
    from torch import Tensor

INLINE = 4096  #: bytes of tensors up to which a result stands in its JSON
_OLD = 3600.0  #: s after which a temporary file has no owner
_SEAL = ',"seal":"'
_SEAL_SIZE = len(_SEAL) + 32 + 2
_UNREADABLE = (OSError, ValueError, LookupError, TypeError, AttributeError, ImportError)


def default_root() -> Path:
    """``$NEUSEE_CACHE``, else ``cache/`` of the checkout around us, else ``~/.cache/neusee``."""
    if named := os.environ.get("NEUSEE_CACHE"):
        return Path(named)
    here = Path.cwd()
    for folder in (here, *here.parents):
        project = folder / "pyproject.toml"
        if (folder / "cache").is_dir() and project.is_file() and 'name = "neusee"' in project.read_text("utf-8"):
            return folder / "cache"
    return Path.home() / ".cache" / "neusee"


class Store:
    """Results by key. Every way in which a folder can fail is a missing result, never a wrong one."""

    def __init__(self, root: Path | None = None) -> None:
        self.root = default_root() if root is None else Path(root)
        self._folder = os.fspath(self.root)  # text, for a path object costs as much as the look-up
        self.code_memo = self.root / "code.json"
        self._known: dict[str, dict[str, Any]] = {}
        self._lost: set[str] = set()  # damaged, and perhaps not to be moved away
        self._warned = self._swept = False
        self._count = 0

    def has(self, key: str) -> bool:
        """Whether there is a result; its payload is not read."""
        return self.about(key) is not None

    def about(self, key: str) -> dict[str, Any] | None:
        """What is known of a result, without reading it."""
        if key in self._known:
            return self._known[key]
        if key in self._lost:
            return None
        try:
            with open(self._path(key, "json"), "rb") as file:
                about = _unseal(file.read())
            if about["key"] != key:
                raise ValueError(f"it is the result of {about['key']}")
            payload = about["payload"]
            if payload and os.stat(self._path(key, "safetensors")).st_size != payload["size"]:
                raise ValueError(f"its payload has not the {payload['size']} bytes that were written")
        except _UNREADABLE as error:
            if os.path.exists(self._path(key, "json")):
                self._put_aside(key, error)
            return None
        self._known[key] = about
        return about

    def get(self, key: str) -> Any:
        """The result, or `KeyError` where there is none that can be trusted."""
        about = self.about(key)
        if about is None:
            raise KeyError(key)
        from neusee.workflows import _codec

        try:
            if payload := about["payload"]:
                tensors = _codec.read(self._path(key, "safetensors"), payload["xxh3"])
            else:
                tensors = [_codec.from_text(*t) for t in about["tensors"]]
            return _codec.unpack(about["layout"], tensors)
        except _UNREADABLE as error:
            self._put_aside(key, error)
            raise KeyError(key) from None

    def put(self, key: str, value: Any, about: dict[str, Any]) -> bool:
        """Keep a result with what is ``about`` it; False, after one warning, where the folder takes none."""
        try:
            self._write(key, value, about)
        except OSError as error:
            if not self._warned:
                warnings.warn(f"{self.root} cannot be written ({error}): results are not kept", stacklevel=3)
            self._warned = True
            return False
        self._lost.discard(key)
        return True

    def entries(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Every result's key and what is known of it, in the order of the keys."""
        for path in sorted(self.root.glob("[0-9a-f][0-9a-f]/*.json")):
            about = self.about(path.stem)
            if about is not None:
                yield path.stem, about

    def _path(self, key: str, suffix: str) -> str:
        return f"{self._folder}/{key[:2]}/{key}.{suffix}"

    def _write(self, key: str, value: Any, about: dict[str, Any]) -> None:
        from neusee.workflows import _codec

        layout, tensors = _codec.pack(value)
        size = sum(t.nbytes for t in tensors)
        entry = {"key": key, **about, "layout": layout, "bytes": size, "payload": None}
        if size <= INLINE:
            entry["tensors"] = [_codec.to_text(t) for t in tensors]
            self._write_about(key, entry)
        else:
            self._write_payload(key, entry, tensors)

    def _write_payload(self, key: str, entry: dict[str, Any], tensors: list[Tensor]) -> None:
        """Payload first, then what names it; of two processes with one key the first one's stays."""
        from neusee.workflows import _codec

        with self._temporary(key) as (part, file):
            xxh3 = _codec.write(file, tensors)
            file.flush()
            os.fsync(file.fileno())
            entry["payload"] = {"size": file.tell(), "xxh3": xxh3}
            with self._lock():
                if key in self._lost or not os.path.exists(self._path(key, "json")):
                    self._name(part, self._path(key, "safetensors"))
                    self._write_about(key, entry)

    def _write_about(self, key: str, entry: dict[str, Any]) -> None:
        """A torn entry fails its seal, so this small file need not wait for the disk."""
        with self._temporary(key) as (part, file):
            file.write(_seal(entry))
            file.flush()
            self._name(part, self._path(key, "json"))
        self._known[key] = entry

    @contextmanager
    def _temporary(self, key: str) -> Iterator[tuple[str, IO[bytes]]]:
        if not self._swept:
            folder = self.root / "tmp"
            folder.mkdir(parents=True, exist_ok=True)
            _sweep(folder)
            self._swept = True
        self._count += 1
        part = f"{self._folder}/tmp/{key}.{os.getpid()}.{id(self):x}.{self._count}"
        try:
            with open(part, "wb") as file:
                yield part, file
        finally:
            with suppress(OSError):
                os.unlink(part)

    def _name(self, part: str, path: str) -> None:
        try:
            os.replace(part, path)
        except FileNotFoundError:
            os.makedirs(os.path.dirname(path), exist_ok=True)
            os.replace(part, path)

    @contextmanager
    def _lock(self) -> Iterator[None]:
        """One process at a time; a file system that knows no locks goes without."""
        with open(self.root / "tmp" / ".lock", "wb") as file:
            with suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def _put_aside(self, key: str, error: Exception) -> None:
        """Move a damaged entry to ``bad/``, where someone may look at it; what another user owns stays."""
        self._known.pop(key, None)
        self._lost.add(key)
        unreadable = isinstance(error, OSError) and not isinstance(error, FileNotFoundError)
        for suffix in () if unreadable else ("json", "safetensors"):
            with suppress(OSError):
                (self.root / "bad").mkdir(exist_ok=True)
                os.replace(self._path(key, suffix), self.root / "bad" / f"{key}.{suffix}")
        warnings.warn(f"the stored result {key} is damaged ({error}): it is put aside", stacklevel=4)


def _sweep(folder: Path) -> None:
    """Remove what killed processes left behind."""
    for path in folder.iterdir():
        with suppress(OSError):
            if time.time() - path.stat().st_mtime > _OLD and path.name != ".lock":
                path.unlink()


def _seal(entry: dict[str, Any]) -> bytes:
    """JSON whose last field is the checksum of all before it."""
    body = json.dumps(entry, separators=(",", ":"))[:-1].encode()
    return body + f'{_SEAL}{xxhash.xxh3_128_hexdigest(body)}"}}'.encode()


def _unseal(raw: bytes) -> dict[str, Any]:
    body = raw[:-_SEAL_SIZE]
    if raw[-_SEAL_SIZE:] != f'{_SEAL}{xxhash.xxh3_128_hexdigest(body)}"}}'.encode():
        raise ValueError("its description is not the one that was written")
    entry: dict[str, Any] = json.loads(body + b"}")
    return entry
