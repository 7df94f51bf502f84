"""Receipts of one store, the metadata of results without a value: a file is read again only after it has changed."""

from __future__ import annotations

from neusee.workflows.store import metadata
from neusee.workflows.store.metadata import Metadata, is_kept
from neusee.workflows.store.payload import stamp_of
from neusee.workflows.store.shared_folder import Disk


class Receipts:
    """The metadata files of one store, of which those of receipts are remembered with the stamp of their file."""

    def __init__(self, disk: Disk) -> None:
        self._disk = disk
        self._read: dict[str, tuple[list[int], Metadata]] = {}

    def find(self, key: str) -> Metadata | None:
        """Return the metadata of ``key``, with or without a value, as `metadata.find` does.

        Raises an error in `UNREADABLE` for damaged metadata.
        """
        try:
            stamp = stamp_of(self._disk.path(key, "json"))
        except (OSError, ValueError):
            return metadata.find(self._disk, key)  # which tells what is wrong with the file, or that there is none
        if key in self._read and self._read[key][0] == stamp:
            return self._read[key][1]
        about = metadata.find(self._disk, key)
        if about is not None and not is_kept(about):
            self._read[key] = stamp, about
        return about
