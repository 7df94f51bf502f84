"""Layer of the kernel: is it offered, and which process answers the stopped calls?"""

from __future__ import annotations

import atexit
import ctypes
import functools
import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import neusee
from neusee.workflows.observation.notification_server import HEADER
from neusee.workflows.observation.system_calls import Filter, Record, machine

# --- notification client --------------------------------------------------------------------------

# The process that answers stopped calls, as its parent sees it: started once, and again after a
# fork or its death.


PR_SET_PTRACER = 0x59616D61
_PROBE = b"neusee: may the process that answers read this memory?"
_SCRIPT = (
    "import sys; sys.path.insert(0, sys.argv[1]); from"
    " neusee.workflows.observation.notification_server import serve; serve(int(sys.argv[2]),"
    " int(sys.argv[3]))"
)
#: s until a process that was just started answers, on a machine with much else to do
_PATIENCE = 20.0


class NoServer(Exception):
    """Error where no process answers stopped calls: it could not be started, may not read this
    process, or died.
    """


class NotificationClient:
    """A running process that answers the stopped calls of this process."""

    def __init__(self) -> None:
        """Start the process; raise `NoServer` if it does not answer or may not read the memory
        of this process.
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
        """Start the server in a session of its own: a Ctrl-C and the end of a terminal do not
        reach it.
        """
        package_folder = str(Path(neusee.__file__).parents[1])
        # as the interpreter is, without the settings, paths and start-up files of the user
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
        """Let the server read the memory of this process, and see that it does."""
        # where Yama asks for it
        ctypes.CDLL(None).prctl(PR_SET_PTRACER, ctypes.c_ulong(server), 0, 0, 0)
        probe = ctypes.create_string_buffer(_PROBE)
        self._socket.settimeout(_PATIENCE)
        # the server reads the text at this address
        if self._asked(b"P", ctypes.addressof(probe)) != _PROBE.decode():
            raise ValueError("it may not read the memory of this process")
        self._socket.settimeout(None)

    def observe_here(self) -> None:
        """Let the server answer for the process that calls this: a fork of that which started
        it, while that waits.
        """
        self._is_of_parent = self.process != os.getpid()
        self.process = os.getpid()
        # a message is a letter and a number of 8 bytes
        self._socket.sendall(b"O" + self.process.to_bytes(HEADER - 1, "little"))
        self._ask_for_sight(self.server())

    def hand_over(self, listener: int) -> None:
        """Let the server answer the calls of a listener, whose observation begins; raise
        `NoServer` if it is dead.
        """
        try:
            socket.send_fds(self._socket, [b"L".ljust(HEADER, b"\0")], [listener])
        except OSError as error:
            raise NoServer(str(error)) from error

    def records(self) -> list[Record]:
        """Return what was recorded since the last listener; raise `NoServer` if the server is
        dead.
        """
        try:
            return [Record(*record) for record in self._asked(b"R", 0)]
        except (OSError, ValueError) as error:
            raise NoServer("the process that watches a step ended") from error

    def server(self) -> int:
        """Return the number of the process that answers."""
        return self._server.pid if self._server is not None else 0

    def alive(self) -> bool:
        """Return True if the server is that of this process, not of the process that it was
        forked from, and runs.
        """
        if self.process != os.getpid() or self._server is None:
            return False
        return self._is_of_parent or self._server.poll() is None

    def close(self) -> None:
        """Let the server end as soon as no thread is left whose calls it answers; nobody waits
        for that.
        """
        self._socket.close()
        if self._server is not None and self._server.poll() is None:
            self._server.returncode = 0  # no status is wanted, and so no warning that it still runs

    def _asked(self, kind: bytes, number: int) -> Any:
        """Send a message and return the answer, which is a length of 8 bytes and JSON."""
        self._socket.sendall(kind + number.to_bytes(HEADER - 1, "little"))
        return json.loads(self._exactly(int.from_bytes(self._exactly(8), "little")))

    def _exactly(self, length: int) -> bytes:
        """Return the next bytes that the server sends; raise `ValueError` if it ends before."""
        received = b""
        while len(received) < length:
            chunk = self._socket.recv(length - len(received))
            if not chunk:
                raise ValueError("it ended")
            received += chunk
        return received


# --- kernel layer ---------------------------------------------------------------------------------

# Layer of the kernel: is it offered here, and which process answers the stopped calls of this one?


_clients: list[NotificationClient] = []  #: the last one started, at most one


@functools.cache
def _filter() -> Filter:
    """Return the filter of this processor, made once."""
    return Filter()


@functools.cache
def missing() -> str:
    """Return why the kernel does not watch steps here, or an empty text if it does."""
    if not machine():
        return "stopped calls need Linux on x86-64 or aarch64"
    return (
        ""
        if _filter().offered()
        else "this kernel, or the container, offers no stopped calls: Linux 5.5 or later"
    )


def client() -> NotificationClient:
    """Return the process that answers, started now if there is none of this process; raise
    `NoServer` if it fails.
    """
    if _clients and not _clients[-1].alive():
        _clients.pop().close()
    if not _clients:
        _clients.append(NotificationClient())
    return _clients[-1]


def begun_for_fork() -> NotificationClient | None:
    """Return the process that answers, which a fork of this one may use too; None if the kernel
    watches nothing.
    """
    if missing():
        return None
    try:
        return client()
    except NoServer:
        return None  # the fork tries again, and says that it is not watched


def give_up() -> None:
    """Start another process that answers at the next call: a fork may have left half an answer
    of the present one.
    """
    while _clients:
        _clients.pop().close()


def stop_here(answering: NotificationClient) -> None:
    """Stop the current thread at the calls of the table from now on; raise `NoServer` if nobody
    would answer.

    The caller makes sure that nothing else runs in this thread meanwhile, such as the collection of
    garbage: until the listener is handed over, the first stopped call would wait for ever.
    """
    try:
        listener = _filter().install()
    except OSError as error:
        raise NoServer(str(error)) from error
    try:
        answering.hand_over(listener)
    finally:
        # the server alone holds it: where the server dies, calls fail and nothing waits
        os.close(listener)


atexit.register(give_up)
