"""Leases: who computes a key right now, so that two processes need not both do it.

A lease is a second name of a file in which its process says who it is, so that to take one
is a single step that either succeeds or does not, and one heartbeat serves them all. On
this machine the owner is looked for by its number and the time at which it began: after
``kill -9`` the next one takes over at once. The owner on another machine must be seen to
change its file; how long it does not is told by the observer's own steady clock, so no
clock that jumps makes a live owner dead. A lease is advice: were two processes to hold
the same one, they would do the same work twice and nothing else.
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
WINDOW = 10.0  #: s without one after which an owner whom one cannot look for is dead
_guard = threading.Lock()
_held: set[Lease] = set()
_badges: dict[str, str] = {}  #: by folder the file in which this process says who it is
_thread: threading.Thread | None = None


class Lease:
    """The right to compute a key, until `release`; one without a path is for a folder that takes no files."""

    __slots__ = ("_inode", "_path")

    def __init__(self, path: str | None = None) -> None:
        self._path = path
        self._inode = os.stat(path).st_ino if path else 0

    def release(self) -> None:
        """Let others have it; one that was taken over, or that a forked child inherited, stays as it is."""
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
    """The leases of one store, as one observer sees them."""

    def __init__(self, disk: Disk) -> None:
        self._disk = disk
        self._seen: dict[str, tuple[object, float]] = {}  #: by path what was there, and since when nothing changed

    def claim(self, key: str) -> Lease | None:
        """The lease of ``key``; None while a live process holds it.

        Who had to wait looks for the result once more before computing it.
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
        """Two tries: the folder may not be there yet, and our file in it may have been swept away."""
        with _guard:
            try:
                os.link(_badge(self._disk), path)
            except FileNotFoundError:
                _badges.pop(self._disk.folder, None)
                self._disk.forget()
                os.link(_badge(self._disk), path)
        return self._kept(path)

    def _taken_over(self, key: str, path: str, found: tuple[object, ...] | None) -> Lease:
        """One observer at a time; who finds that another was faster waits for that one."""
        part = f"{self._disk.folder}/tmp/{key}.{me()}.{threading.get_ident()}"
        with self._disk.lock():
            now = _look(path)
            if now is not None and (found is None or now[:2] != found[:2]):
                raise FileExistsError(path)
            with _guard:
                os.link(_badge(self._disk), path if now is None else part)  # of two who find nobody, one is first
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
    """What a lease says, its file, and what a heartbeat changes; None where there is none."""
    try:
        with open(path, "rb") as file:
            stat, text = os.fstat(file.fileno()), file.readline(200).decode(errors="replace")
    except FileNotFoundError:
        return None
    except OSError:
        stat, text = os.stat(path), ""
    return text, stat.st_ino, stat.st_size, stat.st_mtime_ns


def _badge(disk: Disk) -> str:
    """The file in which this process says who it is; made when it is first needed."""
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
    """While leases are held, show from time to time that their owner is alive."""
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
    """Change a file so that others see it, whatever the clocks say: it grows."""
    file = os.open(path, os.O_WRONLY | os.O_APPEND)
    try:
        os.write(file, b".")
    finally:
        os.close(file)


def _retire() -> None:
    """Also runs at the end of the process, when `_beat` may be at it too."""
    with suppress(KeyError):
        while True:
            _, path = _badges.popitem()
            with suppress(OSError):
                os.unlink(path)


def _forked() -> None:
    """A child holds none of its parent's leases."""
    global _guard, _thread
    _guard, _thread = threading.Lock(), None
    _held.clear()
    _badges.clear()


atexit.register(_retire)
os.register_at_fork(after_in_child=_forked)
