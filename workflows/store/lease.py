"""Leases: only the process that holds the lease of a cache key computes the result that belongs to
the key.

A lease is a second hard link to the badge of a process, a file that names the process: one atomic
step takes a lease, and one heartbeat serves all leases of a process. On the same machine, an
observer looks up the owner by process number and start time, so that the next process takes over at
once after ``kill -9``. An owner on another machine must change its badge at intervals. The observer
measures the intervals by its own monotonic clock, so that a jump of a clock never makes a live
owner count as dead. Two processes with the same lease would compute a result twice and do no other
harm.
"""

from __future__ import annotations

import atexit
import os
import threading
import time
from contextlib import suppress

from neusee.workflows.store.shared_folder import Disk, append, me, open_now, owner_of

BEAT = 2.0  #: s between heartbeats
WINDOW = 10.0  #: s without a heartbeat after which an owner on another machine counts as dead
_guard = threading.Lock()
_held: set[Lease] = set()
#: path of the badge of this process by folder; a badge is a file that names the process
_badges: dict[str, str] = {}
_thread: threading.Thread | None = None


class Lease:
    """The right of one process to compute the result of a cache key, until the process calls
    `release`.

    ``path`` is the file of the lease, or None if no file can be written.
    """

    __slots__ = ("_inode", "_path")

    def __init__(self, path: str | None = None) -> None:
        self._path = path
        self._inode = os.stat(path).st_ino if path else 0

    def release(self) -> None:
        """Delete the file of the lease, unless another process took the lease or this process is
        a forked child.
        """
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

    def __exit__(self, *error: object) -> None:
        self.release()


class Leases:
    """The leases of one store: the rights of processes to compute the results of cache keys."""

    def __init__(self, disk: Disk) -> None:
        self._disk = disk
        #: for each path: the state of the lease file, and the time of its first observation
        self._seen: dict[str, tuple[object, float]] = {}

    def claim(self, key: str) -> Lease | None:
        """Return the lease of ``key``, the right to compute its result, or None while a running
        process holds it.

        A caller that had to wait must look up the result again before it computes the result.
        """
        try:
            return self._claimed(key, f"{self._disk.folder}/tmp/{key}.lease")
        except OSError:
            return Lease()

    def _claimed(self, key: str, path: str) -> Lease | None:
        """Take the lease at ``path``, or take it over from a dead owner; None while its owner
        lives.
        """
        try:
            return self._taken(path)
        except FileExistsError:
            lease_state = _state_of_lease(path)
        if lease_state is not None and not self._dead(path, lease_state):
            return None
        try:
            return self._taken_over(key, path, lease_state)
        except FileExistsError:
            return None

    def _taken(self, path: str) -> Lease:
        """Take a free lease; make the folder of leases and the file that identifies this process
        if needed.
        """
        with _guard:
            try:
                os.link(_badge(self._disk), path)
            # the folder of leases, or the badge in it, was removed
            except FileNotFoundError:
                _badges.pop(self._disk.folder, None)
                self._disk.forget()
                os.link(_badge(self._disk), path)
        return self._kept(path)

    def _taken_over(self, key: str, path: str, look: tuple[object, ...] | None) -> Lease:
        """Take over the lease of a process that has ended, under the lock of the store.

        Raises `FileExistsError` if another process was first.
        """
        temporary = f"{self._disk.folder}/tmp/{key}.{me()}.{threading.get_ident()}"
        with self._disk.lock():
            state_now = _state_of_lease(path)
            # another content or inode: another process took the lease since it was observed
            if state_now is not None and (look is None or state_now[:2] != look[:2]):
                raise FileExistsError(path)
            with _guard:
                # fails for the later of two observers
                os.link(_badge(self._disk), path if state_now is None else temporary)
            try:
                if state_now is not None:
                    os.replace(temporary, path)
            finally:
                with suppress(OSError):
                    os.unlink(temporary)
        self._disk.sweep()
        return self._kept(path)

    def _kept(self, path: str) -> Lease:
        """Hold a lease that was taken, and start the heartbeat if none runs."""
        global _thread
        lease = Lease(path)
        self._seen.pop(path, None)
        with _guard:
            _held.add(lease)
            if _thread is None or not _thread.is_alive():
                _thread = threading.Thread(target=_beat, name="neusee-leases", daemon=True)
                _thread.start()
        return lease

    def _dead(self, path: str, look: tuple[object, ...]) -> bool:
        """Return True if the owner of a lease has ended.

        An owner on another machine is dead if its lease did not change for `WINDOW` seconds
        between two looks of this process.
        """
        # the first word of a lease names its owner
        owner = owner_of(str(look[0]).partition(" ")[0])
        state = owner.state if owner else "foreign"
        if state != "foreign":
            return state == "dead"
        present_time = time.monotonic()
        state_before, unchanged_since = self._seen.get(path, (None, present_time))
        self._seen[path] = (look, unchanged_since if state_before == look else present_time)
        return state_before == look and present_time - unchanged_since > WINDOW


def _state_of_lease(path: str) -> tuple[object, ...] | None:
    """Return the content, inode, size and change time of the file of a lease, or None if the
    file does not exist.
    """
    try:
        with open(path, "rb", opener=open_now) as file:
            file_status, content = (
                os.fstat(file.fileno()),
                file.readline(200).decode(errors="replace"),
            )
    except FileNotFoundError:
        return None
    except OSError:
        file_status, content = os.stat(path), ""
    return content, file_status.st_ino, file_status.st_size, file_status.st_mtime_ns


def _badge(disk: Disk) -> str:
    """Return the path of the badge of this process, a file that names the process; the first
    call writes the file.
    """
    if disk.folder not in _badges:
        disk.prepare()
        path = f"{disk.folder}/tmp/badge.{me()}"
        # a badge of an earlier process with the same number
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


def _beat() -> None:
    """Append to the files that identify this process at intervals, as a heartbeat while the
    process holds leases.
    """
    global _thread
    while True:
        time.sleep(BEAT)
        with _guard:
            if not _held:
                _thread = None
                retire()
                return
            badges = list(_badges.values())
        for path in badges:
            with suppress(OSError):
                # other processes see this change of the file independently of their clocks
                append(path, b".")


def retire() -> None:
    """Delete all files that identify this process as an owner of leases.

    Two threads may call this function at the same time.
    """
    with suppress(KeyError):
        while True:
            _, path = _badges.popitem()
            with suppress(OSError):
                os.unlink(path)


def _forked() -> None:
    """Forget all leases in a forked child process, because the leases belong to the parent
    process.
    """
    global _guard, _thread
    _guard, _thread = threading.Lock(), None
    _held.clear()
    _badges.clear()


atexit.register(retire)
os.register_at_fork(after_in_child=_forked)
