"""Files by name behind fsspec: what fails there is as good as absent, for one warning.

Whether a file is there is read from listings of its folder, which are believed for a while:
a cold run of a thousand steps asks 256 times, side by side, and not a thousand times in a row.
"""

from __future__ import annotations

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

T = TypeVar("T")
Direction = Literal["down", "up"]
_FRESH = 20.0  #: s for which a listing is believed
_FEW = 3  #: folders that are listed one by one; whoever asks for more is told of all of them
_PAUSE = 60.0  #: s for which a remote that failed is left alone; twice as long each time
_LEARN = 1_000_000  #: bytes from which a transfer tells the rate; a smaller one tells the latency
_ORPHAN = 86400.0  #: s after which a half-written file has no owner
_FOLDERS = tuple(f"{i:02x}" for i in range(256))
_RENAMES = frozenset({"file", "local", "sftp", "ssh"})  #: show a file while it is written, and can rename it then
_NEAR = frozenset({"file", "local", "memory"})


class RemoteFiles:
    """A folder at a URL, with files in ``<first two letters>/`` by name."""

    def __init__(self, url: str) -> None:
        self.url = url
        self._fs, self._root = _file_system(url)
        kinds = {self._fs.protocol} if isinstance(self._fs.protocol, str) else set(self._fs.protocol)
        self._renames, near = bool(kinds & _RENAMES), bool(kinds & _NEAR)
        self._latency = {"down": 5e-4 if near else 0.05, "up": 5e-4 if near else 0.05}
        self._rate = {"down": 4e8 if near else 5e7, "up": 4e8 if near else 5e7}
        self._resume: dict[Direction, float] = {"down": 0.0, "up": 0.0}
        self._pause: dict[Direction, float] = {"down": _PAUSE, "up": _PAUSE}
        self._warned = False
        self._listed: dict[str, tuple[float, set[str]]] = {}
        self._made: set[str] = set()
        self._lock = threading.Lock()

    def seconds(self, way: Direction, size: float) -> float:
        """Predicted s to move ``size`` bytes and the description that names them."""
        return 2 * self._latency[way] + size / self._rate[way]

    def exists(self, name: str) -> bool:
        """Whether there was such a file when its folder was last listed."""
        with self._lock:
            if not self._fresh(name[:2]):
                few = sum(map(self._fresh, self._listed)) < _FEW
                self._look([name[:2]] if few else _FOLDERS)
            return name in self._listed[name[:2]][1]

    def names(self) -> set[str]:
        """Names of all files in the folders."""
        with self._lock:
            self._look(_FOLDERS)
            return set().union(*(names for _, names in self._listed.values()))

    def read(self, name: str) -> bytes | None:
        """The bytes of a small file."""
        return self._try("down", lambda: bytes(self._fs.cat_file(self._path(name))), len)

    def fetch(self, name: str, path: str) -> bool:
        """Copy a file from there to ``path``."""

        def get() -> int:
            self._fs.get_file(self._path(name), path)
            return os.path.getsize(path)

        return self._try("down", get, int) is not None

    def send(self, path: str, name: str) -> bool:
        """Copy the file at ``path`` there; False also where it has gone in the meantime."""

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
        """Write a small file; what is there stays, unless ``over``, as far as the file system can tell."""

        def pipe(to: str) -> int:
            try:
                self._fs.pipe_file(to, raw, mode="overwrite" if over or self._renames else "create")
            except FileExistsError:
                pass
            except (TypeError, NotImplementedError):  # a file system that knows no `mode` has only this call
                self._fs.pipe_file(to, raw)
            return len(raw)

        return (not over and self._renames and self._exists(name)) or self._write(name, pipe)

    def warn(self, text: str) -> None:
        """Say it, if nothing was said before."""
        if not self._warned:
            self._warned = True
            warnings.warn(text, stacklevel=5)

    def _path(self, name: str) -> str:
        return f"{self._root}/{name[:2]}/{name}"

    def _fresh(self, folder: str) -> bool:
        return folder in self._listed and time.monotonic() - self._listed[folder][0] < _FRESH

    def _look(self, folders: Sequence[str]) -> None:
        """List those of ``folders`` whose listings are old, side by side."""
        old = [folder for folder in folders if not self._fresh(folder)]
        with suppress(AttributeError):
            self._fs.invalidate_cache()
        now = time.monotonic()
        with ThreadPoolExecutor(min(16, max(1, len(old)))) as pool:
            for folder, found in zip(old, pool.map(self._listing, old), strict=True):
                self._listed[folder] = (now, found)

    def _listing(self, folder: str) -> set[str]:
        found = self._try("down", lambda: self._fs.ls(f"{self._root}/{folder}", detail=False))
        return {str(path).rpartition("/")[2] for path in found or ()}

    def _exists(self, name: str) -> bool:
        return bool(self._try("down", lambda: self._fs.exists(self._path(name))))

    def _write(self, name: str, put: Callable[[str], int]) -> bool:
        """Let ``put`` write a file that has its name only when it is complete."""

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

        size = self._try("up", whole, int)
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
        """Remove what killed processes left half-written; a file system that tells no times keeps it."""
        with suppress(OSError, LookupError, TypeError):
            for entry in self._fs.ls(path, detail=True):
                if time.time() - entry["mtime"] > _ORPHAN:
                    self._fs.rm_file(entry["name"])

    def _try(self, way: Direction, do: Callable[[], T], size: Callable[[T], int] | None = None) -> T | None:
        """What ``do`` gives; None where there is no such file, and while the remote is left alone."""
        if time.monotonic() < self._resume[way]:
            return None
        began = time.perf_counter()
        try:
            found = do()
        except Exception as error:  # each file system has its own, and they have no other kind in common
            if not (way == "down" and isinstance(error, FileNotFoundError)):
                self._failed(way, error)
            return None
        self._pause[way] = _PAUSE
        if size is not None:
            self._learn(way, size(found), time.perf_counter() - began)
        return found

    def _failed(self, way: Direction, error: Exception) -> None:
        alone = isinstance(error, PermissionError | FileNotFoundError)  # what may not be written may yet be read
        for each in (way,) if alone else ("down", "up"):
            self._resume[each] = time.monotonic() + self._pause[each]
            self._pause[each] *= 2
        what = "read" if way == "down" else "written"
        self.warn(f"{self.url} cannot be {what} ({type(error).__name__}: {error}): results are kept here alone")

    def _learn(self, way: Direction, size: int, seconds: float) -> None:
        """Move what is predicted a third of the way towards what was measured."""
        if size < _LEARN:
            self._latency[way] += (seconds - self._latency[way]) / 3
        else:
            rate = size / max(seconds - self._latency[way], 1e-6)
            self._rate[way] += (rate - self._rate[way]) / 3


def _file_system(url: str) -> tuple[Any, str]:
    """The file system of a URL and the path in it; errors say what to install or what was meant."""
    try:
        import fsspec
    except ImportError as error:
        text = f'a store at {url} needs fsspec: pip install "neusee[distributed]"'
        raise ModuleNotFoundError(text) from error
    try:
        found, path = fsspec.core.url_to_fs(url)
    except ImportError as error:
        raise ModuleNotFoundError(f"a store at {url} needs one more package: {error}") from error
    except ValueError as error:
        known, scheme = fsspec.available_protocols(), url.partition("://")[0]
        if scheme in known:
            raise
        raise ValueError(f"no file system goes by {scheme}://, of {url}; {nearest(scheme, known)}") from error
    return found, str(path).rstrip("/")
