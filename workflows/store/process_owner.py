"""Who made a file: a process of a machine, and whether it is still at work. No clock is asked."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from functools import cache
from typing import Literal

State = Literal["alive", "dead", "foreign"]
_IDLE = "ZTtXx"  #: of /proc: ended, or stopped by somebody


@dataclass(frozen=True, slots=True)
class Owner:
    """A process: one that comes later with the same number began at another time."""

    host: str  #: digest of the machine, its present boot and its space of process numbers
    pid: int
    began: str  #: in ticks since the machine's boot; empty where the system does not tell

    def __str__(self) -> str:
        return f"{self.host}-{self.pid}-{self.began}"

    @property
    def state(self) -> State:
        """``foreign``: on another machine, where one cannot look. A process that was stopped counts as dead."""
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
    """The owner that ``text`` names; None where it names none."""
    host, _, rest = text.partition("-")
    pid, _, began = rest.partition("-")
    return Owner(host, int(pid), began) if len(host) == 12 and pid.isdecimal() and len(pid) < 12 else None


def me() -> Owner:
    """This process."""
    return _me(os.getpid())


@cache
def _me(pid: int) -> Owner:
    try:
        return Owner(host(), pid, _process(pid)[1])
    except (OSError, ValueError):
        return Owner(host(), pid, "")


@cache
def host() -> str:
    """This machine until its next boot; two containers with one name differ too."""
    parts = [os.uname().nodename]
    try:
        with open("/proc/sys/kernel/random/boot_id") as file:
            parts.append(file.read())
        parts.append(str(os.stat("/proc/self/ns/pid").st_ino))
    except OSError:
        pass  # a system that tells neither
    return hashlib.blake2b("\n".join(parts).encode(), digest_size=6).hexdigest()


def _process(pid: int) -> tuple[str, str]:
    """What a process is doing and when it began; its name, which stands before, may hold anything."""
    with open(f"/proc/{pid}/stat", "rb") as file:
        fields = file.read().rpartition(b")")[2].split()
    if len(fields) < 20:
        raise ValueError(f"/proc/{pid}/stat is cut short")
    return fields[0].decode(), fields[19].decode()


def _signalled(pid: int) -> State:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return "dead"
    except PermissionError:
        pass
    return "alive"
