"""Times of the imports of modules: whether a file was edited after its import is decided by these
times.

Python keeps no such time, and without byte code no record of the source that it has read.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from types import ModuleType

#: ns by which a clock that is corrected slowly may differ from the steady one
_CLOCK_SLACK = 1_000_000_000


class Moment:
    """The moment at which it was made, as a time that what happens later has not, even if the
    clock is set back.
    """

    def __init__(self, clock: int | None = None, steady: int | None = None) -> None:
        """Take the times (ns) of both clocks at the moment, by default those of now."""
        self._clock = time.time_ns() if clock is None else clock
        self._steady = time.monotonic_ns() if steady is None else steady

    def time(self) -> int:
        """Return the time (ns) of the moment by the clock as it is set now, or as it was then if
        that is earlier.
        """
        by_now = time.time_ns() - (time.monotonic_ns() - self._steady)
        return by_now if by_now < self._clock - _CLOCK_SLACK else self._clock


_import_moments: dict[str, Moment] = {}
_THIS_IMPORT = Moment()


class _Clock:
    """A finder on ``sys.meta_path`` that finds no module, and notes when the import of each
    module begins.
    """

    @staticmethod
    def find_spec(
        name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> None:
        _import_moments[name] = Moment()


def import_time(module: str) -> int:
    """Return the time (ns) at which the import of a module began.

    For a module that was imported before this one, return the time of the import of this module.
    """
    return _import_moments.get(module, _THIS_IMPORT).time()


sys.meta_path.insert(0, _Clock)
