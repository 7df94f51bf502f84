"""Layer of the kernel: is it offered here, and which process answers the stopped calls of this one?"""

from __future__ import annotations

import atexit
import functools
import os

from neusee.workflows.observation.notification_client import NoServer, NotificationClient
from neusee.workflows.observation.seccomp_filter import Filter
from neusee.workflows.observation.system_calls import machine

_clients: list[NotificationClient] = []  #: the last one started, at most one


@functools.cache
def _filter() -> Filter:
    return Filter()


@functools.cache
def missing() -> str:
    """Return why the kernel does not watch steps here, or an empty text if it does."""
    if not machine():
        return "stopped calls need Linux on x86-64 or aarch64"
    return "" if _filter().offered() else "this kernel, or the container, offers no stopped calls: Linux 5.5 or later"


def client() -> NotificationClient:
    """Return the process that answers, started now if there is none of this process; raise `NoServer` if it fails."""
    if _clients and not _clients[-1].alive():
        _clients.pop().close()
    if not _clients:
        _clients.append(NotificationClient())
    return _clients[-1]


def begun_for_fork() -> NotificationClient | None:
    """Return the process that answers, which a fork of this one may use too; None if the kernel watches nothing."""
    if missing():
        return None
    try:
        return client()
    except NoServer:
        return None  # the fork tries again, and says that it is not watched


def give_up() -> None:
    """Start another process that answers at the next call: a fork may have left half an answer of the present one."""
    while _clients:
        _clients.pop().close()


def stop_here(answering: NotificationClient) -> None:
    """Stop the current thread at the calls of the table from now on; raise `NoServer` if nobody would answer.

    The caller makes sure that nothing else runs in this thread meanwhile, such as the collection of garbage: until the
    listener is handed over, the first stopped call would wait for ever.
    """
    try:
        listener = _filter().install()
    except OSError as error:
        raise NoServer(str(error)) from error
    try:
        answering.hand_over(listener)
    finally:
        os.close(listener)  # the server alone holds it: where the server dies, calls fail and nothing waits


atexit.register(give_up)
