"""A store at a URL that many machines share, with a local folder for copies."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import threading
import time
import uuid
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

import xxhash

from neusee.workflows.graph.errors import nearest
from neusee.workflows.keys.cache_key import Key, digest
from neusee.workflows.keys.sealed_files import (
    Kind,
    NotRead,
    NotRegular,
    bytes_of,
    inherit,
    make_folders,
    opened,
    seal_record,
    secrets,
)
from neusee.workflows.store.cache_settings import Verify
from neusee.workflows.store.metadata import (
    UNREADABLE,
    Metadata,
    is_kept,
    read,
    receipt,
    unseal_of,
)
from neusee.workflows.store.payload import stamp_of
from neusee.workflows.store.result_store import Store

# --- folder at url --------------------------------------------------------------------------------

# A shared folder with a URL (``file:///shared/neusee``), treated with the care that a folder of
# other users needs.
#
# Only regular files are read, so that nothing blocks the program. Files that one user of a group
# writes are usable by the others. Nothing is written to a folder that this user may only read.


class FolderAtUrl:
    """The file system of a folder of a store at a URL, with the calls of fsspec that
    `RemoteFiles` makes.
    """

    protocol = ("file", "local")

    def __init__(self, root: str) -> None:
        self._root = root

    def is_read_only(self) -> bool:
        """Return True if the folder exists and this user may not write there."""
        return os.path.isdir(self._root) and not os.access(self._root, os.W_OK)

    def exists(self, path: str) -> bool:
        """Return True if a file, a folder or a link has this name, even a broken link."""
        return os.path.lexists(path)

    def ls(self, path: str, detail: bool = False) -> list[Any]:
        """Return the paths in a folder, with ``detail`` each with its time of last change."""
        with os.scandir(path) as entries:
            if not detail:
                return [entry.path for entry in entries]
            return [
                {"name": entry.path, "mtime": entry.stat(follow_symlinks=False).st_mtime}
                for entry in entries
            ]

    def cat_file(self, path: str) -> bytes:
        """Return the bytes of a regular file; raise `NotRegular` for anything else, and for a
        file that is too long.
        """
        return bytes_of(path)

    def get_file(self, path: str, to: str) -> None:
        """Copy a regular file of the folder to another path."""
        with opened(path) as file, open(to, "wb") as copy:
            shutil.copyfileobj(file, copy)

    def put_file(self, path: str, to: str) -> None:
        """Copy a regular file into the folder, with permission to read for all users of the
        folder.
        """
        with opened(path) as file, open(to, "wb") as copy:
            shutil.copyfileobj(file, copy)
        inherit(to, self._root, 0o444)

    def pipe_file(self, to: str, raw: bytes, **_: Any) -> None:
        """Write bytes to a file in the folder, with permission to read for all users of the
        folder.
        """
        with open(to, "wb") as file:
            file.write(raw)
        inherit(to, self._root, 0o444)

    def mv(self, path: str, to: str) -> None:
        """Rename a file and replace an existing file of the new name; raise `IsADirectoryError` for
        a folder.
        """
        try:
            os.replace(path, to)
        except OSError:
            with suppress(OSError):
                os.unlink(path)
            raise

    def rm_file(self, path: str) -> None:
        """Delete a file."""
        os.unlink(path)

    def makedirs(self, path: str, exist_ok: bool = True) -> None:
        """Make a folder and the missing folders above it, with the group and the permissions of the
        root.
        """
        make_folders(self._root, self._root)
        make_folders(path, self._root)


# --- remote files ---------------------------------------------------------------------------------

# Access to files at a URL through fsspec; a URL that fails counts as empty after one warning.
#
# Listings of the folders show whether a file exists, and each listing counts as valid for a while:
# a run of a thousand steps with an empty cache sends 256 requests in parallel instead of a thousand
# in a row.


T = TypeVar("T")
Direction = Literal["down", "up"]
_DIRECTIONS: tuple[Direction, ...] = ("down", "up")
_LISTING_VALID_SECONDS = 20.0  #: time (s) for which a listing counts as valid
_MOST_FOLDERS_ONE_BY_ONE = (
    3  #: number of folders that are listed one by one; the next query lists all folders
)
_PAUSE_AFTER_FAILURE = (
    60.0  #: time (s) for which a URL is not used after a failure; doubled at each failure
)
#: size (bytes) from which a transfer updates the rate; a smaller transfer updates the latency
_RATE_BYTES = 1_000_000
_ABANDONED_SECONDS = 86400.0  #: time (s) after which a half-written file counts as abandoned
_FOLDERS = tuple(f"{i:02x}" for i in range(256))
#: protocols that show half-written files, but can rename files
_RENAMING_PROTOCOLS = frozenset({"file", "local", "sftp", "ssh"})
_LOCAL_PROTOCOLS = frozenset({"file", "local", "memory"})
#: errors for a circular link, a special file or a folder in place of a file
_NOT_A_FILE_ERRORS = (errno.ELOOP, errno.ENXIO, errno.EISDIR, errno.ENOTDIR)


class RemoteFiles:
    """A folder at a URL, in which each file is at ``<first two letters of the name>/<name>``."""

    def __init__(self, url: str) -> None:
        self.url = url
        self._fs, self._root = _file_system(url)
        protocols = (
            {self._fs.protocol} if isinstance(self._fs.protocol, str) else set(self._fs.protocol)
        )
        self._renames, is_near = (
            bool(protocols & _RENAMING_PROTOCOLS),
            bool(protocols & _LOCAL_PROTOCOLS),
        )
        # latency (s) of each transfer, and rate (bytes / s): guesses until transfers are measured
        self._latency = dict.fromkeys(_DIRECTIONS, 5e-4 if is_near else 0.05)
        self._rate = dict.fromkeys(_DIRECTIONS, 4e8 if is_near else 5e7)
        # time before which the URL is not used in a direction
        self._resume = dict.fromkeys(_DIRECTIONS, 0.0)
        # length (s) of the next pause after a failure
        self._pause = dict.fromkeys(_DIRECTIONS, _PAUSE_AFTER_FAILURE)
        self._warned = False
        # for each folder, the time of its listing (s) and the names in it
        self._listed: dict[str, tuple[float, set[str]]] = {}
        self._made: set[str] = set()  # folders that exist at the URL
        self._lock = threading.Lock()

    def seconds(self, direction: Direction, size: float) -> float:
        """Return the predicted seconds for a transfer of ``size`` bytes and their metadata to or
        from the URL.
        """
        return 2 * self._latency[direction] + size / self._rate[direction]

    def exists(self, name: str) -> bool:
        """Return True if the file ``name`` is in the last listing of its folder, which may be
        some seconds old.
        """
        with self._lock:
            if not self._fresh(name[:2]):
                # with few fresh listings, list one folder; after that list all folders, in parallel
                lists_one = sum(map(self._fresh, self._listed)) < _MOST_FOLDERS_ONE_BY_ONE
                self._list_folders([name[:2]] if lists_one else _FOLDERS)
            return name in self._listed[name[:2]][1]

    def names(self) -> set[str]:
        """Return the names of all files at the URL."""
        with self._lock:
            self._list_folders(_FOLDERS)
            return set().union(*(names for _, names in self._listed.values()))

    def read(self, name: str) -> bytes | None:
        """Return the bytes of a small file at the URL, or None if the file cannot be read."""
        return self._attempt("down", lambda: bytes(self._fs.cat_file(self._path(name))), len)

    def fetch(self, name: str, path: str) -> bool:
        """Copy a file from the URL to the local ``path``; return False if the copy fails."""

        def get() -> int:
            self._fs.get_file(self._path(name), path)
            return os.path.getsize(path)

        return self._attempt("down", get, int) is not None

    def send(self, path: str, name: str) -> bool:
        """Copy the local file at ``path`` to the URL; return False if the copy fails or the
        local file is missing.
        """

        def put(to: str) -> int:
            try:
                self._fs.put_file(path, to)
            except FileNotFoundError:
                if os.path.exists(path):
                    raise
                # the local file was evicted meanwhile: nothing is sent
                return -1
            return os.path.getsize(path)

        return self._write(name, put)

    def write(self, name: str, raw: bytes, over: bool = False) -> bool:
        """Write a small file at the URL; return False on failure. If ``over`` is False, keep an
        existing file.
        """

        def pipe(to: str) -> int:
            try:
                self._fs.pipe_file(to, raw, mode="overwrite" if over or self._renames else "create")
            except FileExistsError:
                pass
            except (
                TypeError,
                NotImplementedError,
            ):  # a file system that does not know `mode` has only this call
                self._fs.pipe_file(to, raw)
            return len(raw)

        # if files are renamed, the file system would replace an existing file
        must_look = not over and self._renames
        exists = must_look and self._attempt("down", lambda: self._fs.exists(self._path(name)))
        return bool(exists) or self._write(name, pipe)

    def warn(self, text: str) -> None:
        """Issue the warning ``text`` if it is the first warning of this object."""
        if not self._warned:
            self._warned = True
            warnings.warn(text, stacklevel=5)

    def _path(self, name: str) -> str:
        return f"{self._root}/{name[:2]}/{name}"

    def _fresh(self, folder: str) -> bool:
        """Return True if a folder was listed within the last `_LISTING_VALID_SECONDS` seconds."""
        return (
            folder in self._listed
            and time.monotonic() - self._listed[folder][0] < _LISTING_VALID_SECONDS
        )

    def _list_folders(self, folders: Sequence[str]) -> None:
        """List the files of ``folders`` at the URL in parallel; skip a folder that was listed a
        few seconds ago.
        """
        outdated = [folder for folder in folders if not self._fresh(folder)]
        with suppress(AttributeError):
            self._fs.invalidate_cache()
        present_time = time.monotonic()
        with ThreadPoolExecutor(min(16, max(1, len(outdated)))) as pool:
            for folder, names in zip(outdated, pool.map(self._listing, outdated), strict=True):
                self._listed[folder] = (present_time, names)

    def _listing(self, folder: str) -> set[str]:
        """Return the names of the files in a folder at the URL; none if it cannot be listed."""
        paths = self._attempt("down", lambda: self._fs.ls(f"{self._root}/{folder}", detail=False))
        return {str(path).rpartition("/")[2] for path in paths or ()}

    def _write(self, name: str, put: Callable[[str], int]) -> bool:
        """Write a file at the URL with the function ``put``, by atomic rename if possible;
        return False on failure.
        """

        def whole() -> int:
            if not self._renames:
                return put(self._path(name))
            temporary = f"{self._root}/tmp/{uuid.uuid4().hex}"
            self._folder(f"{self._root}/tmp")
            self._folder(f"{self._root}/{name[:2]}")
            # a negative size means that there was nothing to send
            size = put(temporary)
            if size >= 0:
                self._fs.mv(temporary, self._path(name))
            return size

        size = self._attempt("up", whole, int)
        if size is None or size < 0:
            return False
        with self._lock:
            if name[:2] in self._listed:
                # the first two letters are the folder
                self._listed[name[:2]][1].add(name)
        return True

    def _folder(self, path: str) -> None:
        """Make a folder at the URL once; remove old files from the folder of half-written ones."""
        if path not in self._made:
            self._fs.makedirs(path, exist_ok=True)
            self._made.add(path)
            if path.endswith("/tmp"):
                self._sweep(path)

    def _sweep(self, path: str) -> None:
        """Remove the half-written files of killed processes, if the file system gives the times
        of files.
        """
        with suppress(OSError, LookupError, TypeError):
            for entry in self._fs.ls(path, detail=True):
                if time.time() - entry["mtime"] > _ABANDONED_SECONDS:
                    self._fs.rm_file(entry["name"])

    def _attempt(
        self, direction: Direction, do: Callable[[], T], size: Callable[[T], int] | None = None
    ) -> T | None:
        """Return the result of the function ``do``, or None if it fails or if the URL is disabled
        after a failure.
        """
        if time.monotonic() < self._resume[direction] or (
            direction == "up" and self._is_read_only()
        ):
            return None
        began = time.perf_counter()
        try:
            result = do()
        except (
            Exception
        ) as error:  # file systems raise different errors, which have no other common base class
            if not (direction == "down" and _counts_as_missing(error)):
                self._failed(direction, error)
            return None
        # a success ends the doubling of pauses
        self._pause[direction] = _PAUSE_AFTER_FAILURE
        if size is not None:
            self._update_speed(direction, size(result), time.perf_counter() - began)
        return result

    def _is_read_only(self) -> bool:
        """Return True for a folder that this user may only read; no results are expected there."""
        return hasattr(self._fs, "is_read_only") and bool(self._fs.is_read_only())

    def _failed(self, direction: Direction, error: Exception) -> None:
        """Stop using the URL for a while, each time twice as long, and warn once."""
        if direction == "up" and isinstance(error, IsADirectoryError):
            return  # a folder in place of one file does not disable the URL
        # reading may work where writing fails, and vice versa
        is_one_way = isinstance(error, PermissionError | FileNotFoundError)
        for paused_direction in (direction,) if is_one_way else _DIRECTIONS:
            self._resume[paused_direction] = time.monotonic() + self._pause[paused_direction]
            self._pause[paused_direction] *= 2
        action = "read" if direction == "down" else "written"
        self.warn(
            f"{self.url} cannot be {action} ({type(error).__name__}: {error}): results are stored"
            " only locally"
        )

    def _update_speed(self, direction: Direction, size: int, seconds: float) -> None:
        """Change the predicted latency or rate of transfers by a third of the difference from
        the measured value.
        """
        if size < _RATE_BYTES:
            # the time of a small transfer is mostly latency
            self._latency[direction] += (seconds - self._latency[direction]) / 3
        else:
            rate = size / max(seconds - self._latency[direction], 1e-6)
            self._rate[direction] += (rate - self._rate[direction]) / 3


def _counts_as_missing(error: Exception) -> bool:
    """Return True for an error that concerns only one name at a URL."""
    if isinstance(error, FileNotFoundError | NotRegular):
        return True
    return isinstance(error, OSError) and error.errno in _NOT_A_FILE_ERRORS


def _file_system(url: str) -> tuple[Any, str]:
    """Return the file system and the path of a URL; errors name the missing package or the most
    similar scheme.
    """
    try:
        import fsspec
    except ImportError as error:
        text = f'a store at {url} needs fsspec: pip install "neusee[distributed]"'
        raise ModuleNotFoundError(text) from error
    try:
        file_system, path = fsspec.core.url_to_fs(url)
    except ImportError as error:
        raise ModuleNotFoundError(f"a store at {url} needs one more package: {error}") from error
    except ValueError as error:
        known_schemes, scheme = fsspec.available_protocols(), url.partition("://")[0]
        # the scheme is known, so the rest of the URL is wrong
        if scheme in known_schemes:
            raise
        raise ValueError(
            f"no file system has the scheme {scheme}:// of {url}; {nearest(scheme, known_schemes)}"
        ) from error
    path = str(path).rstrip("/")
    # a folder of this file system, treated like a folder of other users
    if file_system.protocol in ("file", "local", ("file", "local")):
        file_system = FolderAtUrl(path)
    return file_system, path


# --- remote store ---------------------------------------------------------------------------------

# A store at a URL that many machines share, on any file system of fsspec, with a local folder for
# copies.
#
# The local folder (the local layer) is an ordinary `Store`. It stores each value that is read from
# the URL; a new value is stored in the local layer and at the URL. At the URL, a payload has its
# checksum in its name and is complete before the metadata that name the payload, so that two
# writers of one key cannot mix their files. Leases, pins and the size budget belong to the local
# layer alone: two machines may compute the same key, and the first result stays. After a failure of
# the URL, a run issues one warning and continues with the local layer.


def open_store(where: str | Path | None = None) -> Store:
    """Open the store at a folder or a URL (``s3://bucket/name``); None means ``$NEUSEE_CACHE`` or
    the default folder.

    Raises `ValueError` for an unknown scheme, and `ModuleNotFoundError` if the package for the
    scheme is missing.
    """
    where = os.environ.get("NEUSEE_CACHE") or None if where is None else where
    if isinstance(where, str) and "://" in where:
        return RemoteStore(where)
    return Store(where)


def local_layer(url: str) -> Path:
    """Return the local folder for copies from ``url``: ``$NEUSEE_CACHE_LOCAL`` or a folder in
    ``~/.cache/neusee``.
    """
    if folder := os.environ.get("NEUSEE_CACHE_LOCAL"):
        return Path(folder)
    return Path.home() / ".cache" / "neusee" / digest(url.rstrip("/"))[:16]


class RemoteStore(Store):
    """A local `Store` that reads missing results from ``url`` and also writes its results there."""

    def __init__(
        self,
        url: str,
        root: Path | str | None = None,
        *,
        verify: Verify | None = None,
        budget: int | None = None,
    ) -> None:
        self.url, self._remote = url, RemoteFiles(url)
        self._seen: dict[Key, Metadata] = {}  # metadata read from the URL
        self._broken: set[Key] = set()  # keys whose copy at the URL cannot be used
        self._failed: set[Key] = set()  # keys whose local copy was damaged
        super().__init__(root or local_layer(url), verify=verify, budget=budget)

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(type(self), self.url, self.root, verify=self.verify, budget=self.budget), ()

    def about(self, key: Key) -> Metadata | None:
        """Return the metadata of a result from the local folder or the URL, without reading the
        value.
        """
        local_metadata = super().about(key)
        return (
            local_metadata
            if is_kept(local_metadata)
            else self._remote_metadata(key) or local_metadata
        )

    def get(self, key: Key, kind: Any = Any) -> Any:
        """Return the value of ``key``; raise `KeyError` if neither the local folder nor the URL
        has the value.
        """
        if not self._is_local(key):
            self._fetch_value(key)
        return super().get(key, kind)

    def put_aside(self, key: Key, error: Exception) -> None:
        """Move the local files of a damaged result to ``bad/``; the second time, do not use its
        copy at the URL.
        """
        super().put_aside(key, error)
        # the copy at the URL was damaged as well
        if key in self._failed:
            self._give_up(key)
        self._failed.add(key)

    def put(self, key: Key, value: Any, about: Metadata) -> bool:
        """Store a value locally and at the URL; return False if the value cannot be stored
        locally.
        """
        stored = super().put(key, value, about)
        if stored:
            self._send(key)
        return stored

    def put_receipt(self, key: Key, about: Metadata) -> bool:
        """Store the metadata of a result without its value, locally and at the URL."""
        stored = super().put_receipt(key, about)
        if (
            stored
            and not self._remote.exists(_receipt_name(key))
            and not self._remote.exists(f"{key}.json")
        ):
            self._remote.write(
                _receipt_name(key), seal_record("receipt at a URL", receipt({"key": key, **about}))
            )
        return stored

    def entries(self) -> Iterator[tuple[Key, Metadata]]:
        """Yield every key with its metadata: first the local results, then the results that are
        only at the URL.
        """
        local_keys = set()
        for key, local_metadata in super().entries():
            local_keys.add(key)
            yield key, local_metadata
        at_url = sorted(
            {name.partition(".")[0] for name in self._remote.names() if ".json" in name}
            - local_keys
        )
        with ThreadPoolExecutor(16) as pool:
            for key, remote_metadata in zip(
                at_url, pool.map(self._remote_metadata, at_url), strict=True
            ):
                if remote_metadata is not None:
                    yield key, remote_metadata

    def write_seconds(self, size: float) -> float:
        return super().write_seconds(size) + self._remote.seconds("up", size)

    def read_seconds(self, size: float) -> float:
        return super().read_seconds(size) + self._remote.seconds("down", size)

    def _is_local(self, key: Key) -> bool:
        """Return True if the local folder has the value of a key."""
        return is_kept(super().about(key))

    def _remote_metadata(self, key: Key, look: bool = False) -> Metadata | None:
        """Return the metadata of a result at the URL; if ``look`` is True, request an unlisted
        file too.
        """
        metadata_name, receipt_name = f"{key}.json", _receipt_name(key)
        if (
            key not in self._broken
            and (look or self._remote.exists(metadata_name))
            and not is_kept(self._seen.get(key))
        ):
            self._read_metadata(key, metadata_name, "result at a URL")
        if key not in self._seen and self._remote.exists(receipt_name):
            self._read_metadata(key, receipt_name, "receipt at a URL")
        return self._seen.get(key)

    def _read_metadata(self, key: Key, name: str, kind: Kind) -> None:
        """Read the metadata file ``name`` at the URL; damaged metadata count as missing, after a
        warning.
        """
        file_bytes = self._remote.read(name)
        if file_bytes is not None:
            try:
                self._seen[key] = unseal_of(kind, key, file_bytes)
            except NotRead as error:
                self._give_up(key)
                self.leave(error)
            except UNREADABLE as error:
                self._distrust(key, error)

    def _fetch_value(self, key: Key) -> None:
        """Copy the value of a key from the URL into the local folder; after a failure, do not
        fetch this key again.
        """
        # requests the file even if no listing shows it, since it may be new
        metadata = self._remote_metadata(key, look=True)
        try:
            if is_kept(metadata) and not self._value_fetched(key, metadata):
                self._give_up(key)
        except OSError as error:
            self._give_up(key)
            self._remote.warn(
                f"{self.root} cannot keep copies of {self.url} ({error}): set NEUSEE_CACHE_LOCAL"
            )
        except UNREADABLE as error:
            self._distrust(key, error)

    def _value_fetched(self, key: Key, about: Metadata) -> bool:
        """Copy a value from the URL into the local folder after a check of every byte; return
        False if a copy fails.
        """
        payload = about["payload"]
        with self.disk.temporary(key) as (copied, file):
            file.close()
            if payload and not self._fetched(_payload_name(key, payload["xxh3"]), copied, payload):
                return False
            with self.disk.lock():
                # another process may have fetched the value meanwhile
                if not self._is_local(key):
                    self._described(key, about, copied)
        self.journal.append(key, about)
        return True

    def _described(self, key: Key, about: Metadata, copied: str) -> None:
        """Give the copied file of tensors of a value its final name, and write the metadata with
        local time stamps.
        """
        about = dict(about)
        if about["payload"]:
            path = self.disk.path(key, "safetensors")
            self.disk.rename(copied, path)
            about["payload"] = {**about["payload"], "stamp": stamp_of(path)}
        self._write_about(key, about)
        self._lost.discard(key)

    def _fetched(self, name: str, path: str, payload: Metadata) -> bool:
        """Copy the file ``name`` from the URL to ``path``; return False if the copy fails.

        Raises `ValueError` for a wrong checksum.
        """
        if not self._remote.fetch(name, path):
            return False
        with open(path, "rb") as file:
            xxh3, size = hashlib.file_digest(file, xxhash.xxh3_128).hexdigest(), file.tell()
            os.fsync(file.fileno())
            file.seek(0)
            # without a secret, no signature is checked
            is_signed = not secrets() or hashlib.file_digest(
                file, "sha256"
            ).hexdigest() == payload.get("sha256")
        if (size, xxh3) != (payload["size"], payload["xxh3"]) or not is_signed:
            raise ValueError(
                "checksum mismatch: the stored bytes have changed since they were written"
            )
        return True

    def _send(self, key: Key) -> None:
        """Copy a local value to the URL, the large files before the metadata; copy nothing for
        an evicted value.
        """
        # an unusable copy is replaced
        name, replaces = f"{key}.json", key in self._broken
        if not replaces and self._remote.exists(name):
            return
        try:
            metadata = read(self.disk, key)
            payload = metadata["payload"]
        except UNREADABLE:
            return
        if payload:
            file_name = _payload_name(key, payload["xxh3"])
            is_there = not replaces and self._remote.exists(file_name)
            path = self.disk.path(key, "safetensors")
            if not is_there and not self._remote.send(path, file_name):
                return
        if self._remote.write(name, seal_record("result at a URL", metadata), replaces):
            self._broken.discard(key)

    def _give_up(self, key: Key) -> None:
        """Stop using the copy of a key at the URL."""
        self._seen.pop(key, None)
        self._broken.add(key)

    def _distrust(self, key: Key, error: Exception) -> None:
        """Stop using a damaged copy at the URL, and warn of it."""
        self._give_up(key)
        warnings.warn(
            f"the result {key} at {self.url} is damaged ({error}) and is not used", stacklevel=4
        )


def _receipt_name(key: Key) -> str:
    return f"{key}.note.json"


def _payload_name(key: Key, xxh3: str) -> str:
    return f"{key}-{xxh3}.safetensors"
