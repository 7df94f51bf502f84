"""Access to files at a URL through fsspec; a URL that fails counts as empty after one warning.

Listings of the folders show whether a file exists, and each listing counts as valid for a while: a run of a thousand
steps with an empty cache sends 256 requests in parallel instead of a thousand in a row.
"""

from __future__ import annotations

import errno
import os
import threading
import time
import uuid
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any, Literal, TypeVar

from neusee.workflows.graph.diagnostics import nearest
from neusee.workflows.keys.regular_file import NotRegular

T = TypeVar("T")
Direction = Literal["down", "up"]
_DIRECTIONS: tuple[Direction, ...] = ("down", "up")
_FRESH = 20.0  #: s for which a listing counts as valid
_FEW = 3  #: number of folders that are listed one by one; the next request lists all folders
_PAUSE = 60.0  #: s for which a URL is not used after a failure; doubled at each failure
_LEARN = 1_000_000  #: bytes from which a transfer updates the rate; a smaller transfer updates the latency
_ORPHAN = 86400.0  #: s after which a half-written file counts as abandoned
_FOLDERS = tuple(f"{i:02x}" for i in range(256))
_RENAMES = frozenset({"file", "local", "sftp", "ssh"})  #: show half-written files, but can rename files
_NEAR = frozenset({"file", "local", "memory"})
_NO_FILE = (errno.ELOOP, errno.ENXIO, errno.EISDIR, errno.ENOTDIR)  #: what is there is a link in a circle or a folder


class RemoteFiles:
    """A folder at a URL, in which each file is at ``<first two letters of the name>/<name>``."""

    def __init__(self, url: str) -> None:
        self.url = url
        self._fs, self._root = _file_system(url)
        kinds = {self._fs.protocol} if isinstance(self._fs.protocol, str) else set(self._fs.protocol)
        self._renames, near = bool(kinds & _RENAMES), bool(kinds & _NEAR)
        self._latency = dict.fromkeys(_DIRECTIONS, 5e-4 if near else 0.05)
        self._rate = dict.fromkeys(_DIRECTIONS, 4e8 if near else 5e7)
        self._resume = dict.fromkeys(_DIRECTIONS, 0.0)
        self._pause = dict.fromkeys(_DIRECTIONS, _PAUSE)
        self._warned = False
        self._listed: dict[str, tuple[float, set[str]]] = {}
        self._made: set[str] = set()
        self._lock = threading.Lock()

    def seconds(self, direction: Direction, size: float) -> float:
        """Return the predicted seconds for a transfer of ``size`` bytes and their metadata to or from the URL."""
        return 2 * self._latency[direction] + size / self._rate[direction]

    def exists(self, name: str) -> bool:
        """Return True if the file ``name`` is in the last listing of its folder, which may be some seconds old."""
        with self._lock:
            if not self._fresh(name[:2]):
                few = sum(map(self._fresh, self._listed)) < _FEW
                self._list_folders([name[:2]] if few else _FOLDERS)
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
        """Copy the local file at ``path`` to the URL; return False if the copy fails or the local file is missing."""

        def put(to: str) -> int:
            try:
                self._fs.put_file(path, to)
            except FileNotFoundError:
                if os.path.exists(path):
                    raise
                return -1
            return os.path.getsize(path)

        return self._write(name, put)

    def write(self, name: str, raw: bytes, over: bool = False) -> bool:
        """Write a small file at the URL; return False on failure. If ``over`` is False, keep an existing file."""

        def pipe(to: str) -> int:
            try:
                self._fs.pipe_file(to, raw, mode="overwrite" if over or self._renames else "create")
            except FileExistsError:
                pass
            except (TypeError, NotImplementedError):  # a file system that does not know `mode` has only this call
                self._fs.pipe_file(to, raw)
            return len(raw)

        looks = not over and self._renames
        exists = looks and self._attempt("down", lambda: self._fs.exists(self._path(name)))
        return bool(exists) or self._write(name, pipe)

    def warn(self, text: str) -> None:
        """Issue the warning ``text`` if it is the first warning of this object."""
        if not self._warned:
            self._warned = True
            warnings.warn(text, stacklevel=5)

    def _path(self, name: str) -> str:
        return f"{self._root}/{name[:2]}/{name}"

    def _fresh(self, folder: str) -> bool:
        return folder in self._listed and time.monotonic() - self._listed[folder][0] < _FRESH

    def _list_folders(self, folders: Sequence[str]) -> None:
        """List the files of ``folders`` at the URL in parallel; skip a folder that was listed a few seconds ago."""
        old = [folder for folder in folders if not self._fresh(folder)]
        with suppress(AttributeError):
            self._fs.invalidate_cache()
        now = time.monotonic()
        with ThreadPoolExecutor(min(16, max(1, len(old)))) as pool:
            for folder, names in zip(old, pool.map(self._listing, old), strict=True):
                self._listed[folder] = (now, names)

    def _listing(self, folder: str) -> set[str]:
        paths = self._attempt("down", lambda: self._fs.ls(f"{self._root}/{folder}", detail=False))
        return {str(path).rpartition("/")[2] for path in paths or ()}

    def _write(self, name: str, put: Callable[[str], int]) -> bool:
        """Write a file at the URL with the function ``put``, by atomic rename if possible; return False on failure."""

        def whole() -> int:
            if not self._renames:
                return put(self._path(name))
            part = f"{self._root}/tmp/{uuid.uuid4().hex}"
            self._folder(f"{self._root}/tmp")
            self._folder(f"{self._root}/{name[:2]}")
            size = put(part)
            if size >= 0:
                self._fs.mv(part, self._path(name))
            return size

        size = self._attempt("up", whole, int)
        if size is None or size < 0:
            return False
        with self._lock:
            if name[:2] in self._listed:
                self._listed[name[:2]][1].add(name)
        return True

    def _folder(self, path: str) -> None:
        if path not in self._made:
            self._fs.makedirs(path, exist_ok=True)
            self._made.add(path)
            if path.endswith("/tmp"):
                self._sweep(path)

    def _sweep(self, path: str) -> None:
        """Remove the half-written files of killed processes, if the file system gives the times of files."""
        with suppress(OSError, LookupError, TypeError):
            for entry in self._fs.ls(path, detail=True):
                if time.time() - entry["mtime"] > _ORPHAN:
                    self._fs.rm_file(entry["name"])

    def _attempt(self, direction: Direction, do: Callable[[], T], size: Callable[[T], int] | None = None) -> T | None:
        """Return the result of the function ``do``, or None if ``do`` fails or the URL is disabled after a failure."""
        if time.monotonic() < self._resume[direction] or (direction == "up" and self._is_read_only()):
            return None
        began = time.perf_counter()
        try:
            result = do()
        except Exception as error:  # file systems raise different errors, which have no other common base class
            if not (direction == "down" and _counts_as_missing(error)):
                self._failed(direction, error)
            return None
        self._pause[direction] = _PAUSE
        if size is not None:
            self._update_speed(direction, size(result), time.perf_counter() - began)
        return result

    def _is_read_only(self) -> bool:
        """Return True for a folder that this user may only read, in which case nobody expects results there."""
        return hasattr(self._fs, "is_read_only") and bool(self._fs.is_read_only())

    def _failed(self, direction: Direction, error: Exception) -> None:
        if direction == "up" and isinstance(error, IsADirectoryError):
            return  # a folder in the place of one file
        alone = isinstance(error, PermissionError | FileNotFoundError)  # a file that cannot be written may be readable
        for each in (direction,) if alone else _DIRECTIONS:
            self._resume[each] = time.monotonic() + self._pause[each]
            self._pause[each] *= 2
        what = "read" if direction == "down" else "written"
        self.warn(f"{self.url} cannot be {what} ({type(error).__name__}: {error}): results are stored only locally")

    def _update_speed(self, direction: Direction, size: int, seconds: float) -> None:
        """Change the predicted latency or rate of transfers by a third of the difference from the measured value."""
        if size < _LEARN:
            self._latency[direction] += (seconds - self._latency[direction]) / 3
        else:
            rate = size / max(seconds - self._latency[direction], 1e-6)
            self._rate[direction] += (rate - self._rate[direction]) / 3


def _counts_as_missing(error: Exception) -> bool:
    """Return True for the error of one name at a URL, which says nothing of the others."""
    if isinstance(error, FileNotFoundError | NotRegular):
        return True
    return isinstance(error, OSError) and error.errno in _NO_FILE


def _file_system(url: str) -> tuple[Any, str]:
    """Return the file system and the path of a URL; errors name the missing package or the most similar scheme."""
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
        known, scheme = fsspec.available_protocols(), url.partition("://")[0]
        if scheme in known:
            raise
        raise ValueError(f"no file system has the scheme {scheme}:// of {url}; {nearest(scheme, known)}") from error
    path = str(path).rstrip("/")
    if file_system.protocol in ("file", "local", ("file", "local")):
        from neusee.workflows.store.folder_at_url import FolderAtUrl

        file_system = FolderAtUrl(path)
    return file_system, path
