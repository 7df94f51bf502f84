"""Derived files by key, such as pictures and spectral EXR: a second run takes each file and draws nothing.

The bytes lie in ``files/`` of the store's folder; the store itself keeps their checksum.
"""

from __future__ import annotations

import os
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
import xxhash

from neusee.workflows.store.result_store import Store


class DerivedFiles:
    """Files beside a store; where the store's folder cannot be written, the files live as long as this object."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.folder = store.root / "files"
        self._spare: TemporaryDirectory[str] | None = None

    def find(self, key: str, suffix: str) -> Path | None:
        """Return the file of a key if the file exists and its checksum matches, else None."""
        path = self._path(key, suffix)
        if not path.is_file() or not self.store.has(key):
            return None
        try:
            known = bytes(self.store.get(key).tolist())
        except KeyError:
            return None
        return path if known == _checksum(path) else None

    def keep(self, key: str, suffix: str, what: str, content: bytes) -> Path:
        """Write a read-only file by atomic rename and put its checksum into the store; return the path of the file."""
        try:
            path = self._written(key, suffix, content)
        except PermissionError:
            self._spare = TemporaryDirectory(prefix="neusee-")
            self.folder = Path(self._spare.name)
            path = self._written(key, suffix, content)
        about = {
            "step": what,
            "seconds": 0.0,
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "file": path.name,
            "file_bytes": len(content),
        }
        self.store.put(key, torch.tensor(list(_checksum(path)), dtype=torch.uint8), about)
        return path

    def _path(self, key: str, suffix: str) -> Path:
        return self.folder / key[:2] / f"{key}{suffix}"

    def _written(self, key: str, suffix: str, content: bytes) -> Path:
        path = self._path(key, suffix)
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{key}.{os.getpid()}{suffix}")
        try:
            part.write_bytes(content)
            part.chmod(0o444)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
        return path


def _checksum(path: Path) -> bytes:
    found = xxhash.xxh3_128()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            found.update(block)
    return found.digest()
