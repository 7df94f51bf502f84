"""System calls at which an observed step is stopped: their table, the kernel filter, and the record
of each call.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import socket
import struct
import sys
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

# --- system calls ---------------------------------------------------------------------------------

# Table of the system calls at which a step is stopped: their numbers, what each one does, and which
# of its arguments matter.
#
# A call that is not in the table passes at full speed. The filter and the server process are built
# from this table.


#: what a call does; the server uses it for the record, and the judgement for the taint
Does = Literal[
    "open",
    "openat2",
    "creat",
    "check",
    "xattr",
    "xattr_open",
    "list",
    "input",
    "make",
    "remove",
    "move",
    "link",
    "exec",
    "fork",
    "connect",
    "bind",
    "entropy",
    "unseen",
]
Test = Literal["without", "nonzero", "zero"]

AT_EMPTY_PATH = 0x1000  #: flag: the call is about an open file, not about a path
#: flags of a child process that only starts a program, and of a thread
CLONE_VFORK, CLONE_THREAD = 0x4000, 0x10000
_ARCHITECTURES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}  #: AUDIT_ARCH_… of linux/audit.h
AUDIT_ARCH_I386 = 0x40000003


class Condition(NamedTuple):
    """The condition on an argument for a call to count: without the bits of ``mask``, nonzero, or
    zero.
    """

    argument: int
    test: Test
    mask: int = 0


class Path(NamedTuple):
    """Indices of the arguments with a path: its pointer, and the open folder to which a relative
    path refers (-1: the working folder).
    """

    pointer: int
    folder: int = -1


class Call(NamedTuple):
    """One system call: its number on each processor (-1 if it is missing there), and the indices of
    its arguments.
    """

    name: str
    does: Does
    x86_64: int
    aarch64: int
    path: Path | None = None
    second: Path | None = None
    #: index of the argument that is recorded unchanged, such as the flags of ``open``
    number: int = -1
    when: Condition | None = None


def _about_path(argument: int) -> Condition:
    """Return the condition that a call is about a path, given the index of the argument with its
    flags.
    """
    return Condition(argument, "without", AT_EMPTY_PATH)


CALLS = (
    # read the content of a file or a folder
    Call("open", "open", 2, -1, Path(0), number=1),
    Call("openat", "open", 257, 56, Path(1, 0), number=2),
    Call("openat2", "openat2", 437, 437, Path(1, 0), number=2),
    Call("creat", "creat", 85, -1, Path(0)),
    Call("getdents", "list", 78, -1, number=0),
    Call("getdents64", "list", 217, 61, number=0),
    Call("read", "input", 0, 63, number=0, when=Condition(0, "zero")),
    # check whether a path exists, its age and its size
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
    # calls that fail if the path does not exist
    Call("truncate", "check", 76, 45, Path(0)),
    Call("chmod", "check", 90, -1, Path(0)),
    Call("fchmodat", "check", 268, 53, Path(1, 0)),
    Call("utimensat", "check", 280, 88, Path(1, 0), when=Condition(1, "nonzero")),
    # make or remove a path. The step may read what it made itself; success or failure of the call
    # shows what existed before
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
    # other ways to access a file, which no filter can follow
    Call("open_by_handle_at", "unseen", 304, 265),
    Call("io_uring_setup", "unseen", 425, 425),
    # chance
    Call("getrandom", "entropy", 318, 278, number=1),
)  # fmt: skip

#: 32-bit calls, such as those that open or check a file, connect, or start a program; a 64-bit
#: process normally makes none
CALLS_OF_32_BITS = {
    "open": 5,
    "creat": 8,
    "execve": 11,
    "stat": 106,
    "socketcall": 102,
    "stat64": 195,
    "openat": 295,
    "getrandom": 355,
    "execveat": 358,
    "connect": 362,
    "openat2": 437,
}


def machine() -> str:
    """Return the name of the 64-bit processor, ``x86_64`` or ``aarch64``, if the table covers it,
    otherwise an empty text.
    """
    name = platform.machine()
    return (
        name if sys.platform == "linux" and name in _ARCHITECTURES and sys.maxsize > 2**32 else ""
    )


def audit_arch(name: str) -> int:
    """Return the number with which the kernel identifies a processor."""
    return _ARCHITECTURES[name]


def numbers(name: str) -> dict[int, Call]:
    """Return the calls of a processor, by their numbers."""
    calls = {call.x86_64 if name == "x86_64" else call.aarch64: call for call in CALLS}
    return {number: call for number, call in calls.items() if number >= 0}


# --- seccomp filter -------------------------------------------------------------------------------

# Kernel filter that stops a thread, and its child threads and processes, at the system calls of the
# table.
#
# The filter belongs to the thread that installs it and cannot be removed: install it in a thread
# made for it. Child threads and child processes inherit it. A stopped call waits until the process
# with the listener, a file descriptor, answers it.


PR_SET_NO_NEW_PRIVS = 38
SECCOMP_SET_MODE_FILTER, SECCOMP_GET_ACTION_AVAIL = 1, 2
SECCOMP_FILTER_FLAG_NEW_LISTENER = 1 << 3
#: from Linux 5.19: a signal does not interrupt a stopped call
SECCOMP_FILTER_FLAG_WAIT_KILLABLE_RECV = 1 << 5
SECCOMP_RET_USER_NOTIF, SECCOMP_RET_ALLOW = 0x7FC00000, 0x7FFF0000
_SECCOMP = {"x86_64": 317, "aarch64": 277}  #: number of the call that installs a filter
#: bit in the number of each call of the x32 convention, which is not in the table
_X32 = 0x40000000

#: instructions of linux/bpf_common.h
BPF_LD_W_ABS, BPF_JEQ, BPF_JGE, BPF_JSET, BPF_RET = 0x20, 0x15, 0x35, 0x45, 0x06
#: byte offsets in ``struct seccomp_data``; both processors store the lower half of an argument
#: first
_NUMBER, _ARCH, _ARGUMENTS = 0, 4, 16


class sock_filter(ctypes.Structure):
    """One instruction, as in linux/filter.h."""

    _fields_ = (
        ("code", ctypes.c_uint16),
        ("jt", ctypes.c_uint8),
        ("jf", ctypes.c_uint8),
        ("k", ctypes.c_uint32),
    )


class sock_fprog(ctypes.Structure):
    """A program of instructions, as in linux/filter.h."""

    _fields_ = (("len", ctypes.c_uint16), ("filter", ctypes.POINTER(sock_filter)))


class Step(NamedTuple):
    """One filter instruction: its code, the number of instructions to skip if its test holds and if
    not, and its operand.
    """

    code: int
    then: int
    otherwise: int
    operand: int


_STOP, _PASS = Step(BPF_RET, 0, 0, SECCOMP_RET_USER_NOTIF), Step(BPF_RET, 0, 0, SECCOMP_RET_ALLOW)


def program(name: str) -> list[Step]:
    """Return the filter instructions for a processor."""
    for_32_bits = _calls_of_32_bits() if name == "x86_64" else []
    # all calls of the x32 convention are stopped
    for_x32 = [Step(BPF_JGE, 0, 1, _X32), _STOP] if name == "x86_64" else []
    calls: list[Step] = []
    for number, call in numbers(name).items():
        calls += _call(number, call.when)
    for_64_bits = [_load(_NUMBER), *for_x32, *calls, _PASS]
    return [
        _load(_ARCH),
        # for 64-bit calls, skip the instructions for 32-bit calls and the final `_PASS`
        Step(BPF_JEQ, len(for_32_bits) + 1, 0, audit_arch(name)),
        *for_32_bits,
        _PASS,
        *for_64_bits,
    ]


def _calls_of_32_bits() -> list[Step]:
    """Return instructions that stop the 32-bit calls; for other processors they continue behind
    these.
    """
    stops: list[Step] = []
    for number in CALLS_OF_32_BITS.values():
        stops += [Step(BPF_JEQ, 0, 1, number), _STOP]
    return [Step(BPF_JEQ, 0, len(stops) + 1, AUDIT_ARCH_I386), _load(_NUMBER), *stops]


def _call(number: int, when: Condition | None) -> list[Step]:
    """Return instructions that stop the call with a number if its argument satisfies the
    condition.
    """
    inner_steps = [*_test(when), _STOP]
    # a call with another number skips the inner instructions
    return [Step(BPF_JEQ, 0, len(inner_steps), number), *inner_steps]


def _test(when: Condition | None) -> list[Step]:
    """Return instructions that let a call pass unless its argument satisfies the condition."""
    if when is None:
        return []
    # an argument has 8 bytes, of which one instruction reads 4
    load_low_half, load_high_half = (
        _load(_ARGUMENTS + 8 * when.argument),
        _load(_ARGUMENTS + 8 * when.argument + 4),
    )
    # a step is (code, instructions to skip if it holds, and if not, operand)
    if when.test == "without":
        return [load_low_half, Step(BPF_JSET, 0, 1, when.mask), _PASS]
    if when.test == "zero":
        return [load_low_half, Step(BPF_JEQ, 1, 0, 0), _PASS]
    return [load_low_half, Step(BPF_JEQ, 0, 3, 0), load_high_half, Step(BPF_JEQ, 0, 1, 0), _PASS]


def _load(place: int) -> Step:
    """Return the instruction that loads the 4 bytes at an offset in ``struct seccomp_data``."""
    return Step(BPF_LD_W_ABS, 0, 0, place)


class Filter:
    """The filter for this processor, made once and installed in each observed thread."""

    def __init__(self) -> None:
        steps = program(machine())
        self._steps = (sock_filter * len(steps))(*(sock_filter(*step) for step in steps))
        self._program = sock_fprog(len(steps), self._steps)
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._call = _SECCOMP[machine()]
        self._flags = SECCOMP_FILTER_FLAG_NEW_LISTENER | SECCOMP_FILTER_FLAG_WAIT_KILLABLE_RECV

    def install(self) -> int:
        """Install the filter in the current thread and return its listener; raise `OSError` if that
        fails.

        From then on, the thread waits at the calls of the table until a server answers the
        listener.
        """
        # the kernel requires this of a process without special rights
        if self._libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0):
            raise OSError(ctypes.get_errno(), "the thread may not give up new rights")
        listener = self._seccomp(SECCOMP_SET_MODE_FILTER, self._flags, ctypes.byref(self._program))
        if listener < 0 and ctypes.get_errno() == errno.EINVAL:  # before Linux 5.19
            self._flags = SECCOMP_FILTER_FLAG_NEW_LISTENER
            listener = self._seccomp(
                SECCOMP_SET_MODE_FILTER, self._flags, ctypes.byref(self._program)
            )
        if listener < 0:
            raise OSError(ctypes.get_errno(), f"no filter: {os.strerror(ctypes.get_errno())}")
        return listener

    def offered(self) -> bool:
        """Return True if the kernel can pass stopped calls to a listener."""
        action = ctypes.c_uint32(SECCOMP_RET_USER_NOTIF)
        return self._seccomp(SECCOMP_GET_ACTION_AVAIL, 0, ctypes.byref(action)) == 0

    def _seccomp(self, operation: int, flags: int, argument: object) -> int:
        """Call ``seccomp``, for which the C library has no function."""
        return int(self._libc.syscall(self._call, operation, flags, argument))


# --- stopped task ---------------------------------------------------------------------------------

# Thread that the kernel has stopped at a system call: its memory, its open files and its folders.
#
# The thread waits, so the arguments of its call can be read from outside, from the files of
# ``/proc``.


AT_FDCWD = -100  #: stands for the working folder instead of an open folder
_LONGEST = 4096  #: greatest length of a path (bytes): PATH_MAX


class Task:
    """One thread, by its number."""

    def __init__(self, thread: int) -> None:
        self.thread = thread

    def memory(self, address: int, length: int) -> bytes:
        """Return bytes of the memory of the thread, fewer if the memory ends before."""
        file = os.open(f"/proc/{self.thread}/mem", os.O_RDONLY | os.O_CLOEXEC)
        try:
            return os.pread(file, length, address)
        finally:
            os.close(file)

    def text(self, address: int) -> str:
        """Return the path stored at an address."""
        return os.fsdecode(self.memory(address, _LONGEST).partition(b"\0")[0])

    def link(self, name: str) -> str:
        """Return the path of an open file (``fd/3``) or of the working folder (``cwd``)."""
        return os.readlink(f"/proc/{self.thread}/{name}")

    def status(self, word: str) -> int:
        """Return a number from the status of the thread, such as ``Tgid``."""
        with open(f"/proc/{self.thread}/status", encoding="ascii", errors="replace") as lines:
            return next(int(line.split()[1]) for line in lines if line.startswith(f"{word}:"))

    def path(self, text: str, folder: int, follow: bool = True) -> str:
        """Return the real path for a text; a relative text begins at the open folder ``folder``.

        Without ``follow``, a symbolic link at the end of the path is not resolved.
        """
        if not text.startswith("/"):
            start = "cwd" if folder == AT_FDCWD else f"fd/{folder}"
            text = os.path.join(self.link(start), text)
        # these folders mean the stopped thread, not the server that reads this
        for own_folder in ("/proc/self", "/proc/thread-self"):
            if f"{text}/".startswith(f"{own_folder}/"):
                text = f"/proc/{self.thread}{text.removeprefix(own_folder)}"
        if follow:
            return os.path.realpath(text)
        # keep the last name, even if it is a link
        parent_folder, name = os.path.split(text.rstrip("/"))
        return os.path.join(os.path.realpath(parent_folder), name)


# --- recorded call --------------------------------------------------------------------------------

# Record of one access of a step, made from a stopped system call: what was done, with real paths.


class Record(NamedTuple):
    """One access of a step."""

    does: Does
    path: str  #: real path, or an address
    second: str = ""  #: second path of a call with two paths, or the family of an address
    flags: int = 0  #: of ``open``
    there: bool = True  #: the path existed before the call
    #: True if an import of an installed package, or neusee itself, made the call
    trusted: bool = False


def recorded(task: Task, call: Call, arguments: Sequence[int]) -> Record:
    """Return the record of a stopped call; raise `OSError` if its arguments cannot be read."""
    return _READ[call.does](task, call, arguments)


def without_reading(record: Record) -> Record | None:
    """Return the record of what a trusted task makes, which the step may read later; None if it
    makes nothing.
    """
    if record.does == "open" and record.flags & (os.O_CREAT | os.O_TRUNC):
        return record._replace(flags=(record.flags & ~os.O_ACCMODE) | os.O_WRONLY, trusted=True)
    return record._replace(trusted=True) if record.does in ("make", "move") else None


def _number(call: Call, arguments: Sequence[int]) -> int:
    """Return an argument that is recorded unchanged, as a positive number of 31 bits."""
    return arguments[call.number] & 0x7FFFFFFF


def _path(task: Task, place: Path | None, arguments: Sequence[int], follow: bool = True) -> str:
    """Return the real path that an argument of a call points to."""
    assert place is not None
    folder = AT_FDCWD if place.folder < 0 else _signed(arguments[place.folder])
    return task.path(task.text(arguments[place.pointer]), folder, follow)


def _signed(argument: int) -> int:
    """Return a 32-bit argument as a signed number."""
    low_half = argument & 0xFFFFFFFF
    # subtract 2^32 if the highest of the 32 bits is set
    return low_half - (low_half >> 31 << 32)


def _opened(task: Task, call: Call, arguments: Sequence[int]) -> Record:
    """Return the record of a call that opens or makes a file."""
    if call.does == "creat":
        flags = os.O_CREAT | os.O_WRONLY | os.O_TRUNC
    elif (
        call.does == "openat2"
    ):  # the pointer to a ``struct open_how``, whose first field are the flags
        flags = int(struct.unpack("Q", task.memory(arguments[call.number], 8))[0])
    else:
        flags = _number(call, arguments)
    path = _path(task, call.path, arguments)
    return Record("open", path, "", flags, os.path.lexists(path))


def _at_path(task: Task, call: Call, arguments: Sequence[int]) -> Record:
    """Return the record of a call with one path."""
    # these calls act on a link at the end of the path itself
    of_link_itself = call.does in (
        "make",
        "remove",
    )
    path = _path(task, call.path, arguments, follow=not of_link_itself)
    return Record(call.does, path, there=os.path.lexists(path))


def _two_paths(task: Task, call: Call, arguments: Sequence[int]) -> Record:
    """Return the record of a call with two paths."""
    first_path, second_path = (
        _path(task, place, arguments, follow=False) for place in (call.path, call.second)
    )
    return Record(call.does, first_path, second_path, there=os.path.lexists(first_path))


def _descriptor(task: Task, call: Call, arguments: Sequence[int]) -> Record:
    """Return the record of a call on an open file."""
    does: Does = "xattr" if call.does == "xattr_open" else call.does
    return Record(does, task.link(f"fd/{_number(call, arguments)}"))


def _address(task: Task, call: Call, arguments: Sequence[int]) -> Record:
    """Return the record of a call with the address of a socket."""
    assert call.path is not None
    address_bytes = task.memory(arguments[call.path.pointer], min(_number(call, arguments), 128))
    family = (
        struct.unpack_from("H", address_bytes)[0] if len(address_bytes) > 1 else socket.AF_UNSPEC
    )
    if family == socket.AF_UNIX:
        # the name follows the 2 bytes of the family; an abstract name begins with a zero byte
        name = os.fsdecode(address_bytes[2:].partition(b"\0")[0])
        path = task.path(name, AT_FDCWD) if name else f"@{os.fsdecode(address_bytes[3:])}"
        return Record(call.does, path, "unix")
    if family in (socket.AF_INET, socket.AF_INET6):
        # offset and length of the host in `sockaddr_in` and `sockaddr_in6`
        start, length = (4, 4) if family == socket.AF_INET else (8, 16)
        host = socket.inet_ntop(family, address_bytes[start : start + length])
        # the port, in network byte order
        return Record(
            call.does, f"{host}:{struct.unpack_from('!H', address_bytes, 2)[0]}", "internet"
        )
    # the kernel itself answers a netlink socket; a connect without a family only disconnects the
    # socket
    reaches_nothing = family in (socket.AF_UNSPEC, socket.AF_NETLINK)
    family_name = "" if reaches_nothing else "other"
    return Record(call.does, f"family {family}", family_name)


def _named(task: Task, call: Call, arguments: Sequence[int]) -> Record:
    """Return the record of a call that is described by its name alone."""
    return Record(call.does, call.name)


def _entropy(task: Task, call: Call, arguments: Sequence[int]) -> Record:
    """Return the record of a call for random bytes; ``there`` is True if the call asks for more
    than names and memory layout need.
    """
    length, flags = arguments[call.number], arguments[call.number + 1]
    return Record(
        "entropy", f"{call.name} of {length} bytes", flags=flags & 0xFF, there=length > _SMALL
    )


#: number of random bytes that Python and the C library use for names of files and places in memory,
#: which are part of no result
_SMALL = 32
_READ: dict[Does, Callable[[Task, Call, Sequence[int]], Record]] = {
    **dict.fromkeys(("open", "openat2", "creat"), _opened),
    **dict.fromkeys(("check", "xattr", "make", "remove", "exec"), _at_path),
    **dict.fromkeys(("move", "link"), _two_paths),
    **dict.fromkeys(("list", "input", "xattr_open"), _descriptor),
    **dict.fromkeys(("connect", "bind"), _address),
    **dict.fromkeys(("fork", "unseen"), _named),
    "entropy": _entropy,
}


# --- trusted tasks --------------------------------------------------------------------------------

# Threads and processes whose calls need no record, because neusee or an installed package makes
# them.
#
# The observed process reports this itself, in order with its calls: it calls ``access`` with a mode
# that does not exist, and that call is stopped.


#: marks in place of the mode of ``access``, which tell whose calls follow. The kernel refuses them.
TRUSTED, UNTRUSTED, CHILD = 0x6E650001, 0x6E650002, 0x6E650003
MARKS = (TRUSTED, UNTRUSTED, CHILD)


class TrustedTasks:
    """Threads that import an installed package, and child processes that neusee or such a thread
    starts.
    """

    def __init__(self, process: int) -> None:
        self._process = process  #: number of the observed process
        self._children = 0  #: number of child processes that neusee is about to start
        self._of_thread: dict[int, bool] = {}
        self._of_process: dict[int, bool] = {}

    def mark(self, thread: int, mark: int) -> None:
        """Process a mark that the observed process made."""
        if mark == CHILD:
            self._children += 1
        else:
            self._of_thread[thread] = mark == TRUSTED

    def holds(self, task: Task) -> bool:
        """Return True if a task is trusted, so that its calls need no record."""
        if task.thread not in self._of_thread:
            process = task.status("Tgid")
            self._of_thread[task.thread] = process != self._process and self._child(process)
        return self._of_thread[task.thread]

    def _child(self, process: int) -> bool:
        """Return True for a child process that neusee, or a trusted thread, started."""
        if process not in self._of_process:
            parent_process = Task(process).status("PPid")
            is_trusted = self._of_process.get(parent_process, False)
            if parent_process == self._process:
                is_trusted = self._children > 0 or any(self._of_thread.values())
                # one announced child has now been found
                self._children -= self._children > 0
            self._of_process[process] = is_trusted
        return self._of_process[process]
