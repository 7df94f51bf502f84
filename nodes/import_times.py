"""Times of the imports of modules: whether a file was edited after its import is decided by these times.

Python keeps no such time, and without byte code no record of the source that it has read.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from types import ModuleType

_began: dict[str, int] = {}
_FIRST = time.time_ns()


class _Clock:
    """A finder on ``sys.meta_path`` that finds no module, and notes when the import of each module begins."""

    @staticmethod
    def find_spec(name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> None:
        _began[name] = time.time_ns()


def import_time(module: str) -> int:
    """Return the time (ns) at which the import of a module began.

    For a module that was imported before this one, return the time of the import of this module.
    """
    return _began.get(module, _FIRST)


sys.meta_path.insert(0, _Clock)
