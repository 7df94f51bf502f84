"""Filter of the kernel that stops a thread, and what the thread starts, at the system calls of the table.

The filter belongs to the thread that installs it and cannot be taken away: install it in a thread made for it. Its
threads and child processes inherit it. A stopped call waits until the listener, a file descriptor, is answered.
"""

from __future__ import annotations

import ctypes
import errno
import os
from typing import NamedTuple

from neusee.workflows.observation.system_calls import (
    AUDIT_ARCH_I386,
    CALLS_OF_32_BITS,
    Condition,
    audit_arch,
    machine,
    numbers,
)

PR_SET_NO_NEW_PRIVS = 38
SECCOMP_SET_MODE_FILTER, SECCOMP_GET_ACTION_AVAIL = 1, 2
SECCOMP_FILTER_FLAG_NEW_LISTENER = 1 << 3
SECCOMP_FILTER_FLAG_WAIT_KILLABLE_RECV = 1 << 5  #: from Linux 5.19: a signal does not cut a stopped call short
SECCOMP_RET_USER_NOTIF, SECCOMP_RET_ALLOW = 0x7FC00000, 0x7FFF0000
_SECCOMP = {"x86_64": 317, "aarch64": 277}  #: number of the call that installs a filter
_X32 = 0x40000000  #: bit of the number of a call of the x32 convention, which no table has

#: instructions of linux/bpf_common.h
BPF_LD_W_ABS, BPF_JEQ, BPF_JGE, BPF_JSET, BPF_RET = 0x20, 0x15, 0x35, 0x45, 0x06
#: places in ``struct seccomp_data``; both processors keep the lower half of an argument first
_NUMBER, _ARCH, _ARGUMENTS = 0, 4, 16


class sock_filter(ctypes.Structure):
    """One instruction, as in linux/filter.h."""

    _fields_ = (("code", ctypes.c_uint16), ("jt", ctypes.c_uint8), ("jf", ctypes.c_uint8), ("k", ctypes.c_uint32))


class sock_fprog(ctypes.Structure):
    """A program of instructions, as in linux/filter.h."""

    _fields_ = (("len", ctypes.c_uint16), ("filter", ctypes.POINTER(sock_filter)))


class Step(NamedTuple):
    """One instruction: its code, how many to skip where its test holds and where not, and its operand."""

    code: int
    then: int
    otherwise: int
    operand: int


_STOP, _PASS = Step(BPF_RET, 0, 0, SECCOMP_RET_USER_NOTIF), Step(BPF_RET, 0, 0, SECCOMP_RET_ALLOW)


def program(name: str) -> list[Step]:
    """Return the instructions of the filter for a processor."""
    of_32_bits = _calls_of_32_bits() if name == "x86_64" else []
    x32 = [Step(BPF_JGE, 0, 1, _X32), _STOP] if name == "x86_64" else []
    calls = [step for number, call in numbers(name).items() for step in _call(number, call.when)]
    usual = [_load(_NUMBER), *x32, *calls, _PASS]
    return [_load(_ARCH), Step(BPF_JEQ, len(of_32_bits) + 1, 0, audit_arch(name)), *of_32_bits, _PASS, *usual]


def _calls_of_32_bits() -> list[Step]:
    stops = [step for number in CALLS_OF_32_BITS.values() for step in (Step(BPF_JEQ, 0, 1, number), _STOP)]
    return [Step(BPF_JEQ, 0, len(stops) + 1, AUDIT_ARCH_I386), _load(_NUMBER), *stops]


def _call(number: int, when: Condition | None) -> list[Step]:
    inside = [*_test(when), _STOP]
    return [Step(BPF_JEQ, 0, len(inside), number), *inside]


def _test(when: Condition | None) -> list[Step]:
    """Return instructions that let a call pass unless its argument is what the table says."""
    if when is None:
        return []
    low, high = _load(_ARGUMENTS + 8 * when.argument), _load(_ARGUMENTS + 8 * when.argument + 4)
    if when.test == "without":
        return [low, Step(BPF_JSET, 0, 1, when.mask), _PASS]
    if when.test == "zero":
        return [low, Step(BPF_JEQ, 1, 0, 0), _PASS]
    return [low, Step(BPF_JEQ, 0, 3, 0), high, Step(BPF_JEQ, 0, 1, 0), _PASS]


def _load(place: int) -> Step:
    return Step(BPF_LD_W_ABS, 0, 0, place)


class Filter:
    """The filter of this processor, made once and installed in each observed thread."""

    def __init__(self) -> None:
        steps = program(machine())
        self._steps = (sock_filter * len(steps))(*(sock_filter(*step) for step in steps))
        self._program = sock_fprog(len(steps), self._steps)
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._call = _SECCOMP[machine()]
        self._flags = SECCOMP_FILTER_FLAG_NEW_LISTENER | SECCOMP_FILTER_FLAG_WAIT_KILLABLE_RECV

    def install(self) -> int:
        """Install the filter in the current thread and return its listener; raise `OSError` where that fails.

        From here the thread waits at the calls of the table until somebody serves the listener.
        """
        if self._libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0):
            raise OSError(ctypes.get_errno(), "the thread may not give up new rights")
        listener = self._seccomp(SECCOMP_SET_MODE_FILTER, self._flags, ctypes.byref(self._program))
        if listener < 0 and ctypes.get_errno() == errno.EINVAL:  # before Linux 5.19
            self._flags = SECCOMP_FILTER_FLAG_NEW_LISTENER
            listener = self._seccomp(SECCOMP_SET_MODE_FILTER, self._flags, ctypes.byref(self._program))
        if listener < 0:
            raise OSError(ctypes.get_errno(), f"no filter: {os.strerror(ctypes.get_errno())}")
        return listener

    def offered(self) -> bool:
        """Return True if the kernel hands stopped calls to a listener."""
        action = ctypes.c_uint32(SECCOMP_RET_USER_NOTIF)
        return self._seccomp(SECCOMP_GET_ACTION_AVAIL, 0, ctypes.byref(action)) == 0

    def _seccomp(self, operation: int, flags: int, argument: object) -> int:
        return int(self._libc.syscall(self._call, operation, flags, argument))
