"""Owner of a file: a process on a machine, with a check that the process still runs. The check uses no clock."""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Literal

State = Literal["alive", "dead", "foreign"]
_IDLE = "ZTtXx"  #: states in /proc of a process that has ended or is stopped


@dataclass(frozen=True, slots=True)
class Owner:
    """A process on a machine, identified by the machine, the process number and the start time."""

    host: str  #: digest of the machine, its present boot and its namespace of process numbers
    pid: int
    began: str  #: start time in ticks since the machine's boot; empty if the system does not give the time

    def __str__(self) -> str:
        return f"{self.host}-{self.pid}-{self.began}"

    @property
    def state(self) -> State:
        """Return the process state: ``alive``, ``dead`` (ended or stopped) or ``foreign`` (on another machine)."""
        if self.host != host():
            return "foreign"
        if self.pid == os.getpid():
            return "alive" if self.began == me().began else "dead"
        try:
            status, began = _process(self.pid)
        except FileNotFoundError:
            return "dead" if os.path.exists("/proc/self/stat") else _signalled(self.pid)
        except (OSError, ValueError):
            return "dead"
        return "alive" if began == self.began and status not in _IDLE else "dead"


def owner_of(text: str) -> Owner | None:
    """Return the process that a text such as ``<host>-<number>-<start time>`` names, or None for any other text."""
    host, _, rest = text.partition("-")
    pid, _, began = rest.partition("-")
    return Owner(host, int(pid), began) if len(host) == 12 and pid.isdecimal() and len(pid) < 12 else None


def me() -> Owner:
    """Return the running process as an `Owner`."""
    return _me(os.getpid())


@cache
def _me(pid: int) -> Owner:
    try:
        return Owner(host(), pid, _process(pid)[1])
    except (OSError, ValueError):
        return Owner(host(), pid, "")


@cache
def host() -> str:
    """Return a digest of this machine and its present boot; two containers of the same name have different digests."""
    parts = [os.uname().nodename]
    with suppress(OSError):  # a system without these files
        with open("/proc/sys/kernel/random/boot_id") as file:
            parts.append(file.read())
        parts.append(str(os.stat("/proc/self/ns/pid").st_ino))
    return hashlib.blake2b("\n".join(parts).encode(), digest_size=6).hexdigest()


def _process(pid: int) -> tuple[str, str]:
    """Return the state and the start time of a process from ``/proc``."""
    with open(f"/proc/{pid}/stat", "rb") as file:
        fields = file.read().rpartition(b")")[2].split()  # behind the name, which may hold any character
    if len(fields) < 20:
        raise ValueError(f"the file /proc/{pid}/stat is incomplete")
    return fields[0].decode(), fields[19].decode()


def _signalled(pid: int) -> State:
    try:
        with suppress(PermissionError):  # a process of another user
            os.kill(pid, 0)
    except ProcessLookupError:
        return "dead"
    return "alive"
