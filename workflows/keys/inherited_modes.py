"""Permissions below the root of a store: folders and files have the group and the permissions of the root.

A umask of 022 would take from the group what the owner of the root gave it.
"""

from __future__ import annotations

import os
import stat
from contextlib import suppress


def make_folders(folder: str, root: str) -> None:
    """Make a folder and the missing ones above it; those below ``root`` inherit its permissions.

    The root itself has the permissions that the umask leaves.
    """
    if os.path.isdir(folder):
        return
    if folder == root or not folder.startswith(f"{root}/"):
        os.makedirs(folder, exist_ok=True)
        return
    make_folders(os.path.dirname(folder), root)
    with suppress(FileExistsError):
        os.mkdir(folder)
        inherit(folder, root, 0o7777)
        if os.stat(folder).st_gid != os.getegid():
            os.chmod(folder, os.stat(folder).st_mode | stat.S_ISGID)  # what is made in it has its group


def inherit(path: str, root: str, mask: int) -> None:
    """Give a file or folder the group of ``root``, and those of its permissions that are in ``mask``."""
    top, own = os.stat(root), os.stat(path)
    with suppress(OSError):  # of a group of which this user is no member
        if own.st_gid != top.st_gid:
            os.chown(path, -1, top.st_gid)
    due = top.st_mode & mask
    if due & ~own.st_mode:
        with suppress(OSError):
            os.chmod(path, (own.st_mode | due) & 0o7777)
