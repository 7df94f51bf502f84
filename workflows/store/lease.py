"""Leases: a process that holds the lease of a key computes the key, so that no second process does the same.

A lease is a second hard link to the badge of a process, a file that names the process. Taking
a lease is therefore one atomic step, and one heartbeat serves all leases of a process. On the
same machine, an observer looks up the owner by process number and start time: after
``kill -9`` the next process takes over at once. An owner on another machine must be seen to
change its badge. The observer measures the time without a change by its own monotonic clock,
so that no clock that jumps makes a live owner dead. A lease is advice: if two processes held
the same lease, they would do the same work twice and do no other harm.
"""

from __future__ import annotations

import atexit
import os
import threading
import time
from contextlib import suppress
from types import TracebackType

from neusee.workflows.store.process_owner import me, owner_of
from neusee.workflows.store.shared_folder import Disk

BEAT = 2.0  #: s between heartbeats
WINDOW = 10.0  #: s without a heartbeat after which an owner on another machine counts as dead
_guard = threading.Lock()
_held: set[Lease] = set()
_badges: dict[str, str] = {}  #: by folder, the badge of this process: the file that names the process
_thread: threading.Thread | None = None


class Lease:
    """The right to compute a key until `release`; a lease without a path stands for a folder that takes no files."""

    __slots__ = ("_inode", "_path")

    def __init__(self, path: str | None = None) -> None:
        self._path = path
        self._inode = os.stat(path).st_ino if path else 0

    def release(self) -> None:
        """Give the lease back; a lease that was taken over, or inherited by a forked child, stays unchanged."""
        with _guard:
            if self not in _held:
                return
            _held.discard(self)
        assert self._path
        with suppress(OSError):
            if os.stat(self._path).st_ino == self._inode:
                os.unlink(self._path)

    def __enter__(self) -> Lease:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


class Leases:
    """The leases of one store, as seen by one observer."""

    def __init__(self, disk: Disk) -> None:
        self._disk = disk
        self._seen: dict[str, tuple[object, float]] = {}  #: by path: content, and since when unchanged

    def claim(self, key: str) -> Lease | None:
        """Return the lease of ``key``, or None while a live process holds the lease.

        A caller that had to wait looks up the result once more before computing it.
        """
        try:
            return self._claimed(key, f"{self._disk.folder}/tmp/{key}.lease")
        except OSError:
            return Lease()

    def _claimed(self, key: str, path: str) -> Lease | None:
        try:
            return self._taken(path)
        except FileExistsError:
            found = _look(path)
        if found is not None and not self._dead(path, found):
            return None
        try:
            return self._taken_over(key, path, found)
        except FileExistsError:
            return None

    def _taken(self, path: str) -> Lease:
        """Take a free lease; try twice, because the folder may not exist yet or a sweep may have removed our badge."""
        with _guard:
            try:
                os.link(_badge(self._disk), path)
            except FileNotFoundError:
                _badges.pop(self._disk.folder, None)
                self._disk.forget()
                os.link(_badge(self._disk), path)
        return self._kept(path)

    def _taken_over(self, key: str, path: str, found: tuple[object, ...] | None) -> Lease:
        """Take over the lease of a dead owner under the lock; raise `FileExistsError` if another observer was first."""
        part = f"{self._disk.folder}/tmp/{key}.{me()}.{threading.get_ident()}"
        with self._disk.lock():
            now = _look(path)
            if now is not None and (found is None or now[:2] != found[:2]):
                raise FileExistsError(path)
            with _guard:
                os.link(_badge(self._disk), path if now is None else part)  # one of two observers is first
            try:
                if now is not None:
                    os.replace(part, path)
            finally:
                with suppress(OSError):
                    os.unlink(part)
        self._disk.sweep()
        return self._kept(path)

    def _kept(self, path: str) -> Lease:
        lease = Lease(path)
        self._seen.pop(path, None)
        with _guard:
            _held.add(lease)
            _start()
        return lease

    def _dead(self, path: str, found: tuple[object, ...]) -> bool:
        owner = owner_of(str(found[0]).partition(" ")[0])
        state = owner.state if owner else "foreign"
        if state != "foreign":
            return state == "dead"
        now = time.monotonic()
        before, since = self._seen.get(path, (None, now))
        self._seen[path] = (found, since if before == found else now)
        return before == found and now - since > WINDOW


def _look(path: str) -> tuple[object, ...] | None:
    """Return the content of a lease, its inode and the numbers that a heartbeat changes; None if there is no lease."""
    try:
        with open(path, "rb") as file:
            stat, text = os.fstat(file.fileno()), file.readline(200).decode(errors="replace")
    except FileNotFoundError:
        return None
    except OSError:
        stat, text = os.stat(path), ""
    return text, stat.st_ino, stat.st_size, stat.st_mtime_ns


def _badge(disk: Disk) -> str:
    """Return the path of this process's badge; write the badge when it is first needed."""
    if disk.folder not in _badges:
        disk.prepare()
        path = f"{disk.folder}/tmp/badge.{me()}"
        with suppress(FileNotFoundError):
            os.unlink(path)
        with open(path, "xb") as file:
            try:
                file.write(f"{me()} {os.urandom(8).hex()}\n".encode())
                file.flush()
            except OSError:
                os.unlink(path)
                raise
        _badges[disk.folder] = path
    return _badges[disk.folder]


def _start() -> None:
    global _thread
    if _thread is None:
        _thread = threading.Thread(target=_beat, name="neusee-leases", daemon=True)
        _thread.start()


def _beat() -> None:
    """Change the badges from time to time while leases are held, to show that their owner is alive."""
    global _thread
    while True:
        time.sleep(BEAT)
        with _guard:
            if not _held:
                _thread = None
                _retire()
                return
            badges = list(_badges.values())
        for path in badges:
            with suppress(OSError):
                beat(path)


def beat(path: str) -> None:
    """Append a byte to a file, so that other processes see a change whatever their clocks say."""
    file = os.open(path, os.O_WRONLY | os.O_APPEND)
    try:
        os.write(file, b".")
    finally:
        os.close(file)


def _retire() -> None:
    """Remove all badges of this process; also called at exit, perhaps at the same time as `_beat`."""
    with suppress(KeyError):
        while True:
            _, path = _badges.popitem()
            with suppress(OSError):
                os.unlink(path)


def _forked() -> None:
    """Forget all leases in a forked child, which holds none of its parent's leases."""
    global _guard, _thread
    _guard, _thread = threading.Lock(), None
    _held.clear()
    _badges.clear()


atexit.register(_retire)
os.register_at_fork(after_in_child=_forked)
