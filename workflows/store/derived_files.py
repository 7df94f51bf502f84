"""Files derived from results, such as pictures, stored by key so that a second run can use them
again.

The files are in the folder ``files/`` of the store; their checksums are results of the store.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import threading
import weakref
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Any

import xxhash

from neusee.workflows.keys.sealed_files import make_folders, secrets
from neusee.workflows.store.metadata import is_kept
from neusee.workflows.store.result_store import Store
from neusee.workflows.store.shared_folder import open_now

if TYPE_CHECKING:
    from torch import Tensor

_SHA256 = 32  #: length (bytes) of a SHA-256 digest
_FAST = xxhash.xxh3_128


class DerivedFiles:
    """Files derived from results, in the folder of a store, or in a temporary folder if the
    store cannot be written.
    """

    def __init__(self, store: Store) -> None:
        self.store = store
        self.folder = store.root / "files"
        self._spare = ""  # a temporary folder, which is deleted with this object
        self._failing = threading.Lock()  # lock, because two threads make files
        # inode, size and time stamp of each file when its checksum was right
        self._fresh: dict[Path, tuple[int, ...]] = {}

    def find(self, key: str, suffix: str) -> Path | None:
        """Return the path of the derived file ``key``, or None if the file is missing, or has a
        wrong name or checksum.

        A file that this object has written or compared is not compared again while inode, size and
        time stamp stay the same.
        """
        from torch import Tensor

        path = self._path(key, suffix)
        with suppress(KeyError, OSError):
            # unchanged since it was written or compared
            if path in self._fresh and self._fresh[path] == _state(path):
                return path
            metadata = self.store.about(key) if path.is_file() else None
            is_named = is_kept(metadata) and metadata.get("file") == path.name
            if is_named and _is_right(path, self.store.get(key, Tensor)):
                self._fresh[path] = _state(path)
                return path
        return None

    def keep(self, key: str, suffix: str, step: str, write: Callable[[Path], None]) -> Path:
        """Let ``write`` write a file under a temporary name, rename the file, and store its
        checksum; return its path.

        The file is read-only. If the folder cannot be written, or the file cannot be read back, it
        is written into a temporary folder.
        """
        try:
            # tried again below, in a temporary folder, if the folder of the store fails
            path, digest = self._compared(key, suffix, write)
        except OSError as error:
            self.store.report_failure(error)
            with self._failing:
                if not self._spare:
                    self._spare = mkdtemp(prefix="neusee-")
                    weakref.finalize(self, _remove, self._spare, os.getpid())
                self.folder = Path(self._spare)
            path, digest = self._compared(key, suffix, write)
        metadata = {
            "step": step,
            "seconds": 0.0,
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "file": path.name,
            "file_bytes": path.stat().st_size,
        }
        self.store.put(key, digest, metadata)
        self._fresh[path] = _state(path)
        return path

    def _path(self, key: str, suffix: str) -> Path:
        return self.folder / key[:2] / f"{key}{suffix}"

    def _compared(
        self, key: str, suffix: str, write: Callable[[Path], None]
    ) -> tuple[Path, Tensor]:
        """Write a file; return its path, and the digest of the bytes that are read back from it."""
        path = self._written(key, suffix, write)
        return path, _digest(path, "sha256" if secrets() else _FAST)

    def _written(self, key: str, suffix: str, write: Callable[[Path], None]) -> Path:
        """Let ``write`` write a read-only file, which gets its final name when it is complete;
        return its path.
        """
        path = self._path(key, suffix)
        make_folders(str(path.parent), str(self.store.root))
        temporary = path.with_name(f".{key}.{os.getpid()}{suffix}")
        try:
            write(temporary)
            temporary.chmod(0o444)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
        return path


def _remove(folder: str, process: int) -> None:
    """Remove a folder if this process made it; a forked process does nothing."""
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)


def _state(path: Path) -> tuple[int, ...]:
    """Return inode, size and time stamp of a file, which differ after each change."""
    file_status = path.stat()
    return file_status.st_ino, file_status.st_size, file_status.st_mtime_ns


def _is_right(path: Path, stored_digest: Tensor) -> bool:
    """Return True if a file has the stored digest: SHA-256, or the faster xxh3 if no secret is
    set.
    """
    import torch

    signed = len(stored_digest) == _SHA256
    return (signed or not secrets()) and torch.equal(
        stored_digest, _digest(path, "sha256" if signed else _FAST)
    )


def _digest(path: Path, algorithm: Any) -> Tensor:
    """Return a digest of a file as bytes."""
    import torch

    with open(path, "rb", opener=open_now) as file:
        return torch.tensor(list(hashlib.file_digest(file, algorithm).digest()), dtype=torch.uint8)
