"""Table of the system calls that a step is stopped at: numbers, what each does, and where its arguments stand.

A call that is not in the table passes at full speed. A row that changes what counts as reached is a row of this table;
the filter and the process that serves it are made from it.
"""

from __future__ import annotations

import platform
import sys
from typing import Literal, NamedTuple

#: what a call does, for the process that records it and for the judgement of the records
Does = Literal[
    "open", "openat2", "creat", "check", "xattr", "xattr_open", "list", "input", "make", "remove", "move", "link",
    "exec", "fork", "connect", "bind", "entropy", "unseen",
]  # fmt: skip
Test = Literal["without", "nonzero", "zero"]

AT_EMPTY_PATH = 0x1000  #: the call asks about an open file, not about a path
CLONE_VFORK, CLONE_THREAD = 0x4000, 0x10000  #: a child that only starts a program, and a thread
_ARCHITECTURES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}  #: AUDIT_ARCH_… of linux/audit.h
AUDIT_ARCH_I386 = 0x40000003


class Condition(NamedTuple):
    """What an argument must be for the call to count: ``without`` the bits of a mask, ``nonzero`` or ``zero``."""

    argument: int
    test: Test
    mask: int = 0


class Path(NamedTuple):
    """Where the arguments of a path stand: the pointer, and the folder that a relative path begins at (-1: of work)."""

    pointer: int
    folder: int = -1


class Call(NamedTuple):
    """One system call: its number on each processor (-1 where it is missing), and where its arguments stand."""

    name: str
    does: Does
    x86_64: int
    aarch64: int
    path: Path | None = None
    second: Path | None = None
    number: int = -1  #: argument that is recorded as it is, such as the flags of ``open``
    when: Condition | None = None


def _about_path(argument: int) -> Condition:
    return Condition(argument, "without", AT_EMPTY_PATH)


CALLS = (
    # what is in a file or a folder
    Call("open", "open", 2, -1, Path(0), number=1),
    Call("openat", "open", 257, 56, Path(1, 0), number=2),
    Call("openat2", "openat2", 437, 437, Path(1, 0), number=2),
    Call("creat", "creat", 85, -1, Path(0)),
    Call("getdents", "list", 78, -1, number=0),
    Call("getdents64", "list", 217, 61, number=0),
    Call("read", "input", 0, 63, number=0, when=Condition(0, "zero")),
    # whether it is there, how old and how large it is
    Call("stat", "check", 4, -1, Path(0)),
    Call("lstat", "check", 6, -1, Path(0)),
    Call("newfstatat", "check", 262, 79, Path(1, 0), when=_about_path(3)),
    Call("statx", "check", 332, 291, Path(1, 0), when=_about_path(2)),
    Call("access", "check", 21, -1, Path(0), number=1),
    Call("faccessat", "check", 269, 48, Path(1, 0), number=2),
    Call("faccessat2", "check", 439, 439, Path(1, 0), when=_about_path(3)),
    Call("readlink", "check", 89, -1, Path(0)),
    Call("readlinkat", "check", 267, 78, Path(1, 0)),
    Call("getxattr", "xattr", 191, 8, Path(0)),
    Call("lgetxattr", "xattr", 192, 9, Path(0)),
    Call("fgetxattr", "xattr_open", 193, 10, number=0),
    Call("listxattr", "xattr", 194, 11, Path(0)),
    Call("llistxattr", "xattr", 195, 12, Path(0)),
    Call("flistxattr", "xattr_open", 196, 13, number=0),
    # these fail where it is not there
    Call("truncate", "check", 76, 45, Path(0)),
    Call("chmod", "check", 90, -1, Path(0)),
    Call("fchmodat", "check", 268, 53, Path(1, 0)),
    Call("utimensat", "check", 280, 88, Path(1, 0), when=Condition(1, "nonzero")),
    # what the step makes itself, and may therefore read; whether it could be made or removed says what was there before
    Call("mkdir", "make", 83, -1, Path(0)),
    Call("mkdirat", "make", 258, 34, Path(1, 0)),
    Call("mknod", "make", 133, -1, Path(0)),
    Call("mknodat", "make", 259, 33, Path(1, 0)),
    Call("symlink", "make", 88, -1, Path(1)),
    Call("symlinkat", "make", 266, 36, Path(2, 1)),
    Call("unlink", "remove", 87, -1, Path(0)),
    Call("unlinkat", "remove", 263, 35, Path(1, 0)),
    Call("rmdir", "remove", 84, -1, Path(0)),
    Call("rename", "move", 82, -1, Path(0), Path(1)),
    Call("renameat", "move", 264, 38, Path(1, 0), Path(3, 2)),
    Call("renameat2", "move", 316, 276, Path(1, 0), Path(3, 2)),
    Call("link", "link", 86, -1, Path(0), Path(1)),
    Call("linkat", "link", 265, 37, Path(1, 0), Path(3, 2)),
    # other processes
    Call("execve", "exec", 59, 221, Path(0)),
    Call("execveat", "exec", 322, 281, Path(1, 0)),
    Call("fork", "fork", 57, -1),
    Call("clone", "fork", 56, 220, when=Condition(0, "without", CLONE_VFORK | CLONE_THREAD)),
    Call("connect", "connect", 42, 203, Path(1), number=2),
    Call("bind", "bind", 49, 200, Path(1), number=2),
    Call("sendto", "connect", 44, 206, Path(4), number=5, when=Condition(4, "nonzero")),
    Call("shmget", "unseen", 29, 194, when=Condition(0, "nonzero")),
    Call("msgget", "unseen", 68, 186, when=Condition(0, "nonzero")),
    Call("mq_open", "unseen", 240, 180),
    Call("process_vm_readv", "unseen", 310, 270),
    Call("ptrace", "unseen", 101, 117),
    Call("pidfd_getfd", "unseen", 438, 438),
    # other ways to a file, which no filter can follow
    Call("open_by_handle_at", "unseen", 304, 265),
    Call("io_uring_setup", "unseen", 425, 425),
    # chance
    Call("getrandom", "entropy", 318, 278, number=1),
)  # fmt: skip

#: calls of 32 bits that open, look or start something; a 64-bit process that makes one is out of the ordinary
CALLS_OF_32_BITS = {
    "open": 5, "creat": 8, "execve": 11, "stat": 106, "socketcall": 102, "stat64": 195, "openat": 295,
    "getrandom": 355, "execveat": 358, "connect": 362, "openat2": 437,
}  # fmt: skip


def machine() -> str:
    """Return the processor if the table has its numbers: ``x86_64`` or ``aarch64``, of 64 bits, else an empty text."""
    name = platform.machine()
    return name if sys.platform == "linux" and name in _ARCHITECTURES and sys.maxsize > 2**32 else ""


def audit_arch(name: str) -> int:
    """Return the word with which the kernel names a processor."""
    return _ARCHITECTURES[name]


def numbers(name: str) -> dict[int, Call]:
    """Return the calls of a processor by their numbers."""
    found = {call.x86_64 if name == "x86_64" else call.aarch64: call for call in CALLS}
    return {number: call for number, call in found.items() if number >= 0}
