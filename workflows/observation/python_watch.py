"""What this process itself sees of the observed call under way: its threads, its imports, and what its hooks record."""

from __future__ import annotations

import os
import threading
from typing import Protocol

from neusee.workflows.observation.kept_generators import KeptGenerators
from neusee.workflows.observation.recorded_call import Record
from neusee.workflows.observation.trusted_tasks import CHILD, TRUSTED, UNTRUSTED


class Seedable(Protocol):
    """A generator that knows whether a seed decides what it draws."""

    def is_seeded(self) -> bool:
        """Return True if it does."""


class Watch:
    """One observed call."""

    def __init__(self, kernel: bool) -> None:
        self.kernel = kernel  #: True if the kernel watches too: then it sees all that is opened, and more
        self.records: list[Record] = []
        self.draws: set[str] = set()  #: sources of chance that were asked
        self.kept = KeptGenerators()  #: generators of installed packages
        self.generators: list[Seedable] = []  #: that were made before their seed, if any, was known
        self.bodies: dict[str, str] = {}  #: file of each module of the user that was executed, by name
        self.quiet: dict[str, bool] = {}  #: files, and whether all who asked for their source or marks need no record
        self.settings: set[str] = set()  #: files that installed packages read while they were imported
        self.temporary: set[str] = set()  #: files and folders with names that chance gave
        self._threads: set[threading.Thread] = set()
        self._local = threading.local()

    def add(self, thread: threading.Thread) -> None:
        """Count a thread as one of the call."""
        self._threads.add(thread)

    def is_here(self) -> bool:
        """Return True if the current thread is one of the call."""
        return threading._active.get(threading.get_ident()) in self._threads  # type: ignore[attr-defined]

    def chance(self) -> set[str]:
        """Return the sources of chance that the call has asked, up to now."""
        unseeded = any(not each.is_seeded() for each in self.generators)
        return self.draws | ({"numpy.random.RandomState without a seed"} if unseeded else set())

    def trusted(self) -> bool:
        """Return True if the current thread imports an installed package, or searches for a module."""
        return bool(getattr(self._local, "trusted", False))

    def trust(self, trusted: bool) -> bool:
        """Trust the current thread, or no longer, and return what held before."""
        before = self.trusted()
        if before != trusted:
            self._local.trusted = trusted
            self._mark(TRUSTED if trusted else UNTRUSTED)
        return before

    def heard(self, path: str, quiet: bool) -> None:
        """Take note of who asks for the source or the marks of a file."""
        self.quiet[path] = quiet and self.quiet.get(path, True)

    def trust_child(self) -> None:
        """Trust the next child process that this process starts."""
        self._mark(CHILD)

    def _mark(self, mark: int) -> None:
        """Stop at a call that says whose the next calls are; its answer is always no."""
        if self.kernel:
            os.access("/", mark)


_current: list[Watch] = []  #: the call under way, at most one


def begin(watch: Watch) -> None:
    """Make a call the one under way."""
    _current.append(watch)


def end() -> None:
    """Say that the call under way has ended."""
    _current.clear()


def watch_here() -> Watch | None:
    """Return the observed call that the current thread belongs to, or None."""
    return _current[0] if _current and _current[0].is_here() else None
