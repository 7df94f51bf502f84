"""A folder to which many processes and users write at once.

A file gets its name only when it is complete, and until then carries its owner's: what a
killed process left behind is removed by the next one that writes, whatever the clock says.
Folders, and the few files that all write to, take over what the root lets others do.
"""

from __future__ import annotations

import errno
import fcntl
import itertools
import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from neusee.workflows.store.process_owner import me, owner_of

OLD = 3600.0  #: s after which a temporary file of another machine has no owner
_PATIENCE = 10.0  #: s to wait for the lock; its holder may be stopped, and without it nothing goes wrong but work
_LINKLESS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)  #: of a file system without links
_count = itertools.count()


class Disk:
    """The root of a store, and how one writes below it."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.folder = os.fspath(root)  # text, for a path object costs as much as the look-up
        self._ready = False

    def path(self, key: str, suffix: str) -> str:
        """Where a result lies."""
        return f"{self.folder}/{key[:2]}/{key}.{suffix}"

    def prepare(self) -> None:
        """Make the folder of temporary files, and remove what killed processes left in it."""
        if not self._ready:
            self.root.mkdir(parents=True, exist_ok=True)
            self.make_folder(f"{self.folder}/tmp")
            self.sweep()
            self._ready = True

    def forget(self) -> None:
        """Look again at what is there before the next write: somebody has removed it."""
        self._ready = False

    @contextmanager
    def temporary(self, name: str) -> Iterator[tuple[str, IO[bytes]]]:
        """A new file without a name of its own yet; what is not named in time is gone."""
        self.prepare()
        part = f"{self.folder}/tmp/{name}.{me()}.{next(_count)}"
        try:
            with open(part, "xb") as file:
                yield part, file
        finally:
            with suppress(OSError):
                os.unlink(part)

    def rename(self, part: str, path: str) -> None:
        """Give a complete file its name, in place of what had it."""
        try:
            os.replace(part, path)
        except FileNotFoundError:
            self.make_folder(os.path.dirname(path))
            os.replace(part, path)

    def link(self, part: str, path: str) -> bool:
        """Give a complete file its name unless it is taken; False where it is."""
        try:
            try:
                os.link(part, path)
            except FileNotFoundError:
                self.make_folder(os.path.dirname(path))
                os.link(part, path)
        except FileExistsError:
            return False
        except OSError as error:
            if error.errno not in _LINKLESS:
                raise
            if os.path.lexists(path):
                return False
            os.replace(part, path)
        return True

    def make_folder(self, folder: str) -> None:
        """A folder in which all may write who may write in the root."""
        with suppress(FileExistsError):
            os.mkdir(folder)
            self.share(folder, 0o7777)

    def share(self, path: str, mask: int = 0o666) -> None:
        """Let others do with ``path`` what the root lets them do."""
        wanted, found = os.stat(self.folder).st_mode & mask, os.stat(path).st_mode
        if wanted & ~found:
            with suppress(OSError):
                os.chmod(path, (found | wanted) & 0o7777)

    @contextmanager
    def lock(self) -> Iterator[None]:
        """One process at a time; a file system that knows no locks, or a holder that is stopped, goes without."""
        self.prepare()
        file = self._lock_file()
        try:
            ends = time.monotonic() + _PATIENCE
            while not _locked(file) and time.monotonic() < ends:
                time.sleep(0.001)
            yield
        finally:
            os.close(file)

    def _lock_file(self) -> int:
        path = f"{self.folder}/tmp/.lock"
        try:
            return os.open(path, os.O_RDWR | os.O_TRUNC)
        except FileNotFoundError:
            file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
            self.share(path)
            return file
        except PermissionError:
            return os.open(path, os.O_RDONLY)

    def sweep(self, dry: bool = False, patience: float = math.inf) -> list[tuple[str, int]]:
        """Remove the temporary files of processes that are dead; those removed, with their bytes.

        Leases and badges of other machines stay for ``patience`` seconds: a clock that jumps makes none of them old.
        """
        gone = []
        for entry in os.scandir(f"{self.folder}/tmp"):
            with suppress(OSError):
                if entry.name != ".lock" and _abandoned(entry, patience):
                    gone.append((entry.path, entry.stat(follow_symlinks=False).st_size))
                    if not dry:
                        os.unlink(entry.path)
        return gone


def _locked(file: int) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass  # a file system that knows no locks
    return True


def _abandoned(entry: os.DirEntry[str], patience: float) -> bool:
    """Whether nobody works on a temporary file any more: its owner is dead, or unknown and it is old."""
    words = entry.name.split(".")
    presence = words[-1] == "lease" or words[0] == "badge"
    if words[-1] == "lease":
        with open(entry.path, "rb") as file:
            words = file.readline(200).decode(errors="replace").split()
    owner = next(filter(None, map(owner_of, words)), None)
    state = owner.state if owner else "foreign"
    if state == "foreign":
        return time.time() - entry.stat(follow_symlinks=False).st_mtime > (patience if presence else OLD)
    return state == "dead"
