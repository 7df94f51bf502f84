"""A store that many machines share, behind any file system that fsspec knows, with a local layer in front.

What is read is kept in the local layer, an ordinary `Store`; what is written goes to both. A
payload there bears its own checksum in its name and is complete before the description that
names it, so that two writers of one key cannot mix their halves. Leases, pins and the size
budget are of the local layer alone: two machines may compute the same key, and the first one
stays. A remote that fails costs one warning; the run goes on with the local layer.
"""

from __future__ import annotations

import os
import re
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
from neusee.workflows.store.environment import Verify
from neusee.workflows.store.metadata import Metadata, is_kept, receipt, seal, unseal
from neusee.workflows.store.payload import newest, stamp_of
from neusee.workflows.store.remote_files import RemoteFiles
from neusee.workflows.store.result_store import Store

_NAME = re.compile("[0-9a-f]{32}")


def open_store(where: str | Path | None = None) -> Store:
    """The store at a folder or a URL (``s3://bucket/name``); None: ``$NEUSEE_CACHE``, else the usual folder.

    Raises `ValueError` for a scheme that nobody knows, `ModuleNotFoundError` with the fix where
    the package for it is missing.
    """
    where = os.environ.get("NEUSEE_CACHE") or None if where is None else where
    if isinstance(where, str) and "://" in where:
        return RemoteStore(where)
    return Store(where)


def local_layer(url: str) -> Path:
    """``$NEUSEE_CACHE_LOCAL``, else a folder of the URL's own in ``~/.cache/neusee``."""
    if named := os.environ.get("NEUSEE_CACHE_LOCAL"):
        return Path(named)
    return Path.home() / ".cache" / "neusee" / digest(url.rstrip("/"))[:16]


class RemoteStore(Store):
    """A `Store` whose misses are looked for at ``url``, and whose results go there too."""

    def __init__(
        self, url: str, root: Path | str | None = None, *, verify: Verify | None = None, budget: int | None = None
    ) -> None:
        self.url, self._far = url, RemoteFiles(url)
        self._seen: dict[Key, Metadata] = {}  # descriptions read there
        self._broken: set[Key] = set()  # what is there is of no use
        super().__init__(root or local_layer(url), verify=verify, budget=budget)

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(type(self), self.url, self.root, verify=self.verify, budget=self.budget), ()

    def about(self, key: Key) -> Metadata | None:
        """What is known of a result, here or there, without reading it."""
        here = super().about(key)
        if here is not None and is_kept(here):
            return here
        return self._about_there(key) or here

    def get(self, key: Key) -> Any:
        """The result, or `KeyError` where there is none that can be trusted, neither here nor there."""
        if not self._is_here(key):
            self._bring(key)
        return super().get(key)

    def put(self, key: Key, value: Any, about: Metadata) -> bool:
        """Keep a result here and there; False where not even the local layer takes it."""
        if not super().put(key, value, about):
            return False
        self._send(key)
        return True

    def note(self, key: Key, about: Metadata) -> bool:
        """Keep what is known of a result, here and there, without its value."""
        if not super().note(key, about):
            return False
        if not self._far.exists(_note(key)) and not self._far.exists(f"{key}.json"):
            self._far.write(_note(key), seal(receipt({"key": key, **about})))
        return True

    def entries(self) -> Iterator[tuple[Key, Metadata]]:
        """Every result's key and what is known of it: those here, then those that are only there; receipts too."""
        here = set()
        for key, about in super().entries():
            here.add(key)
            yield key, about
        there = sorted({name.partition(".")[0] for name in self._far.names() if ".json" in name} - here)
        with ThreadPoolExecutor(16) as pool:
            for key, found in zip(there, pool.map(self._about_there, there), strict=True):
                if found is not None:
                    yield key, found

    def write_seconds(self, size: float) -> float:
        return super().write_seconds(size) + self._far.seconds("up", size)

    def read_seconds(self, size: float) -> float:
        return super().read_seconds(size) + self._far.seconds("down", size)

    def _is_here(self, key: Key) -> bool:
        here = super().about(key)
        return here is not None and is_kept(here)

    def _about_there(self, key: Key, look: bool = False) -> Metadata | None:
        """The description at the remote of a value, else of a receipt; ``look``: whatever the listing says."""
        value = f"{key}.json"
        if key not in self._broken and (look or self._far.exists(value)) and not self._is_there(key):
            self._learn(key, value)
        if key not in self._seen and self._far.exists(_note(key)):
            self._learn(key, _note(key))
        return self._seen.get(key)

    def _is_there(self, key: Key) -> bool:
        return key in self._seen and is_kept(self._seen[key])

    def _learn(self, key: Key, name: str) -> None:
        """Read a description; one that is damaged is as good as none."""
        raw = self._far.read(name)
        if raw is None:
            return
        try:
            about = unseal(raw)
            if about["key"] != key:
                raise ValueError(f"it is the result of {about['key']}")
        except (ValueError, LookupError, TypeError) as error:
            self._distrust(key, error)
        else:
            self._seen[key] = about

    def _bring(self, key: Key) -> None:
        """Fetch a value into the local layer; what cannot be fetched is not counted on again."""
        about = self._about_there(key, look=True)
        if about is None or not is_kept(about):
            return
        try:
            if not self._brought(key, about):
                self._give_up(key)
        except ValueError as error:
            self._distrust(key, error)
        except OSError as error:
            self._give_up(key)
            self._far.warn(f"{self.root} takes no copy of what is at {self.url} ({error}): set NEUSEE_CACHE_LOCAL")

    def _brought(self, key: Key, about: Metadata) -> bool:
        """Whether it came, every byte compared with its checksum."""
        payload, bands = about["payload"], _bands(about["layout"])
        missing = {name: xxh3 for name, xxh3 in bands.items() if not self.blobs.has(name)}
        with ExitStack() as files:
            part, *parts = (self._part(files, name) for name in (key, *missing))
            if payload and not self._fetched(_payload_name(key, payload["xxh3"]), part, payload):
                return False
            with ThreadPoolExecutor(16) as pool:
                if not all(pool.map(self._far.fetch, starmap(_band_name, missing.items()), parts)):
                    return False
            with self.disk.lock():
                if not self._is_here(key):
                    self._named(dict(zip(missing, parts, strict=True)), bands)
                    self._described(key, about, part)
        self.journal.append(key, about)
        return True

    def _part(self, files: ExitStack, name: str) -> str:
        part, file = files.enter_context(self.disk.temporary(name))
        file.close()
        return part

    def _named(self, parts: dict[str, str], bands: dict[str, str]) -> None:
        """Put bands in their places; `ValueError` where one is not what was written, or another has its name."""
        for name, part in parts.items():
            self.disk.make_folder(str(self.blobs.root))
            self.disk.link(part, f"{self.blobs.root}/{name[:2]}/{name}")
        for name, xxh3 in bands.items():
            blob = self.blobs.about(name)
            self.blobs.read([name], (1, *blob.shape), blob.dtype, xxh3=[xxh3])

    def _described(self, key: Key, about: Metadata, part: str) -> None:
        """Put a payload in its place and its description beside it, with the stamps that files have here."""
        about = dict(about)
        if about["payload"]:
            path = self.disk.path(key, "safetensors")
            self.disk.rename(part, path)
            about["payload"] = {**about["payload"], "stamp": stamp_of(path)}
        if names := about.get("bands", {}).get("names"):
            about["bands"] = {"names": names, "newest": newest(self.disk, names)}
        self._write_about(key, about)
        self._lost.discard(key)

    def _fetched(self, name: str, part: str, payload: Metadata) -> bool:
        """Whether ``name`` came; `ValueError` where it is not what was written."""
        if not self._far.fetch(name, part):
            return False
        found, size = xxhash.xxh3_128(), 0
        with open(part, "rb") as file:
            while block := file.read(1 << 20):
                found.update(block)
                size += len(block)
            os.fsync(file.fileno())
        if (size, found.hexdigest()) != (payload["size"], payload["xxh3"]):
            raise ValueError("its bytes are not those that were written")
        return True

    def _send(self, key: Key) -> None:
        """What is large first, then what names it; nothing where it was evicted in between."""
        name, over = f"{key}.json", key in self._broken
        if not over and self._far.exists(name):
            return
        try:
            raw = Path(self.disk.path(key, "json")).read_bytes()
            about = unseal(raw)
            files = self._files(key, about)
        except (OSError, ValueError, LookupError):
            return
        with ThreadPoolExecutor(16) as pool:
            sent = pool.map(lambda to: (not over and self._far.exists(to)) or self._far.send(files[to], to), files)
            if not all(sent):
                return
        if self._far.write(name, raw, over):
            self._broken.discard(key)

    def _files(self, key: Key, about: Metadata) -> dict[str, str]:
        """By name at the remote the path of each file that a value needs beside its description."""
        found = {}
        if payload := about["payload"]:
            found[_payload_name(key, payload["xxh3"])] = self.disk.path(key, "safetensors")
        for name, xxh3 in _bands(about["layout"]).items():
            found[_band_name(name, xxh3)] = f"{self.blobs.root}/{name[:2]}/{name}"
        return found

    def _give_up(self, key: Key) -> None:
        self._seen.pop(key, None)
        self._broken.add(key)

    def _distrust(self, key: Key, error: Exception) -> None:
        self._give_up(key)
        warnings.warn(f"the result {key} at {self.url} is damaged ({error}): it is not used", stacklevel=4)


def _note(key: Key) -> str:
    return f"{key}.note.json"


def _payload_name(key: Key, xxh3: str) -> str:
    return f"{key}-{xxh3}.safetensors"


def _band_name(name: str, xxh3: str) -> str:
    return f"{name}-{xxh3}.band"


def _bands(layout: Any) -> dict[str, str]:
    """Checksum by name of every band that a layout needs."""
    found: dict[str, str] = {}
    todo = [layout]
    while todo:
        item = todo.pop()
        if "stacked" in item:
            found |= zip(item["stacked"]["names"], item["stacked"]["xxh3"], strict=True)
        todo += item.get("items", item.get("list", item.get("dict", {}).values()))
    if bad := [name for name in found if not _NAME.fullmatch(name)]:
        raise ValueError(f"{bad[0]!r} is no name of a band")
    return found
