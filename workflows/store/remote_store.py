"""A store at a URL that many machines share, on any file system of fsspec, with a local folder for copies.

The local folder (the local layer) is an ordinary `Store`. It stores each value that is read from the URL; a new value
is stored in the local layer and at the URL. At the URL, a payload has its checksum in its name and is complete before
the metadata that name the payload, so that two writers of one key cannot mix their files. Leases, pins and the size
budget belong to the local layer alone: two machines may compute the same key, and the first result stays. After a
failure of the URL, a run issues one warning and continues with the local layer.
"""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from itertools import starmap
from pathlib import Path
from typing import Any

import xxhash

from neusee.workflows.keys.cache_key import Key, digest
from neusee.workflows.keys.seal import Kind, NotRead, seal_record, secrets
from neusee.workflows.store.environment import Verify
from neusee.workflows.store.metadata import UNREADABLE, Metadata, is_kept, read, receipt, unseal_of
from neusee.workflows.store.payload import newest, stamp_of
from neusee.workflows.store.remote_files import RemoteFiles
from neusee.workflows.store.result_store import Store


def open_store(where: str | Path | None = None) -> Store:
    """Open the store at a folder or a URL (``s3://bucket/name``); None means ``$NEUSEE_CACHE`` or the default folder.

    Raises `ValueError` for an unknown scheme, and `ModuleNotFoundError` if the package for the scheme is missing.
    """
    where = os.environ.get("NEUSEE_CACHE") or None if where is None else where
    if isinstance(where, str) and "://" in where:
        return RemoteStore(where)
    return Store(where)


def local_layer(url: str) -> Path:
    """Return the local folder for copies from ``url``: ``$NEUSEE_CACHE_LOCAL`` or a folder in ``~/.cache/neusee``."""
    if folder := os.environ.get("NEUSEE_CACHE_LOCAL"):
        return Path(folder)
    return Path.home() / ".cache" / "neusee" / digest(url.rstrip("/"))[:16]


class RemoteStore(Store):
    """A local `Store` that reads missing results from ``url`` and also writes its results there."""

    def __init__(
        self, url: str, root: Path | str | None = None, *, verify: Verify | None = None, budget: int | None = None
    ) -> None:
        self.url, self._remote = url, RemoteFiles(url)
        self._seen: dict[Key, Metadata] = {}  # metadata read from the URL
        self._broken: set[Key] = set()  # keys whose copy at the URL cannot be used
        self._failed: set[Key] = set()  # keys whose local copy was damaged
        super().__init__(root or local_layer(url), verify=verify, budget=budget)

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(type(self), self.url, self.root, verify=self.verify, budget=self.budget), ()

    def about(self, key: Key) -> Metadata | None:
        """Return the metadata of a result from the local folder or the URL, without reading the value."""
        here = super().about(key)
        return here if is_kept(here) else self._remote_metadata(key) or here

    def get(self, key: Key, kind: Any = Any) -> Any:
        """Return the value of ``key``; raise `KeyError` if neither the local folder nor the URL has the value."""
        if not self._is_local(key):
            self._fetch_value(key)
        return super().get(key, kind)

    def put_aside(self, key: Key, error: Exception) -> None:
        """Move the local files of a damaged result to ``bad/``; the second time, do not use its copy at the URL."""
        super().put_aside(key, error)
        if key in self._failed:
            self._give_up(key)
        self._failed.add(key)

    def put(self, key: Key, value: Any, about: Metadata) -> bool:
        """Store a value locally and at the URL; return False if the value cannot be stored locally."""
        stored = super().put(key, value, about)
        if stored:
            self._send(key)
        return stored

    def put_receipt(self, key: Key, about: Metadata) -> bool:
        """Store the metadata of a result without its value, locally and at the URL."""
        stored = super().put_receipt(key, about)
        if stored and not self._remote.exists(_receipt_name(key)) and not self._remote.exists(f"{key}.json"):
            self._remote.write(_receipt_name(key), seal_record("receipt at a URL", receipt({"key": key, **about})))
        return stored

    def entries(self) -> Iterator[tuple[Key, Metadata]]:
        """Yield every key with its metadata: first the local results, then the results that are only at the URL."""
        here = set()
        for key, about in super().entries():
            here.add(key)
            yield key, about
        there = sorted({name.partition(".")[0] for name in self._remote.names() if ".json" in name} - here)
        with ThreadPoolExecutor(16) as pool:
            for key, remote in zip(there, pool.map(self._remote_metadata, there), strict=True):
                if remote is not None:
                    yield key, remote

    def write_seconds(self, size: float) -> float:
        return super().write_seconds(size) + self._remote.seconds("up", size)

    def read_seconds(self, size: float) -> float:
        return super().read_seconds(size) + self._remote.seconds("down", size)

    def _is_local(self, key: Key) -> bool:
        return is_kept(super().about(key))

    def _remote_metadata(self, key: Key, look: bool = False) -> Metadata | None:
        """Return the metadata of a result at the URL; if ``look`` is True, request an unlisted file too."""
        value, note = f"{key}.json", _receipt_name(key)
        if key not in self._broken and (look or self._remote.exists(value)) and not is_kept(self._seen.get(key)):
            self._read_metadata(key, value, "result at a URL")
        if key not in self._seen and self._remote.exists(note):
            self._read_metadata(key, note, "receipt at a URL")
        return self._seen.get(key)

    def _read_metadata(self, key: Key, name: str, kind: Kind) -> None:
        """Read the metadata file ``name`` at the URL; damaged metadata count as missing, after a warning."""
        raw = self._remote.read(name)
        if raw is not None:
            try:
                self._seen[key] = unseal_of(kind, key, raw)
            except NotRead as error:
                self._give_up(key)
                self.leave(error)
            except UNREADABLE as error:
                self._distrust(key, error)

    def _fetch_value(self, key: Key) -> None:
        """Copy the value of a key from the URL into the local folder; after a failure, do not fetch this key again."""
        about = self._remote_metadata(key, look=True)
        try:
            if is_kept(about) and not self._value_fetched(key, about):
                self._give_up(key)
        except OSError as error:
            self._give_up(key)
            self._remote.warn(f"{self.root} cannot keep copies of {self.url} ({error}): set NEUSEE_CACHE_LOCAL")
        except UNREADABLE as error:
            self._distrust(key, error)

    def _value_fetched(self, key: Key, about: Metadata) -> bool:
        """Copy a value from the URL into the local folder after a check of every byte; return False if a copy fails."""
        from neusee.workflows.store.serialization import blobs_in

        payload, bands = about["payload"], blobs_in(about["layout"])
        missing = {name: xxh3 for name, xxh3 in bands.items() if not self.blobs.has(name)}
        with ExitStack() as files:
            part, *parts = (self._part(files, name) for name in (key, *missing))
            if payload and not self._fetched(_payload_name(key, payload["xxh3"]), part, payload):
                return False
            with ThreadPoolExecutor(16) as pool:
                if not all(pool.map(self._remote.fetch, starmap(_band_name, missing.items()), parts)):
                    return False
            with self.disk.lock():
                if not self._is_local(key):
                    self._named(dict(zip(missing, parts, strict=True)), bands)
                    self._described(key, about, part)
        self.journal.append(key, about)
        return True

    def _part(self, files: ExitStack, name: str) -> str:
        part, file = files.enter_context(self.disk.temporary(name))
        file.close()
        return part

    def _named(self, parts: dict[str, str], bands: dict[str, str]) -> None:
        """Give band files that were copied from the URL their final names; raise `ValueError` for a wrong checksum."""
        for name, part in parts.items():
            self.disk.make_folder(str(self.blobs.root))
            self.disk.link(part, self.blobs.path(name))
        for name, xxh3 in bands.items():
            blob = self.blobs.about(name)
            self.blobs.read([name], (1, *blob.shape), blob.dtype, xxh3=[xxh3])

    def _described(self, key: Key, about: Metadata, part: str) -> None:
        """Give the copied file of tensors of a value its final name, and write the metadata with local time stamps."""
        about = dict(about)
        if about["payload"]:
            path = self.disk.path(key, "safetensors")
            self.disk.rename(part, path)
            about["payload"] = {**about["payload"], "stamp": stamp_of(path)}
        if names := about.get("bands", {}).get("names"):
            about["bands"] = {"names": names, "newest": newest(self.blobs, names)}
        self._write_about(key, about)
        self._lost.discard(key)

    def _fetched(self, name: str, part: str, payload: Metadata) -> bool:
        """Copy the file ``name`` from the URL to ``part``; return False if the copy fails.

        Raises `ValueError` for a wrong checksum.
        """
        if not self._remote.fetch(name, part):
            return False
        with open(part, "rb") as file:
            xxh3, size = hashlib.file_digest(file, xxhash.xxh3_128).hexdigest(), file.tell()
            os.fsync(file.fileno())
            file.seek(0)
            signed = not secrets() or hashlib.file_digest(file, "sha256").hexdigest() == payload.get("sha256")
        if (size, xxh3) != (payload["size"], payload["xxh3"]) or not signed:
            raise ValueError("checksum mismatch: the stored bytes have changed since they were written")
        return True

    def _send(self, key: Key) -> None:
        """Copy a local value to the URL, the large files before the metadata; copy nothing for an evicted value."""
        name, over = f"{key}.json", key in self._broken
        if not over and self._remote.exists(name):
            return
        try:
            about = read(self.disk, key)
            files = self._files(key, about)
        except UNREADABLE:
            return
        with ThreadPoolExecutor(16) as pool:
            sent = pool.map(
                lambda to: (not over and self._remote.exists(to)) or self._remote.send(files[to], to), files
            )
            if not all(sent):
                return
        if self._remote.write(name, seal_record("result at a URL", about), over):
            self._broken.discard(key)

    def _files(self, key: Key, about: Metadata) -> dict[str, str]:
        """Return the local paths of the payload and band files of a value, by the name of each file at the URL."""
        from neusee.workflows.store.serialization import blobs_in

        paths = {}
        if payload := about["payload"]:
            paths[_payload_name(key, payload["xxh3"])] = self.disk.path(key, "safetensors")
        for name, xxh3 in blobs_in(about["layout"]).items():
            paths[_band_name(name, xxh3)] = self.blobs.path(name)
        return paths

    def _give_up(self, key: Key) -> None:
        self._seen.pop(key, None)
        self._broken.add(key)

    def _distrust(self, key: Key, error: Exception) -> None:
        self._give_up(key)
        warnings.warn(f"the result {key} at {self.url} is damaged ({error}) and is not used", stacklevel=4)


def _receipt_name(key: Key) -> str:
    return f"{key}.note.json"


def _payload_name(key: Key, xxh3: str) -> str:
    return f"{key}-{xxh3}.safetensors"


def _band_name(name: str, xxh3: str) -> str:
    return f"{name}-{xxh3}.band"
