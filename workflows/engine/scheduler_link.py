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
_BETWEEN = 5.0  #: s between two questions while steps are computed
_LOGGERS = ("distributed", "tornado", "tornado.application", "asyncio")


class ClusterLost(OSError):
    """Error of a run whose scheduler or workers are gone; the finished steps stay in the cache."""


class SchedulerLink:
    """What is known of a scheduler through a `distributed.Client`."""

    def __init__(self, client: Any, warn: Callable[[str], None]) -> None:
        self.client, self._warn = client, warn
        self.address = str(client.scheduler.address)
        now = time.monotonic()
        self._asked = self._workers_seen = now
        self._silent = False

    @property
    def is_up(self) -> bool:
        """Return True while the client is connected."""
        return bool(self.client.status == "running")

    def check(self) -> None:
        """Raise `ClusterLost` if the scheduler has ended, or had no worker for too long; say if it is silent."""
        client = self.client
        left = client.status == "running" and (client.scheduler_comm is None or client.scheduler_comm.closed())
        if client.status in ("closing", "closed") or left:
            raise ClusterLost(f"the scheduler {self.address} has ended, or the network to it is cut")
        if client.status == "connecting":
            self._say_silent()
        elif time.monotonic() - self._asked > _BETWEEN:
            self.workers()

    def workers(self) -> Mapping[str, int] | None:
        """Return the number of threads by address of the connected workers, or None if the scheduler does not answer.

        Raises `ClusterLost` if there was none for too long.
        """
        found: Mapping[str, int] | None = None
        with suppress(OSError, AttributeError):  # the latter while the client closes
            found = self.client.sync(self.client.scheduler.ncores, workers=None, callback_timeout=_ANSWER)
        self._asked = now = time.monotonic()
        if found or found is None:
            self._workers_seen = now
        elif now - self._workers_seen > PATIENCE:
            raise ClusterLost(f"the scheduler {self.address} has had no worker for {PATIENCE:.0f} s")
        if found is not None:
            self._silent = False
        return found

    def wait_for_workers(self) -> Mapping[str, int]:
        """Return the connected workers as soon as there is one."""
        while not (found := self.workers()):
            self.check()
            time.sleep(10 * FRESH)
        return found

    def _say_silent(self) -> None:
        if not self._silent:
            self._silent = True
            self._warn(f"the scheduler {self.address} does not answer: waiting up to {PATIENCE:.0f} s for it to return")


def connected(address: Any) -> Any:
    """Return a `distributed.Client` of a scheduler; raise `ClusterLost` if none answers there."""
    from distributed import Client

    try:
        return Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        cause = str(error.__cause__ or error).splitlines()[0]
        raise ClusterLost(f"no scheduler of dask answers at {address} within {PATIENCE:.0f} s: {cause}") from error


def close_client(client: Any) -> None:
    """Close a client, also if its scheduler is gone."""
    with suppress(Exception):
        client.close(timeout=_ANSWER)


def silence_logs() -> None:
    """Let dask and its network print nothing in this process: what a user needs to know is said in a sentence."""
    import distributed  # noqa: F401  makes its loggers, each with a handler of its own

    known = [name for name in logging.root.manager.loggerDict if name.startswith(f"{_LOGGERS[0]}.")]
    for name in (*_LOGGERS, *known):
        logger = logging.getLogger(name)
        logger.handlers[:] = [logging.NullHandler()]
        logger.propagate = False
