"""Warnings of a store, each issued once: a folder that cannot be used, and results that are not read."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import ClassVar

from neusee.workflows.keys.seal import NotRead, Unsigned

_CONSEQUENCE = "the run goes on, but results are not stored, so that the next run computes them again"


class Warned:
    """Base class of `Store` with its warnings; `Store` defines the folder ``root``."""

    root: Path
    failures: ClassVar[list[str]] = []  #: the warnings of all stores of this process, for the reports of studies
    failure = ""  #: the warning after the first write that failed
    _told = False

    def report_failure(self, error: Exception, use: str = "written") -> None:
        """Warn that the folder cannot be written or read, once for each store; `failure` keeps the text for reports."""
        if not self.failure:
            self.pass_on(f"the cache {self.root} cannot be {use} ({error}): {_CONSEQUENCE}")
            warnings.warn(self.failure, stacklevel=5)

    def pass_on(self, failure: str) -> None:
        """Keep for reports the warning ``failure``, which this store or that of a worker process has issued."""
        if not self.failure:
            self.failure = failure
            self.failures.append(failure)

    def leave(self, error: NotRead) -> None:
        """Issue one warning for all results that are left alone, because they are of another format or unsigned."""
        if not self._told:
            what = "without a signature by NEUSEE_CACHE_SECRET" if isinstance(error, Unsigned) else "of another version"
            text = f"results {what} in {self.root} are not read, and count as missing"
            warnings.warn(f"{text}: `neusee cache gc` removes those that nobody used for a week", stacklevel=4)
        self._told = True
