"""A folder to which many processes and users write, with the owner processes of its files."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import itertools
import math
import os
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO, Literal

from neusee.workflows.keys.sealed_files import inherit, make_folders

# --- process owner --------------------------------------------------------------------------------

# Owner of a file: a process on a machine, with a check that the process still runs. The check uses
# no clock.


State = Literal["alive", "dead", "foreign"]
_IDLE = "ZTtXx"  #: states in /proc of a process that has ended or is stopped


@dataclass(frozen=True, slots=True)
class Owner:
    """A process on a machine, identified by the machine, the process number and the start time."""

    host: str  #: digest of the machine, its present boot and its namespace of process numbers
    pid: int
    #: start time in ticks since the machine's boot; empty if the system does not give the time
    began: str

    def __str__(self) -> str:
        return f"{self.host}-{self.pid}-{self.began}"

    @property
    def state(self) -> State:
        """Return the process state: ``alive``, ``dead`` (ended or stopped) or ``foreign`` (on
        another machine).
        """
        if self.host != host():
            return "foreign"
        # this number: the owner is this process, or an earlier one with the same number
        if self.pid == os.getpid():
            return "alive" if self.began == me().began else "dead"
        try:
            status, start_time = _process(self.pid)
        except FileNotFoundError:
            # on a system without /proc, test by a signal
            return "dead" if os.path.exists("/proc/self/stat") else _signalled(self.pid)
        except (OSError, ValueError):
            return "dead"
        return "alive" if start_time == self.began and status not in _IDLE else "dead"


def owner_of(text: str) -> Owner | None:
    """Return the process that a text such as ``<host>-<number>-<start time>`` names, or None for
    any other text.
    """
    host_digest, _, number_and_time = text.partition("-")
    pid, _, start_time = number_and_time.partition("-")
    return (
        Owner(host_digest, int(pid), start_time)
        # the digest is 6 bytes, 12 hexadecimal digits
        if len(host_digest) == 12 and pid.isdecimal() and len(pid) < 12
        else None
    )


def me() -> Owner:
    """Return the running process as an `Owner`."""
    return _me(os.getpid())


@cache
def _me(pid: int) -> Owner:
    """Return this process as an owner, without a start time if the system gives none."""
    try:
        return Owner(host(), pid, _process(pid)[1])
    except (OSError, ValueError):
        return Owner(host(), pid, "")


@cache
def host() -> str:
    """Return a digest of this machine and its present boot; two containers of the same name have
    different digests.
    """
    machine_texts = [os.uname().nodename]
    with suppress(OSError):  # some systems do not have these files
        with open("/proc/sys/kernel/random/boot_id") as file:
            machine_texts.append(file.read())
        machine_texts.append(str(os.stat("/proc/self/ns/pid").st_ino))
    return hashlib.blake2b("\n".join(machine_texts).encode(), digest_size=6).hexdigest()


def _process(pid: int) -> tuple[str, str]:
    """Return the state and the start time of a process from ``/proc``."""
    with open(f"/proc/{pid}/stat", "rb") as file:
        # "number (name) state ...": the name may contain any character; the fields after it begin
        # with the state
        fields = file.read().rpartition(b")")[2].split()
    if len(fields) < 20:
        raise ValueError(f"the file /proc/{pid}/stat is incomplete")
    # field 22 of proc(5): the start time
    return fields[0].decode(), fields[19].decode()


def _signalled(pid: int) -> State:
    """Return whether a process of this machine runs, determined by signal 0, which has no
    effect.
    """
    try:
        with suppress(PermissionError):  # the process exists but belongs to another user
            os.kill(pid, 0)
    except ProcessLookupError:
        return "dead"
    return "alive"


# --- shared folder --------------------------------------------------------------------------------

# A folder to which many processes and many users write at the same time.
#
# A file is complete before it gets its final name; until then its temporary name contains the
# owner. The next writer removes the temporary files of killed processes without using the clock.
# Folders, and the few files to which all processes write, copy the permissions of the root.


MOST_READ = 64 << 20  #: greatest size (bytes) of a file of metadata
OLD = 3600.0  #: time (s) after which a temporary file of another machine counts as abandoned
#: time (s) to wait for the lock; its owner may be stopped, and a run without the lock can at worst
#: repeat work
_LOCK_PATIENCE = 10.0
#: errors of a file system without hard links
_LINKLESS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)
_count = itertools.count()


class Disk:
    """The root folder of a store, with the operations that write below the root."""

    def __init__(self, root: Path) -> None:
        self.root = root
        # text, because building a path object takes as long as the look-up itself
        self.folder = os.fspath(root)
        self._ready = False

    def path(self, key: str, suffix: str) -> str:
        """Return the path of the file of the result ``key`` with a suffix such as ``json``."""
        return f"{self.folder}/{key[:2]}/{key}.{suffix}"

    def prepare(self) -> None:
        """Make the folder of temporary files, and remove temporary files of killed processes."""
        if not self._ready:
            self.root.mkdir(parents=True, exist_ok=True)
            self.make_folder(f"{self.folder}/tmp")
            self.sweep()
            self._ready = True

    def forget(self) -> None:
        """Let the next write make the folder of temporary files again, after another process has
        removed it.
        """
        self._ready = False

    @contextmanager
    def temporary(self, name: str) -> Iterator[tuple[str, IO[bytes]]]:
        """Yield the path and handle of a new temporary file; delete the file later unless the
        caller renamed it.
        """
        self.prepare()
        path = f"{self.folder}/tmp/{name}.{me()}.{next(_count)}"
        try:
            with open(path, "xb") as file:
                # readable for all who may read the store; never changed later
                self.share(path, 0o444)
                yield path, file
        finally:
            with suppress(OSError):
                os.unlink(path)

    def replace(self, name: str, raw: bytes) -> None:
        """Replace the shared file ``name`` in the root folder of the store by a file with the
        content ``raw``.
        """
        with self.temporary(name) as (path, file):
            file.write(raw)
            file.flush()
            self.share(path)
            self.rename(path, f"{self.folder}/{name}")

    def rename(self, temporary: str, path: str) -> None:
        """Rename a complete file to its final name, and replace an existing file; an existing
        folder is put aside.
        """
        try:
            os.replace(temporary, path)
        except FileNotFoundError:
            self.make_folder(os.path.dirname(path))
            os.replace(temporary, path)
        except IsADirectoryError:
            self.put_aside(path)
            os.replace(temporary, path)

    def link(self, temporary: str, path: str) -> bool:
        """Link a complete file to its final name; return False if a file of that name exists."""
        try:
            try:
                os.link(temporary, path)
            except FileNotFoundError:
                self.make_folder(os.path.dirname(path))
                os.link(temporary, path)
        except FileExistsError:
            return False
        except OSError as error:
            if error.errno not in _LINKLESS:
                raise
            if os.path.lexists(path):
                return False
            os.replace(temporary, path)
        return True

    def make_folder(self, folder: str) -> None:
        """Make a folder with write permission for every user who may write in the root folder of
        the store.
        """
        make_folders(folder, self.folder)

    def share(self, path: str, mask: int = 0o666) -> None:
        """Give other users the permissions on ``path`` that they have on the root folder of the
        store.
        """
        inherit(path, self.folder, mask)

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the lock of the store during a ``with`` block.

        The block runs without the lock if the file system has no locks or the wait exceeds
        `_LOCK_PATIENCE` seconds.
        """
        self.prepare()
        lock_file = self._lock_file()
        try:
            deadline = time.monotonic() + _LOCK_PATIENCE
            while not _locked(lock_file) and time.monotonic() < deadline:
                time.sleep(0.001)
            yield
        finally:
            os.close(lock_file)

    def _lock_file(self) -> int:
        """Open the lock file without waiting; anything but a regular file is removed first, if this
        user may.
        """
        path, safe_flags = f"{self.folder}/tmp/.lock", os.O_NOFOLLOW | os.O_NONBLOCK
        with suppress(OSError):
            if not stat.S_ISREG(os.lstat(path).st_mode):
                os.unlink(path)
        try:
            return os.open(path, os.O_RDWR | os.O_TRUNC | safe_flags)
        except FileNotFoundError:
            file = os.open(path, os.O_RDWR | os.O_CREAT | safe_flags, 0o666)
            self.share(path)
            return file
        except (PermissionError, IsADirectoryError):
            # a lock works without permission to write
            return os.open(path, os.O_RDONLY | safe_flags)

    def sweep(self, dry: bool = False, patience: float = math.inf) -> list[tuple[str, int]]:
        """Remove the temporary files of dead processes; return the path and the bytes of each file.

        Leases and badges of other machines stay for ``patience`` seconds, because clocks may jump.
        """
        paths_and_sizes = []
        for entry in entries(f"{self.folder}/tmp"):
            with suppress(OSError):
                if entry.name != ".lock" and _abandoned(entry, patience):
                    paths_and_sizes.append((entry.path, entry.stat(follow_symlinks=False).st_size))
                    if not dry:
                        self.unlink(entry.path)
        return paths_and_sizes

    def unlink(self, path: str) -> None:
        """Delete a file below the root folder; raise `OSError` if a folder on the way there is a
        symbolic link.
        """
        with self._opened_folder(path) as (folder, name):
            os.unlink(name, dir_fd=folder)

    def put_aside(self, path: str) -> None:
        """Move a damaged file to the folder ``bad/`` for inspection, if this user may; follow no
        symbolic link.
        """
        with suppress(OSError):
            self.make_folder(f"{self.folder}/bad")
            with (
                self._opened_folder(path) as (folder, name),
                self._opened_folder(f"{self.folder}/bad/_") as (to, _),
            ):
                os.replace(name, name, src_dir_fd=folder, dst_dir_fd=to)

    @contextmanager
    def _opened_folder(self, path: str) -> Iterator[tuple[int, str]]:
        """Yield the opened folder of a file below the root, and the name of the file.

        Each folder is opened relative to the one above it, so that no symbolic link leads out of
        the root, even one that is created meanwhile. Raises `OSError` for a symbolic link.
        """
        *folders, name = path.removeprefix(f"{self.folder}/").split("/")
        # a path with one of these parts may lead out of the root
        if {"", ".", ".."} & {*folders, name}:
            raise OSError(errno.EPERM, f"{path} is not below {self.folder}")
        open_folders = [os.open(self.folder, os.O_RDONLY | os.O_DIRECTORY)]
        try:
            for folder in folders:
                open_folders.append(
                    os.open(
                        folder,
                        os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW,
                        dir_fd=open_folders[-1],
                    )
                )
            yield open_folders[-1], name
        finally:
            for open_folder in open_folders:
                os.close(open_folder)


def append(path: str, raw: bytes, flags: int = 0) -> int:
    """Append bytes to a file in one write; return the number of written bytes. ``flags`` are flags
    of `os.open`.

    A symbolic link or a pipe is deleted, and counts as a missing file.
    """
    try:
        file = os.open(
            path, os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | flags, 0o666
        )
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.ENXIO):
            raise
        os.unlink(path)
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), path) from None
    try:
        return os.write(file, raw)
    finally:
        os.close(file)


def read_file(path: str, limit: int = MOST_READ) -> bytes:
    """Return the bytes of a file; raise `ValueError` for anything but a regular file, or for more
    than ``limit`` bytes.

    A pipe or a device in place of the file never blocks the caller.
    """
    file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        file_status = os.fstat(file)
        if not stat.S_ISREG(file_status.st_mode) or file_status.st_size > limit:
            raise ValueError(f"{path} is not a file of at most {limit} bytes")
        content = os.read(file, file_status.st_size)
        # the file may grow or shrink while it is read
        while (
            len(content) != file_status.st_size
            and (chunk := os.read(file, limit + 1 - len(content)))
            and len(content) <= limit
        ):
            content += chunk
        return content
    finally:
        os.close(file)


def open_now(path: str, flags: int) -> int:
    """Open a file as an ``opener`` of `open`, without waiting for a pipe in its place."""
    return os.open(path, flags | os.O_NONBLOCK)


def entries(folder: str) -> list[os.DirEntry[str]]:
    """Return the files and folders in a folder, or an empty list for a symbolic link or an
    unreadable folder.
    """
    try:
        if os.path.islink(folder):
            return []
        with os.scandir(folder) as listing:
            return list(listing)
    except OSError:
        return []


def below(base: str) -> Iterator[os.DirEntry[str]]:
    """Yield the files in those subfolders of ``base`` whose names have two letters; follow no
    symbolic link.
    """
    for folder in sorted(entries(base), key=lambda entry: entry.name):
        if len(folder.name) == 2 and folder.is_dir(follow_symlinks=False):
            yield from entries(folder.path)


def _locked(file: int) -> bool:
    """Try to take the lock of a file; return False while another process holds it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass  # the file system has no locks
    return True


def _abandoned(entry: os.DirEntry[str], patience: float) -> bool:
    """Return True if the owner of a temporary file is dead, or if the owner is unknown and the
    file is old.
    """
    name_parts = entry.name.split(".")
    is_lease_or_badge = name_parts[-1] == "lease" or name_parts[0] == "badge"
    if name_parts[-1] == "lease" and entry.is_file(follow_symlinks=False):
        with open(entry.path, "rb", opener=open_now) as file:
            # the name of a lease is that of a key; its content names the owner
            name_parts = file.readline(200).decode(errors="replace").split()
    owner = next(filter(None, map(owner_of, name_parts)), None)
    state = owner.state if owner else "foreign"
    if state == "foreign":
        return time.time() - entry.stat(follow_symlinks=False).st_mtime > (
            patience if is_lease_or_badge else OLD
        )
    return state == "dead"
