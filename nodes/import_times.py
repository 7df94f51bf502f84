"""Import times of modules, which show whether a file was edited after its import.

Python does not record these times, and without byte code it keeps no record of the source read.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from types import ModuleType

#: ns by which gradual corrections may shift the system clock against the monotonic clock
_CLOCK_SLACK = 1_000_000_000


class Moment:
    """The moment of its creation, as a time that later events do not precede, even if the system
    clock is set back.
    """

    def __init__(self, clock: int | None = None, steady: int | None = None) -> None:
        """Store the times (ns) of the system clock and of the monotonic clock, by default the
        present ones.
        """
        self._clock = time.time_ns() if clock is None else clock
        self._steady = time.monotonic_ns() if steady is None else steady

    def time(self) -> int:
        """Return the time (ns) of the moment by the system clock: as it was then, or by its present
        setting if it has been set back.
        """
        by_now = time.time_ns() - (time.monotonic_ns() - self._steady)
        return by_now if by_now < self._clock - _CLOCK_SLACK else self._clock


_import_moments: dict[str, Moment] = {}
_THIS_IMPORT = Moment()


class _Clock:
    """A finder on ``sys.meta_path`` that finds no module but records when the import of each module
    begins.
    """

    @staticmethod
    def find_spec(
        name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> None:
        _import_moments[name] = Moment()


def import_time(module: str) -> int:
    """Return the time (ns) at which the import of a module began.

    For a module imported before `import_times`, return the import time of `import_times`.
    """
    return _import_moments.get(module, _THIS_IMPORT).time()


sys.meta_path.insert(0, _Clock)
