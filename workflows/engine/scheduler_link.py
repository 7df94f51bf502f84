"""The link to a scheduler of dask: whether it answers, which workers it has, and when to give up.

A link that is cut for less than `PATIENCE` comes back by itself: the client connects again, and what was not told is
asked for again. Beyond it the run ends with one sentence, and what is finished stays in the cache.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from neusee.workflows.engine.memory_use import FRESH

PATIENCE = 60.0  #: s without a scheduler, or without any worker, after which a run gives up
_ANSWER = 10.0  #: s in which a scheduler answers a question
_ATTEMPT = 5.0  #: s of one attempt to connect again
_BETWEEN = 5.0  #: s between two questions while steps are computed
_LOGGERS = ("distributed", "tornado", "tornado.application", "asyncio")


class ClusterLost(OSError):
    """Error of a run whose scheduler or workers are gone; the finished steps stay in the cache."""


class SchedulerLink:
    """The connection to a scheduler through a `distributed.Client`, made anew where it was lost."""

    def __init__(self, client: Any, warn: Callable[[str], None]) -> None:
        self.client, self._warn = client, warn
        self.address = str(client.scheduler.address)
        self._asked = self._workers_seen = time.monotonic()
        self.newest: Mapping[str, int] = {}  #: the workers that the scheduler told last
        self._lost: list[Any] = []  # clients before, which futures of lost tasks still name

    def renewed(self) -> bool:
        """Return True if the connection was lost and is made anew, so that all tasks are lost.

        Raises `ClusterLost` if the scheduler does not return, or had no worker for too long.
        """
        client = self.client
        if client.status != "running" or client.scheduler_comm is None or client.scheduler_comm.closed():
            self._connect_again()
            return True
        if time.monotonic() - self._asked > _BETWEEN:
            self.workers()
        return False

    def workers(self) -> Mapping[str, int] | None:
        """Return the number of threads by address of the connected workers, or None if the scheduler does not answer.

        Raises `ClusterLost` if there was none for too long.
        """
        found: Mapping[str, int] | None = None
        with suppress(OSError, AttributeError):  # the latter while the client closes
            found = self.client.sync(self.client.scheduler.ncores, workers=None, callback_timeout=_ANSWER)
        self._asked = now = time.monotonic()
        self.newest = found or {}
        if found or found is None:
            self._workers_seen = now
        elif now - self._workers_seen > PATIENCE:
            raise ClusterLost(f"the scheduler {self.address} has had no worker for {PATIENCE:.0f} s")
        return found

    def wait_for_workers(self) -> Mapping[str, int]:
        """Return the connected workers as soon as there is one."""
        while not (found := self.workers()):
            self.renewed()
            time.sleep(10 * FRESH)
        return found

    def close(self) -> None:
        """Close the connection, and those before it."""
        for client in (self.client, *self._lost):
            with suppress(Exception):
                client.close(timeout=_ANSWER)

    def _connect_again(self) -> None:
        """Connect to the scheduler with a new client, because one that waits for a lost packet misses the return."""
        self._warn(f"the scheduler {self.address} does not answer: waiting up to {PATIENCE:.0f} s for it to return")
        self._lost.append(self.client)
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            with suppress(ClusterLost):
                self.client = connected(self.address, _ATTEMPT)
                self._workers_seen = time.monotonic()
                return
            time.sleep(10 * FRESH)
        raise ClusterLost(f"the scheduler {self.address} has ended, or the network to it is cut")


def connected(address: Any, seconds: float = PATIENCE) -> Any:
    """Return a `distributed.Client` of a scheduler; raise `ClusterLost` if none answers there."""
    from distributed import Client

    try:
        return Client(address, timeout=seconds, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ClusterLost(f"no scheduler of dask answers at {address} within {seconds:.0f} s") from error


def silence_logs() -> None:
    """Let dask and its network print nothing in this process: what a user needs to know is said in a sentence."""
    import distributed  # noqa: F401  makes its loggers, each with a handler of its own

    known = [name for name in logging.root.manager.loggerDict if name.startswith(f"{_LOGGERS[0]}.")]
    for name in (*_LOGGERS, *known):
        logger = logging.getLogger(name)
        logger.handlers[:] = [logging.NullHandler()]
        logger.propagate = False
