"""Small process that answers the stopped system calls of observed steps and remembers what they
reached.

It is a process of its own, because a native reader may hold the lock of the interpreter while it
waits for the answer. It imports the standard library and a few files of this room alone, so it
starts fast. It ends when its parent and all that its parent observed have ended: a process that a
step left behind would wait at its next call for ever.

Messages of the parent: ``O`` with its number: this process is observed now, a fork of the parent or
the parent itself, ``P``: can you read this memory, ``L`` with a listener: a new observation begins,
``R``: report.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import json
import os
import select
import signal
import socket

from neusee.workflows.observation.system_calls import (
    MARKS,
    Call,
    Record,
    Task,
    TrustedTasks,
    audit_arch,
    machine,
    numbers,
    recorded,
    without_reading,
)

SECCOMP_USER_NOTIF_FLAG_CONTINUE = 1
SECCOMP_IOCTL_NOTIF_RECV, SECCOMP_IOCTL_NOTIF_SEND = 0xC0502100, 0xC0182101
SECCOMP_IOCTL_NOTIF_SET_FLAGS = 0x40082104
#: from Linux 6.6: the answer wakes the thread on the same processor, at once
SECCOMP_USER_NOTIF_FD_SYNC_WAKE_UP = 1
HEADER = 9  #: bytes that open a message of the parent: its kind, and a number


class seccomp_data(ctypes.Structure):
    """A system call, as in linux/seccomp.h."""

    _fields_ = (
        ("nr", ctypes.c_int32),
        ("arch", ctypes.c_uint32),
        ("instruction_pointer", ctypes.c_uint64),
        ("args", ctypes.c_uint64 * 6),
    )


class seccomp_notif(ctypes.Structure):
    """A stopped call, as in linux/seccomp.h."""

    _fields_ = (
        ("id", ctypes.c_uint64),
        ("pid", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("data", seccomp_data),
    )


class seccomp_notif_resp(ctypes.Structure):
    """The answer to a stopped call, as in linux/seccomp.h."""

    _fields_ = (
        ("id", ctypes.c_uint64),
        ("val", ctypes.c_int64),
        ("error", ctypes.c_int32),
        ("flags", ctypes.c_uint32),
    )


class Observation:
    """What one observed call reached, in order, each thing once."""

    def __init__(self, process: int) -> None:
        self._calls, self._arch = numbers(machine()), audit_arch(machine())
        self._tasks = TrustedTasks(process)
        self.records: dict[Record, None] = {}  # as an ordered set

    def take(self, stopped: seccomp_notif) -> None:
        """Record a stopped call; what cannot be read is recorded as unseen."""
        call = self._calls.get(stopped.data.nr) if stopped.data.arch == self._arch else None
        if call is None:
            self.records[Record("unseen", "a call of 32 bits")] = None
            return
        task, arguments = Task(stopped.pid), tuple(stopped.data.args)
        # a mark of the observed process, in place of the rights it asks for
        if call.does == "check" and call.number >= 0 and arguments[call.number] in MARKS:
            self._tasks.mark(task.thread, arguments[call.number])
            return
        try:
            record = self._kept(task, call, arguments)
        except (OSError, StopIteration, ValueError) as error:
            record = Record("unseen", f"{call.name}: {error}")
        if record is not None:
            self.records[record] = None

    def _kept(self, task: Task, call: Call, arguments: tuple[int, ...]) -> Record | None:
        """Return the record of a call, or None for a trusted task that only reads."""
        if not self._tasks.holds(task):
            return recorded(task, call, arguments)
        if call.does == "open" and not arguments[call.number] & (os.O_CREAT | os.O_TRUNC):
            return None  # an import makes hundreds of these
        # what it makes may be read by the step later
        may_make = call.does in ("open", "openat2", "creat", "make", "move")
        return without_reading(recorded(task, call, arguments)) if may_make else None


class Server:
    """Listeners that are served, and the observation under way."""

    def __init__(self, parent: socket.socket, process: int) -> None:
        self._parent, self._process = parent, process
        self._poll = select.poll()
        self._open: set[int] = set()  # files that are listened to
        #: listener of the last observation; older ones belong to threads that were left over
        self._current = -1
        self._observation = Observation(process)
        self._add(parent.fileno())

    def serve(self) -> None:
        """Serve until the parent and all that it observed have ended."""
        while self._open:
            for file, events in self._poll.poll():
                if file == self._parent.fileno():
                    self._obey()
                elif events & select.POLLIN:
                    self._answer(file)
                else:  # nobody is left whose calls it stops
                    self._remove(file)
                    os.close(file)

    def _add(self, file: int) -> None:
        """Listen to a file: the socket of the parent, or a listener."""
        self._poll.register(file, select.POLLIN)
        self._open.add(file)

    def _remove(self, file: int) -> None:
        """Listen to a file no longer."""
        self._poll.unregister(file)
        self._open.discard(file)

    def _obey(self) -> None:
        """Do what the next message of the parent says; without one the parent has ended."""
        try:
            message, files, _, _ = socket.recv_fds(self._parent, HEADER, 1)
        except OSError:
            message, files = b"", []
        kind = message[:1]
        if not kind:
            self._remove(self._parent.fileno())
        elif kind == b"O":
            self._process = int.from_bytes(message[1:], "little")
        elif kind == b"P":
            self._reply(Task(self._process).text(int.from_bytes(message[1:], "little")))
        elif kind == b"L":
            self._listen(files[0])
        elif kind == b"R":
            self._reply(list(self._observation.records))

    def _listen(self, listener: int) -> None:
        """Begin a new observation with its listener."""
        with contextlib.suppress(OSError):  # an older kernel wakes the thread in its own time
            fcntl.ioctl(listener, SECCOMP_IOCTL_NOTIF_SET_FLAGS, SECCOMP_USER_NOTIF_FD_SYNC_WAKE_UP)
        self._add(listener)
        self._current, self._observation = listener, Observation(self._process)

    def _reply(self, value: object) -> None:
        """Send a value to the parent: its length in 8 bytes, and JSON."""
        json_text = json.dumps(value).encode()
        self._parent.sendall(len(json_text).to_bytes(8, "little") + json_text)

    def _answer(self, listener: int) -> None:
        """Record a call that a listener stopped, and let it go on."""
        call, answer = seccomp_notif(), seccomp_notif_resp()
        with contextlib.suppress(OSError):  # the thread was killed in between
            fcntl.ioctl(listener, SECCOMP_IOCTL_NOTIF_RECV, call)
            # others belong to steps that were left behind
            if listener == self._current:
                self._observation.take(call)
            answer.id, answer.flags = call.id, SECCOMP_USER_NOTIF_FLAG_CONTINUE
            fcntl.ioctl(listener, SECCOMP_IOCTL_NOTIF_SEND, answer)


def serve(descriptor: int, process: int) -> None:
    """Serve the process at the other end of a socket until it has ended."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # meant for the parent, whose calls must still be answered
        signal.signal(number, signal.SIG_IGN)
    Server(socket.socket(fileno=descriptor), process).serve()
