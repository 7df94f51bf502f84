"""Observation through the kernel: a server process that answers the stopped system calls of
observed steps, and the client that starts it and exchanges messages with it.

The server is a separate process, because a native reader may hold the lock of the interpreter while
it waits for the answer. It imports only the standard library and two files of this room, so it
starts fast. It ends when its parent and all observed processes have ended: a process that a step
left running would otherwise wait at its next call for ever.

Messages of the parent: ``O`` with a process number: this process, the parent or its fork, is
observed now; ``P``: read the text at this address; ``L`` with a listener: begin a new observation;
``R``: report the records.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import fcntl
import functools
import json
import os
import select
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import neusee
from neusee.workflows.observation.system_calls import (
    MARKS,
    Call,
    Filter,
    Record,
    Task,
    TrustedTasks,
    audit_arch,
    machine,
    numbers,
    recorded,
    without_reading,
)

# --- notification server --------------------------------------------------------------------------

SECCOMP_USER_NOTIF_FLAG_CONTINUE = 1
SECCOMP_IOCTL_NOTIF_RECV, SECCOMP_IOCTL_NOTIF_SEND = 0xC0502100, 0xC0182101
SECCOMP_IOCTL_NOTIF_SET_FLAGS = 0x40082104
#: from Linux 6.6: the answer wakes the thread at once, on the same processor
SECCOMP_USER_NOTIF_FD_SYNC_WAKE_UP = 1
HEADER = 9  #: length (bytes) of a message of the parent: its kind (1) and a number (8)


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
    """The records of one observed call, in order, each once."""

    def __init__(self, process: int) -> None:
        self._calls, self._arch = numbers(machine()), audit_arch(machine())
        self._tasks = TrustedTasks(process)
        self.records: dict[Record, None] = {}  # as an ordered set

    def take(self, stopped: seccomp_notif) -> None:
        """Record a stopped system call; a call that cannot be read is recorded as unseen."""
        call = self._calls.get(stopped.data.nr) if stopped.data.arch == self._arch else None
        if call is None:
            self.records[Record("unseen", "a call of 32 bits")] = None
            return
        task, arguments = Task(stopped.pid), tuple(stopped.data.args)
        # a mark of the observed process in place of an access mode: it tells whose calls follow
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
        """Return the record of a call; None for a call of a trusted task that makes no file."""
        # `holds` returns True for a trusted task
        if not self._tasks.holds(task):
            return recorded(task, call, arguments)
        # `call.number` is the index of the argument with the flags
        if call.does == "open" and not arguments[call.number] & (os.O_CREAT | os.O_TRUNC):
            return None  # an import makes hundreds of these
        # the step may later read a file that the trusted task makes
        may_make = call.does in ("open", "openat2", "creat", "make", "move")
        return without_reading(recorded(task, call, arguments)) if may_make else None


class Server:
    """The listeners that are served, and the present observation."""

    def __init__(self, parent: socket.socket, process: int) -> None:
        self._parent, self._process = parent, process
        self._poll = select.poll()
        self._open: set[int] = set()  # file descriptors that are polled
        #: listener of the last observation; older listeners belong to threads that earlier steps
        #: left running
        self._current = -1
        self._observation = Observation(process)
        self._add(parent.fileno())

    def serve(self) -> None:
        """Serve until the parent and all observed processes have ended."""
        while self._open:
            for file, events in self._poll.poll():
                if file == self._parent.fileno():
                    self._obey()
                elif events & select.POLLIN:
                    self._answer(file)
                else:  # no thread is left whose calls this listener stops
                    self._remove(file)
                    os.close(file)

    def _add(self, file: int) -> None:
        """Poll a file descriptor: the socket of the parent, or a listener."""
        self._poll.register(file, select.POLLIN)
        self._open.add(file)

    def _remove(self, file: int) -> None:
        """Stop polling a file descriptor."""
        self._poll.unregister(file)
        self._open.discard(file)

    def _obey(self) -> None:
        """Carry out the next message of the parent; an empty message means that the parent has
        ended.
        """
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
        """Begin a new observation with a listener."""
        with contextlib.suppress(OSError):  # older kernels lack this flag and wake the thread later
            fcntl.ioctl(listener, SECCOMP_IOCTL_NOTIF_SET_FLAGS, SECCOMP_USER_NOTIF_FD_SYNC_WAKE_UP)
        self._add(listener)
        self._current, self._observation = listener, Observation(self._process)

    def _reply(self, value: object) -> None:
        """Send a value to the parent: the length as 8 bytes, and then JSON."""
        json_text = json.dumps(value).encode()
        self._parent.sendall(len(json_text).to_bytes(8, "little") + json_text)

    def _answer(self, listener: int) -> None:
        """Record a call that a listener stopped, and let the call continue."""
        call, answer = seccomp_notif(), seccomp_notif_resp()
        with contextlib.suppress(OSError):  # the thread was killed in between
            fcntl.ioctl(listener, SECCOMP_IOCTL_NOTIF_RECV, call)
            # other listeners belong to threads of earlier steps
            if listener == self._current:
                self._observation.take(call)
            answer.id, answer.flags = call.id, SECCOMP_USER_NOTIF_FLAG_CONTINUE
            fcntl.ioctl(listener, SECCOMP_IOCTL_NOTIF_SEND, answer)


def serve(descriptor: int, process: int) -> None:
    """Serve the process at the other end of a socket until that process has ended."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # such a signal is meant for the parent, whose calls must still be answered
        signal.signal(number, signal.SIG_IGN)
    Server(socket.socket(fileno=descriptor), process).serve()


# --- notification client --------------------------------------------------------------------------

# Client of the server process. The server is started once, and again after a fork or its death.


PR_SET_PTRACER = 0x59616D61
_PROBE = b"neusee: may the process that answers read this memory?"
_SCRIPT = (
    "import sys; sys.path.insert(0, sys.argv[1]); from"
    " neusee.workflows.observation.kernel_layer import serve; serve(int(sys.argv[2]),"
    " int(sys.argv[3]))"
)
#: time limit (s) for the first answer of a new server, long enough for a busy machine
_PATIENCE = 20.0


class NoServer(Exception):
    """Error if no server answers stopped calls: it could not be started, may not read this process,
    or died.
    """


class NotificationClient:
    """A running server process that answers the stopped calls of this process."""

    def __init__(self) -> None:
        """Start the server; raise `NoServer` if it does not answer or may not read the memory of
        this process.
        """
        self.process = os.getpid()
        #: True in a fork, which cannot see whether the server of its parent has ended
        self._is_of_parent = False
        self._server: subprocess.Popen[bytes] | None = None
        self._socket, server_end = socket.socketpair()
        try:
            with server_end:
                self._server = self._started(server_end)
            self._ask_for_sight(self._server.pid)
        except (OSError, ValueError) as error:
            self.close()
            raise NoServer(f"the process that watches a step did not start: {error}") from error

    def _started(self, theirs: socket.socket) -> subprocess.Popen[bytes]:
        """Start the server in its own session, so that neither Ctrl-C nor the end of a terminal
        reaches it.
        """
        package_folder = str(Path(neusee.__file__).parents[1])
        # the same interpreter, without the settings, paths and start-up files of the user
        command = [
            sys.executable,
            "-I",
            "-S",
            "-c",
            _SCRIPT,
            package_folder,
            str(theirs.fileno()),
            str(self.process),
        ]
        no_stream = subprocess.DEVNULL
        return subprocess.Popen(
            command,
            stdin=no_stream,
            stdout=no_stream,
            stderr=no_stream,
            cwd="/",
            pass_fds=[theirs.fileno()],
            start_new_session=True,
        )

    def _ask_for_sight(self, server: int) -> None:
        """Permit the server to read the memory of this process, and check that it can."""
        # needed on kernels with the Yama security module
        ctypes.CDLL(None).prctl(PR_SET_PTRACER, ctypes.c_ulong(server), 0, 0, 0)
        probe = ctypes.create_string_buffer(_PROBE)
        self._socket.settimeout(_PATIENCE)
        # the server reads the text at this address
        if self._asked(b"P", ctypes.addressof(probe)) != _PROBE.decode():
            raise ValueError("it may not read the memory of this process")
        self._socket.settimeout(None)

    def observe_here(self) -> None:
        """Let the server answer the calls of the current process; it may be a fork of the process
        that started the server, which then waits.
        """
        self._is_of_parent = self.process != os.getpid()
        self.process = os.getpid()
        # a message is one letter and a number of 8 bytes
        self._socket.sendall(b"O" + self.process.to_bytes(HEADER - 1, "little"))
        self._ask_for_sight(self.server())

    def hand_over(self, listener: int) -> None:
        """Pass a listener to the server and begin its observation; raise `NoServer` if the server
        is dead.
        """
        try:
            socket.send_fds(self._socket, [b"L".ljust(HEADER, b"\0")], [listener])
        except OSError as error:
            raise NoServer(str(error)) from error

    def records(self) -> list[Record]:
        """Return the records of the present observation; raise `NoServer` if the server is dead."""
        try:
            return [Record(*record) for record in self._asked(b"R", 0)]
        except (OSError, ValueError) as error:
            raise NoServer("the process that watches a step ended") from error

    def server(self) -> int:
        """Return the process number of the server."""
        return self._server.pid if self._server is not None else 0

    def alive(self) -> bool:
        """Return True if the server runs and serves the current process, not the process from which
        this one was forked.
        """
        if self.process != os.getpid() or self._server is None:
            return False
        return self._is_of_parent or self._server.poll() is None

    def close(self) -> None:
        """Let the server end as soon as no thread is left whose calls it answers; do not wait for
        that.
        """
        self._socket.close()
        if self._server is not None and self._server.poll() is None:
            # set, so that Popen does not warn that the process still runs
            self._server.returncode = 0

    def _asked(self, kind: bytes, number: int) -> Any:
        """Send a message and return the answer: a length as 8 bytes, and then JSON."""
        self._socket.sendall(kind + number.to_bytes(HEADER - 1, "little"))
        return json.loads(self._exactly(int.from_bytes(self._exactly(8), "little")))

    def _exactly(self, length: int) -> bytes:
        """Return the next ``length`` bytes from the server; raise `ValueError` if the server ends
        before.
        """
        received = b""
        while len(received) < length:
            chunk = self._socket.recv(length - len(received))
            if not chunk:
                raise ValueError("it ended")
            received += chunk
        return received


# --- kernel layer ---------------------------------------------------------------------------------

# Is observation through the kernel available here, and which server answers the stopped calls of
# this process?


#: the client that was started last; the list is empty or has one entry
_clients: list[NotificationClient] = []


@functools.cache
def _filter() -> Filter:
    """Return the filter for this processor, made once."""
    return Filter()


@functools.cache
def missing() -> str:
    """Return the reason why the kernel cannot observe steps here, or an empty text if it can."""
    if not machine():
        return "stopped calls need Linux on x86-64 or aarch64"
    return (
        ""
        if _filter().offered()
        else "this kernel, or the container, offers no stopped calls: Linux 5.5 or later"
    )


def client() -> NotificationClient:
    """Return the client of this process, and start it if there is none; raise `NoServer` if that
    fails.
    """
    if _clients and not _clients[-1].alive():
        _clients.pop().close()
    if not _clients:
        _clients.append(NotificationClient())
    return _clients[-1]


def begun_for_fork() -> NotificationClient | None:
    """Return the client, which a fork of this process may use too; None if the kernel observes
    nothing.
    """
    if missing():
        return None
    try:
        return client()
    except NoServer:
        return None  # the fork tries again, and reports if it is not watched


def give_up() -> None:
    """Close the client, so that the next call starts a new server: a fork may have left half an
    answer of the present one.
    """
    while _clients:
        _clients.pop().close()


def stop_here(answering: NotificationClient) -> None:
    """Stop the current thread at the system calls of the table from now on; raise `NoServer` if no
    server would answer.

    The caller ensures that nothing else runs in this thread meanwhile, such as the collection of
    garbage: until the listener is handed over, the first stopped call would wait for ever.
    """
    try:
        listener = _filter().install()
    except OSError as error:
        raise NoServer(str(error)) from error
    try:
        answering.hand_over(listener)
    finally:
        # only the server keeps the listener open: if it dies, calls fail and no thread waits
        os.close(listener)


atexit.register(give_up)
