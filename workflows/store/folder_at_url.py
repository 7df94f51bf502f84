"""A shared folder that is named by a URL (``file:///shared/neusee``), with the care that a folder of others needs.

What is no regular file is never waited for or read, and what one user of a group makes the others may use. A folder
that this user may only read is never written to.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from typing import Any

from neusee.workflows.keys.inherited_modes import inherit, make_folders
from neusee.workflows.keys.regular_file import bytes_of, opened


class FolderAtUrl:
    """The file system of a folder of a store at a URL, with the calls of fsspec that `RemoteFiles` makes."""

    protocol = ("file", "local")

    def __init__(self, root: str) -> None:
        self._root = root

    def is_read_only(self) -> bool:
        """Return True if the folder exists and this user may not write there."""
        return os.path.isdir(self._root) and not os.access(self._root, os.W_OK)

    def exists(self, path: str) -> bool:
        """Return True if something has this name, also a link that leads nowhere."""
        return os.path.lexists(path)

    def ls(self, path: str, detail: bool = False) -> list[Any]:
        """Return the paths in a folder, with ``detail`` each with its time of last change."""
        with os.scandir(path) as found:
            if not detail:
                return [entry.path for entry in found]
            return [{"name": each.path, "mtime": each.stat(follow_symlinks=False).st_mtime} for each in found]

    def cat_file(self, path: str) -> bytes:
        """Return the bytes of a regular file; raise `NotRegular` for anything else, and for a file that is too long."""
        return bytes_of(path)

    def get_file(self, path: str, to: str) -> None:
        """Copy a regular file of the folder to another path."""
        with opened(path) as file, open(to, "wb") as copy:
            shutil.copyfileobj(file, copy)

    def put_file(self, path: str, to: str) -> None:
        """Copy a regular file into the folder, where the users of the folder may read it."""
        with opened(path) as file, open(to, "wb") as copy:
            shutil.copyfileobj(file, copy)
        inherit(to, self._root, 0o444)

    def pipe_file(self, to: str, raw: bytes, **_: Any) -> None:
        """Write bytes to a file in the folder, where the users of the folder may read it."""
        with open(to, "wb") as file:
            file.write(raw)
        inherit(to, self._root, 0o444)

    def mv(self, path: str, to: str) -> None:
        """Rename a file to a name that something else may have; raise `IsADirectoryError` for a folder."""
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
        """Make a folder with the group and the permissions of the root, and the missing ones above it."""
        make_folders(self._root, self._root)
        make_folders(path, self._root)
